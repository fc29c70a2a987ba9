"""Commands for a whole rig: stop, reset, power, speed override, control, moves of groups, and rehearsals of a loss."""

import asyncio
import json
import os
import shlex
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import TypeVar

import click

from ldcnd.cli.connection import AXIS, Target, of_options, with_target
from ldcnd.cli.halting import NAME, halting
from ldcnd.cli.main import CommandGroup
from ldcnd.cli.names import whose
from ldcnd.cli.nearest import Typed, naming_nearest
from ldcnd.cli.output import FAILED, UNREACHABLE, end_as_interrupted, show_error, show_lines
from ldcnd.cli.quantities import outcome, rounded, values_of
from ldcnd.cli.sending import Sender, Shown, commanding, derived_for_all, derived_question
from ldcnd.cli.there import axis_of
from ldcnd.cli.typed import Finite, Quantity, TypedNumber, in_units, number_of, reads_as_one
from ldcnd.client.lease import acquire, control
from ldcnd.client.rig_client import RigClient
from ldcnd.contract.commands import CommandReply, MoveVelocity, Power, Reset
from ldcnd.contract.condition import assess
from ldcnd.contract.errors import LdcndError, LeaseExpired, OutcomeUnknown, SessionError, UnknownAxis, WrongState
from ldcnd.contract.events import CommandStatus
from ldcnd.contract.frozen import Frozen
from ldcnd.contract.leases import HolderList, ListHolders
from ldcnd.contract.meta import AxisInfo
from ldcnd.contract.rig_commands import (
    AxisMove,
    AxisPath,
    LinePath,
    MoveTogether,
    MoveTogetherReply,
    PreviewTogether,
    PreviewTogetherReply,
    Rehearse,
    Reload,
    SetSpeedOverride,
    SpeedOverrideReply,
    WalkPath,
)
from ldcnd.contract.samples import AxisState, StateSample, TelemetryItem
from ldcnd.contract.units import Dimension, quantity_text

GroupT = TypeVar("GroupT", bound=Frozen)
NOT_STOPPED = "NOT stopped, use the emergency stop: "


def stop_rig(target: Target, axis: str | None) -> None:
    """Stop one axis or all, on every rig that can be reached or the one named; say which drives have confirmed it."""
    try:
        replies = target.run_on_each(lambda client: client.stop(axis, client=NAME))
    except SessionError as error:
        show_error(error, NOT_STOPPED)
        sys.exit(UNREACHABLE)
    # of several rigs most have no axis of this name
    concerned = {rig: reply for rig, reply in replies.items() if not isinstance(reply, UnknownAxis)} or replies
    codes = set[int]()
    for rig, reply in concerned.items():
        whose = f"{rig}: "  # also of one: another rig, at another endpoint, has not been stopped
        if isinstance(reply, LdcndError):
            codes.add(UNREACHABLE if isinstance(reply, SessionError) else FAILED)
            show_error(reply, f"{whose}{NOT_STOPPED}")
            continue
        target.show(reply, *([f"{whose}{reply.outcome}"] if reply.outcome else []), rig=rig)
        for remark in filter(None, (reply.unreached, reply.warning)):
            show_lines(f"{whose}{remark}", err=True)
        if reply.shortfall:
            codes.add(FAILED)
            show_lines(f"{whose}{reply.shortfall}", err=True)
    if codes:
        sys.exit(min(codes))


@click.command()
@click.argument("axis", type=AXIS, required=False)
@with_target
def stop(target: Target, axis: str | None) -> None:
    """Stop AXIS, or every axis, and latch: nothing moves again before `ldcnd reset`.

    Without --rig it stops on every rig that this endpoint reaches, and names them. It needs no lease and works in any
    state. It is no emergency stop. The exit code is 0 only when all drives that take
    a stop have confirmed it, and the others (SmartStep) stood when they were read last.
    """
    stop_rig(target, axis)


reset = derived_for_all("reset", Reset)
power = derived_for_all("power", Power, "on")


