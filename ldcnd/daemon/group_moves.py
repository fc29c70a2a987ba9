"""Absolute moves of several axes of one line that start in the same servo cycle, or not at all."""

import asyncio
from collections.abc import Awaitable, Callable, Mapping

from ldcnd.daemon.group_member import GroupMoveRequest, Meeting
from ldcnd.daemon.rig import Rig
from ldcnd.errors import LdcndError, NotSupported
from ldcnd.model.replies import CommandReply
from ldcnd.model.requests import MoveAbsoluteRequest, Request, Verb

Execute = Callable[[str, Verb, Request], Awaitable[CommandReply]]
"""Carries out a command of an axis, with whatever the daemon asks before it does."""


async def move_together(
    rig: Rig, moves: Mapping[str, MoveAbsoluteRequest], execute: Execute
) -> tuple[CommandReply, ...]:
    """Start absolute moves of several axes together; returns once every drive has proven that it started.

    Args:
        rig: the daemon's.
        moves: by axis name; exactly the members of one configured group.
        execute: how a single command is carried out.

    Raises:
        UnknownAxis: there is no such axis.
        NotSupported: the axes are on different lines, or are no group.
        RequestRefused: a member cannot move; nothing was started.
        BusError: the line failed; `OutcomeUnknown` when a drive may have started, then all were told to stop.
    """
    lines = {bus for bus in rig.buses for name in moves if rig.axis(name) in bus.axes}
    if len(lines) != 1:
        raise NotSupported(f"axes {', '.join(moves)} are not on one line, so they cannot start together")
    (line,) = lines
    meeting = Meeting(line.network, frozenset(moves))

    async def take_part(name: str, move: MoveAbsoluteRequest) -> CommandReply | LdcndError:
        try:
            return await execute(name, Verb.MOVE_ABSOLUTE, GroupMoveRequest.of(move, meeting))
        except LdcndError as error:
            meeting.fail(error)
            return error

    async with asyncio.TaskGroup() as group:
        tasks = [group.create_task(take_part(name, move), name=f"group move {name}") for name, move in moves.items()]
    replies = []
    for task in tasks:
        result = task.result()
        if isinstance(result, LdcndError):
            raise meeting.failure or result
        replies.append(result)
    return tuple(replies)
