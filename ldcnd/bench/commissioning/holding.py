"""Holding output: friction and load of an axis, from the output that holds it at rest behind a motion each way.

The loop has a position and a derivative gain only, so its output at rest is `kp` times the position error. A slow
motion forward ends where output and load exceed friction no more, one back where they do so the other way: half of the
difference of the two outputs is friction, their mean is what holds the load. Outputs are whole PWM steps, so both are
known to half a step or so.

An axis with a hanging load stands on its stop when the step begins, so each trial first goes away from there, with the
loop closed, and ends where it can still fall: that it falls when the loop opens is seen, and not concluded.
"""

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass

from typing_extensions import override

from ldcnd.bench.commissioning.first_settings import powered_off
from ldcnd.bench.commissioning.motor import (
    COUNTING,
    DAMPING,
    FELL_SHARE,
    HOW_IT_ENDS,
    OUTPUTS,
    PWM_PER_GAIN,
    REGISTER_MOST,
    error_limit,
    lent_gains,
)
from ldcnd.bench.commissioning.record import Figure, PlotSeries, Result, StepState
from ldcnd.bench.commissioning.step import AxisContext, Step, StepContext, refuse_latched, refuse_previewed, rest_counts
from ldcnd.bench.kept_gains import open_loop
from ldcnd.bench.machine_faults import STANDS, MachineFault, named
from ldcnd.client.axis import Axis, seen
from ldcnd.contract.commands import Verb
from ldcnd.contract.errors import CommandAborted, DriveFault
from ldcnd.contract.samples import AxisState

WAY = 2.5
"""Each motion goes this many times the position error limit: it counts from the goal before, which the axis may be one
limit behind, so an axis that does not follow both ways exceeds the limit."""
LIFT = 1.25
"""It first goes this many times the position error limit away from where it stands, and does not come back to there."""
REACH = 5.0
"""It stays within this many times the position error limit: lift, one motion, and what it may be beyond its goal."""
SATURATED_SHARE = 0.8
"""The output is at its limit from this share of the position error limit on."""
DURATION_S = 3.0
"""Time for each motion, seconds: so slow that it ends with no more speed than friction takes at once."""
RAMP_SHARE = 0.1
APPROACHES = 2
"""From each side."""
GROWTH = 1.5
CARRIED_GROWTH = 3.0
"""Growth of the output limit where the axis stood, and where it went one way: by itself, or carried by a load."""
HALF_A_STEP = 0.5
UNIT = "of 255 PWM steps"


