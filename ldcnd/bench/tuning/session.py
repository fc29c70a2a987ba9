"""Tuning one axis of a running rig, by the public client alone: measure, propose, apply, verify, or put back.

Each trial closes the loop where the axis stands and opens it again, so no position error is ever handed from one set of
gains to the next. The old gains are on the disk of this host before the first others are in the drive. They come back
when anything ends a measurement; after the death of this host, when a person asks for it.
"""

import asyncio
import math
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager, suppress
from dataclasses import asdict, dataclass, replace

from ldcnd.bench.kept_gains import (
    LEASE_S,
    PUT_BACK_S,
    KeptGains,
    forget,
    gains_in,
    keep,
    kept_for,
    load,
    open_loop,
    put_back,
    putting_back,
    restore,
)
from ldcnd.bench.tuning.design import Proposal, duration_s, figures_of, propose, stiff_gains, within_authority
from ldcnd.bench.tuning.excitation import (
    MOST_ERROR_LIMIT,
    Excitation,
    MoveRecord,
    Purpose,
    Trial,
    TrialOutcome,
    Trials,
)
from ldcnd.bench.tuning.identify import Identified, identify
from ldcnd.bench.tuning.plan import Plan, check_as_planned, check_off
from ldcnd.bench.tuning.response import TrapezoidMove, simulate
from ldcnd.bench.tuning.verdict import MOST_MEASURED_OVERSHOOT, SAME_S, Measured, measured, objection, worst
from ldcnd.client.axis import Axis
from ldcnd.client.calmed import ended_by_calm
from ldcnd.client.lease import program_name
from ldcnd.client.rig import Rig
from ldcnd.client.rig_client import RigClient
from ldcnd.client.traces import Trace
from ldcnd.contract.errors import (
    DriveFault,
    LdcndError,
    Remedy,
    StopLatched,
    ValueOutOfRange,
    WrongState,
)
from ldcnd.contract.samples import AxisState
from ldcnd.drives.driver import Gains
from ldcnd.drives.ldcn.profiles import Profile

CLIENT = program_name("ldcnd tune")
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

