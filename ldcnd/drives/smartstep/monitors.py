"""The values that a drive shows: monitors Un, signal bits, switches, alarm codes, and the two 32-bit counters.

Signal bits are electrical levels: 1 is high, 0 is low, whatever a signal means; bits that the manual calls not used
are dropped.

No latch holds the halves of a counter together. High, low, high and "equal is good" is wrong for a counter that rests
on a boundary of 65536 and trembles by one: both high halves may agree and still not belong to the low half. So the low
half decides which of two adjacent high halves is its own, and near a boundary further high halves are read to learn
whether there are two. A counter that is where it was at standstill is not read on: there is nothing left to learn.
Sources: manual 3, all tables; 5 and 6 with their notes. The counter rule was found by simulation, the manual gives
none.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import Enum, IntFlag, StrEnum
from types import MappingProxyType
from typing import ClassVar

from ldcnd.contract.parameters import MonitorReading
from ldcnd.contract.samples import MonitorName
from ldcnd.drives.parameter_access import MonitorValue
from ldcnd.drives.smartstep.addresses import OperatingMode, Register
from ldcnd.drives.smartstep.profiles import SmartStepProfile


@dataclass(frozen=True, slots=True)
class Monitor:
    """One word of the status displays.

    Attributes:
        label: the monitor's number on the display.
        unit: empty for bits.
        signed: two's complement.
    """

    address: int
    label: str
    title: str
    unit: str
    signed: bool = False

    def value_of(self, word: int) -> int:
        """Return the word as a number in `unit`."""
        return signed_word(word) if self.signed else word


def signed_word(word: int) -> int:
    """Return 16 bits as two's complement."""
    return word - 0x10000 if word & 0x8000 else word


SPEED_FEEDBACK = Monitor(0x8000, "Un000", "Speed feedback", "r/min", signed=True)
SPEED_REFERENCE = Monitor(0x8001, "Un001", "Speed reference", "r/min", signed=True)
TORQUE_REFERENCE = Monitor(0x8002, "Un002", "Torque reference", "%", signed=True)
PULSES_FROM_Z = Monitor(0x8003, "Un003", "Number of pulses from phase Z", "pulses")
ELECTRICAL_ANGLE = Monitor(0x8004, "Un004", "Electrical angle", "degrees")
INPUT_SIGNALS = Monitor(0x8005, "Un005", "Input signal monitoring", "")
OUTPUT_SIGNALS = Monitor(0x8006, "Un006", "Output signal monitoring", "")
REFERENCE_PULSE_SPEED = Monitor(0x8007, "Un007", "Reference pulse speed display", "r/min", signed=True)
POSITION_DEVIATION = Monitor(0x8008, "Un008", "Position deviation (deviation counter)", "command units", signed=True)
CUMULATIVE_LOAD = Monitor(0x8009, "Un009", "Cumulative load ratio", "%")
REGENERATIVE_LOAD = Monitor(0x800A, "Un00A", "Regenerative load ratio", "%")
BRAKE_LOAD = Monitor(0x800B, "Un00B", "Dynamic brake resistance load ratio", "%")
INPUT_COUNTER_LOW = Monitor(0x800C, "Un00C", "Input pulse counter (rightmost 16 bits)", "command units")
INPUT_COUNTER_HIGH = Monitor(0x800D, "Un00C", "Input pulse counter (leftmost 16 bits)", "command units")
FEEDBACK_COUNTER_LOW = Monitor(0x800E, "Un00D", "Feedback pulse counter (rightmost 16 bits)", "pulses")
FEEDBACK_COUNTER_HIGH = Monitor(0x800F, "Un00D", "Feedback pulse counter (leftmost 16 bits)", "pulses")


class InputSignal(IntFlag):
    """Bits of 8005H."""

    RUN = 0x0001  # CN1-14
    RESET = 0x0010  # CN1-18


class OutputSignal(IntFlag):
    """Bits of 8006H."""

    ALM = 0x0001  # CN1-34
    INP = 0x0002  # CN1-8
    BKIR = 0x0040  # CN1-7