class HoldingOutput(Step):
    """Measures friction and load by the output that holds the axis."""

    name = "hold"
    title = "Friction and hanging load, measured"
    about = (
        "The axis moves slowly forward and back by a fraction of a turn, with as little output as that takes. What the"
        " motor gives at rest behind each motion tells its friction, and how much of it a load takes."
    )
    needs = (Verb.POWER, Verb.MOVE_RELATIVE, Verb.SET_GAINS)
    depends = ("direction",)

    @override
    def obstacle(self, site: AxisContext) -> str:
        if super().obstacle(site):
            return super().obstacle(site)
        if site.config.gains is None:
            return "not possible without `gains` in the configuration: the loop stays open"
        if site.config.settle.unsettled == "fault":
            return 'not possible with `settle.unsettled = "fault"`: the axis rests beside its goals here'
        return ""

    @override
    async def preview(self, site: StepContext) -> tuple[str, ...]:
        el, way = error_limit(site), _way(site)
        velocity, acceleration = _profile(site)
        async with site.rig.watch(site.info.axis) as axis:
            refuse_latched(await seen(axis))
            if not await _sides(site, axis):
                refuse_previewed(
                    await axis.preview(distance=_farthest(site), velocity=velocity, acceleration=acceleration)
                )
        return (
            (
                f"{site.info.axis} moves {APPROACHES} times forward and back by {WAY * el:.0f} counts"
                f" ({site.length(way)}), at {site.length(velocity)}/s, with {OUTPUTS[0]} to {OUTPUTS[-1]} {UNIT}"
            ),
            (
                f"it begins {LIFT * el:.0f} counts beside where it stands, on the side to which it can go, and stays"
                f" within {REACH * el:.0f} counts; a load that hangs falls back when the loop opens"
            ),
            f"beyond a position error of {el} counts the drive opens its loop; then more output is tried",
            "run the step motor first: this one takes for granted that motor and encoder agree",
            *HOW_IT_ENDS,
        )

    @override
    async def run(self, site: StepContext, axis: Axis) -> Result:
        el = error_limit(site)
        sign = -1 if site.info.direction == "reverse" else 1
        async with lent_gains(site, axis) as old:
            origin, output = await rest_counts(axis), OUTPUTS[0]
            while output <= min(OUTPUTS[-1], old["ol"]):
                before = await rest_counts(axis)
                gone = abs(before - origin)
                if gone > REACH * el:
                    return _failed(site, f"it went {gone} counts by itself", MachineFault.CARRIED)
                first = -1 if sign * (before - origin) > 0 else 1
                carried = False
                wanted = (first, -first) if gone < el / 2 else (first,)  # from where it was left towards the origin
                sides = await _sides(site, axis)
                for lift in [each for each in wanted if each in sides] or sides:
                    trial = await self._approach(site, axis, output, el, lift)
                    if trial:
                        return _judged(site, trial, old.get("cl"))
                    carried = abs(await rest_counts(axis) - before) > el / 2
                    if carried:
                        break
                output = math.ceil(output * (CARRIED_GROWTH if carried else GROWTH))
        return _failed(site, f"it does not follow with {min(OUTPUTS[-1], old['ol'])} {UNIT}", *STANDS)

    @staticmethod
    async def _approach(site: StepContext, axis: Axis, output: int, el: int, lift: int) -> "HoldingTrial | None":
        """Go away from where it stands, then to and fro, with an output limit; None where the drive gives up."""
        kp = min(math.ceil(PWM_PER_GAIN * output / (SATURATED_SHARE * el)), REGISTER_MOST)
        await axis.set_gains(kp=kp, kd=min(DAMPING * kp, REGISTER_MOST), ki=0, il=0, ol=output, el=el, lent=True)
        velocity, acceleration = _profile(site)
        lifted, way = lift * LIFT * el / site.counts_per_unit, lift * _way(site)
        outputs: list[tuple[int, float]] = []
        await axis.power(on=True)
        for distance in (lifted, *(way, -way) * APPROACHES):
            motion = await axis.move_relative(distance, velocity=velocity, acceleration=acceleration)
            with suppress(DriveFault, CommandAborted):  # its state tells more
                await motion.done()
            refuse_latched(axis)
            if axis.state.state is AxisState.ERROR_STOP:
                await open_loop(axis)
                return None
            held = await rest_counts(axis)
            error = (motion.reply.position or 0.0) - axis.position.value
            if modulo := site.info.modulo:  # both are within a turn, of which the end may lie between
                error = math.remainder(error, modulo)
            error *= site.counts_per_unit
            outputs.append((1 if distance > 0 else -1, kp * error / PWM_PER_GAIN))
        await open_loop(axis)
        sign = -1 if site.info.direction == "reverse" else 1
        return HoldingTrial(tuple(outputs[1:]), sign * (await rest_counts(axis) - held), max(COUNTING, FELL_SHARE * el))


@dataclass(frozen=True, slots=True)
class HoldingTrial:
    """What an axis did that followed to and fro.

    Attributes:
        outputs: direction of each motion, and the output at rest behind it, PWM steps.
        fell: how far it went by itself when the loop was opened, counts forward.
        falls_from: from so many counts on, it has fallen.
    """

    outputs: tuple[tuple[int, float], ...]
    fell: int
    falls_from: float


def _way(site: StepContext) -> float:
    """Return how far each motion goes, in axis units."""
    return WAY * error_limit(site) / site.counts_per_unit


def _farthest(site: StepContext) -> float:
    """Return how far the goals are from where it stands, in axis units."""
    return (LIFT + WAY) * error_limit(site) / site.counts_per_unit


