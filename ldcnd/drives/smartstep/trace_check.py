"""Whether a trace says what the drive did: its words under every reading that the manual leaves open, beside monitors.

The layout of a trace word, its byte order and the gear of command pulses are assumptions. While a trace is recorded,
the monitors of its channels are read, too. The values of a trace are right when every reading of its words that agrees
with the monitors gives the same values; otherwise they are uncertain, and the problem says why. What a test on the
drive has verified is not varied. Pure.
Source: manual 3, monitors 8000H to 8008H; 4, settings 3 and 7, "Unit conversion", notes on the trigger.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise, product

from ldcnd.contract.traces import TraceTrigger, TriggerKind
from ldcnd.drives.smartstep.monitors import (
    INPUT_SIGNALS,
    OUTPUT_SIGNALS,
    POSITION_DEVIATION,
    REFERENCE_PULSE_SPEED,
    SPEED_FEEDBACK,
    TORQUE_REFERENCE,
    InputSignal,
    Monitor,
    OutputSignal,
)
from ldcnd.drives.smartstep.profiles import ByteOrder, CommandPulseGear, SmartStepProfile, TraceWordLayout
from ldcnd.drives.smartstep.trace_data import (
    FULL_SCALE,
    DataObject,
    IoObject,
    TraceConstants,
    decode_word,
    scale,
)
from ldcnd.drives.smartstep.trace_result import DATA, SIGNALS, Assignment
from ldcnd.drives.tracer import SIGNAL_LEVEL

TRIGGER_LATE_S = 0.002
"""A trigger is detected at most so late (manual 4, note 1)."""
CLOCK_ERROR = 0.02
"""How far the clock of a drive may be off, as a fraction; the manual gives no accuracy."""
FEWEST_AGREEING = 2
"""Readings of a layout that must agree with the monitors before they verify it."""

_MONITORS: Mapping[DataObject, Monitor] = {
    DataObject.TORQUE_REFERENCE: TORQUE_REFERENCE,
    DataObject.SPEED_FEEDBACK: SPEED_FEEDBACK,
    DataObject.COMMAND_PULSE_SPEED: REFERENCE_PULSE_SPEED,
    DataObject.POSITION_DEVIATION: POSITION_DEVIATION,
}
_SIGNALS: Mapping[IoObject, tuple[Monitor, int]] = {
    IoObject.RUN: (INPUT_SIGNALS, InputSignal.RUN),
    IoObject.RESET: (INPUT_SIGNALS, InputSignal.RESET),
    IoObject.ALM: (OUTPUT_SIGNALS, OutputSignal.ALM),
    IoObject.INP: (OUTPUT_SIGNALS, OutputSignal.INP),
    IoObject.BKIR: (OUTPUT_SIGNALS, OutputSignal.BKIR),
}


@dataclass(frozen=True, slots=True)
class Reading:
    """One way to read the words of a trace, of those that the manual leaves open.

    Attributes:
        trace_word_layout: where the I/O bit and the value sit.
        trace_byte_order: which half of a word comes first.
        command_pulse_gear: which way command pulses are geared to motor speed.
        encoder_counts_per_rev: encoder counts in one turn of the motor.
    """

    trace_word_layout: TraceWordLayout
    trace_byte_order: ByteOrder
    command_pulse_gear: CommandPulseGear
    encoder_counts_per_rev: int

    def applied_to(self, profile: SmartStepProfile) -> SmartStepProfile:
        """Return a profile that reads words so."""
        return replace(profile, **{key: getattr(self, key) for key in READING})

    def named(self, *, geared: bool) -> str:
        """Return it in words; the gear only where command pulses were recorded."""
        name = f"{self.trace_word_layout.value}, {self.trace_byte_order.value} byte first"
        if geared:
            name += f", gear {self.command_pulse_gear.value}, {self.encoder_counts_per_rev} counts a revolution"
        return name


READING = tuple(Reading.__slots__)
"""The assumptions of a profile that a reading is made of."""


@dataclass(frozen=True, slots=True)
class Comparison:
    """A monitor that shows what a channel records; for a signal one bit of it."""

    channel: str
    monitor: Monitor
    bit: int | None = None

    def value_of(self, word: int) -> float:
        """Return what the word of the monitor says of the channel, in its unit; a signal is 0 or 1."""
        return float(self.monitor.value_of(word)) if self.bit is None else float(bool(word & self.bit))


@dataclass(frozen=True, slots=True)
class Shown:
    """A monitor's value while the trace was recorded, at an instant between two of the loop's clock."""

    comparison: Comparison
    value: float
    from_s: float
    until_s: float


@dataclass(frozen=True, slots=True)
class Samples:
    """The words of a trace in order of time, of each memory that was used, in the byte order of the profile.

    Attributes:
        first_from_s: the first sample was not taken before this instant, in loop time, nor after `first_until_s`.
    """

    words: tuple[tuple[int, ...], ...]
    interval_s: float
    first_from_s: float
    first_until_s: float

    def window(self, shown: Shown) -> range | None:
        """Return the samples among which is what a monitor has shown; None when it may lie outside of the trace."""
        earliest = (shown.from_s - self.first_until_s) / self.interval_s
        latest = (shown.until_s - self.first_from_s) / self.interval_s
        first = math.floor(earliest - CLOCK_ERROR * abs(earliest)) - 1
        last = math.ceil(latest + CLOCK_ERROR * abs(latest)) + 1
        if first < -2 or last > len(self.words[0]):  # noqa: PLR2004 - a sample and its rounding before the first
            return None
        return range(max(0, first), min(last + 1, len(self.words[0])))


@dataclass(frozen=True, slots=True)
class Judgement:
    """The result of comparing a trace with the monitors.

    Attributes:
        problems: why its values are uncertain; none when they are right.
        verified: assumptions that this trace, with those before it, has verified.
        contradicted: assumptions that it has contradicted.
        possible: the readings of the drive's words that all traces until now leave; None for any.
    """

    problems: tuple[str, ...] = ()
    verified: frozenset[str] = frozenset()
    contradicted: frozenset[str] = frozenset()
    possible: frozenset[Reading] | None = None


def comparisons(assignment: Assignment) -> tuple[Comparison, ...]:
    """Return the monitors that can be read beside a trace: one for each requested channel."""
    found = []
    for name in assignment.channels:
        if name in DATA:
            found.append(Comparison(name, _MONITORS[DATA[name]]))
        else:
            found.append(Comparison(name, *_SIGNALS[SIGNALS[name]]))
    return tuple(found)


def judge(
    profile: SmartStepProfile,
    constants: TraceConstants,
    assignment: Assignment,
    samples: Samples,
    shown: Sequence[Shown],
    possible: frozenset[Reading] | None = None,
) -> Judgement:
    """Compare a trace with what the monitors showed meanwhile.

    Args:
        profile: how the drive is taken to behave.
        constants: what scales the values.
        assignment: which channel is in which memory.
        samples: the words.
        shown: what was read of the monitors.
        possible: what earlier traces of the same drive have left possible; None for anything.
    """
    if profile.trace_word_layout is TraceWordLayout.RAW:
        return Judgement(("the words of the trace memory are published as they are, without a layout",))
    windows = [(each, window) for each in shown if (window := samples.window(each))]
    assumed, everything = reading_of(profile), readings(profile)
    candidates = everything if possible is None else [each for each in everything if each in possible]
    geared = DataObject.COMMAND_PULSE_SPEED in _data(assignment)
    given = _Given(profile, constants, assignment, samples)

    def shown_by(reading: Reading) -> Reading:
        """Return a reading as far as this trace can tell it from others."""
        if geared:
            return reading
        return replace(
            reading,
            command_pulse_gear=assumed.command_pulse_gear,
            encoder_counts_per_rev=assumed.encoder_counts_per_rev,
        )

    distinct = list(dict.fromkeys(map(shown_by, candidates)))
    agreeing = [each for each in distinct if given.contradiction(each, windows) is None]
    against = given.contradiction(assumed, windows)
    if against:
        others = "; ".join(sorted({each.named(geared=geared) for each in agreeing})) or "no layout that is known"
        contradicted = frozenset(
            key for key in _varied(distinct) if all(getattr(each, key) != getattr(assumed, key) for each in agreeing)
        )
        left = frozenset(each for each in candidates if shown_by(each) in agreeing)
        text = f"{against}; {others} agrees with the monitors"
        return Judgement((text,), contradicted=contradicted, possible=left or None)
    if not agreeing:
        text = "the monitors of this trace and of those before it agree with no layout at once"
        return Judgement((text,), possible=None)
    expected = given.columns(assumed)
    different = [each for each in agreeing if each != assumed and not _alike(given.columns(each), expected)]
    problems = _wrapped(profile, assignment, expected)
    if different:
        others = "; ".join(sorted({each.named(geared=geared) for each in different}))
        problems.append(
            f"not verified: words are taken as {assumed.named(geared=geared)}, and the monitors allow {others} as well"
        )
    if len(windows) >= FEWEST_AGREEING:
        candidates = [each for each in candidates if shown_by(each) in agreeing]
        possible = frozenset(candidates)
    verified = _varied(everything) - _varied(candidates)
    return Judgement(tuple(problems), verified=verified, possible=possible)


def trigger_problem(
    trigger: TraceTrigger, level: float, column: Sequence[float | None], index: int, interval_s: float
) -> str | None:
    """Return what is wrong when the recorded values show no trigger where the drive says that it was.

    A drive whose trace was ended from elsewhere is in its normal mode, too, and says anything. The condition may have
    been met `TRIGGER_LATE_S` before it was detected.

    Args:
        trigger: what the drive waited for.
        level: as it was set in the drive, in the unit of the channel.
        column: the values of its channel.
        index: of the sample at which the trigger was detected.
        interval_s: between two samples.
    """
    first = max(0, index - math.ceil(TRIGGER_LATE_S / interval_s) - 1)
    near = [value for value in column[first : index + 2] if value is not None]
    if trigger.channel in SIGNALS:
        level = SIGNAL_LEVEL
    edges = list(pairwise(near))
    if index == 0:  # nothing was recorded before the trigger, so only the level after it can be seen
        edges = [(-math.inf, near[0])] if trigger.kind is TriggerKind.RISING else [(math.inf, near[0])]
    rose = any(before < level <= after for before, after in edges)
    fell = any(after < level <= before for before, after in edges)
    changed = any(before != after for before, after in edges)
    met = {
        TriggerKind.RISING: rose,
        TriggerKind.FALLING: fell,
        TriggerKind.EITHER: changed,
        TriggerKind.CHANGE: changed,
    }
    if met.get(trigger.kind, True):
        return None
    return (
        f"the values show no {trigger.kind.value} trigger of {trigger.channel} at sample {index}: the trace was ended"
        " from elsewhere, or the trigger bits or the layout are wrong"
    )


# -- readings of a word ----------------------------------------------------------------------------------------------


def reading_of(profile: SmartStepProfile) -> Reading:
    """Return the reading that a profile assumes."""
    return Reading(*(getattr(profile, key) for key in READING))


def readings(profile: SmartStepProfile) -> list[Reading]:
    """Return every combination of what is not verified about the words of a trace."""
    counts = sorted({max(1, round(profile.encoder_counts_per_rev * factor)) for factor in (0.25, 0.5, 1, 2, 4)})
    choices: tuple[Sequence[object], ...] = (
        [each for each in TraceWordLayout if each is not TraceWordLayout.RAW],
        list(ByteOrder),
        list(CommandPulseGear),
        counts,
    )
    left = [
        [getattr(profile, key)] if profile.is_verified(key) else choice
        for key, choice in zip(READING, choices, strict=True)
    ]
    return [Reading(*values) for values in product(*left)]


def _data(assignment: Assignment) -> tuple[DataObject, ...]:
    return tuple(DATA[name] for name in assignment.channels if name in DATA)


def _varied(some: Sequence[Reading]) -> frozenset[str]:
    """Return the assumptions in which readings differ."""
    return frozenset(key for key in READING if len({getattr(reading, key) for reading in some}) > 1)


@dataclass(frozen=True, slots=True)
class _Given:
    """A trace, to be read in any way; `decoded` keeps the words that were decoded in a way before."""

    profile: SmartStepProfile
    constants: TraceConstants
    assignment: Assignment
    samples: Samples
    decoded: dict[tuple[str, TraceWordLayout, bool], list[int]] = field(default_factory=dict)

    def columns(self, reading: Reading) -> list[list[float]]:
        """Return the values of each channel."""
        return [
            [point * factor for point in self._points(reading, channel)]
            for channel in self.assignment.channels
            for factor in [self._scale(reading, channel)]
        ]

    def contradiction(self, reading: Reading, windows: Sequence[tuple[Shown, range]]) -> str | None:
        """Return how a reading of the words cannot be, by what monitors have shown; None when it can."""
        texts = (self._against(reading, shown, window) for shown, window in windows)
        return next((text for text in texts if text), None)

    def _points(self, reading: Reading, channel: str) -> list[int]:
        """Return the numbers of a channel before they are scaled; a signal is 0 or 1."""
        swapped = reading.trace_byte_order is not self.profile.trace_byte_order
        key = (channel, reading.trace_word_layout, swapped)
        if key not in self.decoded:
            words = self.samples.words[self.assignment.memory(channel)]
            if swapped:
                words = tuple((word >> 8 | word << 8) & 0xFFFF for word in words)
            points = (decode_word(word, reading.trace_word_layout) for word in words)
            self.decoded[key] = [point.value if channel in DATA else int(bool(point.io)) for point in points]
        return self.decoded[key]

    def _scale(self, reading: Reading, channel: str) -> float:
        return scale(reading.applied_to(self.profile), self.constants, DATA[channel]) if channel in DATA else 1.0

    def _against(self, reading: Reading, shown: Shown, window: range) -> str | None:
        comparison = shown.comparison
        factor = self._scale(reading, comparison.channel)
        points = self._points(reading, comparison.channel)
        values = [points[place] * factor for place in window]
        where = f"monitor {comparison.monitor.address:04X}H shows {comparison.channel} at {shown.value:g}"
        taken = f"while the words, taken as {reading.trace_word_layout.value}, say"
        if comparison.bit is not None:
            return None if shown.value in values else f"{where} {taken} {values[0]:g}"
        # A monitor has whole units; a value may have passed between two samples, and one layout loses its lowest bit.
        slack = 1.0 + 2 * factor
        slack += max((abs(after - before) for before, after in pairwise(values)), default=0.0)
        if min(values) - slack <= shown.value <= max(values) + slack:
            return None
        return f"{where} {taken} {min(values):g} to {max(values):g}"


def _alike(columns: list[list[float]], others: list[list[float]]) -> bool:
    return all(
        math.isclose(value, other, rel_tol=1e-9, abs_tol=1e-9)
        for column, known in zip(columns, others, strict=True)
        for value, other in zip(column, known, strict=True)
    )


def _wrapped(profile: SmartStepProfile, assignment: Assignment, columns: list[list[float]]) -> list[str]:
    """Say where a position deviation may be more than fits: what a drive records then is not known."""
    if profile.trace_word_layout is TraceWordLayout.LSB_IO_MASK:
        return []
    return [
        f"{name} goes beyond {FULL_SCALE}: what a drive records beyond 15 bits is not known"
        for name, column in zip(assignment.channels, columns, strict=True)
        if DATA.get(name) is DataObject.POSITION_DEVIATION and any(abs(value) > FULL_SCALE for value in column)
    ]