class FunctionSwitch(IntFlag):
    """Bits of 8106H; 1 is on."""

    ONLINE_AUTO_TUNING = 0x01  # No. 1
    DYNAMIC_BRAKE = 0x02  # No. 2
    COMMAND_PULSE_INPUT = 0x04  # No. 3
    RESOLUTION_4 = 0x08  # No. 4
    RESOLUTION_5 = 0x10  # No. 5
    PARAMETERS_RULE = 0x20  # No. 6; which level means so is RECOLLECTED


R7D_AP = 0x000C
"""The word of 8800H; the manual prints the same word for R7D-APL and R7D-APH, so they cannot be distinguished."""


def input_levels(word: int) -> InputSignal:
    """Return the levels in 8005H."""
    return InputSignal(word & (InputSignal.RUN | InputSignal.RESET))


def output_levels(word: int) -> OutputSignal:
    """Return the levels in 8006H."""
    return OutputSignal(word & (OutputSignal.ALM | OutputSignal.INP | OutputSignal.BKIR))


def function_switches(word: int) -> FunctionSwitch:
    """Return the switches in 8106H."""
    return FunctionSwitch(word & 0x3F)


def gain_switch(word: int) -> int:
    """Return the position of the gain rotary switch in 8105H, 0 to 15."""
    return word & 0xF


def run_is_on(profile: SmartStepProfile, levels: InputSignal) -> bool:
    """Return whether RUN requests servo-on; which level does is an assumption of the profile."""
    return bool(levels & InputSignal.RUN) is not profile.unit.run_active_low


def reset_is_on(profile: SmartStepProfile, levels: InputSignal) -> bool:
    """Return whether RESET requests an alarm reset; which level does is an assumption of the profile."""
    return bool(levels & InputSignal.RESET) is not profile.unit.reset_active_low


def alarm_is_out(profile: SmartStepProfile, levels: OutputSignal) -> bool:
    """Tell whether /ALM says alarm; which level does is an assumption of the profile."""
    return bool(levels & OutputSignal.ALM) is profile.unit.alarm_output_high


def _is_on(levels: OutputSignal, signal: OutputSignal, *, active_low: bool | None) -> bool | None:
    """Tell whether an output is on; None where no setting says at which level it is."""
    return None if active_low is None else bool(levels & signal) is not active_low


NO_ALARM = 0x0099
"""Not an alarm: it says that there is none, and is never shown as A.99 (manual 3, note)."""
HISTORY_LENGTH = 10


class AlarmKind(StrEnum):
    """The meaning of an alarm code for the drive."""

    NONE = "none"
    ALARM = "alarm"
    """The drive has stopped; RESET on CN1-18 clears it, no command does."""
    WARNING = "warning"
    """91 and 92: titled alarms in the manual, but related drives go on running (INFERRED_MEDIUM)."""
    UNKNOWN = "unknown"
    """A code that the manual does not list; the number is kept."""


@dataclass(frozen=True, slots=True)
class AlarmCode:
    """A code and the manual's words for it."""

    code: int
    text: str
    kind: AlarmKind = AlarmKind.ALARM
    unfollowed: bool = False
    """Shaft and encoder did not go where they were sent."""


ALARMS: tuple[AlarmCode, ...] = (
    AlarmCode(0x0004, "Parameter setting error"),
    AlarmCode(0x0010, "Overcurrent"),
    AlarmCode(0x0030, "Regeneration error"),
    AlarmCode(0x0032, "Regeneration overload"),
    AlarmCode(0x0040, "Overvoltage/undervoltage"),
    AlarmCode(0x0051, "Overspeed"),
    AlarmCode(0x0070, "Overload"),
    AlarmCode(0x0073, "Dynamic brake overload"),
    AlarmCode(0x0074, "Inrush resistance overload"),
    AlarmCode(0x007A, "Radiator overheating"),
    AlarmCode(0x00BF, "System error"),
    AlarmCode(0x00C1, "Runaway detected", unfollowed=True),
    AlarmCode(0x00C2, "Phase error detected", unfollowed=True),
    AlarmCode(0x00C3, "Encoder disconnection detected", unfollowed=True),
    AlarmCode(0x00D0, "Deviation counter over", unfollowed=True),
    AlarmCode(0x0091, "Overload alarm", AlarmKind.WARNING),
    AlarmCode(0x0092, "Regeneration overload alarm", AlarmKind.WARNING),
    AlarmCode(NO_ALARM, "Normal (No alarm)", AlarmKind.NONE),
)


