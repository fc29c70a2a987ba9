"""Moves of several axes that begin together, along a straight line or a path, and what they would be."""

import asyncio
from collections.abc import Awaitable, Callable, Iterable, Mapping

from ldcnd.axis.motion import AxisMotion
from ldcnd.axis.plans import MotionPlan
from ldcnd.axis.procedures.group import GroupMoveRequest, Meeting, Rendezvous, plans_on_line
from ldcnd.axis.procedures.path import PathShareRequest, SharedPath
from ldcnd.contract.commands import AxisCommand, CommandReply, MoveAbsolute
from ldcnd.contract.errors import LdcndError, MalformedRequest, NotSupported
from ldcnd.contract.rig_commands import (
    AxisShare,
    GroupMoves,
    LinePath,
    MoveTogetherReply,
    PathReply,
    PreviewTogether,
    PreviewTogetherReply,
    WalkPath,
)
from ldcnd.daemon.line import BusService
from ldcnd.daemon.rig import OwnedRig

Execute = Callable[[str, AxisCommand[CommandReply]], Awaitable[CommandReply]]
"""Carries out a command of an axis, after all checks of the daemon."""


async def move_together(
    rig: OwnedRig,
    moves: Mapping[str, MoveAbsolute],
    execute: Execute,
    *,
    straight: bool = False,
    max_deviation: float | None = None,
) -> MoveTogetherReply:
    """Start absolute moves of several axes together; returns once every drive has proven that it started.

    Args:
        rig: the daemon's.
        moves: by axis name; exactly the members of one configured group.
        execute: how a single command is carried out.
        straight: they keep to a straight line.
        max_deviation: the line is refused if they would leave it by more, in axis units.

    Raises:
        UnknownAxis: there is no such axis.
        NotSupported: the axes are on different lines, or are no group.
        RequestRefused: a member cannot move, or they would leave the line; nothing was started.
        BusError: the line failed; `OutcomeUnknown` when a drive may have started, then all were commanded to stop.
    """
    line = _line_of(rig, moves)
    meeting = Meeting(line.network, frozenset(moves), straight=straight, max_deviation=max_deviation)

    requests = {name: GroupMoveRequest.of(move, meeting) for name, move in moves.items()}
    return meeting.reply(await _all_of(requests, meeting, execute))


async def walk_path(rig: OwnedRig, command: WalkPath, execute: Execute) -> PathReply:
    """Walk axes along a polyline; returns once every drive walks.

    Raises:
        MalformedRequest: an axis is named twice, or the axes have differently many corners.
        UnknownAxis, NotSupported, RequestRefused, BusError: as `move_together`.
    """
    via = {move.axis: move.via for move in command.moves}
    if len({len(corners) for corners in via.values()}) > 1 or len(via) < len(command.moves):
        raise MalformedRequest("a path names each axis once, with equally many corners", remedy="see `via`")
    line = _line_of(rig, via)
    path = SharedPath(line.network, line.bus, frozenset(via), command.speed, command.max_deviation)
    moves = {move.axis: move.absolute() for move in command.moves}

    requests = {name: PathShareRequest.of(move, via[name], path) for name, move in moves.items()}
    return path.reply(await _all_of(requests, path, execute))


async def _all_of(
    requests: Mapping[str, AxisCommand[CommandReply]], rendezvous: Rendezvous, execute: Execute
) -> tuple[CommandReply, ...]:
    """Have each axis carry out its part; returns once all have started, and raises why none did."""

    async def take_part(name: str, request: AxisCommand[CommandReply]) -> CommandReply | LdcndError:
        try:
            return await execute(name, request)
        except LdcndError as error:
            # refused before its turn it never meets the others, who would wait for it in vain
            rendezvous.fail(error)
            return error

    async with asyncio.TaskGroup() as group:
        tasks = [
            group.create_task(take_part(name, request), name=f"{request.verb} {name}")
            for name, request in requests.items()
        ]
    replies = []
    for task in tasks:
        result = task.result()
        if isinstance(result, LdcndError):
            raise rendezvous.failure or result
        replies.append(result)
    return tuple(replies)


def preview_together(rig: OwnedRig, request: PreviewTogether) -> PreviewTogetherReply:
    """Plan moves of a group without sending anything.

    Raises:
        UnknownAxis, NotSupported, RequestRefused: as `move_together`, but for what is in the way only now.
    """
    moves = shares_of(request)
    _line_of(rig, moves)
    axes = {name: _planned(rig.axes[name].motion, move) for name, move in moves.items()}
    plans, deviation = {name: plan for name, (_, plan) in axes.items()}, None
    if request.path is LinePath.LINEAR:
        plans, deviation = plans_on_line(axes, request.max_deviation)
    shares = tuple(
        AxisShare(
            axis=name,
            position=axes[name][0].plans.shown(plan.position) or 0.0,
            velocity=plan.velocity,
            acceleration=plan.acceleration,
            duration_s=plan.duration_s or 0.0,
        )
        for name, plan in plans.items()
    )
    longest_s = max(share.duration_s for share in shares)
    return PreviewTogetherReply(shares=shares, duration_s=longest_s, deviation=deviation)


def _planned(motion: AxisMotion, move: MoveAbsolute) -> tuple[AxisMotion, MotionPlan]:
    """Return what an axis would do for its share of a group move, by itself."""
    position = motion.plans.unwrapped(move.position, move.direction)
    return motion, motion.plans.to(position, move.velocity, move.acceleration)


def shares_of(command: GroupMoves) -> dict[str, MoveAbsolute]:
    """Return the move of each axis.

    Raises:
        MalformedRequest: an axis is named twice.
    """
    moves = {move.axis: move.absolute() for move in command.moves}
    if len(moves) < len(command.moves):
        raise MalformedRequest("a group move names each axis once", remedy="send one move for each axis")
    return moves


def _line_of(rig: OwnedRig, names: Iterable[str]) -> BusService:
    """Return the line that all these axes are on.

    Raises:
        UnknownAxis, NotSupported: as `move_together`.
    """
    wanted = list(names)
    lines = {bus for bus in rig.buses for name in wanted if rig.axes[name] in bus.axes}
    if len(lines) != 1:
        raise NotSupported(f"axes {', '.join(wanted)} are not on one line, so they cannot start together")
    (line,) = lines
    return line
