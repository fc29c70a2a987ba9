"""Tuning one axis of a running rig, by the public client alone: measure, propose, apply, verify, or put back.

Each trial closes the loop where the axis stands and opens it again, so no position error is ever handed from one set of
gains to the next. The old gains are on the disk of this host before the first others are in the drive. They come back
when anything ends a measurement; after the death of this host, when a person asks for it.
"""

import asyncio
import math
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager
from dataclasses import asdict, dataclass, replace

from ldcnd.client.axis import Axis
from ldcnd.client.rig import Rig
from ldcnd.client.rig_client import RigClient
from ldcnd.client.traces import Trace, armed_trace, fetch_trace, wait_for_trace
from ldcnd.drivers.ldcn.profiles import PROFILES, Profile
from ldcnd.drivers.ldcn.registers import Gains
from ldcnd.errors import (
    DriveFault,
    NotReferenced,
    NotSupported,
    PositionLimit,
    Remedy,
    ValueOutOfRange,
    WrongState,
    step,
)
from ldcnd.model.meta import AxisInfo
from ldcnd.model.samples import AxisState
from ldcnd.model.traces import TakeTrace
from ldcnd.tuning.kept_gains import KeptGains, at_rest, forget, gains_in, keep, kept_for, load, put_back
from ldcnd.tuning.ldcn.design import Proposal, duration_s, figures_of, propose, stiff_gains, within_authority
from ldcnd.tuning.ldcn.excitation import Bounds, Excitation, Record, Shown, Trial, Trials
from ldcnd.tuning.ldcn.identify import Identified, identify
from ldcnd.tuning.ldcn.response import Figures, Move, simulate
from ldcnd.tuning.ldcn.verdict import MOST_MEASURED_OVERSHOOT, Measured, measured, objection, worst
from ldcnd.tuning.report import Estimate, LoopMargins, MoveFigures, TuningReport

CLIENT = "ldcnd tune"
LEASE_S = 2.0
"""So soon the daemon applies `loss.client` of the axis when this program disappears, seconds."""
WITHIN_COUNTS = 2000
"""Distance where none is wanted, counts."""
PUT_BACK_S = 15.0
"""Longest time that the old gains may take to come back, seconds."""
LEAD_S = 0.1
"""Samples are taken for so much longer than the trial lasts, seconds."""
FIRST_INTERVAL_S = 0.0025
"""Time between two samples until a trace has shown it, seconds."""
LONGEST_INTERVAL_S = 0.012
"""With samples farther apart than this, a trace shows too little, seconds."""
STILL_SAMPLES = 4
STILL_INTERVAL_S = 0.02
STILL_LOOKS = 100
TRACE_S = 60.0
AFTER_REST_S = 0.03
"""A record ends so long after its last count, seconds."""
BELOW = 1 - 1e-9
"""Keeps a limit that was converted to counts and back from being exceeded by its rounding."""

Tell = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class Plan:
    """What tuning would do; nothing has been sent to the drive.

    Attributes:
        info: the axis.
        profile: its dialect.
        bounds: what the axis may be asked to do.
        lines: the same for people.
    """

    info: AxisInfo
    profile: Profile
    bounds: Bounds
    lines: tuple[str, ...]

    @property
    def counts_per_unit(self) -> float:
        """Signed: negative where forward in units is backward in counts."""
        counts = self.info.counts_per_unit or 1.0
        return -counts if self.info.direction == "reverse" else counts

    def units(self, counts: float) -> float:
        """Return counts as a length in axis units, without sign of its own."""
        return counts / abs(self.counts_per_unit)


@dataclass(frozen=True, slots=True)
class Findings:
    """What was measured and is proposed; the old gains are in the drive.

    Attributes:
        plan: as it was.
        old: the gains that the axis had.
        known: the plant.
        proposal: gains for it.
        move: the test move.
        before: as measured with the old gains; fewer than two where the drive gave up or the model forbade it.
        farthest_counts: from where the axis stood.
    """

    plan: Plan
    old: dict[str, int]
    known: Identified
    proposal: Proposal
    move: Move
    before: tuple[Measured, ...]
    farthest_counts: int


@dataclass(frozen=True, slots=True)
class Verified:
    """The test move with the proposed gains.

    Attributes:
        after: as measured; fewer than two where the drive gave up.
        objection: why the gains were not kept; None where they were.
        farthest_counts: from where the axis stood.
    """

    after: tuple[Measured, ...]
    objection: str | None
    farthest_counts: int