@click.command()
@click.argument("percent", type=Finite(0, 100), required=False)
@commanding
def speed(sender: Sender, percent: float | None) -> None:
    """Set the speed override of the rig to PERCENT of every velocity; without PERCENT show it.

    At 0 what moves is halted and nothing begins: without --rig on every rig that this endpoint reaches. The exit code
    is 0 only when their drives have confirmed it. Raising it needs control of the axes where moving them would.
    """

    async def shown(client: RigClient) -> str:
        states = [await client.state(info.axis) for info in await client.axes()]
        return ", ".join(sorted({f"{rounded(state.speed_override)} %" for state in states if state}))

    if percent is None:
        show_lines(sender.target.run(shown))
        return
    leases = (sender.lease,) if sender.lease else ()
    request = of_options(SetSpeedOverride, percent=percent, leases=leases, client=None if sender.lease else NAME)

    async def ask(client: RigClient) -> dict[str, SpeedOverrideReply]:
        return {client.rig: await client.ask(request)}

    target, codes = sender.target, set[int]()
    # a halt goes to every rig unless one is named
    made = target.run_on_each(ask) if request.takes_energy_out else target.run(ask)
    replies = {rig: each[rig] if isinstance(each, dict) else each for rig, each in made.items()}
    for rig, reply in replies.items():
        if isinstance(reply, LdcndError):
            codes.add(UNREACHABLE if isinstance(reply, SessionError) else FAILED)
            show_error(reply, f"{whose(rig, len(replies))}{NOT_STOPPED}")
            continue
        changed = [f"{axis}: goes on at another speed" for axis in reply.changed]
        kept = [f"{axis}: goes on at the speed with which it began" for axis in reply.unchanged]
        halted = [f"{axis}: halted" for axis in reply.confirmed]
        told = [f"speed override {rounded(reply.percent)} %", *changed, *kept, *halted]
        target.show(reply, *(f"{whose(rig, len(replies))}{line}" for line in told), rig=rig)
        if reply.shortfall:
            codes.add(FAILED)
            show_lines(f"{whose(rig, len(replies))}{reply.shortfall}", err=True)
    if codes:
        sys.exit(min(codes))


@click.command()
@click.option("--dry-run", is_flag=True, help="Show what would change, and change nothing.")
@click.option("--yes", is_flag=True, help="Do not ask for confirmation.")
@commanding
def reload(sender: Sender, *, dry_run: bool, yes: bool) -> None:
    """Have the daemon read its configuration again: limits, default speeds, settling, rates and priorities.

    What would change is shown first. A key that needs a restart of the daemon is named, and stays as it is. An axis
    that another client controls keeps its settings, and is named.
    """
    target = sender.target
    leases = (sender.lease,) if sender.lease else ()
    shown = target.run(lambda client: client.ask(Reload(dry_run=True, leases=leases)))
    if dry_run or not any(each.taken for each in shown.changes):
        target.show(shown, *shown.lines())
        return
    if not yes:
        show_lines(*shown.lines(), err=True)
        if not click.confirm("Reload", err=True):
            raise click.Abort
    request = Reload(revision=shown.revision, leases=leases)
    reply = target.run(lambda client: client.ask(request))
    target.show(reply, *reply.lines())


@click.group(cls=CommandGroup)
def lease() -> None:
    """See who controls which axis, and take control."""


def _holders(reply: HolderList, _axis: AxisInfo | None) -> Shown:
    needed = "a motion needs control" if reply.required else "an axis that is not controlled is open to all"
    lines = [f"{each.axis:8} {each.client or 'not controlled'}" for each in reply.holders]
    yield reply, [*lines, f"({needed})"]


lease.add_command(derived_question("list", ListHolders, shows=_holders))


@lease.command(context_settings={"allow_interspersed_args": False})
@click.option("--axis", "axes", type=AXIS, multiple=True, help="This axis; may be repeated. All axes when missing.")
@click.option("--name", default=NAME, show_default="you", help="Who holds it, for people.")
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


RUN_UP_S = 0.5
"""Time in motion before the loss, seconds."""
PATIENCE_S = 30.0


