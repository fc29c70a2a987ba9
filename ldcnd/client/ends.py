"""How a command has ended, as the states of its axis and its daemon tell: one wait for all who ask."""

import asyncio
from collections.abc import Awaitable, Callable
from contextlib import suppress

from ldcnd.client.rest import drive_silent, heard
from ldcnd.contract.commands import CommandReply
from ldcnd.contract.errors import OutcomeUnknown, UnknownCommand
from ldcnd.contract.events import FINAL, CommandOutcome
from ldcnd.contract.samples import LinkState, StateSample

CHECK_PERIOD_S = 0.2
"""Longest time between two queries for the outcome of a command that its axis does not name, seconds."""


async def until_ended(
    axis: str,
    command_id: str,
    state: Callable[[], StateSample | None],
    news: Callable[[], Awaitable[object]],
    outcome: Callable[[str], Awaitable[CommandOutcome]],
) -> tuple[StateSample, CommandOutcome | None]:
    """Wait until a command has ended in any way; return the state after it, and its outcome if its daemon knows it.

    The daemon is asked while no state names the command: before it has begun, and once it is over.

    Args:
        axis: its name.
        command_id: names the command.
        state: returns the last state of the axis.
        news: returns once something has come from the axis.
        outcome: queries the daemon for the outcome of a command.

    Raises:
        OutcomeUnknown: the drive stopped answering, or nothing comes from the axis any more.
    """
    while True:
        last = state()
        if last and last.link is LinkState.DOWN:
            raise drive_silent(axis)
        unnamed = last is not None and (last.command is None or last.command.command_id != command_id)
        if last and unnamed:
            try:
                ended = await outcome(command_id)
            except UnknownCommand:  # the daemon was restarted, or it is long ago
                return last, None
            if ended.status in FINAL:
                return last, ended
        # it waits for another one, perhaps for long, or the state that names it is still on its way
        with suppress(TimeoutError):
            async with asyncio.timeout(CHECK_PERIOD_S if unnamed else None):
                while state() is last:
                    await heard(axis, news)


def forgotten(reply: CommandReply) -> OutcomeUnknown:
    """Return the error for a command that its daemon does not know any more."""
    return OutcomeUnknown(
        f"axis {reply.axis}: the daemon was restarted; it has no outcome of {reply.verb}", axis=reply.axis
    )