async def plan(client: RigClient, name: str, within: float | None) -> Plan:
    """Check that an axis can be tuned, and say what that would do; sends nothing to its drive.

    Args:
        client: of the rig.
        name: of the axis.
        within: the distance from where it stands that it may not leave, in axis units; 2000 counts when missing.

    Raises:
        NotSupported: its drive has no gains of this kind.
        WrongState: its loop is closed, it moves, or an earlier tuning is not put back.
        NotReferenced: it has position limits, and does not know where it is.
        PositionLimit: the distance does not fit between them.
        ValueOutOfRange: it is too short.
    """
    rig = Rig(client, await client.daemon())
    async with rig.watch(name) as axis:
        info = next(each for each in await client.axes() if each.axis == name)
        profile = _profile_of(info)
        if kept_for(rig.name, name):
            raise WrongState(
                f"axis {name}: an earlier tuning was cut short and its gains are still to be put back",
                axis=name,
                remedy=f"type: ldcnd tune {name} --put-back",
            )
        await _check_off(axis)
        counts_per_unit = info.counts_per_unit or 1.0
        within_counts = WITHIN_COUNTS if within is None else round(within * counts_per_unit)
        limits = info.limits
        bounds = Bounds(
            within_counts,
            math.inf if limits.velocity is None else limits.velocity * counts_per_unit * BELOW,
            math.inf if limits.acceleration is None else limits.acceleration * counts_per_unit * BELOW,
        )
        excitation = Excitation(profile, bounds)
        await _check_travel(axis, info, within_counts / counts_per_unit)
        lines = _lines(info, axis.position.value, bounds, excitation)
    return Plan(info, profile, bounds, lines)


def _profile_of(info: AxisInfo) -> Profile:
    if info.family == "smartstep":
        raise NotSupported(
            f"axis {info.axis}: a {info.model} tunes itself; its gains are parameters of the drive",
            axis=info.axis,
            remedy=f"choose online auto-tuning with Pn110 (`ldcnd params get {info.axis} Pn110`), and save its result"
            " with the drive's own function Fn007",
        )
    profile = PROFILES.get(info.model)
    if profile is None:
        raise NotSupported(f"axis {info.axis}: a {info.model} has no law that is known here", axis=info.axis)
    return profile


async def _check_off(axis: Axis) -> None:
    """Refuse an axis whose loop is closed: with the amplifier off, a load that falls has fallen."""
    state = axis.state
    if state.enabled or state.state is not AxisState.DISABLED:
        raise WrongState(
            f"axis {axis.name} is {state.state.value}: tuning begins with the loop open, because it opens it many"
            " times: an axis that does not stay where it is then cannot be tuned by it",
            axis=axis.name,
            value=state.state.value,
            remedy=Remedy("secure the load, then {}", step("reset"))
            if state.state is AxisState.ERROR_STOP
            else f"secure the load, then type: ldcnd axis power {axis.name} off",
        )
    await at_rest(axis)


async def _check_travel(axis: Axis, info: AxisInfo, within: float) -> None:
    """Refuse a distance that does not fit into the travel of the axis, and an axis that comes from one side only."""
    limits = info.limits
    here = axis.position.value
    lowest, highest = limits.position_min, limits.position_max
    if (lowest is not None or highest is not None) and not axis.state.referenced:
        raise NotReferenced(
            f"axis {axis.name} has position limits and does not know where it is",
            axis=axis.name,
            remedy=Remedy("{}, then power it off", step("home")),
        )
    if (lowest is not None and here - within < lowest) or (highest is not None and here + within > highest):
        raise PositionLimit(
            f"axis {axis.name} stands at {here:g} {info.unit}: {within:g} {info.unit} either way would leave"
            f" {'-inf' if lowest is None else f'{lowest:g}'} to {'inf' if highest is None else f'{highest:g}'}",
            axis=axis.name,
            value=within,
            limit=min(math.inf if lowest is None else here - lowest, math.inf if highest is None else highest - here),
            remedy="move it away from its limits, or allow less with --within",
        )
    for distance in (within, -within):
        if (await axis.preview(distance=distance)).approach_from is not None:
            raise WrongState(
                f"axis {axis.name} comes to its goals from one side (`approach`): tuning moves it both ways",
                axis=axis.name,
                remedy="take `approach` out of the configuration for the tuning",
            )


