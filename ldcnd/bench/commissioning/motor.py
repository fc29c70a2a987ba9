"""Motor against encoder: does a positive output turn the motor the way in which the encoder counts forward?

The loop is closed with an output limit that begins with a single PWM step and grows by half, and with a low position
error limit. The set-point leads away beyond that limit: a motor that turns the wrong way, one that does not turn and an
encoder that does not count all end in the drive, which opens its loop.
"""

import math
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass

from typing_extensions import override

from ldcnd.bench.commissioning.record import Figure, PlotSeries, Result, StepState
from ldcnd.bench.commissioning.step import Step, StepContext, refuse_latched, refuse_previewed, rest_counts
from ldcnd.client.axis import Axis, seen
from ldcnd.client.kept_gains import KeptGains, gains_in, keep, open_loop, restore
from ldcnd.contract.commands import Verb
from ldcnd.contract.errors import CommandAborted, DriveFault, LdcndError, WrongState
from ldcnd.contract.samples import AxisState

MOST_EL_COUNTS = 200
OUTPUTS = (1, 2, 3, 4, 6, 9, 13, 20, 30, 45, 60)
"""Output limits that are tried, in PWM steps of 255. A motor that stood at one gets at most twice its friction next."""
LEAD = 2.0
"""The set-point goes this many times the position error limit."""
DURATION_S = 0.2
"""Time that the set-point takes for that, seconds."""
RAMP_SHARE = 0.1
CAUGHT = 3.0
"""A runaway ends within this many times the position error limit: one until the loop opens; then it coasts, at most
twice as far, because it was driven with at most twice its friction, which at speed is at least half of that at rest."""
FORWARD_SHARE = 0.25
REVERSE_SHARE = 0.125
"""Shares of the position error limit from which a motion counts as one."""
COUNTING = 4
"""An encoder that counts less, counts nothing: the person is asked whether the axis moved."""
DAMPING = 8
"""kd over kp while the step runs."""
PWM_PER_GAIN = 256
"""The drive's output is kp times the error, divided by this."""
REGISTER_MOST = 0x7FFF

HOW_IT_ENDS = (
    "the loop is open before, between and after: a load that falls without power must be secured",
    "ending the step, in a terminal by Ctrl-C, halts it and opens the loop",
    "the gains of the drive come back at the end; this is software, keep the emergency stop within reach",
)
"""Said before each step that lends gains and moves."""


class MotorDirection(Step):
    """Compares the direction of the motor with that of the encoder."""

    name = "motor"
    title = "Motor against encoder"
    about = (
        "The loop is closed with a low output limit and a low position error limit, and asked for a fraction of a turn,"
        " with a little more output each time, until the encoder counts. If motor and encoder disagree, the position"
        " error limit opens the loop."
    )
    needs = (Verb.POWER, Verb.MOVE_RELATIVE, Verb.SET_GAINS)

    @override
    def obstacle(self, site: StepContext) -> str:
        if site.config.gains is None and not super().obstacle(site):
            return "not possible without `gains` in the configuration: the loop stays open"
        return super().obstacle(site)

    @override
    async def preview(self, site: StepContext) -> tuple[str, ...]:
        el = error_limit(site)
        caught = CAUGHT * el
        lead = _lead(site, el)
        await _refuse_what_cannot_be(site, lead)
        return (
            (
                f"{site.info.axis} moves forward by about {LEAD * el:.0f} counts ({site.length(lead.distance)}), at"
                f" {site.length(lead.velocity)}/s, with {OUTPUTS[0]} to {OUTPUTS[-1]} of 255 PWM steps"
            ),
            (
                f"it stays within {caught:.0f} counts ({site.length(caught / site.counts_per_unit)}): a motor that"
                f" turns the wrong way is caught after {el} counts, where the loop opens, and its friction stops it"
            ),
            (
                "an encoder that does not count: the loop opens, too, within"
                f" {lead.distance / lead.velocity:.2g} s, and you are asked whether the axis moved: watch it"
            ),
            "watch also that it is this axis that moves: equal drives whose addresses are exchanged look alike",
            *HOW_IT_ENDS,
        )

    @override
    async def run(self, site: StepContext, axis: Axis) -> Result:
        el = error_limit(site)
        points: list[tuple[float, float]] = []
        async with lent_gains(site, axis) as old:
            for output in (each for each in OUTPUTS if each <= old["ol"]):
                moved = await self._try(site, axis, output, el)
                points.append((output, moved))
                if moved >= FORWARD_SHARE * el or moved <= -REVERSE_SHARE * el:
                    break
                nothing = f"the encoder counted nothing with {output} of 255 PWM steps"
                if abs(moved) < COUNTING and await site.person.confirm(f"{nothing}: did the axis move"):
                    return _blind(nothing, el, points)
        if abs(moved) >= COUNTING and len(await site.rig.describe()) > 1:
            name = site.info.axis
            if not await site.person.confirm(f"the encoder counted {moved}: was it axis {name} that moved"):
                return _mistaken(name, el, points)
        return _judged(el, points)

    async def _try(self, site: StepContext, axis: Axis, output: int, el: int) -> int:
        """Ask for a motion with an output limit; return how far the axis is then from where it was, in counts."""
        # from half the position error limit on the output is at its limit
        kp = min(math.ceil(2 * PWM_PER_GAIN * output / el), REGISTER_MOST)
        lowered = {"kp": kp, "kd": min(DAMPING * kp, REGISTER_MOST), "ki": 0, "il": 0, "ol": output, "el": el}
        await axis.set_gains(**lowered, lent=True)
        sign = -1 if site.info.direction == "reverse" else 1
        before = await rest_counts(axis)
        lead = _lead(site, el)
        await axis.power(on=True)
        motion = await axis.move_relative(lead.distance, velocity=lead.velocity, acceleration=lead.acceleration)
        with suppress(DriveFault, CommandAborted):  # where the axis is tells more
            await motion.done()
        refuse_latched(axis)
        tripped = axis.state.state is AxisState.ERROR_STOP
        await open_loop(axis)
        moved = sign * (await rest_counts(axis) - before)
        if not tripped and abs(moved) < REVERSE_SHARE * el:
            raise WrongState(
                f"axis {axis.name} was halted before it could be seen to move", axis=axis.name, remedy="run it again"
            )
        return moved