def alarm(word: int) -> AlarmCode:
    """Return what a drive means by an alarm word; a code that is not listed keeps its number."""
    for known in ALARMS:
        if known.code == word:
            return known
    return AlarmCode(word, f"unlisted alarm code {word:04X}H", AlarmKind.UNKNOWN)


class AlarmHistory:
    """Entries that a drive adds to its alarm history, from one complete reading of it to the next.

    Entry 0 is the newest (INFERRED_MEDIUM); a drive that adds at the other end shows that by its first new alarm. The
    ten words are read one after the other, so an alarm that comes meanwhile may tear them: what cannot follow from the
    reading before is believed only when it reads the same again, and is then another drive's. An alarm that fills the
    whole history already cannot be seen coming again.
    """

    def __init__(self) -> None:
        self._known: tuple[int, ...] | None = None
        self._odd: tuple[int, ...] | None = None

    def take(self, words: tuple[int, ...]) -> tuple[int, ...] | None:
        """Return the codes that are new, oldest first; None when the history has to be read again.

        The first reading tells nothing new: when its alarms came is not known.
        """
        known, odd = self._known, self._odd
        added: tuple[int, ...] | None = ()
        if known is not None:
            added = _added(known, words)
            if added is None:
                added = _added(known[::-1], words[::-1])
        if added is None and words != odd:
            self._odd = words
            return None
        self._known, self._odd = words, None
        return tuple(code for code in reversed(added or ()) if code != NO_ALARM)


def _added(before: tuple[int, ...], now: tuple[int, ...]) -> tuple[int, ...] | None:
    """Return the fewest entries that were put in front of `before`, newest first; None when that cannot be."""
    for count in range(len(now)):
        if now[count:] == before[: len(now) - count]:
            return now[:count]
    return None


GUARD_COUNTS = 256
"""How near to a boundary the low half must be to make the high half suspect."""
GUARD_READS = 8
LONGEST_ROUNDS = 5
LEAST_EVENNESS = 0.75
"""Least ratio of the times before and behind the low half: more uneven, and the halves may be of two counts."""
_HALF = 0x8000
_WORD = 0x10000
_RANGE = 0x1_0000_0000


class Counter(Enum):
    """Low half, high half, and the mode that clears it."""

    COMMAND = (INPUT_COUNTER_LOW, INPUT_COUNTER_HIGH, OperatingMode.COMMAND_COUNTER_CLEAR)
    FEEDBACK = (FEEDBACK_COUNTER_LOW, FEEDBACK_COUNTER_HIGH, OperatingMode.FEEDBACK_COUNTER_CLEAR)

    def __init__(self, low: Monitor, high: Monitor, clear_mode: OperatingMode) -> None:
        self.low = low
        self.high = high
        self.clear_mode = clear_mode


@dataclass(frozen=True, slots=True)
class CounterValue:
    """A counter reading; the halves were read one after the other, at some instants between."""

    latched: ClassVar[bool] = False

    raw: int
    resolved: bool = False
    """Off by 65536 from the last value at standstill, and corrected by it."""

    @property
    def signed(self) -> int:
        """The value as 32-bit two's complement: a cleared counter that moved backwards is negative."""
        return self.raw - _RANGE if self.raw >= _RANGE // 2 else self.raw