def _lines(info: AxisInfo, here: float, bounds: Bounds, excitation: Excitation) -> tuple[str, ...]:
    within = bounds.within_counts / (info.counts_per_unit or 1.0)
    distance = f"{within:g} {info.unit} ({bounds.within_counts} counts)"
    output = f"{excitation.most_impulse:.0f} PWM steps times servo ticks"
    return (
        f"{info.axis} stands at {here:g} {info.unit}; it will stay within {distance} of that.",
        "Short pulses come first, then soft moves by a quarter of that, stiff ones by an eighth, test moves by half.",
        "The loop is opened between moves: what does not stay where it is without power must be secured.",
        f"Without an encoder the motor would get pulses of at most {output}; the drive ends them.",
        "Its gains are kept on this host, and put back at the end, at Ctrl-C and on a fault.",
        "This is software, not an emergency stop: keep yours within reach.",
    )


async def measure(client: RigClient, planned: Plan, bandwidth_hz: float | None, tell: Tell) -> Findings:
    """Excite an axis, identify it, propose gains, and measure the old ones; leaves it off, with the old gains.

    Args:
        client: of the rig.
        planned: by `plan`, just now.
        bandwidth_hz: crossover that is wanted; chosen when None.
        tell: gets a line now and then.

    Raises:
        DriveFault: the axis does not do what it should; the message says what.
        ValueOutOfRange: its traces tell too little, or no gains have the margins.
        LdcndError: as the daemon refused it; also when control was lost.
    """
    excitation = Excitation(planned.profile, planned.bounds)
    profile = planned.profile
    async with _tuned_axis(client, planned) as (axis, kept), _named(axis.name):
        tests = _Trials(client, axis, planned, kept.gains)
        tell("pulses: does the encoder count the motor's way?")
        await tests.run(excitation.pulses())
        tell(f"it gives way at {excitation.level} of 255 PWM steps; soft moves")
        soft = await tests.run(excitation.soft())
        first = await asyncio.to_thread(identify, profile, soft)
        tell("stiff moves")
        stiff = await tests.run(excitation.stiff(await asyncio.to_thread(stiff_gains, profile, first)))
        tell("identifying")
        known = await asyncio.to_thread(identify, profile, (*soft, *stiff), first.plant)
        move = within_authority(known.plant, excitation.wanted())
        tell("searching for gains")
        proposal = await asyncio.to_thread(propose, profile, known, move, bandwidth_hz)
        proposal = replace(proposal, gains=_as_allowed(proposal.gains, kept.gains))
        before: tuple[Measured, ...] = ()
        usual = _gains(kept.gains)
        if _is_worth_a_try(profile, known, usual, move):
            tell("test move with the old gains")
            before = tests.measured(known, await tests.run(excitation.test(usual, move, duration_s(move))))
        await _restore(axis, kept)
    return Findings(planned, kept.gains, known, proposal, move, before, excitation.farthest_counts)


async def verify(client: RigClient, found: Findings, tell: Tell) -> Verified:
    """Load the proposed gains and make the test move; they stay if it is at least as good as before.

    The axis is off afterwards, with the new gains or with the old ones.

    Raises:
        LdcndError: as the daemon refused it; also when control was lost. The old gains are put back then.
    """
    planned, profile = found.plan, found.plan.profile
    rig = Rig(client, await client.daemon())
    async with rig.watch(planned.info.axis) as watched:
        await _check_off(watched)
        await _check_travel(watched, planned.info, planned.units(planned.bounds.within_counts))
    excitation = Excitation(profile, planned.bounds)
    async with _tuned_axis(client, planned) as (axis, kept), _named(axis.name):
        tests = _Trials(client, axis, planned, kept.gains)
        tell("test move with the proposed gains")
        records = await tests.run(excitation.test(found.proposal.gains, found.move, duration_s(found.move)))
        after = tests.measured(found.known, records)
        why = objection(_worst(after), _worst(found.before))
        if why is None:
            await load(axis, _registers(found.proposal.gains, kept.gains))
            forget(kept)
        else:
            await _restore(axis, kept)
    return Verified(after, why, excitation.farthest_counts)


@asynccontextmanager
async def _tuned_axis(client: RigClient, planned: Plan) -> AsyncIterator[tuple[Axis, KeptGains]]:
    """Control an axis whose gains are kept; puts them back, with a new lease if need be, unless that was done."""
    rig = Rig(client, await client.daemon())
    name = planned.info.axis
    kept: KeptGains | None = None
    try:
        async with rig.control(name, client=CLIENT, lease_s=LEASE_S) as axis:
            await _check_off(axis)
            await axis.set_gains()  # a drive that was not powered on since its reset has none yet
            info = next(each for each in await rig.describe() if each.axis == name)
            kept = KeptGains(rig=rig.name, axis=name, gains=gains_in(info))
            keep(kept)
            try:
                yield axis, kept
            finally:
                await _put_back_if_kept(axis, kept)
    finally:
        if kept and kept_for(rig.name, name):
            async with asyncio.timeout(PUT_BACK_S):
                await put_back(rig, kept)


