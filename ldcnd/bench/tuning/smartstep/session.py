"""Trying gains of a SmartStep: its own auto-tuning and its gains, moves before and after by its recorder, put back.

No command of the line moves the motor: it follows pulses from elsewhere. So the machine moves by itself while a trace
is recorded, and two traces compare only where the machine has done the same. New values go to RAM, where they are lost
at power-off; the old ones are on the disk of this host before.
"""

import math
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from contextlib import asynccontextmanager

from pydantic import Field

from ldcnd.client.axis import Axis
from ldcnd.client.kept_gains import LEASE_S, KeptGains, forget, keep, kept_for, put_back_by_hand, restore
from ldcnd.client.lease import program_name
from ldcnd.client.rig import Rig
from ldcnd.client.rig_client import RigClient
from ldcnd.contract.errors import LdcndError, NotSupported, ValueOutOfRange, WrongState
from ldcnd.contract.frozen import Frozen
from ldcnd.contract.parameters import ParameterValue
from ldcnd.contract.samples import MonitorName
from ldcnd.drives.smartstep.monitors import FunctionSwitch
from ldcnd.drives.smartstep.parameters import PN110, digit_of, digit_texts

CLIENT = program_name("ldcnd tune")
GAINS = ("Pn100", "Pn101", "Pn102", "Pn103", "Pn109", "Pn10A", "Pn401")
"""Parameters of the loops, as far as the drive's manual lists them (3, user parameters)."""
CHANNELS = ("speed_feedback", "position_deviation", "inp")
POINTS = 500
TRACE_S = 120.0
"""Longest time from the end of a record until it has been read from the drive's memory, seconds."""
ALIKE = 0.1
"""Two moves are alike when their top speeds differ by no more than this share."""
STANDS_RPM = 1.0
SAME = 0.1
"""A deviation that is larger by less than this share is the same."""
NEVER = 2
"""Pn110.0: no online auto-tuning (recollected)."""

Tell = Callable[[str], None]


class MoveFigures(Frozen):
    """Figures of what the drive has recorded while the machine moved."""

    top_speed_rpm: float
    """The highest speed, either way."""
    largest_deviation: float
    """Largest position deviation, command units."""
    typical_deviation: float
    """Root mean square of it, command units."""
    in_position: float
    """Share of the time for which the drive said that it was in position."""


class SmartStepTuning(Frozen):
    """What `ldcnd tune` has read, tried and left in a SmartStep."""

    axis: str
    """The axis."""
    auto_tuning: tuple[str, ...]
    """Pn110 in words."""
    auto_tuning_runs: bool
    """The drive changes its inertia rate by itself while it moves."""
    auto_tuning_result_percent: int | None
    """Fn007: the result of the drive's own auto-tuning; null where it was not read."""
    switches_rule: bool
    """The gain rotary switch decides, not the parameters."""
    gain_switch: int | None
    """Its position."""
    gains: dict[str, ParameterValue]
    """As they were, by number."""
    tried: dict[str, int] = Field(default_factory=dict)
    """Values that were tried, by number."""
    before: MoveFigures | None = None
    """With the gains as they were."""
    after: MoveFigures | None = None
    """With those that were tried."""
    objection: str | None = None
    """Why they are not better; null where they are at least as good, or none were tried."""
    kept: bool = False
    """They are in use: in RAM, until the drive is powered off."""


async def read_tuning(client: RigClient, name: str) -> SmartStepTuning:
    """Read what a drive says of its tuning; changes nothing.

    Raises:
        LdcndError: as the daemon refused it.
    """
    rig = Rig(client, await client.daemon())
    async with rig.watch(name) as axis:
        gains = {each: (await axis.read_parameter(each)).value for each in GAINS}
        setting = (await axis.read_parameter(PN110.label)).value.active
        wanted = (MonitorName.AUTO_TUNING_RESULT, MonitorName.FUNCTION_SWITCHES, MonitorName.GAIN_SWITCH)
        found = {each.monitor: each.value for each in (await axis.read_monitors(monitors=wanted)).readings}
    switches = FunctionSwitch(found.get(MonitorName.FUNCTION_SWITCHES, FunctionSwitch.PARAMETERS_RULE) & 0x3F)
    return SmartStepTuning(
        axis=name,
        auto_tuning=digit_texts(PN110, setting),
        auto_tuning_runs=FunctionSwitch.ONLINE_AUTO_TUNING in switches and digit_of(setting, 0) != NEVER,
        auto_tuning_result_percent=found.get(MonitorName.AUTO_TUNING_RESULT),
        switches_rule=FunctionSwitch.PARAMETERS_RULE not in switches,
        gain_switch=found.get(MonitorName.GAIN_SWITCH),
        gains=gains,
    )