@asynccontextmanager
async def lent_gains(site: StepContext, axis: Axis) -> AsyncIterator[dict[str, int]]:
    """Open the loop, yield the gains that the drive has, and put them back at the end, whatever ends the context.

    The loop is open afterwards. Where control was lost meanwhile they stay kept: the checklist puts them back.

    Raises:
        WrongState: the gains are not known, or the axis does not come to rest.
        LdcndError: as the daemon refused it.
    """
    refuse_latched(axis)
    await open_loop(axis)
    await axis.set_gains()  # a drive that was not powered on since its reset has none yet
    info = next(each for each in await site.rig.describe() if each.axis == axis.name)
    kept = KeptGains(rig=site.rig.name, axis=axis.name, gains=gains_in(info), model=info.model)
    keep(kept)
    try:
        yield kept.gains
    finally:
        with suppress(LdcndError):
            await restore(axis, kept)


def error_limit(site: StepContext) -> int:
    """Return the position error limit of the step, in counts: that of the configuration if it is lower."""
    return min(MOST_EL_COUNTS, site.config.gains.el) if site.config.gains else MOST_EL_COUNTS


@dataclass(frozen=True, slots=True)
class _Lead:
    """How the set-point leads away from the axis, in axis units."""

    distance: float
    velocity: float
    acceleration: float


def _lead(site: StepContext, el: int) -> _Lead:
    distance, limits = LEAD * el / site.counts_per_unit, site.info.limits
    velocity = min(distance / DURATION_S, limits.velocity or math.inf)
    return _Lead(distance, velocity, min(velocity / (RAMP_SHARE * DURATION_S), limits.acceleration or math.inf))


async def _refuse_what_cannot_be(site: StepContext, lead: _Lead) -> None:
    """Raise what the daemon would refuse about the distance."""
    async with site.rig.watch(site.info.axis) as axis:
        refuse_latched(await seen(axis))
        reply = await axis.preview(distance=lead.distance, velocity=lead.velocity, acceleration=lead.acceleration)
    refuse_previewed(reply)


def _blind(nothing: str, el: int, points: list[tuple[float, float]]) -> Result:
    text = f"{nothing}, and the axis moved: switch the drive off and check the wires of the encoder"
    return _result(StepState.FAILED, text, el, points)


def _mistaken(name: str, el: int, points: list[tuple[float, float]]) -> Result:
    text = (
        f"what moved is not axis {name}: exchange the addresses of the two axes in the configuration (`ldcnd scan PORT`"
        " says from which end the chain is numbered), start the daemon again, and run this step again"
    )
    return _result(StepState.FAILED, text, el, points)


def _judged(el: int, points: list[tuple[float, float]]) -> Result:
    output, moved = points[-1]
    if moved >= FORWARD_SHARE * el:
        text, state = f"motor and encoder agree: it moved forward by {moved:.0f} counts", StepState.DONE
    elif moved <= -REVERSE_SHARE * el:
        text = (
            f"motor and encoder disagree: asked forward, it moved back by {-moved:.0f} counts until the loop opened,"
            " unless a load pulled it. Switch the drive off, swap the two wires of the motor, and run this step again"
        )
        state = StepState.FAILED
    else:
        text = f"it stood with up to {output:.0f} of 255 PWM steps: check supply, wires of the motor, and brake"
        state = StepState.FAILED
    return _result(state, text, el, points)


def _result(state: StepState, text: str, el: int, points: list[tuple[float, float]]) -> Result:
    output, moved = points[-1]
    figures = (
        Figure(what="moved", value=moved, unit="counts"),
        Figure(what="output limit", value=output, unit="of 255 PWM steps"),
        Figure(what="position error limit", value=el, unit="counts"),
        Figure(what="stated distance", value=CAUGHT * el, unit="counts"),
    )
    series = (
        PlotSeries(title="Motion by output limit", x="PWM steps of 255", y="counts forward", points=tuple(points)),
    )
    return Result(state=state, text=text, figures=figures, series=series)
