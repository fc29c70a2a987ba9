"""A line between a schedule and a scripted far end, on the jumping clock."""

import asyncio

from ldcnd.contract.errors import BusError
from ldcnd.line.exchange import Exchange, Lane, Resync, Timing
from ldcnd.line.flight_recorder import BusStatistics, WireLog
from ldcnd.line.line import Line
from ldcnd.line.schedule import Schedule
from ldcnd.line.settings import BusSettings
from ldcnd.line.transaction import Transaction
from tests.support import toy_family as toy
from tests.support.scripted_line import Say, ScriptedLine

BYTE_S = 10 / 115_200
REQUEST_S = toy.REQUEST_BYTES * BYTE_S
REPLY_S = toy.REPLY_BYTES * BYTE_S
FENCE_S = toy.RESYNC.quiet_s + len(toy.FLUSH) * BYTE_S + toy.RESYNC.settle_s
MARGIN_S = 0.005


class RecordingTransaction(Transaction):
    """A transaction that notes its outcomes in a story."""

    proves = False

    def __init__(self, exchange: Exchange[int], story: list[str], lane: Lane = Lane.COMMAND):
        super().__init__(exchange, lane, 0.0)
        self.story = story
        self.send_again = 0
        self._doubted = False
        self.timing: Timing | None = None
        self.error: BusError | None = None

    @property
    def doubted(self) -> bool:
        return self._doubted

    def doubt(self) -> None:
        self._doubted = True

    def may_go(self, now_s: float) -> bool:
        self._doubted = False
        return True

    def completed(self, reply: bytes, timing: Timing) -> None:
        self.timing = timing
        self.story.append(f"completed {self.exchange.decode(reply)}")

    def lost(self, error: BusError) -> bool:
        self.error = error
        self.story.append(f"lost {toy.number_of(self.exchange.request)}")
        return self._again()

    def _again(self) -> bool:
        self.send_again -= 1
        return self.send_again >= 0

    def rejected(self) -> bool:
        self.story.append(f"rejected {toy.number_of(self.exchange.request)}")
        return self._again()


class Bench:
    """A line between a schedule and a scripted far end; tells its story."""

    make_line: type[Line] = Line

    def __init__(self, *, echo: bool = False, paced: bool = True, resync: Resync = toy.RESYNC):
        self.story: list[str] = []
        self.schedule: Schedule[Transaction] = Schedule()
        self.wire = ScriptedLine(toy.answer)
        self.wire.echo = echo
        self.statistics = BusStatistics()
        self.log = WireLog()
        settings = BusSettings("toy", 115_200, margin_s=MARGIN_S, echo=echo, paced=paced)
        self.line = self.make_line(
            settings,
            self.wire,
            self.schedule,
            resync,
            self.statistics,
            self.log,
            self._note_loss,
            report_failure=self._note_failure,
        )

    def _note_loss(self, reason: str) -> None:
        self.story.append(f"line lost: {reason}")

    def _note_failure(self, error: BaseException) -> None:
        raise error

    def add(
        self,
        number: int,
        lane: Lane = Lane.COMMAND,
        *,
        then_baud: int | None = None,
        at_baud: int | None = None,
        reply_bytes: int = toy.REPLY_BYTES,
        response_s: float = toy.RESPONSE_S,
        repeatable: bool = True,
        slow_to_deliver: bool = False,
    ) -> RecordingTransaction:
        """Queue an exchange of that number."""
        exchange = toy.exchange(number, reply_bytes=reply_bytes, response_s=response_s, repeatable=repeatable)
        transaction = RecordingTransaction(exchange, self.story, lane)
        transaction.then_baud, transaction.at_baud = then_baud, at_baud
        transaction.slow_to_deliver = slow_to_deliver
        return self.queue(transaction)

    def queue(self, transaction: RecordingTransaction) -> RecordingTransaction:
        """Queue a transaction in its lane."""
        self.schedule.push(transaction, transaction.lane)
        self.line.kick()
        return transaction

    def sent(self, number: int) -> list[float]:
        """When a request was written."""
        return [
            written.at_s
            for written in self.wire.writes
            if written.data != toy.FLUSH and toy.number_of(written.data) == number
        ]

    def replies(self, says: dict[int, list[Say]]) -> None:
        """Answer some numbers in a special way, the first time only."""

        def script(packet: bytes) -> list[Say]:
            special = None if packet == toy.FLUSH else says.pop(toy.number_of(packet), None)
            return toy.answer(packet) if special is None else special

        self.wire.script = script


async def settle(seconds: float = 1.0) -> None:
    """Let virtual time pass."""
    await asyncio.sleep(seconds)
