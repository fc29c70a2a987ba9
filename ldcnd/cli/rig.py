"""Commands for a whole rig: stop, reset, power and the speed override."""

import sys

import click

from ldcnd.cli.connection import AXIS, Target, with_target
from ldcnd.cli.output import FAILED, UNREACHABLE, show_error, show_lines
from ldcnd.cli.sending import NAME, Sender, commanding
from ldcnd.contract.commands import Power, Reset
from ldcnd.contract.errors import LdcndError, SessionError, UnknownAxis


def stop_rig(target: Target, axis: str | None) -> None:
    """Stop one axis or all, on every rig that can be reached or the one named; say which drives have confirmed it."""
    replies = target.run_on_each(lambda client: client.stop(axis, client=NAME))
    # of several rigs most have no axis of this name
    concerned = {rig: reply for rig, reply in replies.items() if not isinstance(reply, UnknownAxis)} or replies
    codes = set[int]()
    for rig, reply in concerned.items():
        whose = f"{rig}: " if len(replies) > 1 else ""
        if isinstance(reply, LdcndError):
            codes.add(UNREACHABLE if isinstance(reply, SessionError) else FAILED)
            show_error(reply, f"{whose}NOT stopped, use the emergency stop: ")
            continue
        unconfirmed = sorted(set(reply.axes) - set(reply.confirmed))
        target.show(reply, f"{whose}stopped and latched: {', '.join(reply.confirmed) or 'none'}", rig=rig)
        if unconfirmed:
            codes.add(FAILED)
            names = ", ".join(unconfirmed)
            show_lines(
                f"{whose}NOT confirmed: {names}; the latch holds, look at the machine, use its emergency stop", err=True
            )
    if codes:
        sys.exit(min(codes))


@click.command()
@click.argument("axis", type=AXIS, required=False)
@with_target
def stop(target: Target, axis: str | None) -> None:
    """Stop AXIS, or every axis, and latch: nothing moves again before `ldcnd reset`.

    Without --rig it stops on every rig that can be reached. It needs no lease and works in any state. It is no
    emergency stop. The exit code is 0 only when all drives have confirmed it.
    """
    stop_rig(target, axis)


@click.command()
@click.argument("axes", type=AXIS, nargs=-1, metavar="[AXIS]...")
@commanding
def reset(sender: Sender, axes: tuple[str, ...]) -> None:
    """Clear stop latches and faults of each AXIS, or of all axes; nothing moves."""
    sender.send_to_all(axes, Reset())


@click.command()
@click.argument("switch", type=click.Choice(["on", "off"]))
@click.argument("axes", type=AXIS, nargs=-1, metavar="[AXIS]...")
@commanding
def power(sender: Sender, switch: str, axes: tuple[str, ...]) -> None:
    """Close (on) or open (off) the position loops of each AXIS, or of all axes; nothing moves."""
    sender.send_to_all(axes, Power(on=switch == "on"))
