"""Polling one drive word by word: which item is due, which words it takes, what they say together.

Another node's turn fits between any two words. A drive that does not answer is polled for one word only, more and more
seldom, because each exchange costs the others of its line a third of a second.
"""

import asyncio
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum

from typing_extensions import override

from ldcnd.contract.errors import BusError
from ldcnd.contract.samples import MonitorName, TelemetryItem
from ldcnd.drives.driver import PartialReading
from ldcnd.drives.parameter_access import MonitorValue
from ldcnd.drives.smartstep.addresses import Register
from ldcnd.drives.smartstep.commands import Refusal, is_self_hearing, reference, with_response_time
from ldcnd.drives.smartstep.monitors import (
    COUNTERS,
    HISTORY_LENGTH,
    INPUT_SIGNALS,
    OUTPUT_SIGNALS,
    SPEED_FEEDBACK,
    WORDS,
    Counter,
    CounterReading,
    CounterValue,
    counter_value,
    word_value,
)
from ldcnd.drives.smartstep.parameters import PARAMETERS
from ldcnd.drives.smartstep.profiles import SmartStepProfile
from ldcnd.drives.smartstep.words import CounterClears, stray_packets
from ldcnd.line.bus import Bus
from ldcnd.line.exchange import NEVER_S, Exchange, Poller, Timing, next_on_grid
from ldcnd.line.proof import MISSES_UNTIL_LOST
from ldcnd.log import get_logger

log = get_logger("smartstep")

FIRST_BACKOFF_S = 1.0
LONGEST_BACKOFF_S = 10.0
STRAY_WAIT_S = 0.3
"""A drive that received its own reply has answered by then: its longest response time and some margin."""
ALARM_HISTORY_PAUSE_S = 0.5
"""Between two words of an alarm history that is wanted now: others of the line hardly notice."""
PUT_OFF_S = 1.0
"""Longer than an exchange takes beside the drive's response; not for ever, because the bus keeps the date till then."""


class Basic(Enum):
    """Items polled beside monitors."""

    IDENTITY = "identity"
    STATE = "state"
    VELOCITY = "velocity"
    POSITION = "position"
    ALARM_HISTORY = "alarm_history"
    PARAMETERS = "parameters"


Item = Basic | MonitorName

BASIC_WORDS: Mapping[Basic, tuple[int, ...]] = {
    Basic.IDENTITY: (Register.DRIVER_TYPE, Register.SOFTWARE_VERSION),
    Basic.STATE: (Register.PRESENT_ALARM, INPUT_SIGNALS.address, OUTPUT_SIGNALS.address),
    Basic.VELOCITY: (SPEED_FEEDBACK.address,),
    Basic.ALARM_HISTORY: (Register.ALARM_HISTORY,),  # and nine more, each in a turn of its own
    Basic.PARAMETERS: (PARAMETERS[0].ram_address,),  # and all others, likewise
}
HISTORY = tuple(Register.ALARM_HISTORY + place for place in range(HISTORY_LENGTH))
STATE_WORDS = (*BASIC_WORDS[Basic.STATE], *BASIC_WORDS[Basic.VELOCITY])
"""Words that tell of a drive what its position does not."""
PUBLISHED = {
    Basic.STATE: TelemetryItem.STATE,
    Basic.VELOCITY: TelemetryItem.VELOCITY,
    Basic.POSITION: TelemetryItem.POSITION,
}


@dataclass(frozen=True, slots=True)
class UnitWords:
    """The latest words of a drive; complete only once each was read.

    Attributes:
        words: by address.
        position: the feedback counter.
        pieces: what of them is new; None when all is.
    """

    words: Mapping[int, int]
    position: CounterValue
    pieces: PartialReading | None = None


@dataclass(frozen=True, slots=True)
class Listeners:
    """Callbacks of a poller; none of them waits.

    Attributes:
        read: of an item that was read completely, with all that is known of the drive.
        monitored: of a monitor.
        identified: of driver type and software version, whenever the drive may be another one.
        missed: of a poll that brought nothing.
        self_hearing: of a drive that takes its own replies for commands.
        history: of the alarm history; it returns whether that has to be read again at once.
        audited: of the place of a parameter in `PARAMETERS` and its value in use; returns as `history`.
    """

    read: Callable[[UnitWords, TelemetryItem, Timing], None]
    monitored: Callable[[MonitorValue, Timing], None]
    identified: Callable[[int, int], None]
    missed: Callable[[BusError], None]
    self_hearing: Callable[[], None]
    history: Callable[[tuple[int, ...]], bool]
    audited: Callable[[int, int], bool]


