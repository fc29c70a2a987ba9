"""The far end of a line, played back from a capture: every packet of the host draws what it drew then.

Time is that of the event loop, moved by `shift_s`. What came from the far end comes at the instant at which it came
then, behind the packet that it answered; a packet that is late makes its answer as late. What the host sends must be
what it sent, in the same order: the first packet that is not ends the replay with a `ReplayDeviation`.

A host in the field takes time for everything and is held up now and then. What it did because of a reply follows it in
the log: such a reply is delivered when that was done. How late it woke up for its timers is up to the event loop.

A client's request is no packet, but a cause of packets: it is handed out again at its place between them.
"""

import asyncio
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Protocol

from typing_extensions import override

from ldcnd.contract.errors import TransportLost
from ldcnd.line.flight_recorder import AT_ONCE_REMARK, WireEvent, WireRecord
from ldcnd.line.transport import Receiver, Transport

PATIENCE_S = 1.0
"""Time for the host to send a packet after the instant at which it sent it then, seconds; opening may take longer."""
OPENING_PATIENCE_S = 15.0

_ARRIVALS = frozenset({WireEvent.RECEIVED, WireEvent.PART, WireEvent.STRAY, WireEvent.ECHO})
"""Records from the far end, each in one piece."""
_FROM_OUTSIDE = _ARRIVALS | {WireEvent.LOST, WireEvent.COMMAND}
_ANY_TIME = frozenset({WireEvent.COMMAND, WireEvent.STRAY})
"""Events that may come a little later: the recorded host took time for everything, this one takes none."""
_DECIDED_THERE = frozenset({WireEvent.TIMEOUT, WireEvent.RESYNC, WireEvent.SETTLED, WireEvent.POLLED})
"""Decisions of the recorded host; this one decides again."""


class ReplayDeviation(Exception):
    """The daemon that a capture is played to does not send what was sent when the capture was made."""


class Coming(Protocol):
    """Something that is to happen at an instant."""

    def cancel(self) -> None:
        """Let it not happen."""


ArriveAt = Callable[[float, Callable[[], None]], Coming]


class Replay:
    """Plays one capture, once.

    Args:
        records: from the opening of the line on, oldest first.
        until_s: when the capture ends, on the records' clock.
        ask: carries out a client's request, as it stands in the journal; must not block.
        shift_s: loop time less the records' time.
        fixed_baud: the port could not change its rate.
        slow_host: the host took time for what it did, as all do that are real.
        arrive_at: has something come from outside at an instant of the loop's; `call_at` of the loop if missing.

    Attributes:
        ended: done when the capture is over; raises `ReplayDeviation` when the host did something else.
        packets: how many packets of the host were answered as then.
        late_s: by how much the host was latest.
    """

    def __init__(
        self,
        records: Sequence[WireRecord],
        until_s: float,
        ask: Callable[[str], None],
        *,
        shift_s: float = 0.0,
        fixed_baud: bool = False,
        slow_host: bool = False,
        arrive_at: ArriveAt | None = None,
    ) -> None:
        self._loop = asyncio.get_running_loop()
        self.ended: asyncio.Future[None] = self._loop.create_future()
        self.packets = 0
        self.late_s = 0.0
        self.fixed_baud = fixed_baud
        self._arrive_at: ArriveAt = arrive_at or self._loop.call_at
        in_turn = tuple(_taken_in_turn(records)) if slow_host else records
        self._answered_at_s = _answered_at_s(in_turn)
        self._records = [(number, record) for number, record in enumerate(in_turn) if _counts(record)]
        self._until_s = until_s
        self._ask = ask
        self._shift_s = shift_s
        self._next = 0
        self._end = len(self._records)
        self._taken: set[int] = set()  # by the host, before what comes before it
        self._behind_s = 0.0  # by how much the last packet was late
        self._opening: asyncio.Future[None] | None = None
        self._line: ReplayLine | None = None
        self._timer: Coming | None = None
        self._wait()

    async def open(self) -> Transport:
        """Open the line when it was opened then; an `Opener`."""
        opening = self._opening = self._loop.create_future()
        self._wait()
        await opening
        self._line = ReplayLine(self)
        return self._line

    def close(self) -> None:
        """Play nothing more."""
        if self._timer:
            self._timer.cancel()
            self._timer = None
        if not self.ended.done():
            self.ended.cancel()
        if self._opening and not self._opening.done():
            self._opening.cancel()

    # -- what the host does ------------------------------------------------------------------------------------------

    def sent(self, data: bytes) -> None:
        """Take a packet; not answered once the capture is over."""
        if self.ended.done():
            return
        if self._take(WireEvent.SENT, lambda record: record.data == data, f"{WireEvent.SENT} {data.hex(' ')}"):
            self.packets += 1

    def baud_set(self, baud: int) -> None:
        """Take a change of the rate."""
        if self.ended.done():
            return
        self._take(WireEvent.BAUD, lambda record: record.note == str(baud), f"{WireEvent.BAUD} {baud}")

    def lag_s(self) -> float:
        """Return how long from now the answer to the next packet may take; 0 when there was none."""
        answered_at_s = self._answered_at_s.get(self._next)
        if answered_at_s is None:
            return 0.0
        sent_at_s = self._records[self._next][1].at_s
        return answered_at_s - min(sent_at_s, self._now_s())

    def closed(self, line: "ReplayLine") -> None:
        """Deliver nothing more to a line that was closed."""
        if self._line is line:
            self._line = None

    def _take(self, event: WireEvent, is_same: Callable[[WireRecord], bool], got: str) -> bool:
        """Find the record of what the host does; it may do so before something comes from outside, but not after."""
        places = (place for place in range(self._next, self._end) if self._holds_up(place))
        place = next(places, self._end)
        if place == self._end:
            return False
        record = self._records[place][1]
        if record.event is event and is_same(record):
            self._taken.add(place)
            self._behind_s = max(0.0, self._now_s() - record.at_s)
            self.late_s = max(self.late_s, self._behind_s)
            self._wait()
            return True
        self._deviate(got)
        return False

    def _holds_up(self, place: int) -> bool:
        return place not in self._taken and self._records[place][1].event not in _ANY_TIME

    def _deliver(self, data: bytes) -> None:
        if self._line and self._line.receiver and not self.ended.done():
            self._line.receiver.data_received(data)

    # -- what happens by itself --------------------------------------------------------------------------------------

    def _wait(self) -> None:
        """Set the one timer for whatever the next record needs."""
        if self._timer:
            self._timer.cancel()
        if self.ended.done():
            return
        while self._next in self._taken:
            self._taken.remove(self._next)
            self._next += 1
        if self._next == self._end:
            self._timer = self._at(self._until_s, self._over)
            return
        _, record = self._records[self._next]
        if record.event in _FROM_OUTSIDE:
            self._timer = self._at(record.at_s + self._behind_s, self._happen)
        elif record.event is WireEvent.OPENED and self._opening:
            self._timer = self._at(record.at_s, self._happen)
        else:
            patience_s = OPENING_PATIENCE_S if record.event is WireEvent.OPENED else PATIENCE_S
            missed_at_s = max(self._loop.time(), record.at_s + patience_s + self._shift_s)
            self._timer = self._loop.call_at(missed_at_s, self._missed)

    def _now_s(self) -> float:
        """Return the records' time."""
        return self._loop.time() - self._shift_s

    def _at(self, at_s: float, callback: Callable[[], None]) -> Coming:
        return self._arrive_at(max(self._loop.time(), at_s + self._shift_s), callback)

    def _happen(self) -> None:
        _, record = self._records[self._next]
        self._next += 1
        receiver = self._line.receiver if self._line else None
        match record.event:
            case WireEvent.OPENED:
                opening, self._opening = self._opening, None
                if opening and not opening.done():
                    opening.set_result(None)
            case WireEvent.COMMAND:
                self._ask(record.data.decode())
            case WireEvent.LOST:
                if self._line and receiver:
                    self._line.lost = record.note
                    receiver.transport_lost(record.note)
            case _:
                self._deliver(record.data)
        self._wait()

    def _missed(self) -> None:
        self._deviate("nothing")

    def _over(self) -> None:
        self.ended.set_result(None)

    def _deviate(self, got: str) -> None:
        number, record = self._records[self._next]
        expected = f"{record.event} {record.data.hex(' ') or record.note}".rstrip()
        self.ended.set_exception(
            ReplayDeviation(
                f"packet {self.packets + 1} (record {number}, {record.at_s:.9f} s): expected {expected!r},"
                f" got {got!r} at {self._now_s():.9f} s"
            )
        )
        self._wait()


