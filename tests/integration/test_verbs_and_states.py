"""One table: in which state of an axis each command is taken, and with which refusal it is not."""

from collections.abc import Awaitable, Callable
from dataclasses import replace

import pytest

from ldcnd.axis.axis import AxisService
from ldcnd.axis.events import CommandBegun, StopUnconfirmed
from ldcnd.axis.rest import RestEvidence
from ldcnd.axis.status import ActiveCommand, AxisStatus, Completion
from ldcnd.contract.commands import (
    Halt,
    Home,
    HomeMethod,
    Jog,
    MoveAbsolute,
    MoveRelative,
    MoveVelocity,
    Power,
    Reset,
    SetGains,
    SetOutputs,
    SetPosition,
    SetPwm,
    Track,
    Verb,
)
from ldcnd.contract.errors import ErrorCode, LdcndError
from ldcnd.contract.samples import AxisState, LinkState
from tests.support.dialect_rig import AXIS, V4, dialect_rig

PENDING = ErrorCode.STOP_UNCONFIRMED
TAKEN, WRONG, LATCHED, AWAY = "taken", ErrorCode.WRONG_STATE, ErrorCode.STOP_LATCHED, ErrorCode.AXIS_UNREACHABLE
MOTIONS = {
    "move_absolute": MoveAbsolute(position=1.0),
    "move_relative": MoveRelative(distance=1.0),
    "move_velocity": MoveVelocity(velocity=1.0),
    "jog": Jog(velocity=1.0),
    "home": Home(method=HomeMethod.INDEX, velocity=1.0),
    "set_pwm": SetPwm(duty=0.05, duration_s=1.0),
    "track": Track(position=0.1),
}
COMMANDS = MOTIONS | {
    "power on": Power(on=True),
    "power off": Power(on=False),
    "set_position": SetPosition(position=0.0),
    "set_gains": SetGains(kp=300),
    "set_outputs": SetOutputs(),
    "halt": Halt(),
    "reset": Reset(),
}


def row(**different: object) -> dict[str, object]:
    """Return what becomes of each command: it is taken, unless the row says otherwise."""
    motions = different.pop("motions", TAKEN)
    return (
        dict.fromkeys(COMMANDS, TAKEN)
        | dict.fromkeys(MOTIONS, motions)
        | {k.replace("_on", " on"): v for k, v in different.items()}
    )


BUSY = row(motions=WRONG, power_on=WRONG, set_position=WRONG, reset=WRONG)
TABLE = {
    "standstill": row(),
    "disabled": row(motions=WRONG),
    "moving": BUSY,
    "continuous": BUSY,
    "stopping": BUSY,
    "homing": BUSY,
    "tracking": BUSY | {"track": TAKEN},
    "pwm": BUSY | {"set_pwm": TAKEN},
    "latched": row(motions=LATCHED, power_on=LATCHED, set_outputs=LATCHED),
    "stopping, latched": row(motions=LATCHED, power_on=LATCHED, set_outputs=LATCHED, set_position=WRONG, reset=WRONG),
    "stop pending": row(motions=PENDING, power_on=PENDING, set_outputs=PENDING, reset=PENDING),
    "error": row(motions=WRONG, power_on=WRONG),
    "error, moving": row(motions=WRONG, power_on=WRONG, reset=WRONG),
    "error, latched": row(motions=LATCHED, power_on=LATCHED, set_outputs=LATCHED),
    "away": dict.fromkeys(COMMANDS, AWAY) | {"halt": TAKEN, "power off": TAKEN},
}


RESTING = {"standstill", "disabled", "latched", "stop pending", "error", "error, latched"}


async def nothing(*_args: object, **_kwargs: object) -> None:
    """Stand in for every packet."""


async def put(axis: AxisService, name: str) -> None:
    """Bring what the daemon knows of the axis into a state."""
    tracker, commands = axis.tracker, axis.commands
    commands._drop_procedure()
    stands = AxisStatus(AXIS, tracker.status.scale, link=LinkState.UP, referenced=True, enabled=True)
    tracker.status = replace(stands, state=AxisState.STANDSTILL)
    motion = {"moving": AxisState.DISCRETE_MOTION, "continuous": AxisState.CONTINUOUS_MOTION}
    motion |= {"stopping": AxisState.STOPPING, "homing": AxisState.HOMING}
    kind = name.partition(",")[0]
    if kind in motion:
        tracker.take(CommandBegun(ActiveCommand("other", Verb.MOVE_ABSOLUTE, 0, motion[kind], Completion.PROFILE)))
    elif kind in ("tracking", "pwm"):
        await axis.execute(MOTIONS["track" if kind == "tracking" else "set_pwm"])
        if kind == "tracking":
            commands.procedure._due_s = float("-inf")  # as if it had come long ago
    elif kind == "error":
        tracker.status = replace(tracker.status, state=AxisState.ERROR_STOP, enabled=name == "error, moving")
    elif kind == "disabled":
        tracker.status = replace(tracker.status, state=AxisState.DISABLED, enabled=False)
    elif kind == "away":
        tracker.status = replace(tracker.status, link=LinkState.DOWN)
    tracker.status = replace(tracker.status, stop_latched="latched" in name)
    if name == "stop pending":
        tracker.take(StopUnconfirmed(0))
    set_at_rest(
        axis, kind in ("standstill", "disabled", "latched", "stop pending") or name in ("error", "error, latched")
    )


def set_at_rest(axis: AxisService, at_rest: bool) -> None:  # noqa: FBT001
    axis.tracker.status = replace(axis.tracker.status, rest=RestEvidence(rests=at_rest))


async def outcome(send: Callable[[], Awaitable[object]]) -> object:
    try:
        await send()
    except LdcndError as error:
        return error.code
    return TAKEN


@pytest.mark.promise("stop-latches")
@pytest.mark.parametrize("state", TABLE)
@pytest.mark.sweep(2)
async def test_each_command_is_taken_or_refused_as_the_table_says(state):
    async with dialect_rig(V4, pwm={"duty": 0.5, "duration_s": 5.0}, tracking={"step": 0.4, "rate": 50.0}) as rig:
        await rig.power_on()
        axis = rig.rig.daemon.rig.axes[AXIS]
        reading = axis.tracker.latest()
        for name in ("load", "start", "track", "power", "reset", "clear_warnings", "set_gains", "set_outputs"):
            setattr(axis.driver, name, nothing)
        axis.driver.stop = _value  # as asked
        axis.motion.read = lambda: _value(reading)  # no packet
        found = {}
        for name, command in COMMANDS.items():
            await put(axis, state)
            found[name] = await outcome(lambda command=command: axis.execute(command))
        assert found == TABLE[state]


async def _value(reading: object) -> object:
    return reading