class CounterReading:
    """Requests one word at a time until the value is certain, or gives up.

    Right while the counter moves less than 32768 between two reads; faster even motion is noticed and read again. So is
    a high half that changed while other packets came between: the low one may belong to either.

    Attributes:
        wanted: the monitor to read next; None when finished.
        value: the result; None while reading, and when `LONGEST_ROUNDS` rounds gave none.
    """

    def __init__(self, counter: Counter, last_at_rest: int | None = None) -> None:
        """Begin with the first high half.

        Args:
            counter: which of the two.
            last_at_rest: the last accepted raw value, if the motor has stood still since; None otherwise.
        """
        self.wanted: Monitor | None = counter.high
        self.value: CounterValue | None = None
        self._counter = counter
        self._last_at_rest = last_at_rest
        self._rounds_left = LONGEST_ROUNDS
        self._highs: list[int] = []
        self._low: int | None = None
        self._read_at_s: list[float] = []

    def take(self, word: int, at_s: float) -> None:
        """Accept the word of the monitor that was wanted, which came at an instant; ignored when none is."""
        if self.wanted is None:
            return
        self._read_at_s.append(at_s)
        if self.wanted is self._counter.low:
            self._low = word
            self.wanted = self._counter.high
            return
        self._highs.append(word)
        if self._low is None:
            self.wanted = self._counter.low
        else:
            self._judge(self._low)

    def _judge(self, low: int) -> None:
        seen = set(self._highs)
        high = _high_of(seen, low)
        # near a boundary the low half tells which high half is its own, however long the reads took
        torn = len(seen) > 1 and not _is_near_boundary(low) and not self._is_even()
        if high is None or torn:
            self._begin_again()
            return
        raw = high * _WORD + low
        known = self._last_at_rest is not None and _is_near(self._last_at_rest, raw)
        is_suspect = len(seen) == 1 and _is_near_boundary(low) and not known
        if not is_suspect or len(self._highs) == 2 + GUARD_READS:
            self._accept(raw)

    def _is_even(self) -> bool:
        """Tell whether about as long has passed before the low half as behind it."""
        first_s, low_s, second_s = self._read_at_s[:3]
        shorter_s, longer_s = sorted((low_s - first_s, second_s - low_s))
        return shorter_s >= LEAST_EVENNESS * longer_s

    def _begin_again(self) -> None:
        self._highs.clear()
        self._read_at_s.clear()
        self._low = None
        self._rounds_left -= 1
        self.wanted = self._counter.high if self._rounds_left else None

    def _accept(self, raw: int) -> None:
        self.wanted = None
        # elsewhere the two halves tell it: it may have gone that far between two looks at its speed
        last = self._last_at_rest if _is_near_boundary(raw % _WORD) else None
        nearest = raw if last is None else _nearest_to(last, raw)
        self.value = CounterValue(nearest, resolved=nearest != raw)


def _high_of(seen: Iterable[int], low: int) -> int | None:
    """Return the high half that goes with `low` out of one or two adjacent ones; None when they are not adjacent."""
    highs = sorted(seen)
    if len(highs) == 1:
        return highs[0]
    if highs == [0, _WORD - 1]:
        highs.reverse()  # the counter went through zero
    elif len(highs) > 2 or highs[1] - highs[0] != 1:  # noqa: PLR2004 - two adjacent halves
        return None
    # a low half near 0 goes with the higher one of them, one near FFFFH with the lower one
    return highs[1] if low < _HALF else highs[0]


def _is_near_boundary(low: int) -> bool:
    return low < GUARD_COUNTS or low >= _WORD - GUARD_COUNTS


def _nearest_to(last: int, raw: int) -> int:
    """Return `raw`, or its neighbour 65536 away if that one is close to a value known from standstill."""
    for candidate in ((raw + _WORD) % _RANGE, (raw - _WORD) % _RANGE):
        if _is_near(last, candidate):
            return candidate
    return raw


def _is_near(last: int, raw: int) -> bool:
    return min((raw - last) % _RANGE, (last - raw) % _RANGE) < GUARD_COUNTS


