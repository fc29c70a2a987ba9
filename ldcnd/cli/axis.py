"""`ldcnd axis`: show axes and move them."""

import click

from ldcnd.cli.connection import AXIS, Target, of_options, with_target
from ldcnd.cli.derived import derived
from ldcnd.cli.lazy_group import LazyGroup
from ldcnd.cli.quantities import number, sample_text, seconds
from ldcnd.cli.rig import stop_rig
from ldcnd.cli.sending import Sender, commanding
from ldcnd.cli.typed import Finite, axis_of
from ldcnd.client.rig_client import RigClient
from ldcnd.contract.commands import (
    BufferMode,
    Direction,
    Halt,
    Home,
    HomeMethod,
    HomeStop,
    MoveAbsolute,
    MoveAnalog,
    MoveRelative,
    MoveVelocity,
    Power,
    Preview,
    PreviewReply,
    Probe,
    ProbeSource,
    ProbeStop,
    QuickStop,
    Reset,
    SetGains,
    SetOutputs,
    SetPosition,
    SetPwm,
    Track,
)
from ldcnd.contract.meta import AxisInfo
from ldcnd.contract.samples import TelemetryItem

WAIT = click.option("--wait", is_flag=True, help="Return when it has ended; Ctrl-C halts the axis.")
LEAVE = click.option("--leave-running", is_flag=True, help="With --wait: Ctrl-C ends the wait only, the axis moves on.")

HOMES = {
    "list": "ldcnd.cli.axis_state:list_axes",
    "faults": "ldcnd.cli.axis_state:faults",
    "watch": "ldcnd.cli.axis_state:watch",
    "jog": "ldcnd.cli.jog:jog",
    "monitors": "ldcnd.cli.axis_drive:monitors",
    "read-monitors": "ldcnd.cli.axis_drive:read_monitors",
    "alarms": "ldcnd.cli.axis_drive:alarms",
    "clear-counter": "ldcnd.cli.axis_drive:clear_counter",
}
"""The commands that are not in this file; they are loaded when they are used."""


@click.group(cls=LazyGroup, homes=HOMES)
def command() -> None:
    """List, watch, move, stop and home axes of a running daemon."""


@command.command()
@click.argument("axis", type=AXIS)
@click.argument("switch", type=click.Choice(["on", "off"]))
@commanding
def power(sender: Sender, axis: str, switch: str) -> None:
    """Close (on) or open (off) the position loop of AXIS; nothing moves."""
    sender.send(axis, Power(on=switch == "on"))


@command.command(context_settings={"ignore_unknown_options": True})
@click.argument("axis", type=AXIS)
@click.argument("value", type=Finite())
@click.option("--relative", is_flag=True, help="VALUE is a distance.")
@click.option("--at-velocity", is_flag=True, help="VALUE is a velocity: run until stopped or to the soft limit.")
@click.option("--velocity", type=Finite(), help="Units a second; the axis default when missing.")
@click.option("--acceleration", type=Finite(), help="Units a second squared; the axis default when missing.")
@click.option(
    "--direction",
    type=click.Choice([direction.value for direction in Direction]),
    help="Which way to turn, on an axis with a modulo; the shortest when missing.",
)
@click.option(
    "--buffer-mode",
    type=click.Choice([mode.value for mode in BufferMode]),
    default=BufferMode.REFUSE.value,
    help="What happens if the axis moves already.",
)
@WAIT
@LEAVE
@commanding
def move(
    sender: Sender,
    axis: str,
    value: float,
    velocity: float | None,
    acceleration: float | None,
    direction: str | None,
    buffer_mode: str,
    *,
    relative: bool,
    at_velocity: bool,
    wait: bool,
    leave_running: bool,
) -> None:
    """Move AXIS to the position VALUE."""
    if relative and at_velocity:
        raise click.UsageError("--relative and --at-velocity exclude each other")
    given = {"acceleration": acceleration, "buffer_mode": buffer_mode}
    request: MoveVelocity | MoveRelative | MoveAbsolute
    if direction and (relative or at_velocity):
        raise click.UsageError("--direction goes with a position")
    if at_velocity:
        if velocity is not None:
            raise click.UsageError("with --at-velocity, VALUE is the velocity; leave --velocity out")
        request = of_options(MoveVelocity, velocity=value, **given)
    elif relative:
        request = of_options(MoveRelative, distance=value, velocity=velocity, **given)
    else:
        request = of_options(MoveAbsolute, position=value, velocity=velocity, direction=direction, **given)
    sender.send(axis, request, wait=wait, leave_running=leave_running)


@command.command()
@click.argument("axis", type=AXIS)
@click.option("--method", type=click.Choice([method.value for method in HomeMethod]), help="What marks the position.")
@click.option("--velocity", type=Finite(), help="Search velocity, signed; units a second.")
@click.option("--find-velocity", type=Finite(), help="Speed at which a limit switch is found first; units a second.")
@click.option("--acceleration", type=Finite(), help="Units a second squared; the axis default when missing.")
@click.option("--position", type=Finite(), help="Value of the reference position.")
@click.option("--timeout", "timeout_s", type=Finite(), help="Longest search, in seconds.")
@click.option("--distance", type=Finite(), help="Longest search, in axis units.")
@click.option("--stop", type=click.Choice([stop.value for stop in HomeStop]), help="How the motor stops there.")
@click.option("--move-to", type=Finite(), help="Where to go afterwards.")
@WAIT
@LEAVE
@commanding
def home(sender: Sender, axis: str, *, wait: bool, leave_running: bool, **given: object) -> None:
    """Search the reference position of AXIS, as configured unless said otherwise."""
    sender.send(axis, of_options(Home, **given), wait=wait, leave_running=leave_running)


