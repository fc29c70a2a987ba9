"""Motor against encoder: does a positive output turn the motor the way in which the encoder counts forward?

The loop is closed with an output limit that begins with a single PWM step and grows by half, and with a low position
error limit. The set-point leads away beyond that limit: a motor that turns the wrong way, one that does not turn and an
encoder that does not count all end in the drive, which opens its loop.
"""

import math
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass

from typing_extensions import override

from ldcnd.bench.commissioning.record import Figure, PlotSeries, Result, StepState
from ldcnd.bench.commissioning.step import AxisContext, Step, StepContext, refuse_latched, refuse_previewed, rest_counts
from ldcnd.bench.kept_gains import KeptGains, gains_in, keep, open_loop, restore
from ldcnd.bench.machine_faults import STANDS, MachineFault, named
from ldcnd.client.axis import Axis, seen
from ldcnd.contract.commands import Verb
from ldcnd.contract.errors import CommandAborted, DriveFault, LdcndError, WrongState
from ldcnd.contract.samples import AxisState

MOST_EL_COUNTS = 200
TRACE_END_S = 60.0
"""Longest time from the arming of a trace to its end, seconds."""
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
FELL_SHARE = 0.1
"""An axis that goes by itself this share of the position error limit when the loop opens has a load that hangs."""
TRACE_S = 0.02
AFTER_S = 0.2
"""The trace of a motion has a sample each `TRACE_S`, and lasts this much longer than its profile, seconds."""
SHAFT = {"yes": "it turned", "no": "it stood", "unseen": "it cannot be seen"}
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
    def obstacle(self, site: AxisContext) -> str:
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
                f" {site.length(lead.velocity)}/s, with {OUTPUTS[0]} to {OUTPUTS[-1]} of 255 PWM steps; back by as much"
                " where it does not"
            ),
            (
                f"it stays within {caught:.0f} counts ({site.length(caught / site.counts_per_unit)}): a motor that"
                f" turns the wrong way is caught after {el} counts, where the loop opens, and its friction stops it; a"
                " load that carries it off then may take it twice as far"
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
        tries: list[MotorTry] = []
        lead = _lead(site, el)
        back = await axis.preview(distance=-lead.distance, velocity=lead.velocity, acceleration=lead.acceleration)
        ways = [1] if back.refusal else [1, -1]
        went_against = False
        async with lent_gains(site, axis) as old:
            for output in (each for each in OUTPUTS if each <= old["ol"]):
                for way in tuple(ways):
                    tries.append(await self._try(site, axis, output, el, way))
                    if way > 0 and await self._is_blind(site, tries):  # before it is asked back, without counts
                        return _result(el, tries, MachineFault.NO_COUNTS)
                    if tries[-1].follows(el):
                        return await self._confirmed(site, el, tries)
                    if tries[-1].goes_against(el):
                        if way < 0:  # asked forward it stood, or went back: no load does both
                            return _result(el, tries, MachineFault.REVERSED)
                        went_against = True
                        ways.remove(1)  # a load may carry it: asked back, only a reversed motor goes forward
                    elif went_against and tries[-1].goes(el):
                        return _result(el, tries, MachineFault.CARRIED)
        if any(each.goes(el) or each.goes_against(el) for each in tries):
            return _result(el, tries, MachineFault.REVERSED, MachineFault.CARRIED, MachineFault.COUPLING)
        if await site.person.choose("did the shaft of the motor turn", SHAFT) == "yes":
            return _result(el, tries, MachineFault.COUPLING)
        return _result(el, tries, *STANDS, *(() if -1 in ways else (MachineFault.AT_END,)))

    @staticmethod
    async def _is_blind(site: StepContext, tries: "Sequence[MotorTry]") -> bool:
        """Ask whether the axis moved where nothing was counted so far."""
        if any(abs(each.farthest) >= COUNTING for each in tries):
            return False
        nothing = f"the encoder counted nothing with {tries[-1].output} of 255 PWM steps"
        return await site.person.confirm(f"{nothing}: did the axis move")

    async def _confirmed(self, site: StepContext, el: int, tries: "list[MotorTry]") -> Result:
        """Ask whether it was this axis; return that motor and encoder agree."""
        name, moved = site.info.axis, tries[-1].farthest
        if len(await site.rig.describe()) > 1 and not await site.person.confirm(
            f"the encoder counted {moved}: was it axis {name} that moved"
        ):
            text = (
                f"what moved is not axis {name}: exchange the addresses of the two axes in the configuration (`ldcnd"
                " scan PORT` says from which end the chain is numbered), start the daemon again, and run this step"
                " again"
            )
            return _result(el, tries, text=text, state=StepState.FAILED)
        return _agreement(el, tries)

    async def _try(self, site: StepContext, axis: Axis, output: int, el: int, way: int) -> "MotorTry":
        """Ask for a motion with an output limit, with its trace; its place is taken before the loop is opened."""
        # from half the position error limit on the output is at its limit
        kp = min(math.ceil(2 * PWM_PER_GAIN * output / el), REGISTER_MOST)
        lowered = {"kp": kp, "kd": min(DAMPING * kp, REGISTER_MOST), "ki": 0, "il": 0, "ol": output, "el": el}
        await axis.set_gains(gain_set=None, **lowered, lent=True)
        sign = -1 if site.info.direction == "reverse" else 1
        before = await rest_counts(axis)
        lead = _lead(site, el)
        await axis.power(on=True)
        samples = math.ceil((lead.distance / lead.velocity * (1 + RAMP_SHARE) + AFTER_S) / TRACE_S)
        async with axis.tracing("position", samples=samples, interval_s=TRACE_S) as taken:
            motion = await axis.move_relative(
                way * lead.distance, velocity=lead.velocity, acceleration=lead.acceleration
            )
            with suppress(DriveFault, CommandAborted):  # where the axis is tells more
                await motion.done()
            refuse_latched(axis)
            trace = await taken(TRACE_END_S)
        tripped = axis.state.state is AxisState.ERROR_STOP
        held = await rest_counts(axis)
        await open_loop(axis)
        rest = await rest_counts(axis)
        places = [*(int(each) for each in trace.raw[0] if each is not None), held, rest]
        farthest = max((sign * (each - before) for each in places), key=abs)
        if not tripped and abs(held - before) < REVERSE_SHARE * el:
            raise WrongState(
                f"axis {axis.name} was halted before it could be seen to move", axis=axis.name, remedy="run it again"
            )
        fell = 0 if tripped else sign * (rest - held)
        return MotorTry(output, way, farthest, tripped, fell)


@dataclass(frozen=True, slots=True)
class MotorTry:
    """One motion that was tried.

    Attributes:
        output: its limit, PWM steps.
        way: 1 where it was asked forward, -1 back.
        farthest: from where it stood, counts forward, while the loop was closed or behind that.
        tripped: the drive has opened the loop.
        fell: how far it went by itself when the loop was opened, counts forward.
    """

    output: int
    way: int
    farthest: int
    tripped: bool
    fell: int

    def follows(self, el: int) -> bool:
        """Tell whether it went to its goal and stayed there: neither a load nor a reversed motor does that."""
        return not self.tripped and self.goes(el)

    def goes(self, el: int) -> bool:
        """Tell whether it went the way that was asked."""
        return self.way * self.farthest >= FORWARD_SHARE * el

    def goes_against(self, el: int) -> bool:
        """Tell whether it went the other way."""
        return self.way * self.farthest <= -REVERSE_SHARE * el


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


def _agreement(el: int, tries: Sequence[MotorTry]) -> Result:
    last = tries[-1]
    text = f"motor and encoder agree: it moved {'forward' if last.way > 0 else 'back'} by {abs(last.farthest)} counts"
    found: list[MachineFault] = []
    if abs(last.fell) >= max(COUNTING, FELL_SHARE * el):
        side = "back" if last.fell * last.way < 0 else "on"
        text += f"; it fell {side} by {abs(last.fell)} counts when the loop opened"
        found.append(MachineFault.LOAD_HANGS)
    elif any(each.goes_against(el) for each in tries):
        text += "; before that it went against its output"
        found.append(MachineFault.CARRIED)
    if last.way < 0 and not found:
        text += f"; forward it did not move with {last.output} of 255 PWM steps: {MachineFault.AT_END}"
    return _result(el, tries, *found, text=text, state=StepState.DONE)


def _result(
    el: int, tries: Sequence[MotorTry], *faults: MachineFault, text: str = "", state: StepState = StepState.FAILED
) -> Result:
    last = max(tries, key=lambda each: abs(each.farthest))
    if not text:
        asked = {1: "asked forward", -1: "asked back"}
        went = {each.way: each for each in tries if abs(each.farthest) >= COUNTING}
        text = "; ".join(
            f"{asked[way]}, it moved {'forward' if each.farthest > 0 else 'back'} by {abs(each.farthest)} counts"
            for way, each in went.items()
        )
        text = text or f"it stood with up to {last.output if went else tries[-1].output} of 255 PWM steps"
    figures = (
        Figure(what="moved", value=last.farthest, unit="counts"),
        Figure(what="output limit", value=tries[-1].output, unit="of 255 PWM steps"),
        Figure(what="position error limit", value=el, unit="counts"),
        Figure(what="stated distance", value=CAUGHT * el, unit="counts"),
    )
    series = tuple(
        PlotSeries(
            title=f"Motion by output limit, asked {side}",
            x="PWM steps of 255",
            y="counts forward",
            points=tuple((float(each.output), float(each.farthest)) for each in tries if each.way == way),
        )
        for way, side in ((1, "forward"), (-1, "back"))
    )
    said = f"{text}: {named(faults)}" if faults else text
    return Result(state=state, text=said, figures=figures, series=series, faults=tuple(faults))
