"""The two 32-bit pulse counters, read in halves that no latch holds together.

High, low, high and "equal is good" is wrong for a counter that rests on a boundary of 65536 and trembles by one: both
high halves may agree and still not belong to the low half. So the low half decides which of two adjacent high halves is
its own, and near a boundary further high halves are read to learn whether there are two. A counter that is where it was
at standstill is not read on: there is nothing left to learn.
Sources: manual 5 and 6 with their notes; the rule was found by simulation, as the manual gives none.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum, StrEnum
from typing import ClassVar

from ldcnd.drivers.smartstep.operating_modes import OperatingMode
from ldcnd.drivers.smartstep.status import (
    FEEDBACK_COUNTER_HIGH,
    FEEDBACK_COUNTER_LOW,
    INPUT_COUNTER_HIGH,
    INPUT_COUNTER_LOW,
    Monitor,
)

GUARD_COUNTS = 256
"""How near to a boundary the low half must be to make the high half suspect."""
GUARD_READS = 8
LONGEST_ROUNDS = 5
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


class CounterQuality(StrEnum):
    """How a counter value was put together."""

    AGREED = "agreed"
    """All high halves were the same, or the low half said which of two belongs to it."""
    RESOLVED = "resolved"
    """Off by 65536 from the last value at standstill, and corrected by it."""


@dataclass(frozen=True, slots=True)
class CounterValue:
    """A counter reading; the halves were read one after the other, at some instants between."""

    latched: ClassVar[bool] = False

    raw: int
    quality: CounterQuality = CounterQuality.AGREED

    @property
    def signed(self) -> int:
        """The value as 32-bit two's complement: a cleared counter that moved backwards is negative."""
        return self.raw - _RANGE if self.raw >= _RANGE // 2 else self.raw


class CounterReading:
    """Asks for one word at a time until it can tell the value, or gives up.

    Right while the counter moves less than 32768 between two reads; faster even motion is noticed and read again.

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

    def take(self, word: int) -> None:
        """Accept the word of the monitor that was wanted; ignored when none is."""
        if self.wanted is None:
            return
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
        if high is None:
            self._begin_again()
            return
        raw = high * _WORD + low
        known = self._last_at_rest is not None and _is_near(self._last_at_rest, raw)
        is_suspect = len(seen) == 1 and _is_near_boundary(low) and not known
        if not is_suspect or len(self._highs) == 2 + GUARD_READS:
            self._accept(raw)

    def _begin_again(self) -> None:
        self._highs.clear()
        self._low = None
        self._rounds_left -= 1
        self.wanted = self._counter.high if self._rounds_left else None

    def _accept(self, raw: int) -> None:
        self.wanted = None
        resolved = raw if self._last_at_rest is None else _nearest_to(self._last_at_rest, raw)
        quality = CounterQuality.AGREED if resolved == raw else CounterQuality.RESOLVED
        self.value = CounterValue(resolved, quality)


def _high_of(seen: Iterable[int], low: int) -> int | None:
    """Return the high half that goes with `low` out of one or two adjacent ones; None when they are not adjacent."""
    highs = sorted(seen)
    if len(highs) == 1:
        return highs[0]
    if highs == [0, _WORD - 1]:
        highs.reverse()  # the counter went through zero
    elif len(highs) > 2 or highs[1] - highs[0] != 1:  # noqa: PLR2004 - two adjacent halves
        return None
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
