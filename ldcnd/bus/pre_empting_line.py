"""A line on which a stop does not wait for the reply to a poll.

A module of the PIC-SERVO kind takes back what it sends as soon as it hears the host (PIC-SERVO manual, 4.1), so a stop
can go while a poll's reply is due. Replies do not say what they answer, so what comes back then may be anybody's. Such
a stop goes twice therefore: ahead, with nothing believed of what comes back, and again behind the fence, where its
answer counts as on any line. Stops may go twice; nothing else is sent ahead, and only polls are interrupted: they
change nothing.

A module that is about to execute a packet must not hear another one, which would overwrite it (same place): a stop goes
ahead only once the packet before it has surely been executed.
"""

from ldcnd.bus.exchange_queue import POLL
from ldcnd.bus.line import ANY, NOT_PLAIN, Line
from ldcnd.bus.line_phase import Phase
from ldcnd.bus.settings import HOST_LATE_S, WORTH_S
from ldcnd.bus.turn import Turn
from ldcnd.bus.watchdog import NEVER_S
from ldcnd.bus.wire_log import WireEvent
from ldcnd.exchange import Exchange

AHEAD = "stop ahead of a reply"
"""Remark of the wire log, and another one for what comes back."""
NOT_BELIEVED = "not believed"


class PreEmptingLine(Line):
    """See the module: one exchange is outstanding, or stops whose replies are not believed."""

    _hurried: Turn | None = None  # the poll whose reply is about to be taken back
    _answer_by_s = NEVER_S  # its deadline
    _gone: tuple[Turn, ...] = ()  # stops that went ahead
    _free_at_s = 0.0  # when the last of them has been executed
    _over_at_s = 0.0  # when no reply to it can come any more

    def kick(self) -> None:
        """See `Line`."""
        super().kick()
        if self._first_to_go():
            self._hurry(self._loop.time())

    def _hurry(self, now_s: float) -> None:
        """Let a stop go ahead as soon as it may, if that is worth it."""
        turn = self._turn
        if self.phase is Phase.AHEAD:
            self._watchdog.set(max(now_s, self._free_at_s))
        elif turn and turn.lane is POLL and self.phase is Phase.REPLY and self._hurried is not turn:
            at_s = max(now_s, self._executed_by_s(turn.exchange, self._sent_at_s))
            if self._sent_at_s + self.wire.longest_s(turn.exchange) - at_s >= WORTH_S:
                self._hurried, self._answer_by_s = turn, self._watchdog.deadline_s
                self._watchdog.set(at_s)

    def _take_back(self, turn: Turn, now_s: float) -> None:
        """Send stops instead of waiting for a poll's reply, unless it is there or nobody wants to stop any more."""
        self._hurried, self._gone = None, ()
        self.wire.collect()
        if self._turn is not turn or self.phase is not Phase.REPLY:
            return
        if self._first_to_go() is None:
            self._watchdog.set(self._answer_by_s)
            return
        self._users.taken_back(turn)
        self._statistics.taken_back += 1
        self._fence.doubt()
        self._turn, self.phase, self._missing = None, Phase.AHEAD, NOT_PLAIN
        self.wire.expect(ANY)
        self._go_ahead(now_s)

    def _go_ahead(self, now_s: float) -> None:
        """Send the next stop, or wait until no reply can come any more, or go on behind the fence."""
        stop = self._first_to_go()
        if stop:
            request = stop.exchange.request
            failure = self.wire.write(request)
            self.wire.sent(request, now_s, AHEAD)
            self._gone += (stop,)
            self._free_at_s = self._executed_by_s(stop.exchange, now_s)
            self._over_at_s = now_s + HOST_LATE_S + self.wire.longest_s(stop.exchange) + self._settings.margin_s
            self._watchdog.set(self._free_at_s)
            if failure:
                self.transport_lost(failure)
        elif now_s < self._over_at_s:
            self._watchdog.set(self._over_at_s)
        else:
            self._raise_fence(now_s)

    def _first_to_go(self) -> Turn | None:
        """Return the first stop that waits and may go ahead, and has not."""
        waiting = (stop for stop in self._users.stops() if stop.exchange.repeatable and stop not in self._gone)
        return next(waiting, None)

    def _executed_by_s(self, exchange: Exchange[object], sent_at_s: float) -> float:
        """Return when a packet has surely been executed: its node is about to answer then, or does."""
        return sent_at_s + HOST_LATE_S + len(exchange.request) * self.wire.byte_s + exchange.response_s

    def _stray(self, data: bytes, now_s: float) -> None:
        """See `Line`; what comes back behind a stop that went ahead is expected and not believed."""
        if self.phase is Phase.AHEAD:
            self.wire.note(WireEvent.RECEIVED, now_s, data, NOT_BELIEVED)
        else:
            super()._stray(data, now_s)

    def _expired(self, now_s: float) -> None:
        if self.phase is Phase.AHEAD:
            self._go_ahead(now_s)
        elif self._turn and self._turn is self._hurried and self.phase is Phase.REPLY:
            self._take_back(self._turn, now_s)
        else:
            super()._expired(now_s)
