"""`ldcnd axis`: show axes and move them."""

import asyncio
import sys
from functools import partial
from typing import Any

import click

from ldcnd.cli.connection import AXIS, Target, of_options, with_target
from ldcnd.cli.halting import NAME, halted, halting
from ldcnd.cli.main import CommandGroup
from ldcnd.cli.names import whose
from ldcnd.cli.nearest import naming_nearest
from ldcnd.cli.output import HELD, Keyboard, end_as_interrupted, keys, show_lines
from ldcnd.cli.quantities import number, seconds
from ldcnd.cli.sending import WAITING, Sender, Shown, commanding, derived, derived_question
from ldcnd.cli.there import axis_of
from ldcnd.cli.typed import Finite, Quantity, in_units
from ldcnd.client.lease import Control, control
from ldcnd.client.motion import Jogging
from ldcnd.client.rig_client import RigClient
from ldcnd.contract.commands import (
    LONGEST_HOLD_S,
    BufferMode,
    Direction,
    Halt,
    Home,
    Jog,
    MoveAbsolute,
    MoveAnalog,
    MoveRelative,
    MoveVelocity,
    Probe,
    QuickStop,
    SetGains,
    SetOutputs,
    SetPosition,
    SetPwm,
    Track,
)
from ldcnd.contract.errors import ConfigError, LeaseExpired
from ldcnd.contract.meta import AxisInfo
from ldcnd.contract.parameters import AlarmReport, ClearCounter, CounterReply, ReadAlarms
from ldcnd.contract.questions import Preview, PreviewReply
from ldcnd.contract.units import Dimension, quantity_text, shown_quantity

WAIT, LEAVE = (click.option(name, is_flag=True, help=text) for name, text in WAITING.items())


@click.command(context_settings={"ignore_unknown_options": True})
@click.argument("axis", type=AXIS)
@click.argument("value", type=Quantity())
@click.option("--relative", is_flag=True, help="VALUE is a distance.")
@click.option(
    "--at-velocity",
    is_flag=True,
    help="VALUE is a velocity: run until stopped, at most as long and as far as the reply says.",
)
@click.option("--velocity", type=Quantity(), help="Units a second; the axis default when missing.")
@click.option("--acceleration", type=Quantity(), help="Units a second squared; the axis default when missing.")
@click.option(
    "--direction",
    type=click.Choice([direction.value for direction in Direction]),
    help="Which way to turn, on an axis with a modulo; the shortest when missing.",
)
@click.option("--for", "for_s", type=Finite(0, 86_400, min_open=True), help="Duration at the velocity, seconds.")
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
    for_s: float | None,
    *,
    relative: bool,
    at_velocity: bool,
    wait: bool,
    leave_running: bool,
) -> None:
    """Move AXIS to the position VALUE, by the distance VALUE, or at the velocity VALUE."""
    if relative and at_velocity:
        raise click.UsageError("--relative and --at-velocity exclude each other")
    given: dict[str, Any] = {"acceleration": acceleration, "buffer_mode": buffer_mode}
    request: MoveVelocity | MoveRelative | MoveAbsolute
    if direction and (relative or at_velocity):
        raise click.UsageError("--direction goes with a position")
    if for_s is not None and not at_velocity:
        raise click.UsageError("--for goes with a velocity")
    if at_velocity:
        if velocity is not None:
            raise click.UsageError("with --at-velocity, VALUE is the velocity; leave --velocity out")
        request = of_options(MoveVelocity, **(given := given | {"velocity": value, "duration_s": for_s}))
    elif relative:
        request = of_options(MoveRelative, **(given := given | {"distance": value, "velocity": velocity}))
    else:
        given |= {"position": value, "velocity": velocity, "direction": direction}
        request = of_options(MoveAbsolute, **given)
    sender.send(axis, request, given, wait=wait, leave_running=leave_running)


LEASE_S = 1.0
"""The daemon applies `loss.client` so soon when this program disappears."""
HOLD_S = 0.4
"""Longest time between two repetitions of the key that reach the daemon; then it ends the jog."""
RENEW_EACH_S = 0.1


@click.command(context_settings={"ignore_unknown_options": True})
@click.argument("axis", type=AXIS)
@click.argument("velocity", type=Quantity())
@click.option("--for", "for_s", type=Finite(0, 3600, min_open=True), help="Duration, seconds.")
@click.option("--acceleration", type=Quantity(), help="Units a second squared; the axis default when missing.")
@click.option("--force", is_flag=True, help="Take control from its holder.")
@with_target
def jog(
    target: Target, axis: str, velocity: float, for_s: float | None, acceleration: float | None, *, force: bool
) -> None:
    """Run AXIS at VELOCITY (units a second, signed) while the space bar is held, or with --for for a time.

    The axis is under control of this command meanwhile. It is halted when the key is released, when the time is over,
    at Ctrl-C and when the terminal goes; if this program dies, the daemon ends the jog within half a second.
    """
    given = {"velocity": velocity, "acceleration": acceleration}
    request = of_options(Jog, hold_s=HOLD_S, **given)
    if for_s is None and not sys.stdin.isatty():
        raise ConfigError("there is no keyboard here", remedy="say how long to run with --for SECONDS")

    async def work(client: RigClient) -> str:
        info = await axis_of(client, axis)
        command = in_units(request, given, info)
        async with (
            control(client, f"{NAME} jog", axis, lease_s=LEASE_S, force=force) as held,
            halting(client, info) as accepted,
        ):
            accepted.set()  # who has control is heard: what it sends may be carried out
            with naming_nearest((command, given, info)):
                if for_s is None:
                    await _while_pressed(client, info, held, command)
                else:
                    await _for_a_time(client, info, held, command, for_s)
            return await halted(client, info)

    end_as_interrupted()
    show_lines(target.run(work))


