"""Commands for a whole rig: stop, reset and power, several axes at once, and who controls what."""

import asyncio
import os
import shlex
import sys
from collections.abc import Mapping

import click

from ldcnd.cli.connection import AXIS, Target, of_options, with_target
from ldcnd.cli.ending import end_as_interrupted
from ldcnd.cli.output import FAILED, show_lines
from ldcnd.cli.quantities import outcome, rounded, values_of
from ldcnd.cli.sending import NAME, Sender, commanding, halted
from ldcnd.cli.typed import Finite, axis_of
from ldcnd.client.lease import control
from ldcnd.client.rig_client import RigClient
from ldcnd.errors import LeaseExpired
from ldcnd.model.commands import Power, Reset, StopReply
from ldcnd.model.events import ReadOutcome
from ldcnd.model.rig_commands import (
    AxisMove,
    AxisPath,
    LinePath,
    ListHolders,
    MoveTogether,
    MoveTogetherReply,
    PreviewTogether,
    SetSpeedOverride,
    WalkPath,
)

GROUP_TIME_S = 10.0


def stop_rig(target: Target, axis: str | None) -> None:
    """Stop one axis or all, and say which drives have confirmed it."""

    async def work(client: RigClient) -> StopReply:
        return await client.stop(axis, client=NAME)

    # a rig that is named is not searched for first: the stop is what reaches it first
    rig = target.rig
    reply = target.run_session(lambda session: work(RigClient(session, rig))) if rig else target.run(work)
    unconfirmed = sorted(set(reply.axes) - set(reply.confirmed))
    target.show(reply, f"stopped and latched: {', '.join(reply.confirmed) or 'none'}")
    if unconfirmed:
        show_lines(
            f"NOT confirmed: {', '.join(unconfirmed)}; the latch holds, look at the machine, use its emergency stop",
            err=True,
        )
        sys.exit(FAILED)


@click.command()
@click.argument("axis", type=AXIS, required=False)
@with_target
def stop(target: Target, axis: str | None) -> None:
    """Stop AXIS, or every axis of the rig, and latch: nothing moves again before `ldcnd reset`.

    It needs no lease and works in any state. It is no emergency stop.
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


@click.command()
@click.argument("percent", type=Finite(0, 100), required=False)
@commanding
def speed(sender: Sender, percent: float | None) -> None:
    """Set the speed override of the rig to PERCENT of every velocity; without PERCENT show it.

    At 0 what moves is halted and nothing begins. Raising it needs control of the axes where moving them would.
    """

    async def shown(client: RigClient) -> str:
        states = [await client.state(info.axis) for info in await client.axes()]
        return ", ".join(sorted({f"{rounded(state.speed_override)} %" for state in states if state}))

    if percent is None:
        show_lines(sender.target.run(shown))
        return
    leases = (sender.lease,) if sender.lease else ()
    request = of_options(SetSpeedOverride, percent=percent, leases=leases, client=None if sender.lease else NAME)
    reply = sender.target.run(lambda client: client.ask(request))
    told = [f"{axis}: goes on at another speed" for axis in reply.changed] + [
        f"{axis}: halted" for axis in reply.halted
    ]
    sender.target.show(reply, f"speed override {rounded(reply.percent)} %", *told)


@click.group()
def group() -> None:
    """Move several axes that start in the same servo cycle."""


@group.command("move", context_settings={"ignore_unknown_options": True})
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

        reply = await client.ask(request, timeout_s=GROUP_TIME_S)
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


@group.command("preview", context_settings={"ignore_unknown_options": True})
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


@group.command("path", context_settings={"ignore_unknown_options": True})
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
        values = {"axis": axis, "via": via, "position": end, "velocity": velocity, "acceleration": acceleration}
        moves.append(of_options(AxisPath, **values, **who))
    request = of_options(WalkPath, moves=tuple(moves), speed=speed, max_deviation=max_deviation)

    async def work(client: RigClient) -> None:
        infos = [await axis_of(client, move.axis) for move in moves]
        reply = await client.ask(request, timeout_s=GROUP_TIME_S)
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
        values = {"axis": axis, "position": position, "velocity": velocity, "acceleration": acceleration}
        shares.append(of_options(AxisMove, **values, **who))
    return tuple(shares)


@click.group()
def lease() -> None:
    """See who controls which axis, and take control."""


@lease.command("list")
@with_target
def list_holders(target: Target) -> None:
    """Show who controls each axis."""
    reply = target.run(lambda client: client.ask(ListHolders()))
    needed = "a motion needs control" if reply.required else "an axis that is not controlled is open to all"
    lines = [f"{each.axis:8} {each.client or 'not controlled'}" for each in reply.holders]
    target.show(reply, *lines, f"({needed})")


@lease.command(context_settings={"allow_interspersed_args": False})
@click.option("--axis", "axes", type=AXIS, multiple=True, help="This axis; may be repeated. All axes when missing.")
@click.option("--name", default=NAME, show_default=True, help="Who holds it, for people.")
@click.option(
    "--seconds",
    "lease_s",
    type=Finite(0.2, 60),
    default=2.0,
    show_default=True,
    help="The daemon applies `loss.client` so soon when this program disappears.",
)
@click.option("--force", is_flag=True, help="Take control from its holder.")
@click.argument("program", nargs=-1, metavar="[-- PROGRAM...]")
@with_target
def hold(
    target: Target, axes: tuple[str, ...], name: str, lease_s: float, program: tuple[str, ...], *, force: bool
) -> None:
    """Hold control until Ctrl-C, or for as long as PROGRAM runs.

    The lease is printed, and in $LDCND_LEASE of PROGRAM, where all commands of ldcnd find it.
    """

    async def work(client: RigClient) -> int:
        for axis in axes:
            await axis_of(client, axis)
        async with control(client, name, *axes, lease_s=lease_s, force=force) as held:
            if program:
                environment = {**os.environ, "LDCND_LEASE": held.lease.lease}
                running = await asyncio.create_subprocess_exec(*program, env=environment)
                return await running.wait()
            target.show(held.lease, f"{held.lease.lease}  controls {', '.join(held.lease.axes)}; Ctrl-C releases it")
            await held.over.wait()
            why = f": {held.lost.message}" if held.lost else ""
            raise LeaseExpired(f"control is lost{why}", remedy="hold it again")

    try:
        code = target.run(work)
    except FileNotFoundError as error:
        raise click.UsageError(f"{shlex.join(program)}: {error.strerror}") from error
    sys.exit(code)