@command.command(context_settings={"ignore_unknown_options": True})
@click.argument("axis")
@click.option(
    "--source",
    "sources",
    multiple=True,
    required=True,
    type=click.Choice([source.value for source in ProbeSource]),
    help="What latches; several may be named, the first that comes counts.",
)
@click.option("--position", type=Finite(), help="Where the move ends when no input comes.")
@click.option("--distance", type=Finite(), help="How far it goes when no input comes, signed.")
@click.option("--velocity", type=Finite(), help="Units a second; the axis default when missing.")
@click.option("--acceleration", type=Finite(), help="Units a second squared; the axis default when missing.")
@click.option("--stop", type=click.Choice([stop.value for stop in ProbeStop]), help="How the motor stops there.")
@WAIT
@LEAVE
@commanding
def probe(sender: Sender, axis: str, *, wait: bool, leave_running: bool, **given: object) -> None:
    """Move AXIS until an input changes and latch the position there; with --wait show it."""
    sender.send(axis, of_options(Probe, **given), wait=wait, leave_running=leave_running)
    if wait:
        latch = sender.target.run(lambda client: client.last(axis, TelemetryItem.LATCH))
        if latch is not None:
            sender.target.show(latch, f"{axis}: {sample_text(latch)}")


@command.command()
@click.argument("axis", type=AXIS, required=False)
@with_target
def stop(target: Target, axis: str | None) -> None:
    """Stop AXIS, or the whole rig, and latch: nothing moves again before reset."""
    stop_rig(target, axis)


@command.command()
@click.argument("axis", type=AXIS)
@commanding
def halt(sender: Sender, axis: str) -> None:
    """Bring AXIS to rest; another command may follow."""
    sender.send(axis, Halt())


@command.command()
@click.argument("axis", type=AXIS)
@commanding
def reset(sender: Sender, axis: str) -> None:
    """Clear the stop latch and the faults of AXIS; nothing moves."""
    sender.send(axis, Reset())


for each in (
    derived("quick-stop", QuickStop),
    derived("set-position", SetPosition, "position"),
    derived("gains", SetGains),
    derived("pwm", SetPwm, "duty", "duration_s", moves=True),
    derived("track", Track, "position", moves=True),
    derived("move-analog", MoveAnalog, "target", moves=True),
    derived("outputs", SetOutputs),
):
    command.add_command(each)


@command.command()
@click.argument("axis", type=AXIS)
@click.option("--position", type=Finite(), help="A move to this position.")
@click.option("--distance", type=Finite(), help="A move by this distance.")
@click.option("--velocity", type=Finite(), help="Speed of the move; alone: a motion at this velocity, signed.")
@click.option("--acceleration", type=Finite(), help="Units a second squared; the axis default when missing.")
@with_target
def preview(
    target: Target,
    axis: str,
    position: float | None,
    distance: float | None,
    velocity: float | None,
    acceleration: float | None,
) -> None:
    """Show what a motion of AXIS would do; nothing is sent to its drive."""
    asked = of_options(Preview, position=position, distance=distance, velocity=velocity, acceleration=acceleration)

    async def work(client: RigClient) -> tuple[AxisInfo, PreviewReply]:
        return await axis_of(client, axis), await client.ask(asked, axis)

    info, reply = target.run(work)
    target.show(reply, *_previewed(info, reply))


def _previewed(info: AxisInfo, reply: PreviewReply) -> list[str]:
    if reply.refusal:
        lines = [f"{info.axis}: would be refused: {reply.refusal.message} [{reply.refusal.code}]"]
        if reply.refusal.nearest is not None:
            lines.append(f"  the nearest value that would be accepted is {reply.refusal.nearest:g}")
        return lines
    end = "runs until stopped or to the soft limit"
    if reply.position is not None:
        end = f"ends at {number(reply.position, info)}"
    time = f", in {seconds(reply.duration_s)} without settling" if reply.duration_s is not None else ""
    lines = [
        f"{info.axis}: {end}{time}",
        f"  velocity     {_held(reply.velocity, reply.velocity_error)} {info.unit}/s",
        f"  acceleration {_held(reply.acceleration, reply.acceleration_error)} {info.unit}/s²",
    ]
    if reply.bus_s is not None:
        lines.append(f"  {len(reply.packets)} packets, {seconds(reply.bus_s)} on the line at most")
    return [*lines, *(f"  now in the way: {obstacle}" for obstacle in reply.obstacles)]


def _held(value: float | None, error: float | None) -> str:
    if value is None:
        return "unknown"
    return f"{value:.6g}" + (f" ({error:+.2g} by rounding)" if error else "")
