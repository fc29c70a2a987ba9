"""Whether a request may still begin: its `not_after` is not past, and its sender still waits for the reply."""

from ldcnd.contract.commands import AxisCommand, CommandReply
from ldcnd.contract.errors import CommandExpired
from ldcnd.contract.rig_commands import SetIo

REPLY_S = 1.0
"""Time left for a drive's acknowledgement and the reply when a command begins; who gets none by then gives up."""
AGAIN = "send it again if it is still wanted"


def check_allowed(command: AxisCommand[CommandReply] | SetIo, of: str, now_ns: int, axis: str | None = None) -> None:
    """Refuse what comes later than its sender allows.

    Args:
        command: the request.
        of: what it is for, in words.
        now_ns: UTC in ns since 1970.
        axis: that it is for, if one.

    Raises:
        CommandExpired: its `not_after` is past.
    """
    if command.not_after is not None and now_ns > command.not_after:
        late_s = (now_ns - command.not_after) / 1e9
        raise CommandExpired(
            f"{of}: {command.verb} is {late_s:.3f} s later than its sender allows",
            axis=axis,
            value=command.not_after,
            remedy=AGAIN,
        )


def check_awaited(
    command: AxisCommand[CommandReply] | SetIo, of: str, waited_s: float, axis: str | None = None
) -> None:
    """Refuse what has waited for longer than its sender does: nobody would expect its effect any more.

    Args:
        command: the request.
        of: what it is for, in words.
        waited_s: since its arrival, seconds.
        axis: that it is for, if one.

    Raises:
        CommandExpired: its reply would come too late.
    """
    limit_s = command.answer_s - REPLY_S
    if waited_s > limit_s:
        raise CommandExpired(
            f"{of}: the turn of {command.verb} came later than its sender waits for a reply",
            axis=axis,
            value=waited_s,
            limit=limit_s,
            remedy=AGAIN,
        )