@click.command()
@click.argument("loss", type=click.Choice(["client-loss", "bus-loss", "daemon-stop"]))
@click.argument("axis", type=AXIS)
@click.option("--velocity", type=Quantity(), required=True, help="Units a second, signed.")
@click.option("--lease", "lease_s", type=Finite(), default=1.0, show_default=True, help="For client-loss, seconds.")
@click.confirmation_option("--yes", prompt="The axis will move. Go on?")
@with_target
def drill(target: Target, loss: str, axis: str, velocity: float, lease_s: float) -> None:
    """Jog AXIS, rehearse a loss, and report how long until the axis reacts and until it is at rest.

    client-loss takes control and disappears; bus-loss has the daemon drop the line and open it again; daemon-stop has
    it apply `loss.daemon` as at its shutdown, without ending.
    """

    async def work(client: RigClient) -> dict[str, float]:
        info = await axis_of(client, axis)
        request = in_units(of_options(MoveVelocity, velocity=velocity), {"velocity": velocity}, info)
        if loss == "client-loss":
            return await _lose_client(client, info, request, lease_s)
        return await _rehearse(client, info, request, loss.replace("-", "_"))

    end_as_interrupted()
    _report(target, axis, loss.replace("-", " "), target.run(work))


async def _lose_client(client: RigClient, info: AxisInfo, request: MoveVelocity, lease_s: float) -> dict[str, float]:
    """Move an axis under a lease that is not renewed."""
    axis = info.axis
    if client.lease:
        raise WrongState(
            f"axis {axis}: `ldcnd lease hold`, which runs this, goes on renewing its lease: no client is lost",
            axis=axis,
            remedy="run it outside",
        )
    held = await acquire(client, "drill", (axis,), lease_s)
    lease, began_s = held.lease.lease, asyncio.get_running_loop().time()
    try:
        async with halting(client, info) as accepted:
            accepted.set()  # who has control is heard: what it sends may be carried out
            await client.command(axis, Power(on=True, lease=lease))
            await client.command(axis, request.model_copy(update={"lease": lease}))
            reacted_s, stands_s = await _watch(client, axis, lease_s + PATIENCE_S)
    except BaseException:  # what is cut short leaves no lease behind that keeps others from the axis
        await held.release()
        raise
    return {
        "lease_s": lease_s,
        "reacted_after_lease_s": reacted_s - began_s - lease_s,
        "stands_after_lease_s": stands_s - began_s - lease_s,
    }


async def _rehearse(client: RigClient, info: AxisInfo, request: MoveVelocity, kind: str) -> dict[str, float]:
    """Play a loss under control of the whole rig: a lost line concerns all axes on it."""
    axis, loop = info.axis, asyncio.get_running_loop()
    async with control(client, "drill", lease_s=PATIENCE_S) as held, halting(client, info) as accepted:
        accepted.set()  # as above
        await held.command(axis, Power(on=True))
        await held.command(axis, request)
        await asyncio.sleep(RUN_UP_S)
        began_s = loop.time()
        loss = Rehearse.model_validate({"kind": kind, "axis": axis, "lease": held.lease.lease})
        await client.ask(loss, timeout_s=PATIENCE_S)
        answered_s = loop.time()
        reacted_s, stands_s = await _watch(client, axis, PATIENCE_S)
    return {
        "carried_out_s": answered_s - began_s,
        "reacted_s": reacted_s - began_s,
        "stands_s": stands_s - began_s,
    }


async def _watch(client: RigClient, axis: str, within_s: float) -> tuple[float, float]:
    """Return when the axis began to come to rest, and when it stood, in loop time.

    Raises:
        OutcomeUnknown: it did neither in time.
    """
    loop = asyncio.get_running_loop()
    reacted_s = None
    with suppress(TimeoutError):
        async with client.samples(axis, TelemetryItem.STATE) as states, asyncio.timeout(within_s):
            async for _, state in states:
                if not isinstance(state, StateSample) or state.state is AxisState.CONTINUOUS_MOTION:
                    continue
                reacted_s = reacted_s or loop.time()
                if state.state is not AxisState.STOPPING:
                    return reacted_s, loop.time()
    raise OutcomeUnknown(f"axis {axis}: it was not seen to come to rest within {within_s:g} s", axis=axis)


def _report(target: Target, axis: str, what: str, measured: dict[str, float]) -> None:
    if target.as_json:
        print(json.dumps({"axis": axis, "drill": what, **{name: round(value, 4) for name, value in measured.items()}}))
        return
    print(f"{axis}: {what}")
    for name, value in measured.items():
        print(f"  {name.removesuffix('_s').replace('_', ' '):24} {value:8.3f} s")


