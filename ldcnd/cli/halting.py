"""Halts of what a command has begun and does not wait for any more, with words of how each has ended."""

import asyncio
import getpass
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress

from ldcnd.cli.names import typed, whose
from ldcnd.cli.output import leaves_of, show_lines
from ldcnd.cli.quantities import outcome, place
from ldcnd.client.rig_client import RigClient
from ldcnd.contract.commands import LONGEST_NAME, Halt
from ldcnd.contract.errors import InternalError, LdcndError, OutcomeUnknown, SessionError, step
from ldcnd.contract.events import CommandStatus
from ldcnd.contract.meta import AxisInfo

HALT_TIME_S = 3.0
"""Longest wait for an axis that was told to halt, seconds."""


def _name() -> str:
    try:
        person = getpass.getuser()
    except (ImportError, KeyError, OSError):  # of a process whose user has no account, or of a system that has none
        return "ldcnd"
    return f"{person} (ldcnd)"[:LONGEST_NAME]


NAME = _name()
"""Under this name the command line is found in events unless a lease says another: who was it, is asked later."""


@asynccontextmanager
async def halting(client: RigClient, *infos: AxisInfo, leave_running: bool = False) -> AsyncIterator[asyncio.Event]:
    """Halt axes, and say so, if anything but a refusal or the outcome cuts the context short, such as Ctrl-C.

    Or say that they are left running. Yields what is to be set once the daemon has accepted something: before, a
    session that fails has begun nothing.
    """
    accepted = asyncio.Event()
    try:
        yield accepted
    except BaseException as error:
        if all(_leaves_nothing_open(each, accepted=accepted.is_set()) for each in leaves_of(error)):
            raise
        is_left = f"{'is' if accepted.is_set() else 'may be'} left running"
        names = [info.axis for info in infos]
        said = [f"{whose(client.rig)}{axis} {is_left}; {_halts(axis)}" for axis in names if leave_running]
        _say(*(said or await _halted_all(client, infos)))
        raise


def _leaves_nothing_open(error: BaseException, *, accepted: bool) -> bool:
    """Tell whether an error is a refusal, or the outcome of a command: nothing goes on moving unwatched."""
    if isinstance(error, SessionError):
        return not accepted
    return isinstance(error, LdcndError) and not isinstance(error, OutcomeUnknown | InternalError)


async def _halted_all(client: RigClient, infos: tuple[AxisInfo, ...]) -> list[str]:
    """Halt axes and return the outcome of each in words; a Ctrl-C meanwhile prints what is confirmed so far."""
    halts = {info.axis: asyncio.create_task(halted(client, info), name=f"halt {info.axis}") for info in infos}
    under_way = f"told to halt, and not confirmed at rest yet; it is waited for, {HALT_TIME_S:g} s at most"
    while not all(halt.done() for halt in halts.values()):
        try:
            await asyncio.wait(halts.values())
        except asyncio.CancelledError:  # takes no halt away
            _say(*(h.result() if h.done() else f"{whose(client.rig)}{axis}: {under_way}" for axis, h in halts.items()))
    return [halt.result() for halt in halts.values()]


async def halted(client: RigClient, info: AxisInfo) -> str:
    """Halt an axis and wait until it is at rest; return the outcome in words."""
    try:
        async with asyncio.timeout(HALT_TIME_S):
            reply = await client.command(info.axis, Halt(client=NAME), HALT_TIME_S)
            state, ended = await client.end_of(reply)
            position = await client.position(info.axis)
    except (TimeoutError, LdcndError) as error:
        why = str(error) or "it still moves"
        stops = f"`{typed(step('stop'), None)}` stops every axis"
        return f"{whose(client.rig)}{info.axis}: NOT confirmed at rest: {why}; {stops}"
    if ended.status is not CommandStatus.DONE:
        return f"{whose(client.rig)}{outcome(info, ended, state)}"
    at = f" at {place(position, info, state)}" if position else ""
    return f"{whose(client.rig)}{info.axis}: halted{at}"


def _halts(axis: str) -> str:
    return f"`{typed(step('halt'), axis)}` halts it"


def _say(*lines: str) -> None:
    with suppress(OSError):  # the terminal may be what has gone
        show_lines(*lines, err=True)