Tell = Callable[[str], None]


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
        farthest_counts: from there.
    """

    plan: Plan
    old: dict[str, int]
    known: Identified
    proposal: Proposal
    move: TrapezoidMove
    before: tuple[Measured, ...]
    farthest_counts: int


@dataclass(frozen=True, slots=True)
class VerifiedMove:
    """The test move with the proposed gains.

    Attributes:
        after: as measured; fewer than two where the drive gave up.
        objection: why the gains were not kept; None where they were.
        farthest_counts: from where the axis stood.
    """

    after: tuple[Measured, ...]
    objection: str | None
    farthest_counts: int


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
    profile = planned.profile
    async with _tuned_axis(client, planned, tell) as (axis, kept), _named(axis.name):
        tests = _Trials(axis, planned, kept.gains)
        excitation = Excitation(profile, planned.bounds, await tests.offset_counts())
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
        await restore(axis, kept)
    farthest_counts = excitation.farthest_counts
    return Findings(planned, kept.gains, known, proposal, move, before, farthest_counts)


async def verify(client: RigClient, found: Findings, tell: Tell) -> VerifiedMove:
    """Load the proposed gains and make the test move; they stay if it is at least as good as before.

    The axis is off afterwards, with the new gains or with the old ones.

    Raises:
        LdcndError: as the daemon refused it; also when control was lost. The old gains are put back then.
    """
    planned, profile = found.plan, found.plan.profile
    async with _tuned_axis(client, planned, tell) as (axis, kept), _named(axis.name):
        tests = _Trials(axis, planned, kept.gains)
        excitation = Excitation(profile, planned.bounds, await tests.offset_counts())
        tell("test move with the proposed gains")
        records = await tests.run(excitation.test(found.proposal.gains, found.move, duration_s(found.move)))
        after = tests.measured(found.known, records)
        why = objection(worst(after), worst(found.before), max(SAME_S, 2 * tests.interval_s))
        if why is None:
            await load(axis, registers_of(found.proposal.gains, kept.gains))
            forget(kept)
        else:
            await restore(axis, kept)
    return VerifiedMove(after, why, excitation.farthest_counts)


@asynccontextmanager
async def _tuned_axis(client: RigClient, planned: Plan, tell: Tell) -> AsyncIterator[tuple[Axis, KeptGains]]:
    """Control an axis whose gains are kept; puts them back, with a new lease if need be, unless that was done."""
    rig = Rig(client, await client.daemon())
    name = planned.info.axis
    kept: KeptGains | None = None
    try:
        async with rig.control(name, client=CLIENT, lease_s=LEASE_S) as axis:
            await check_off(axis)
            await axis.set_gains()  # a drive that was not powered on since its reset has none yet
            info = next(each for each in await rig.describe() if each.axis == name)
            check_as_planned(planned, info)
            kept = KeptGains(rig=rig.name, axis=name, gains=gains_in(info), model=info.model)
            keep(kept)
            try:
                async with ended_by_calm(rig, axis, CLIENT, "tuning"):
                    yield axis, kept
            finally:
                await _put_back_if_kept(axis, kept, tell)
    finally:
        if kept is not None and kept_for(rig.name, name):
            await _put_back_anew(rig, kept, tell)


async def _put_back_anew(rig: Rig, kept: KeptGains, tell: Tell) -> None:
    """Put gains back under a lease of their own: that of the tuning was lost."""
    try:
        async with asyncio.timeout(PUT_BACK_S):
            await put_back(rig, kept, CLIENT)
    except (LdcndError, TimeoutError) as error:
        raise WrongState(
            f"axis {kept.axis}: tuning was cut short, and its old gains could not be put back: {error}",
            axis=kept.axis,
            remedy=Remedy("once it can be controlled again, {}", putting_back(kept.axis)),
        ) from error
    tell(f"{kept.axis}: off, with its old gains")


async def _put_back_if_kept(axis: Axis, kept: KeptGains, tell: Tell) -> None:
    """Put gains back if they are still to be put back and this client still has control; what fails is tried anew."""
    if kept_for(kept.rig, kept.axis) and axis.control and not axis.control.lost:
        with suppress(LdcndError):
            await restore(axis, kept)
            tell(f"{kept.axis}: off, with its old gains")


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
    """Carries out trials on an axis that is controlled here.

    Attributes:
        interval_s: time between two samples of the last trace, seconds.
    """

    def __init__(self, axis: Axis, planned: Plan, old: dict[str, int]) -> None:
        self._axis = axis
        self._plan = planned
        self._old = old
        self.interval_s = FIRST_INTERVAL_S

    async def run(self, trials: Trials) -> tuple[MoveRecord, ...]:
        """Carry out all trials of a kind; return what they lead to."""
        try:
            trial = next(trials)
            while True:
                trial = trials.send(await self._try(trial))
        except StopIteration as end:
            records: tuple[MoveRecord, ...] = end.value
            return records

    def measured(self, known: Identified, records: Sequence[MoveRecord]) -> tuple[Measured, ...]:
        """Return test moves beside what the model says."""
        return tuple(measured(self._plan.profile, known.plant, record) for record in records)

    async def _try(self, trial: Trial) -> TrialOutcome:
        axis, counts_per_unit = self._axis, self._plan.counts_per_unit
        from_counts = await self.rest_counts()
        await axis.set_gains(gain_set=None, **registers_of(trial.gains, self._old), lent=True)
        await axis.power(on=True)
        try:
            samples = math.ceil((trial.lasts_s + LEAD_S) / self.interval_s)
            async with axis.tracing("position", samples=samples) as taken:
                motion = await axis.move_relative(
                    trial.move.distance_counts / counts_per_unit,
                    velocity=self._plan.units(trial.move.speed_counts_per_s),
                    acceleration=self._plan.units(trial.move.acceleration_counts_per_s2),
                )
                trace = await taken(TRACE_S)
            if axis.state.stop_latched:
                raise StopLatched(f"axis {axis.name} was stopped while it was tuned", axis=axis.name)
            tripped = axis.state.state is AxisState.ERROR_STOP
        finally:
            await open_loop(axis)
        self.interval_s = trace.offsets_ns[-1] / 1e9 / (len(trace.offsets_ns) - 1)
        if trial.purpose is not Purpose.PULSE and self.interval_s > LONGEST_INTERVAL_S:
            raise ValueOutOfRange(
                f"axis {axis.name}: its line brings a sample every {self.interval_s * 1e3:.0f} ms",
                axis=axis.name,
                value=self.interval_s,
                limit=LONGEST_INTERVAL_S,
                remedy="a higher baud rate, lower `rates` of the other axes, or a host that is less busy",
            )
        rest_counts = await self.rest_counts() - from_counts
        per_unit = abs(counts_per_unit)
        move = replace(
            trial.move,
            speed_counts_per_s=per_unit * (motion.reply.velocity or 0.0),
            acceleration_counts_per_s2=per_unit * (motion.reply.acceleration or 0.0),
        )
        times, positions = _until_rest(trace, from_counts)
        return TrialOutcome(MoveRecord(trial.gains, move, trial.start, times, positions), tripped, rest_counts)

    async def offset_counts(self) -> int:
        """Return where the axis stands, from where it stood when this was planned and agreed to, in counts.

        Raises:
            WrongState: so far away that the moves would leave the distance that was stated.
        """
        planned = self._plan
        offset_counts = await self.rest_counts() - planned.here_counts
        if abs(offset_counts) > planned.bounds.within_counts // 2:
            raise WrongState(
                f"axis {self._axis.name} was moved since this was planned: it stands {offset_counts:+d} counts from"
                " there",
                axis=self._axis.name,
                value=offset_counts,
                remedy="tune it again",
            )
        return offset_counts

    async def rest_counts(self) -> int:
        """Wait until the axis stands, by samples of its own; return where, in counts."""
        for _ in range(STILL_LOOKS):
            trace = await self._axis.take_trace(
                "position", samples=STILL_SAMPLES, interval_s=STILL_INTERVAL_S, within_s=TRACE_S
            )
            places = [int(each) for each in trace.raw[0] if each is not None]
            if places and max(places) - min(places) <= 1:
                return places[-1]
        raise WrongState(
            f"axis {self._axis.name} does not come to rest with its loop open",
            axis=self._axis.name,
            remedy="secure the load; a spindle without friction cannot be tuned by this",
        )


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


def registers_of(gains: Gains, old: dict[str, int]) -> dict[str, int]:
    """Return what `set_gains` gets: the registers that this drive has; the current limit stays as it is configured."""
    wanted = {name: value for name, value in asdict(gains).items() if name in old}
    return wanted | ({"cl": old["cl"]} if "cl" in old else {})


def _as_allowed(gains: Gains, old: dict[str, int]) -> Gains:
    """Keep an output limit that a person has set lower, and an error limit that `set_gains` takes."""
    return replace(gains, ol=min(gains.ol, old["ol"]), el=min(gains.el, MOST_ERROR_LIMIT))


def _is_worth_a_try(profile: Profile, known: Identified, gains: Gains, move: TrapezoidMove) -> bool:
    """Tell whether the model lets the old gains make the test move: a loop that rings is not tried on a machine."""
    run = simulate(profile, known.plant, replace(gains, cl=0), move, duration_s(move))
    shown = figures_of(run, move)
    return shown.settled and not run.tripped and shown.overshoot <= MOST_MEASURED_OVERSHOOT