def _taken_in_turn(records: Sequence[WireRecord]) -> Iterator[WireRecord]:
    """Let a reply come when the host did what it did next because of it: what it took for that, it takes again."""
    for record, after in pairwise(records):
        drew = after.event is WireEvent.SENT and after.note.endswith(AT_ONCE_REMARK)
        if record.event is WireEvent.RECEIVED and (drew or after.event is WireEvent.POLLED):
            yield replace(record, at_s=after.at_s)
        else:
            yield record
    yield from records[-1:]


def _counts(record: WireRecord) -> bool:
    return record.event not in _DECIDED_THERE and bool(record.data or record.event not in _ARRIVALS)


def _answered_at_s(records: Sequence[WireRecord]) -> dict[int, float]:
    """Return when the answer to a packet was there, by the packet's place among the records that count."""
    found: dict[int, float] = {}
    place = sent_at = -1
    for record in records:
        place += _counts(record)
        if record.event is WireEvent.SENT:
            sent_at = place
        elif record.event is WireEvent.TIMEOUT:
            found.pop(sent_at, None)
            sent_at = -1
        elif record.event in _ARRIVALS and record.data and sent_at >= 0:
            found[sent_at] = record.at_s
    return found


class ReplayLine(Transport):
    """The open pipe to a capture.

    Attributes:
        receiver: who gets the bytes.
        lost: why the pipe is gone; empty while it is not.
    """

    def __init__(self, replay: Replay) -> None:
        self.fixed_baud = replay.fixed_baud
        self.receiver: Receiver | None = None
        self.lost = ""
        self._replay = replay

    @property
    def lag_s(self) -> float:  # type: ignore[override] # a fixed delay elsewhere
        """See `Transport`: a host that was held up still took what it found then."""
        return self._replay.lag_s()

    @override
    def attach(self, receiver: Receiver) -> None:
        self.receiver = receiver

    @override
    def write(self, data: bytes) -> None:
        self._require_open()
        self._replay.sent(data)

    def expect(self, reply_bytes: int) -> None:
        """Do nothing: the capture decides how replies are cut into pieces."""

    def discard_input(self) -> None:
        """Do nothing: what was dropped then is not in the capture."""

    @override
    def set_baud(self, baud: int) -> None:
        self._require_open()
        self._replay.baud_set(baud)

    @override
    async def close(self) -> None:
        self.receiver = None
        self._replay.closed(self)

    def _require_open(self) -> None:
        if self.lost:
            raise TransportLost(self.lost)