def check_wanted(found: SmartStepTuning, wanted: Mapping[str, int]) -> None:
    """Refuse values that would not be in use.

    Raises:
        ValueOutOfRange: one of them is no gain.
        NotSupported: the switches of the drive decide.
    """
    for name in wanted:
        if name not in GAINS:
            raise ValueOutOfRange(
                f"axis {found.axis}: {name} is none of {', '.join(GAINS)}",
                axis=found.axis,
                value=name,
                remedy=f"write other parameters with: ldcnd params set {found.axis} {name} VALUE",
            )
    if found.switches_rule:
        raise NotSupported(
            f"axis {found.axis}: its gain switch decides ({found.gain_switch:X}), not its parameters",
            axis=found.axis,
            remedy="turn function selection switch 6 on, and the drive off and on",
        )


async def try_gains(
    client: RigClient,
    found: SmartStepTuning,
    wanted: Mapping[str, int],
    record_s: float,
    moves: Callable[[str], Awaitable[None]],
    accepted: Callable[[SmartStepTuning], Awaitable[bool]],
    tell: Tell,
) -> SmartStepTuning:
    """Record a move, write gains to RAM, record it again, and keep them or put the old ones back.

    Args:
        client: of the rig.
        found: by `read_tuning`, just now.
        wanted: values by the numbers of their parameters.
        record_s: duration of a record, seconds.
        moves: returns when the machine is about to move; is told what is recorded.
        accepted: whether gains are kept, once both records are there.
        tell: gets a line now and then.

    Raises:
        LdcndError: as the daemon refused it; the old gains are back then, unless control was lost.
    """
    check_wanted(found, wanted)
    async with _changing(client, found, wanted, tell) as (axis, kept):
        await moves("the present gains")
        before = await _recorded(axis, record_s)
        for name, value in wanted.items():
            tell(f"{found.axis}: {name} = {value} in RAM")
            await axis.write_parameter(name, value)
        await moves("the new gains")
        after = await _recorded(axis, record_s)
        tried = found.model_copy(
            update={"tried": dict(wanted), "before": before, "after": after, "objection": objection(before, after)}
        )
        if await accepted(tried):
            forget(kept)
            return tried.model_copy(update={"kept": True})
        await restore(axis, kept)
    return tried


@asynccontextmanager
async def _changing(
    client: RigClient, found: SmartStepTuning, wanted: Mapping[str, int], tell: Tell
) -> AsyncIterator[tuple[Axis, KeptGains]]:
    """Control an axis whose parameters are kept; puts them back unless that was done, or they are not to come back."""
    rig = Rig(client, await client.daemon())
    async with rig.control(found.axis, client=CLIENT, lease_s=LEASE_S) as axis:
        # read again: others could write until now
        old = {name: (await axis.read_parameter(name)).value.active for name in wanted}
        kept = KeptGains(rig=rig.name, axis=found.axis, gains=old)
        keep(kept)
        try:
            yield axis, kept
        finally:
            if kept_for(rig.name, found.axis):
                try:
                    await restore(axis, kept)
                except LdcndError as error:
                    tell(f"{found.axis}: its old gains could not be put back: {error}; {put_back_by_hand(found.axis)}")


async def _recorded(axis: Axis, record_s: float) -> MoveFigures:
    """Let the drive record, and return the figures.

    Raises:
        WrongState: the motor stood all the time.
    """
    trace = await axis.take_trace(*CHANNELS, samples=POINTS, interval_s=record_s / POINTS, within_s=record_s + TRACE_S)
    speed, deviation, in_position = ([each or 0.0 for each in column] for column in trace.values)
    top = max(map(abs, speed))
    if top < STANDS_RPM:
        raise WrongState(
            f"axis {axis.name}: the motor stood while it was recorded",
            axis=axis.name,
            remedy="let the machine move it while the drive records; --record makes that longer",
        )
    return MoveFigures(
        top_speed_rpm=top,
        largest_deviation=max(map(abs, deviation)),
        typical_deviation=math.sqrt(sum(each * each for each in deviation) / len(deviation)),
        in_position=sum(map(bool, in_position)) / len(in_position),
    )


def objection(before: MoveFigures, after: MoveFigures) -> str | None:
    """Return why gains are not better than those before; None where they are at least as good."""
    if abs(after.top_speed_rpm - before.top_speed_rpm) > ALIKE * before.top_speed_rpm:
        return (
            f"the moves were not alike: up to {before.top_speed_rpm:.0f} r/min before, {after.top_speed_rpm:.0f} after"
        )
    if after.typical_deviation > (1 + SAME) * before.typical_deviation:
        return f"the deviation has grown from {before.typical_deviation:.1f} to {after.typical_deviation:.1f} units"
    return None