async def _put_back_if_kept(axis: Axis, kept: KeptGains) -> None:
    """Put gains back if they are still to be put back and this client still has control."""
    if kept_for(kept.rig, kept.axis) and axis.control and not axis.control.lost:
        async with asyncio.timeout(PUT_BACK_S):
            await _restore(axis, kept)


async def _restore(axis: Axis, kept: KeptGains) -> None:
    await load(axis, kept.gains)
    forget(kept)


@asynccontextmanager
async def _named(axis: str) -> AsyncIterator[None]:
    """Let errors of the pure part say which axis they are about."""
    try:
        yield
    except (DriveFault, ValueOutOfRange) as error:
        if error.axis is not None:
            raise
        text = f"axis {axis}: {error.message}"
        raise type(error)(text, axis=axis, value=error.value, limit=error.limit, remedy=error.remedy) from error


class _Trials:
    """Carries out trials on an axis that is controlled here."""

    def __init__(self, client: RigClient, axis: Axis, planned: Plan, old: dict[str, int]) -> None:
        self._client = client
        self._axis = axis
        self._plan = planned
        self._old = old
        self._interval_s = FIRST_INTERVAL_S

    async def run(self, trials: Trials) -> tuple[Record, ...]:
        """Carry out all trials of a kind; return what they lead to."""
        try:
            trial = next(trials)
            while True:
                trial = trials.send(await self._try(trial))
        except StopIteration as end:
            records: tuple[Record, ...] = end.value
            return records

    def measured(self, known: Identified, records: Sequence[Record]) -> tuple[Measured, ...]:
        """Return test moves beside what the model says."""
        return tuple(measured(self._plan.profile, known.plant, record) for record in records)

    async def _try(self, trial: Trial) -> Shown:
        axis, counts_per_unit = self._axis, self._plan.counts_per_unit
        from_counts = await self._rest_counts()
        await axis.set_gains(**_registers(trial.gains, self._old))
        await axis.power(on=True)
        try:
            samples = math.ceil((trial.lasts_s + LEAD_S) / self._interval_s)
            request = self._stamped(TakeTrace(channels=("position",), samples=samples))
            async with armed_trace(self._client, axis.name, request) as armed:
                motion = await axis.move_relative(
                    trial.move.distance_counts / counts_per_unit,
                    velocity=self._plan.units(trial.move.speed_counts_per_s),
                    acceleration=self._plan.units(trial.move.acceleration_counts_per_s2),
                )
                await wait_for_trace(self._client, axis.name, armed.trace_id, TRACE_S)
                trace = await fetch_trace(self._client, axis.name, armed.trace_id)
            tripped = axis.state.state is AxisState.ERROR_STOP
        finally:
            await self._open_loop()
        self._interval_s = trace.offsets_ns[-1] / 1e9 / (len(trace.offsets_ns) - 1)
        if self._interval_s > LONGEST_INTERVAL_S:
            raise ValueOutOfRange(
                f"axis {axis.name}: its line brings a sample every {self._interval_s * 1e3:.0f} ms",
                axis=axis.name,
                value=self._interval_s,
                limit=LONGEST_INTERVAL_S,
                remedy="a higher baud rate, or lower `rates` of the other axes",
            )
        rest_counts = await self._rest_counts() - from_counts
        per_unit = abs(counts_per_unit)
        move = replace(
            trial.move,
            speed_counts_per_s=per_unit * (motion.reply.velocity or 0.0),
            acceleration_counts_per_s2=per_unit * (motion.reply.acceleration or 0.0),
        )
        times, positions = _until_rest(trace, from_counts)
        return Shown(Record(trial.gains, move, trial.start, times, positions), tripped, rest_counts)

    async def _open_loop(self) -> None:
        """Open the loop; clear the trip of a drive that has opened it by itself."""
        axis = self._axis
        if axis.state.state is AxisState.ERROR_STOP and not axis.state.stop_latched:
            await at_rest(axis)
            await axis.reset()
        await axis.power(on=False)

    async def _rest_counts(self) -> int:
        """Wait until the axis stands, by samples of its own; return where, in counts."""
        for _ in range(STILL_LOOKS):
            request = self._stamped(
                TakeTrace(channels=("position",), samples=STILL_SAMPLES, interval_s=STILL_INTERVAL_S)
            )
            async with armed_trace(self._client, self._axis.name, request) as armed:
                await wait_for_trace(self._client, self._axis.name, armed.trace_id, TRACE_S)
                trace = await fetch_trace(self._client, self._axis.name, armed.trace_id)
            places = [int(each) for each in trace.raw[0] if each is not None]
            if places and max(places) - min(places) <= 1:
                return places[-1]
        raise WrongState(
            f"axis {self._axis.name} does not come to rest with its loop open",
            axis=self._axis.name,
            remedy="secure the load; a spindle without friction cannot be tuned by this",
        )

    def _stamped(self, request: TakeTrace) -> TakeTrace:
        control = self._axis.control
        return control.stamped(request, self._axis.name) if control else request