GAIN_SWITCH = Monitor(Register.GAIN_SWITCH, "", "Gain rotary switch", "")
FUNCTION_SWITCHES = Monitor(Register.FUNCTION_SWITCHES, "", "Function selection switches", "")
AUTO_TUNING_RESULT = Monitor(Register.AUTO_TUNING_RESULT, "Fn007", "Auto-tuning result", "%")

WORDS: Mapping[MonitorName, Monitor] = MappingProxyType(
    {
        MonitorName.SPEED_FEEDBACK: SPEED_FEEDBACK,
        MonitorName.SPEED_REFERENCE: SPEED_REFERENCE,
        MonitorName.TORQUE_REFERENCE: TORQUE_REFERENCE,
        MonitorName.PULSES_FROM_Z: PULSES_FROM_Z,
        MonitorName.ELECTRICAL_ANGLE: ELECTRICAL_ANGLE,
        MonitorName.INPUT_SIGNALS: INPUT_SIGNALS,
        MonitorName.OUTPUT_SIGNALS: OUTPUT_SIGNALS,
        MonitorName.REFERENCE_PULSE_SPEED: REFERENCE_PULSE_SPEED,
        MonitorName.POSITION_DEVIATION: POSITION_DEVIATION,
        MonitorName.CUMULATIVE_LOAD: CUMULATIVE_LOAD,
        MonitorName.REGENERATIVE_LOAD: REGENERATIVE_LOAD,
        MonitorName.BRAKE_LOAD: BRAKE_LOAD,
        MonitorName.GAIN_SWITCH: GAIN_SWITCH,
        MonitorName.FUNCTION_SWITCHES: FUNCTION_SWITCHES,
        MonitorName.AUTO_TUNING_RESULT: AUTO_TUNING_RESULT,
    }
)
"""Monitors of one word."""

COUNTERS: Mapping[MonitorName, Counter] = MappingProxyType(
    {MonitorName.INPUT_COUNTER: Counter.COMMAND, MonitorName.FEEDBACK_COUNTER: Counter.FEEDBACK}
)
"""Monitors of two words that are read by turns."""


def word_value(name: MonitorName, word: int, profile: SmartStepProfile) -> MonitorValue:
    """Return what the word of a monitor says; which level makes a signal active is an assumption of the profile."""
    monitor = WORDS[name]
    bits: IntFlag | None = None
    active: tuple[str, ...] | None = None
    match name:
        case MonitorName.INPUT_SIGNALS:
            bits = inputs = input_levels(word)
            on = {InputSignal.RUN: run_is_on(profile, inputs), InputSignal.RESET: reset_is_on(profile, inputs)}
            active = tuple(signal.name or "" for signal in on if on[signal])
        case MonitorName.OUTPUT_SIGNALS:
            bits = outputs = output_levels(word)
            said = {
                OutputSignal.ALM: alarm_is_out(profile, outputs),
                OutputSignal.INP: _is_on(outputs, OutputSignal.INP, active_low=profile.unit.inp_active_low),
                OutputSignal.BKIR: _is_on(outputs, OutputSignal.BKIR, active_low=profile.unit.bkir_active_low),
            }
            active = tuple(signal.name or "" for signal in said if said[signal])
        case MonitorName.FUNCTION_SWITCHES:
            bits = function_switches(word)
        case MonitorName.GAIN_SWITCH:
            word = gain_switch(word)
        case _:
            pass
    if bits is None:
        value = monitor.value_of(word)
        return MonitorValue(MonitorReading(monitor=name, value=value, unit=monitor.unit, title=monitor.title))
    high = tuple(bit.name or "" for bit in bits)
    return MonitorValue(
        MonitorReading(monitor=name, value=int(bits), unit="", title=monitor.title, high=high, active=active)
    )


def counter_value(name: MonitorName, signed: int, *, resolved: bool) -> MonitorValue:
    """Return what a counter says."""
    low = COUNTERS[name].low
    title = low.title.removesuffix(" (rightmost 16 bits)")
    return MonitorValue(MonitorReading(monitor=name, value=signed, unit=low.unit, title=title), resolved=resolved)