@click.group(cls=CommandGroup)
def group() -> None:
    """Move several axes that start in the same servo cycle."""


@group.command("move", context_settings={"ignore_unknown_options": True})
@click.argument("moves", nargs=-1, required=True, metavar="AXIS=POSITION...")
@click.option("--velocity", type=Quantity(), help="Units a second, for each axis; the axis defaults when missing.")
@click.option("--acceleration", type=Quantity(), help="Units a second squared; the axis defaults when missing.")
@click.option("--straight", is_flag=True, help="Keep to a straight line: all ramp alike and arrive together.")
@click.option("--max-deviation", type=Quantity(), help="Refuse a line that would be left by more, in axis units.")
@click.option("--wait", is_flag=True, help="Return when all have ended; Ctrl-C halts them.")
@click.option("--dry-run", is_flag=True, help="Show how each would move, and for how long; move none.")
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
    dry_run: bool,
) -> None:
    """Start absolute moves of all members of a configured group together, or none of them: `x=10 y=20`."""
    # a preview needs no lease
    who = {} if dry_run else {"lease": sender.lease, "client": None if sender.lease else NAME}
    wanted = _shares(moves, velocity, acceleration, who)
    path = LinePath.LINEAR if straight else LinePath.INDEPENDENT
    moved = tuple(move for move, _ in wanted)
    if dry_run:
        asked = of_options(PreviewTogether, moves=moved, path=path, max_deviation=max_deviation)
        _preview(sender.target, asked, wanted, {"max_deviation": max_deviation})
        return
    request = of_options(MoveTogether, moves=moved, path=path, max_deviation=max_deviation)
    if wait:
        end_as_interrupted()

    async def work(client: RigClient) -> list[str]:
        converted, infos = await _in_units(client, request, wanted, {"max_deviation": max_deviation})

        async def follow(reply: MoveTogetherReply) -> list[str]:
            async with asyncio.TaskGroup() as waits:  # one axis that gets out of sight ends the wait for all
                ends = [waits.create_task(client.end_of(each), name=f"end of {each.axis}") for each in reply.replies]
            failed = list[str]()
            for info, end in zip(infos, ends, strict=True):
                state, ended = end.result()
                sender.show_end(state, ended, f"{whose(client.rig)}{outcome(info, ended, state)}")
                failed += [info.axis] if ended.status is not CommandStatus.DONE else []
            return failed

        async with halting(client, *infos, leave_running=not wait) as accepted:
            found = await client.states()
            with naming_nearest(*_typed(converted, wanted, infos)):
                reply = await client.ask(converted)
            accepted.set()
            lines = _accepted(client, reply.replies, infos, found)
            if reply.deviation is not None:
                lines.append(f"at most {rounded(reply.deviation)} from the line")
            sender.target.show(reply, *lines)
            return await follow(reply) if wait else []

    if sender.target.run(work):
        sys.exit(FAILED)


def _preview(
    target: Target,
    request: PreviewTogether,
    wanted: list[tuple[AxisMove, Mapping[str, object]]],
    given: Mapping[str, object],
) -> None:
    """Show what a move of a group would be like; nothing moves."""

    async def work(client: RigClient) -> tuple[PreviewTogetherReply, list[AxisInfo]]:
        converted, infos = await _in_units(client, request, wanted, given)
        with naming_nearest(*_typed(converted, wanted, infos)):
            return await client.ask(converted), infos

    reply, infos = target.run(work)
    lines = [
        f"{each.axis}: to {rounded(each.position)} at {quantity_text(each.velocity, info, Dimension.VELOCITY)}"
        f" with {quantity_text(each.acceleration, info, Dimension.ACCELERATION)}"
        for each, info in zip(reply.shares, infos, strict=True)
    ]
    off = "" if reply.deviation is None else f", at most {rounded(reply.deviation)} from the line"
    lines.append(f"{rounded(reply.duration_s)} s{off}")
    target.show(reply, *lines)


