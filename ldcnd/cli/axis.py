"""`ldcnd axis`: look at axes and move them."""

import asyncio
import sys

import click

from ldcnd.cli.connection import Target, with_target
from ldcnd.client.rig_client import RigClient
from ldcnd.model.commands import (
    AxisCommand,
    BufferMode,
    CommandReply,
    Halt,
    Home,
    HomeMethod,
    MoveAbsolute,
    MoveRelative,
    MoveVelocity,
    Power,
    Reset,
)
from ldcnd.model.meta import AxisInfo
from ldcnd.model.parameters import (
    ClearCounter,
    CounterName,
    ReadAlarms,
    ReadProfile,
)
from ldcnd.model.samples import (
    AdcSample,
    FaultSample,
    PositionSample,
    Sample,
    StateSample,
    TelemetryItem,
    VelocitySample,
)


@click.group()
def command() -> None:
    """List, watch, move, stop and home axes of a running daemon."""


@command.command("list")
@with_target
def list_axes(target: Target) -> None:
    """Show every axis with its state and position."""

    async def work(client: RigClient) -> list[tuple[AxisInfo, StateSample | None, Sample | None]]:
        return [
            (axis, await client.state(axis.axis), await client.last(axis.axis, TelemetryItem.POSITION))
            for axis in await client.axes()
        ]

    for axis, state, position in target.run(work):
        where = f"{position.value:12.4f} {position.unit}" if isinstance(position, PositionSample) else "           ?"
        what = f"{state.state}{' (stop latched)' if state.stop_latched else ''}" if state else "unknown"
        target.show(axis, f"{axis.axis:8} {axis.model:14} {axis.bus}/{axis.address:<4} {where:20} {what}")


@command.command()
@click.argument("axis", default="*")
@click.option("--item", type=click.Choice([item.value for item in TelemetryItem]), help="Only this item.")
@click.option("--count", type=click.IntRange(min=1), help="End after so many samples.")
@with_target
def watch(target: Target, axis: str, item: str | None, count: int | None) -> None:
    """Show the telemetry of AXIS (or of all) as it comes."""

    async def work(client: RigClient) -> None:
        seen = 0
        async with client.samples(axis, item or "*") as samples:
            async for name, sample in samples:
                target.show(sample, f"{name:8} {_text(sample)}")
                seen += 1
                if seen == count:
                    return

    target.run(work)


@command.command()
@click.argument("axis")
@click.argument("switch", type=click.Choice(["on", "off"]))
@with_target
def power(target: Target, axis: str, switch: str) -> None:
    """Close (on) or open (off) the position loop of AXIS; nothing moves."""
    _send(target, axis, Power(on=switch == "on"))


@command.command(context_settings={"ignore_unknown_options": True})
@click.argument("axis")
@click.argument("value", type=float)
@click.option("--relative", is_flag=True, help="VALUE is a distance.")
@click.option("--at-velocity", is_flag=True, help="VALUE is a velocity: move until told otherwise.")
@click.option("--velocity", type=float, help="Units a second; the axis default when missing.")
@click.option("--acceleration", type=float, help="Units a second squared; the axis default when missing.")
@click.option(
    "--buffer-mode",
    type=click.Choice([mode.value for mode in BufferMode]),
    default=BufferMode.REFUSE.value,
    help="What happens if the axis moves already.",
)
@click.option("--wait", is_flag=True, help="Return when the move has ended.")
@with_target
def move(
    target: Target,
    axis: str,
    value: float,
    velocity: float | None,
    acceleration: float | None,
    buffer_mode: str,
    *,
    relative: bool,
    at_velocity: bool,
    wait: bool,
) -> None:
    """Move AXIS to the position VALUE."""
    request: AxisCommand[CommandReply]
    if relative and at_velocity:
        raise click.UsageError("--relative and --at-velocity exclude each other")
    if at_velocity:
        if velocity is not None:
            raise click.UsageError("with --at-velocity, VALUE is the velocity; leave --velocity out")
        request = MoveVelocity(velocity=value, acceleration=acceleration)
    elif relative:
        request = MoveRelative(distance=value, velocity=velocity, acceleration=acceleration)
    else:
        request = MoveAbsolute(position=value, velocity=velocity, acceleration=acceleration)
    _send(target, axis, request.model_copy(update={"buffer_mode": BufferMode(buffer_mode)}), wait=wait)


@command.command()
@click.argument("axis")
@click.option("--method", type=click.Choice([method.value for method in HomeMethod]), help="What marks the position.")
@click.option("--velocity", type=float, help="Search velocity, signed; units a second.")
@click.option("--position", type=float, help="What the position is called there.")
@click.option("--wait", is_flag=True, help="Return when the search has ended.")
@with_target
def home(
    target: Target, axis: str, method: str | None, velocity: float | None, position: float | None, *, wait: bool
) -> None:
    """Search the reference position of AXIS, as configured unless said otherwise."""
    request = Home(method=HomeMethod(method) if method else None, velocity=velocity, position=position)
    _send(target, axis, request, wait=wait)


@command.command()
@click.argument("axis", required=False)
@with_target
def stop(target: Target, axis: str | None) -> None:
    """Stop AXIS, or the whole rig, and latch: nothing moves again before reset."""
    reply = target.run(lambda client: client.stop(axis))
    unconfirmed = sorted(set(reply.axes) - set(reply.confirmed))
    target.show(reply, f"stopped: {', '.join(reply.confirmed) or 'none'}")
    if unconfirmed:
        print(f"not confirmed: {', '.join(unconfirmed)}; what takes a stop is latched all the same", file=sys.stderr)
        sys.exit(1)