async def _sides(site: StepContext, axis: Axis) -> list[int]:
    """Return the sides to which it may go: forward 1, back -1. It may stand at one of its limits."""
    velocity, acceleration = _profile(site)
    replies = {
        side: await axis.preview(distance=side * _farthest(site), velocity=velocity, acceleration=acceleration)
        for side in (1, -1)
    }
    return [side for side, reply in replies.items() if not reply.refusal and reply.approach_from is None]


def _profile(site: StepContext) -> tuple[float, float]:
    """Return velocity and acceleration of the motions, in axis units."""
    limits = site.info.limits
    velocity = min(_way(site) / DURATION_S, limits.velocity or math.inf)
    return velocity, min(velocity / (RAMP_SHARE * DURATION_S), limits.acceleration or math.inf)


def _held(outputs: Sequence[tuple[int, float]], direction: int) -> float:
    """Return the output that holds the axis behind motions in a direction, PWM steps; the drive gives whole ones."""
    held = [math.trunc(output) for way, output in outputs if way == direction]
    return sum(held) / len(held)


def _judged(site: StepContext, trial: HoldingTrial, limit: int | None) -> Result:
    outputs = trial.outputs
    forward, back = _held(outputs, 1), _held(outputs, -1)
    # the next whole step would have moved it on
    friction, load = max((forward - back) / 2 + HALF_A_STEP, 0.0), (forward + back) / 2
    pulls = f"a load pulls it {'back' if load > 0 else 'forward'} with {abs(load):.1f} {UNIT}"
    has_fallen = abs(trial.fell) >= trial.falls_from
    faults: tuple[MachineFault, ...] = ()
    if has_fallen:
        side = "forward" if trial.fell > 0 else "back"
        text = f"it fell {side} by {abs(trial.fell)} counts when the loop opened; {pulls}"
        faults = (MachineFault.LOAD_HANGS,)
    elif forward * back > 0:
        text = (
            f"{pulls}, more than the {friction:.1f} of its friction, and it stayed where it was when the loop opened: a"
            " brake holds it; without that it falls"
        )
        faults = (MachineFault.LOAD_HANGS,)
    elif abs(load) < 1.0:
        text = f"no load to speak of; friction takes {friction:.1f} {UNIT}"
    else:
        holds = "holds it without power" if min(abs(forward), abs(back)) >= 1.0 else "hardly holds it without power"
        text = f"{pulls}; its friction of {friction:.1f} {holds}: it stayed where it was when the loop opened"
    if faults:
        text += f": {named(faults)}{powered_off(site.config)}"
        if _said(site) == "none":
            text += "; you have said that nothing falls: run the step load again"
    figures = (
        Figure(what="output at rest behind a motion forward", value=forward, unit=UNIT),
        Figure(what="output at rest behind a motion back", value=back, unit=UNIT),
        Figure(what="friction, to half a step", value=friction, unit=UNIT),
        Figure(what="output that holds the load, to half a step", value=load, unit=UNIT),
        *_current_limit(limit),
    )
    points = tuple((float(number), output) for number, (_, output) in enumerate(outputs, 1))
    series = (PlotSeries(title="Output at rest", x="motion", y="PWM steps of 255", points=points),)
    return Result(state=StepState.DONE, text=text, figures=figures, series=series, faults=faults)


def _said(site: StepContext) -> object:
    """Return what the person has answered in the step `load`."""
    figures = site.record.of("load").result.figures
    return next((each.value for each in figures if each.what == "load"), None)


def _current_limit(limit: int | None) -> tuple[Figure, ...]:
    """Return what the drive does about its current, where it has a register for that."""
    if limit is None:
        return ()
    side = "none" if not limit else f"at A/D readings {'above' if limit & 1 else 'below'} {limit}"
    return (
        Figure(
            what="current limit (cl)",
            value=f"{limit}: {side}; not proposed, because the scale of the current sensor is not known here: read"
            " `adc` of the axis at the motor's rated current",
        ),
    )


def _failed(site: StepContext, seen: str, *faults: MachineFault) -> Result:
    """Return that it did not follow; a reversed motor may be why, unless the step `motor` has excluded it."""
    agrees = site.record.of("motor").result.state is StepState.DONE
    possible = faults if agrees else (*faults, MachineFault.REVERSED)
    return Result(state=StepState.FAILED, text=f"{seen}: {named(possible)}", faults=possible)