@group.command("path", context_settings={"ignore_unknown_options": True})
@click.argument("corners", nargs=-1, required=True, metavar="AXIS=P1,P2,...")
@click.option("--speed", type=Quantity(), help="Along the path, axis units a second; as fast as may be when missing.")
@click.option("--velocity", type=Quantity(), help="The highest of each axis, units a second; the axis defaults.")
@click.option("--acceleration", type=Quantity(), help="Likewise, units a second squared.")
@click.option("--max-deviation", type=Quantity(), help="Refuse a path that would be left by more, in axis units.")
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
    wanted = []
    for each in corners:
        axis, _, places = each.partition("=")
        if reads_as_one(places):
            one, two = places.replace(",", "."), places.replace(",", ".0,")
            raise click.UsageError(f"{each!r} can mean one place or two: type {axis}={one} or {axis}={two}")
        *via, end = (number_of(place, each) for place in places.split(","))
        given = {"via": tuple(via), "position": end, "velocity": velocity, "acceleration": acceleration}
        wanted.append((of_options(AxisPath, axis=axis, **given, **who), given))
    bounds = {"speed": speed, "max_deviation": max_deviation}
    request = of_options(WalkPath, moves=tuple(move for move, _ in wanted), **bounds)

    async def work(client: RigClient) -> None:
        converted, infos = await _in_units(client, request, wanted, bounds)
        async with halting(client, *infos, leave_running=True) as accepted:
            found = await client.states()
            with naming_nearest(*_typed(converted, wanted, infos)):
                reply = await client.ask(converted)
            accepted.set()
            lines = _accepted(client, reply.replies, infos, found)
            said = f"{rounded(reply.duration_s)} s, at most {rounded(reply.deviation)} from the path"
            sender.target.show(reply, *lines, f"{said}; ends within {rounded(reply.ahead_s)} s if the daemon dies")

    sender.target.run(work)


def _accepted(
    client: RigClient, replies: Sequence[CommandReply], infos: Sequence[AxisInfo], found: Mapping[str, StateSample]
) -> list[str]:
    return [
        f"{whose(client.rig)}{each.axis}: accepted{values_of(each, info, assess(found.get(each.axis)))}"
        for each, info in zip(replies, infos, strict=True)
    ]


def _shares(
    moves: tuple[str, ...], velocity: float | None, acceleration: float | None, who: Mapping[str, str | None]
) -> list[tuple[AxisMove, Mapping[str, object]]]:
    """Return what is to be done, from `axis=position` of each axis, and the numbers as they were typed."""
    shares: list[tuple[AxisMove, Mapping[str, object]]] = []
    for each in moves:
        axis, _, position = each.partition("=")
        given = {"position": number_of(position, each), "velocity": velocity, "acceleration": acceleration}
        shares.append((of_options(AxisMove, axis=axis, **given, **who), given))
    return shares


def _typed(
    request: MoveTogether | PreviewTogether | WalkPath,
    shares: Sequence[tuple[AxisMove, Mapping[str, object]]],
    infos: Sequence[AxisInfo],
) -> list[Typed]:
    """Return the share of each axis as it is sent, with what was typed for it."""
    return [(move, given, info) for move, (_, given), info in zip(request.moves, shares, infos, strict=True)]


async def _in_units(
    client: RigClient,
    request: GroupT,
    shares: Sequence[tuple[AxisMove, Mapping[str, object]]],
    given: Mapping[str, object],
) -> tuple[GroupT, list[AxisInfo]]:
    """Return a request with the numbers of each axis in its units, and what the axes are.

    Raises:
        click.UsageError: a number for all of them together would be another one in the units of another axis.
    """
    infos = [await axis_of(client, move.axis) for move, _ in shares]
    moves = tuple(in_units(move, typed, info) for (move, typed), info in zip(shares, infos, strict=True))
    together, *others = (in_units(request, given, info) for info in infos)
    for name in given:
        meanings = [getattr(each, name) for each in (together, *others)]
        if any(each != meanings[0] for each in meanings):
            said = ", ".join(f"{meant:g} for {info.axis}" for meant, info in zip(meanings, infos, strict=True))
            typed = given[name]
            text = typed.text if isinstance(typed, TypedNumber) else typed
            option = f"--{name.replace('_', '-')}"
            raise click.UsageError(f"{option} {text} means something else for each axis: {said}")
    return together.model_copy(update={"moves": moves}), infos
