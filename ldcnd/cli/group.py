"""`ldcnd group`: several axes that start together, or walk along a path together."""

import asyncio
import sys
from collections.abc import Mapping

import click

from ldcnd.cli.connection import Target, of_options, with_target
from ldcnd.cli.main import CommandGroup
from ldcnd.cli.output import FAILED, end_as_interrupted, show_lines
from ldcnd.cli.quantities import outcome, rounded, values_of
from ldcnd.cli.sending import NAME, Sender, commanding, halted
from ldcnd.cli.typed import Finite, axis_of, number_of
from ldcnd.client.rig_client import RigClient
from ldcnd.contract.events import ReadOutcome
from ldcnd.contract.rig_commands import (
    AxisMove,
    AxisPath,
    LinePath,
    MoveTogether,
    MoveTogetherReply,
    PreviewTogether,
    WalkPath,
)


@click.group(cls=CommandGroup)
def command() -> None:
    """Move several axes that start in the same servo cycle."""


@command.command("move", context_settings={"ignore_unknown_options": True})
@click.argument("moves", nargs=-1, required=True, metavar="AXIS=POSITION...")
@click.option("--velocity", type=Finite(), help="Units a second, for each axis; the axis defaults when missing.")
@click.option("--acceleration", type=Finite(), help="Units a second squared; the axis defaults when missing.")
@click.option("--straight", is_flag=True, help="Keep to a straight line: all ramp alike and arrive together.")
@click.option("--max-deviation", type=Finite(), help="Refuse a line that would be left by more, in axis units.")
@click.option("--wait", is_flag=True, help="Return when all have ended; Ctrl-C halts them.")
@commanding
def group_move(
    sender: Sender,
    moves: tuple[str, ...],
    velocity: float | None,
    acceleration: float | None,
    *,
    straight: bool,
    max_deviation: float | None,
    wait: bool,
) -> None:
    """Start absolute moves of all members of a configured group together, or none of them: `x=10 y=20`."""
    who = {"lease": sender.lease, "client": None if sender.lease else NAME}
    wanted = _shares(moves, velocity, acceleration, who)
    path = LinePath.LINEAR if straight else LinePath.INDEPENDENT
    request = of_options(MoveTogether, moves=wanted, path=path, max_deviation=max_deviation)
    if wait:
        end_as_interrupted()

    async def work(client: RigClient) -> list[str]:
        infos = [await axis_of(client, move.axis) for move in wanted]

        async def follow(reply: MoveTogetherReply) -> list[str]:
            states = [await client.wait_for_end(each.axis, each.command_id) for each in reply.replies]
            failed = [each.axis for each, state in zip(reply.replies, states, strict=True) if state.last_error]
            for each, info, state in zip(reply.replies, infos, states, strict=True):
                ended = await client.ask(ReadOutcome(command_id=each.command_id))
                sender.target.show(state, outcome(info, ended, state))
            return failed

        reply = await client.ask(request)
        lines = [
            f"{each.axis}: accepted{values_of(each, info)}" for each, info in zip(reply.replies, infos, strict=True)
        ]
        if reply.deviation is not None:
            lines.append(f"at most {rounded(reply.deviation)} from the line")
        sender.target.show(reply, *lines)
        if not wait:
            return []
        try:
            return await follow(reply)
        except asyncio.CancelledError:
            show_lines(*[await halted(client, info) for info in infos], err=True)
            raise

    if sender.target.run(work):
        sys.exit(FAILED)


@command.command("preview", context_settings={"ignore_unknown_options": True})
@click.argument("moves", nargs=-1, required=True, metavar="AXIS=POSITION...")
@click.option("--velocity", type=Finite(), help="Units a second, for each axis; the axis defaults when missing.")
@click.option("--acceleration", type=Finite(), help="Units a second squared; the axis defaults when missing.")
@with_target
def group_preview(target: Target, moves: tuple[str, ...], velocity: float | None, acceleration: float | None) -> None:
    """Say how long a straight line of a group would take, and how far from it the axes would get; nothing moves."""
    request = of_options(PreviewTogether, moves=_shares(moves, velocity, acceleration, {}), path=LinePath.LINEAR)
    reply = target.run(lambda client: client.ask(request))
    lines = [
        f"{each.axis}: to {rounded(each.position)} at {rounded(each.velocity)} with {rounded(each.acceleration)}"
        for each in reply.shares
    ]
    lines.append(f"{rounded(reply.duration_s)} s, at most {rounded(reply.deviation or 0.0)} from the line")
    target.show(reply, *lines)


@command.command("path", context_settings={"ignore_unknown_options": True})
@click.argument("corners", nargs=-1, required=True, metavar="AXIS=P1,P2,...")
@click.option("--speed", type=Finite(), help="Along the path, in axis units a second; as fast as may be when missing.")
@click.option("--velocity", type=Finite(), help="The highest of each axis, units a second; the axis defaults.")
@click.option("--acceleration", type=Finite(), help="Likewise, units a second squared.")
@click.option("--max-deviation", type=Finite(), help="Refuse a path that would be left by more, in axis units.")
@commanding
def group_path(
    sender: Sender,
    corners: tuple[str, ...],
    speed: float | None,
    velocity: float | None,
    acceleration: float | None,
    max_deviation: float | None,
) -> None:
    """Walk all members of a configured group along a polyline, on drives with path mode: `z=20,20,0 c=0,15,0`."""
    who = {"lease": sender.lease, "client": None if sender.lease else NAME}
    moves = []
    for each in corners:
        axis, _, places = each.partition("=")
        *via, end = places.split(",")
        corner, limits = [number_of(place, each) for place in via], {"velocity": velocity, "acceleration": acceleration}
        moves.append(of_options(AxisPath, axis=axis, via=corner, position=number_of(end, each), **limits, **who))
    request = of_options(WalkPath, moves=tuple(moves), speed=speed, max_deviation=max_deviation)

    async def work(client: RigClient) -> None:
        infos = [await axis_of(client, move.axis) for move in moves]
        reply = await client.ask(request)
        lines = [
            f"{each.axis}: accepted{values_of(each, info)}" for each, info in zip(reply.replies, infos, strict=True)
        ]
        said = f"{rounded(reply.duration_s)} s, at most {rounded(reply.deviation)} from the path"
        sender.target.show(reply, *lines, f"{said}; ends within {rounded(reply.ahead_s)} s if the daemon dies")

    sender.target.run(work)


def _shares(
    moves: tuple[str, ...], velocity: float | None, acceleration: float | None, who: Mapping[str, str | None]
) -> tuple[AxisMove, ...]:
    """Return what is to be done, from `axis=position` of each axis."""
    shares = []
    for each in moves:
        axis, _, position = each.partition("=")
        limits = {"velocity": velocity, "acceleration": acceleration}
        shares.append(of_options(AxisMove, axis=axis, position=number_of(position, each), **limits, **who))
    return tuple(shares)