class UnitPoller(Poller[int | Refusal]):
    """Polls one drive; deadlines are absolute, and missed periods are skipped."""

    def __init__(
        self,
        bus: Bus,
        unit: int,
        profile: SmartStepProfile,
        rates_hz: Mapping[Item, float],
        start_at_s: float,
        listeners: Listeners,
        *,
        wires_checked: bool = True,
        is_lost: Callable[[], bool] = lambda: False,
        clears: CounterClears | None = None,
    ) -> None:
        """Prepare the polls; sends nothing.

        Args:
            bus: the owner of the line.
            unit: the unit number.
            profile: how the drive is taken to behave.
            rates_hz: how often each item is read.
            start_at_s: from when on, in loop time.
            listeners: its callbacks.
            wires_checked: the drive is known not to receive its own replies; otherwise that is checked before a word is
                read that may be zero.
            is_lost: tells whether the line has given the drive up, so that who answers has to be identified; it counts
                exchanges of others, too.
            clears: of its counters; None where nobody clears them.
        """
        self.node = unit
        self.due_at_s = start_at_s
        self._bus = bus
        self._loop = asyncio.get_running_loop()
        self._profile = profile
        self._listeners = listeners
        self._is_lost = is_lost
        self._clears = clears or CounterClears()
        self._periods_s: dict[Item, float] = {item: 1.0 / rate for item, rate in rates_hz.items() if rate > 0}
        periods_s = self._periods_s
        self.rates_hz = {item: 1.0 / periods_s[basic] for basic, item in PUBLISHED.items() if basic in periods_s}
        self._due_s: dict[Item, float] = dict.fromkeys(self._periods_s, start_at_s)
        self._due_s[Basic.IDENTITY] = start_at_s
        self._words: dict[int, int] = {}
        self._asked_at_s: dict[int, float] = {}  # of each of these words
        self._position: CounterValue | None = None
        self._position_at_s = 0.0
        self._position_behind: int | None = None  # how many clears of counters
        self._at_rest_since_position = False
        self._item: Item | None = None
        self._left: list[int] = []
        self._counter: CounterReading | None = None
        self._counter_behind: int | None = None
        self._address = 0
        self._low_timing: Timing | None = None
        self._one_word_only = False
        self._history_place = 0
        self._hurries_history = True
        self._audited = list(range(len(PARAMETERS)))  # places; the next one first
        self._misses = 0 if wires_checked else MISSES_UNTIL_LOST

    # -- poller ------------------------------------------------------------------------------------------------------

    def next_exchange(self, now_s: float) -> Exchange[int | Refusal]:
        """See `Poller`.

        The line takes its next turn before it delivers the last reply; which word is next depends on that reply, so
        the turn after this one is put off until then.
        """
        queued_at_s, self.due_at_s = self.due_at_s, now_s + self._profile.unit.first_character_s + PUT_OFF_S
        if self._misses >= MISSES_UNTIL_LOST or self._one_word_only:
            # every drive has it, and it is never zero: 0099H without an alarm (manual 3)
            self._address = Register.PRESENT_ALARM
        else:
            if self._item is None:
                self._begin(now_s, queued_at_s)
            wanted = self._counter.wanted if self._counter else None
            self._address = wanted.address if wanted else self._left.pop(0)
        return with_response_time(reference(self.node, self._address), self._profile)

    @override
    def deliver(self, reply: int | Refusal, timing: Timing) -> None:
        identifies = self._item is Basic.IDENTITY or self._due_s[Basic.IDENTITY] < NEVER_S
        if self._misses >= MISSES_UNTIL_LOST or (self._is_lost() and not identifies):
            self._misses = 0
            self._abandon()
            self._back(timing.received_at_s)
            return
        self._misses = 0
        # until `_heard`, which comes much sooner than this turn
        if self._one_word_only:
            self._next_turn(timing.received_at_s + LONGEST_BACKOFF_S)
            return
        if self._item and isinstance(reply, Refusal):
            self._give_up(self._item, reply)
        elif self._counter and isinstance(reply, int):
            self._take_half(self._counter, reply, timing)
        elif self._item and isinstance(reply, int):
            # the history has a new entry, or one more is on its way
            if self._address == Register.PRESENT_ALARM and reply != self._words.get(self._address):
                self._read_history(timing.received_at_s)
            self._words[self._address], self._asked_at_s[self._address] = reply, timing.sent_at_s
            if not self._left:
                self._finish(self._item, timing)
        due_s = min(self._due_s.values())
        # behind the others that are due, also with what is late: units take turns word by word
        self._next_turn(timing.received_at_s if self._item else max(timing.received_at_s, due_s))

    @override
    def missed(self, error: BusError) -> None:
        self._misses += 1
        self._abandon()
        self._at_rest_since_position = False
        self._listeners.missed(error)
        now_s = self._loop.time()
        if self._misses < MISSES_UNTIL_LOST:
            self._next_turn(now_s)
        else:
            doublings = min(10, self._misses - MISSES_UNTIL_LOST)
            self._next_turn(now_s + min(LONGEST_BACKOFF_S, FIRST_BACKOFF_S * 2.0**doublings))

    def _next_turn(self, at_s: float) -> None:
        """Request the next turn; the line may take it before this returns."""
        self.due_at_s = at_s
        # not added: it may have been replaced while its poll was on the wire, or its line lost while it waited
        self._bus.move_poller(self)

    # -- items -------------------------------------------------------------------------------------------------------

    def _begin(self, now_s: float, queued_at_s: float) -> None:
        """Take up the item that is due and has the earliest deadline: its next turn.

        What has become due since the turn was requested waits for another one, or it would pass over a late item at the
        last moment.
        """

        def urgency(item: Item) -> tuple[bool, float]:
            due_s = self._due_s[item]
            return due_s > queued_at_s, due_s + self._periods_s.get(item, 0.0)

        item = self._item = min(self._due_s, key=urgency)
        due_s = self._due_s[item]
        if item is Basic.IDENTITY:
            self._due_s[item] = NEVER_S
        else:
            self._due_s[item] = next_on_grid(due_s, self._periods_s[item], now_s)
        self._left = []
        counter = _counter_of(item)
        if counter:
            behind = self._counter_behind = self._clears.over
            stood = self._at_rest_since_position and behind == self._position_behind
            last = self._position if item is Basic.POSITION and stood else None
            self._counter = CounterReading(counter, last.raw if last else None)
        elif isinstance(item, MonitorName):
            self._left.append(WORDS[item].address)
        elif item is Basic.ALARM_HISTORY:
            self._left.append(HISTORY[self._history_place])
        elif item is Basic.PARAMETERS:
            self._left.append(PARAMETERS[self._audited[0]].ram_address)
        else:
            self._left.extend(BASIC_WORDS[item])

    def _abandon(self) -> None:
        """Leave the item that is being read; it comes again in its turn."""
        self._item = self._counter = self._low_timing = None
        self._left = []

    def _give_up(self, item: Item, refusal: Refusal) -> None:
        """Stop polling an item that the drive does not have."""
        self._abandon()
        if item is Basic.PARAMETERS and len(self._audited) > 1:
            del self._audited[0]  # this model lacks it
            return
        log.warning("item not there", unit=self.node, item=item.value, reason=str(refusal))
        # without it there is neither state nor fault
        if item is not Basic.STATE:
            self._due_s[item] = NEVER_S

    def _back(self, now_s: float) -> None:
        """The drive answers again: it may have been off, or be another one."""
        self._words.clear()
        self._position = None
        for item in self._periods_s:
            if self._due_s[item] < NEVER_S:
                self._due_s[item] = now_s
        self._due_s[Basic.IDENTITY] = now_s
        self._read_history(now_s)
        # The word of this poll is never zero, so a drive that takes its own replies for commands shows now.
        self._one_word_only = True
        self._next_turn(now_s + LONGEST_BACKOFF_S)
        self._loop.call_later(STRAY_WAIT_S, self._heard, now_s)

    def _heard(self, answered_at_s: float) -> None:
        """Resume polls of a drive that has come back, unless it receives its own replies: then nothing more is sent."""
        if self._hears_itself(answered_at_s):
            log.error("drive takes its own replies for commands; nothing more is sent to it", unit=self.node)
            self._listeners.self_hearing()
        else:
            self._one_word_only = False
            self._next_turn(self._loop.time())

    def _hears_itself(self, since_s: float) -> bool:
        return any(is_self_hearing(self.node, packet) for packet in stray_packets(self._bus, since_s))

    def _finish(self, item: Item, timing: Timing) -> None:
        self._abandon()
        if isinstance(item, MonitorName):
            self._listeners.monitored(word_value(item, self._words[WORDS[item].address], self._profile), timing)
        elif item is Basic.IDENTITY:
            self._listeners.identified(*(self._words[address] for address in BASIC_WORDS[Basic.IDENTITY]))
        elif item is Basic.ALARM_HISTORY:
            self._take_history(timing.received_at_s)
        elif item is Basic.PARAMETERS:
            self._take_parameter(timing.received_at_s)
        else:
            self._tell(item, timing)

    def _tell(self, item: Basic, timing: Timing, *, recounted: bool = False) -> None:
        """Tell of an item once the first reading of the drive is complete."""
        if item is Basic.VELOCITY and self._words[SPEED_FEEDBACK.address]:
            self._at_rest_since_position = False
        if self._position and all(address in self._words for address in STATE_WORDS):
            oldest_s = min(self._position_at_s, *(self._asked_at_s[address] for address in STATE_WORDS))
            pieces = PartialReading(timing.sent_at_s - oldest_s, position=item is Basic.POSITION, recounted=recounted)
            self._listeners.read(UnitWords(self._words, self._position, pieces), PUBLISHED[item], timing)

    # -- alarm history -----------------------------------------------------------------------------------------------

    def _read_history(self, now_s: float) -> None:
        """Read the history from its first word on, one turn after the other, if it is read at all."""
        self._history_place = 0
        self._hurries_history = True
        if self._due_s.get(Basic.ALARM_HISTORY, NEVER_S) < NEVER_S:
            self._due_s[Basic.ALARM_HISTORY] = now_s

    def _take_history(self, now_s: float) -> None:
        """Go on to the next word, or tell of the whole history."""
        self._history_place += 1
        if self._history_place < HISTORY_LENGTH:
            if self._hurries_history:
                self._due_s[Basic.ALARM_HISTORY] = now_s + ALARM_HISTORY_PAUSE_S
            return
        self._history_place = 0
        self._hurries_history = False
        if self._listeners.history(tuple(self._words[address] for address in HISTORY)):
            self._read_history(now_s)

    # -- parameters --------------------------------------------------------------------------------------------------

    def _take_parameter(self, now_s: float) -> None:
        """Tell of a parameter; go on to the next one, unless this one has to be read again."""
        place = self._audited[0]
        if self._listeners.audited(place, self._words[PARAMETERS[place].ram_address]):
            self._due_s[Basic.PARAMETERS] = now_s
        else:
            self._audited.append(self._audited.pop(0))

    # -- counters ----------------------------------------------------------------------------------------------------

    def _take_half(self, reading: CounterReading, word: int, timing: Timing) -> None:
        if reading.wanted is not None and reading.wanted.address in _LOW_HALVES:
            self._low_timing = timing  # the low half tells how far it has turned, at this instant
        reading.take(word, timing.received_at_s)
        if reading.wanted:
            return
        item, low_timing, behind = self._item, self._low_timing or timing, self._counter_behind
        self._abandon()
        value = reading.value
        if behind is None or behind != self._clears.over:
            log.debug("counter was cleared while it was read", unit=self.node)
        elif value is None:
            log.warning("counter moves too fast to be read", unit=self.node, item=item.value if item else "")
        elif isinstance(item, MonitorName):
            self._listeners.monitored(counter_value(item, value.signed, resolved=value.resolved), low_timing)
        else:
            recounted = self._position is not None and behind != self._position_behind
            self._position, self._position_at_s, self._position_behind = value, low_timing.sent_at_s, behind
            # of the latest speed, which was read before: a later one that is not 0 revokes it, see `_tell`
            self._at_rest_since_position = self._words.get(SPEED_FEEDBACK.address) == 0
            self._tell(Basic.POSITION, low_timing, recounted=recounted)


_LOW_HALVES = frozenset(counter.low.address for counter in Counter)


def _counter_of(item: Item) -> Counter | None:
    if item is Basic.POSITION:
        return Counter.FEEDBACK
    return COUNTERS.get(item) if isinstance(item, MonitorName) else None