async def _for_a_time(client: RigClient, info: AxisInfo, held: Control, command: Jog, for_s: float) -> None:
    """Run the axis for a time, in seconds, or until its software limit."""
    jog = Jogging(partial(held.command, info.axis), command)
    reply = await jog.begin()
    at = quantity_text(reply.velocity or command.velocity, info, Dimension.VELOCITY)
    show_lines(f"{whose(client.rig)}{info.axis}: runs at {at} for {for_s:g} s")
    try:
        async with asyncio.timeout(for_s):
            while True:
                await jog.held()
    except TimeoutError:
        return
    except LeaseExpired:
        if held.lost:
            raise


async def _while_pressed(client: RigClient, info: AxisInfo, held: Control, command: Jog) -> None:
    """Run the axis whenever the space bar is held, until another key is pressed."""
    first = command.model_copy(update={"hold_s": LONGEST_HOLD_S})
    with keys() as keyboard:
        show_lines("hold the space bar to run, any other key ends", err=True)
        while await keyboard.pressed(HELD):
            jog = Jogging(partial(held.command, info.axis), first)
            await jog.begin()
            try:
                await _renewed_until_released(keyboard, jog)
            except LeaseExpired:
                if held.lost:
                    raise
            show_lines(await halted(client, info), err=True)


async def _renewed_until_released(keyboard: Keyboard, jog: Jogging) -> None:
    """Keep a jog alive with the repetitions of the key; return when it is not repeated any more."""
    loop = asyncio.get_running_loop()
    due_s = loop.time()
    async for _ in keyboard.repetitions(HELD):
        if loop.time() >= due_s:
            due_s = loop.time() + RENEW_EACH_S
            await jog.renew(hold_s=HOLD_S)


def _previewed(reply: PreviewReply, info: AxisInfo | None) -> Shown:
    yield reply, _preview_lines(reply, info) if info else ()


def _preview_lines(reply: PreviewReply, info: AxisInfo) -> list[str]:
    if reply.refusal:
        return [f"{info.axis}: would be refused: {reply.refusal.message} [{reply.refusal.code}]"]
    end = reply.ends or ""
    if reply.position is not None:
        end = f"ends at {number(reply.position, info)}"
    time = f", in {seconds(reply.duration_s)} without settling" if reply.duration_s is not None else ""
    lines = [
        f"{info.axis}: {end}{time}",
        f"  velocity     {_held(reply.velocity, reply.velocity_error, info, Dimension.VELOCITY)}",
        f"  acceleration {_held(reply.acceleration, reply.acceleration_error, info, Dimension.ACCELERATION)}",
    ]
    if reply.bus_s is not None:
        lines.append(f"  {len(reply.packets)} packets, {seconds(reply.bus_s)} on the line at most")
    return [*lines, *(f"  now in the way: {obstacle}" for obstacle in reply.obstacles)]


def _held(value: float | None, error: float | None, info: AxisInfo, dimension: Dimension) -> str:
    if value is None:
        return "unknown"
    off = f" ({shown_quantity(error, info, dimension)[0]:+.2g} by rounding)" if error else ""
    return quantity_text(value, info, dimension, ".6g") + off


def _alarms(reply: AlarmReport, _info: AxisInfo | None) -> Shown:
    past = (f"  {place} {entry.code:04X}H {entry.text}" for place, entry in enumerate(reply.history))
    yield reply, [f"{reply.axis}: {reply.present.code:04X}H {reply.present.text}", *past]


def _cleared(reply: CounterReply, _info: AxisInfo | None) -> Shown:
    remarks = "".join(f"; {remark}" for remark in reply.remarks)
    yield reply, [f"{reply.axis}: the {reply.counter} counter is cleared and reads {reply.value}{remarks}"]


home = derived("home", Home, moves=True)
halt = derived("halt", Halt, rests=True)


HOMES = {
    "at": "ldcnd.cli.past:at",
    "monitors": "ldcnd.cli.looking:monitors",
    "reset": "ldcnd.cli.rig:reset",
    "stop": "ldcnd.cli.rig:stop",
}
"""The commands that are not in this file; they are loaded when they are used."""


@click.group(cls=CommandGroup, homes=HOMES)
def command() -> None:
    """Send a command to an axis of a running daemon; those of every day are typed without `axis`."""


for each in (
    halt,
    home,
    derived("quick-stop", QuickStop, rests=True),
    derived("set-position", SetPosition, "position"),
    derived("gains", SetGains),
    derived("probe", Probe, moves=True),
    derived("pwm", SetPwm, "duty", "duration_s", moves=True),
    derived("track", Track, "position", moves=True),
    derived("move-analog", MoveAnalog, "target", moves=True),
    derived("outputs", SetOutputs),
    derived_question("preview", Preview, shows=_previewed),
    derived_question("alarms", ReadAlarms, shows=_alarms),
    derived_question("clear-counter", ClearCounter, "counter", shows=_cleared),
):
    command.add_command(each)