@command.command()
@click.argument("axis")
@with_target
def halt(target: Target, axis: str) -> None:
    """Bring AXIS to rest; another command may follow."""
    _send(target, axis, Halt())


@command.command()
@click.argument("axis")
@with_target
def reset(target: Target, axis: str) -> None:
    """Clear the stop latch and the faults of AXIS; nothing moves."""
    _send(target, axis, Reset())


@command.command()
@click.argument("axis")
@with_target
def profile(target: Target, axis: str) -> None:
    """Show how the drive of AXIS is taken to behave, assumptions with their verification."""
    reply = target.run(lambda client: client.command(axis, ReadProfile()))
    hearing = ", HEARS ITSELF: nothing is written" if reply.self_hearing else ""
    target.show(reply, f"{axis}: {reply.model}, {reply.identity or 'not answering'}{hearing}")
    if target.as_json:
        return
    for each in reply.assumptions:
        setting = f" = {each.setting}" if each.setting else ""
        print(f"  {each.verification:14} [{each.confidence:6}] {each.key}{setting}: {each.question}")


@command.command()
@click.argument("axis")
@with_target
def monitors(target: Target, axis: str) -> None:
    """Show the last values of the monitors of AXIS."""
    for name, sample in target.run(lambda client: client.monitors(axis)).items():
        high = f"  high: {', '.join(sample.high)}" if sample.high else ""
        target.show(sample, f"{name:22} {sample.value:8d} {sample.unit:14} {sample.title}{high}  ({sample.quality})")


@command.command()
@click.argument("axis")
@with_target
def alarms(target: Target, axis: str) -> None:
    """Show the present alarm of AXIS and the history that its drive keeps."""
    reply = target.run(lambda client: client.command(axis, Verb.READ_ALARMS, ReadAlarms(), timeout_s=30.0))
    if not isinstance(reply, AlarmReport):
        raise NotSupported(f"axis {axis} keeps no alarms", axis=axis)
    past = (f"  {entry.code:04X}H {entry.text}" for entry in reply.history)
    target.show(reply, f"{axis}: {reply.present.code:04X}H {reply.present.text}", *past)


@command.command("clear-counter")
@click.argument("axis")
@click.argument("counter", type=click.Choice([name.value for name in CounterName]))
@with_target
def clear_counter(target: Target, axis: str, counter: str) -> None:
    """Set a pulse counter of AXIS to 0; command pulses must be stopped, and the motor must stand."""
    request = ClearCounter(counter=CounterName(counter))
    reply = target.run(lambda client: client.command(axis, request))
    remarks = "".join(f"; {remark}" for remark in reply.remarks)
    target.show(reply, f"{axis}: the {counter} counter is cleared and reads {reply.value}{remarks}")


def _send(target: Target, axis: str, command: AxisCommand[CommandReply], *, wait: bool = False) -> None:
    async def work(client: RigClient) -> tuple[CommandReply, StateSample | None]:
        reply = await client.command(axis, command)
        target.show(reply, f"{axis}: {command.verb} accepted{_values(reply)}")
        return reply, await _follow(client, reply) if wait else None

    async def _follow(client: RigClient, reply: CommandReply) -> StateSample:
        """Show where the axis is while it moves, on a terminal."""
        async with client.samples(axis, TelemetryItem.POSITION) as positions, asyncio.TaskGroup() as group:
            progress = group.create_task(_show(positions), name="progress")
            try:
                return await client.wait_for_end(axis, reply.command_id)
            finally:
                progress.cancel()

    async def _show(positions: object) -> None:
        if sys.stderr.isatty() and hasattr(positions, "__aiter__"):
            async for _, sample in positions:
                print(f"\r{axis}: {_text(sample)}\x1b[K", end="", file=sys.stderr, flush=True)

    _, state = target.run(work)
    if state is None:
        return
    if sys.stderr.isatty():
        print(file=sys.stderr)
    failed = state.last_error is not None
    target.show(state, f"{axis}: {state.state}{f', {state.last_error}' if failed else ''}")
    if failed:
        sys.exit(1)


def _values(reply: CommandReply) -> str:
    parts = (
        ("to", reply.position),
        ("at", reply.velocity),
        ("with acceleration", reply.acceleration),
        ("in s", reply.duration_s),
    )
    return "".join(f" {name} {value:g}" for name, value in parts if value is not None)


def _text(sample: Sample) -> str:
    match sample:
        case PositionSample():
            return f"position {sample.value:12.4f} {sample.unit}  ({sample.quality})"
        case VelocitySample():
            return f"velocity {sample.value:12.4f} {sample.unit}  ({sample.quality})"
        case AdcSample():
            return f"adc      {sample.counts:5d} of {sample.full_scale}, {sample.volts:.3f} V  ({sample.quality})"
        case StateSample():
            latched = ", stop latched" if sample.stop_latched else ""
            return f"state    {sample.state}, moving: {sample.moving}, link {sample.link}{latched}"
        case FaultSample():
            return "fault    " + ("; ".join(f"{fault.code}: {fault.text}" for fault in sample.active) or "none")
        case _:
            return sample.model_dump_json()