def _until_rest(trace: Trace, from_counts: int) -> tuple[tuple[float, ...], tuple[int, ...]]:
    """Return the samples of a trace until a moment after the last one that differs from the end."""
    pairs = [
        (offset / 1e9, int(raw) - from_counts)
        for offset, raw in zip(trace.offsets_ns, trace.raw[0], strict=True)
        if raw is not None
    ]
    last = next((time for time, at in reversed(pairs) if at != pairs[-1][1]), pairs[0][0])
    kept = [pair for pair in pairs if pair[0] <= last + AFTER_REST_S]
    return tuple(time for time, _ in kept), tuple(at for _, at in kept)


def _gains(registers: dict[str, int]) -> Gains:
    return Gains(**{"cl": 0, "deadband": 0, **registers})


def _registers(gains: Gains, old: dict[str, int]) -> dict[str, int]:
    """Return what `set_gains` gets: the registers that this drive has; the current limit stays as it is configured."""
    wanted = {name: value for name, value in asdict(gains).items() if name in old}
    return wanted | ({"cl": old["cl"]} if "cl" in old else {})


def _as_allowed(gains: Gains, old: dict[str, int]) -> Gains:
    """Keep an output limit that a person has set lower."""
    return replace(gains, ol=min(gains.ol, old["ol"]))


def _is_worth_a_try(profile: Profile, known: Identified, gains: Gains, move: Move) -> bool:
    """Tell whether the model lets the old gains make the test move: a loop that rings is not tried on a machine."""
    run = simulate(profile, known.plant, replace(gains, cl=0), move, duration_s(move))
    shown = figures_of(run, move)
    return shown.settled and not run.tripped and shown.overshoot <= MOST_MEASURED_OVERSHOOT


def _worst(moves: Sequence[Measured]) -> Figures | None:
    return worst(moves) if len(moves) == len(("there", "back")) else None


def report(found: Findings, verified: Verified | None = None) -> TuningReport:
    """Return everything that was found out, as one document."""
    planned, plant, spread = found.plan, found.known.plant, found.known.interval
    info = planned.info
    units = {
        "acceleration": "counts/s^2 per PWM step",
        "damping_per_s": "1/s",
        "friction_pwm": "PWM steps",
        "load_pwm": "PWM steps",
        "delay_s": "s",
        "backlash_counts": "counts",
    }
    margins = found.proposal.margins
    return TuningReport(
        axis=info.axis,
        unit=info.unit,
        within=planned.units(planned.bounds.within_counts),
        farthest=planned.units(max(found.farthest_counts, verified.farthest_counts if verified else 0)),
        plant={
            name: Estimate(value=getattr(plant, name), interval=getattr(spread, name), unit=unit)
            for name, unit in units.items()
        },
        left_counts=found.known.left_counts,
        distance=planned.units(abs(found.move.distance_counts)),
        old_gains=found.old,
        gains=_registers(found.proposal.gains, found.old),
        margins=LoopMargins(
            bandwidth_hz=margins.crossover_hz,
            phase_deg=margins.phase_deg,
            gain_db=margins.gain_db if math.isfinite(margins.gain_db) else None,
        ),
        predicted=_shown(planned, found.proposal.figures),
        before=_shown_worst(planned, found.before),
        after=_shown_worst(planned, verified.after) if verified else None,
        objection=verified.objection if verified else None,
        applied=verified is not None and verified.objection is None,
    )


def _shown_worst(planned: Plan, moves: Sequence[Measured]) -> MoveFigures | None:
    figures = _worst(moves)
    return _shown(planned, figures) if figures else None


def _shown(planned: Plan, figures: Figures) -> MoveFigures:
    return MoveFigures(
        settling_s=figures.settling_s,
        settled=figures.settled,
        overshoot=figures.overshoot,
        following_error=planned.units(figures.following_error_counts),
        error=planned.units(figures.error_counts),
    )
