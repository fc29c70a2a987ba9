"""A line whose far end says what a test tells it to, when the test tells it to; for the jumping clock."""

import asyncio
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from typing_extensions import override

from ldcnd.contract.errors import TransportLost
from ldcnd.line.transport import Receiver, Transport

BITS_PER_BYTE = 10


@dataclass(frozen=True, slots=True)
class Say:
    """Bytes that the far end sends in answer to a request.

    Attributes:
        data: what it sends.
        after_s: pause between the request's last bit and the first bit of the data.
        latency_s: how long the adapter keeps the bytes to itself.
        unbidden: the node sends even when the host has sent something else meanwhile; others give way.
    """

    data: bytes
    after_s: float = 0.0001
    latency_s: float = 0.0
    unbidden: bool = False


@dataclass(frozen=True, slots=True)
class Written:
    """A packet of the host and when it was handed over, in loop time."""

    at_s: float
    data: bytes


Script = Callable[[bytes], Sequence[Say]]
"""What the far end says to a request."""


class ScriptedLine(Transport):
    """A transport that records what is written and plays a script's answers at the line's rate.

    Attributes:
        script: called with each packet; replace it to change the far end's mind.
        bytewise: deliver byte by byte as the wire carries them, not each answer whole at its end.
        echo: the adapter returns what the host sends.
        holds_back: deliver nothing before as many bytes are there as were told to be expected, like a terminal.
        expected: as told last.
        history: everything that happened here, in order: "write <hex>", "refused", "baud <rate>",
            "discard", "close".
    """

    def __init__(self, script: Script, baud: int = 115_200) -> None:
        self.script = script
        self.bytewise = False
        self.echo = False
        self.holds_back = False
        self.expected = 1
        self._held = b""
        self.fails_to_write = False
        self.writes: list[Written] = []
        self.history: list[str] = []
        self.baud = baud
        self._receiver: Receiver | None = None  # nobody listens before `attach`
        self._loop = asyncio.get_running_loop()
        self._wire_free_at_s = 0.0
        self._coming: list[tuple[float, Say, asyncio.TimerHandle]] = []
        self._gone = False

    @property
    def byte_s(self) -> float:
        """Time of one byte on the wire."""
        return BITS_PER_BYTE / self.baud

    def packets(self) -> list[bytes]:
        """Return what was written, first to last."""
        return [written.data for written in self.writes]

    # -- the far end -------------------------------------------------------------------------------------------------

    def say(self, data: bytes) -> None:
        """Deliver bytes at once, whoever asked."""
        if self._receiver and not self._gone:
            self._held += data
            if not self.holds_back or len(self._held) >= self.expected:
                self.collect()

    def lose(self, reason: str = "unplugged") -> None:
        """Pull the plug."""
        if not self._gone:
            self._silence()
            if self._receiver:
                self._receiver.transport_lost(reason)

    # -- transport ---------------------------------------------------------------------------------------------------

    @override
    def attach(self, receiver: Receiver) -> None:
        self._receiver = receiver

    @override
    def write(self, data: bytes) -> None:
        if self._gone or self.fails_to_write:
            self.history.append("refused")
            raise TransportLost("the port is gone")
        now_s = self._loop.time()
        self.writes.append(Written(now_s, data))
        self.history.append(f"write {data.hex()}")
        self._give_way(now_s)
        over_s = max(now_s, self._wire_free_at_s) + len(data) * self.byte_s
        self._wire_free_at_s = over_s
        if self.echo:
            self._play(Say(data, 0.0, unbidden=True), now_s)
        for said in self.script(data):
            self._play(said, over_s)

    def expect(self, reply_bytes: int) -> None:
        """See `Transport`; what is enough now is delivered in the loop's next turn."""
        self.expected = reply_bytes
        if len(self._held) >= reply_bytes:
            self._loop.call_soon(self.collect)

    @override
    def collect(self) -> None:
        data, self._held = self._held, b""
        if data and self._receiver and not self._gone:
            self._receiver.data_received(data)

    def discard_input(self) -> None:
        """Drop what is held back; all else that has arrived was delivered."""
        self._held = b""
        self.history.append("discard")

    @override
    def set_baud(self, baud: int) -> None:
        if self._gone:
            raise TransportLost("the port is gone")
        self.history.append(f"baud {baud}")
        self.baud = baud

    @override
    async def close(self) -> None:
        self._silence()
        self.history.append("close")

    def _play(self, said: Say, from_s: float) -> None:
        start_s = from_s + said.after_s
        pieces = [bytes([byte]) for byte in said.data] if self.bytewise else [said.data]
        end_s = start_s
        for piece in pieces:
            end_s += len(piece) * self.byte_s
            self._coming.append((start_s, said, self._loop.call_at(end_s + said.latency_s, self.say, piece)))

    def _give_way(self, now_s: float) -> None:
        """Nodes that have not begun to answer drop their answer when the host sends again."""
        for start_s, said, timer in self._coming:
            if start_s > now_s and not said.unbidden:
                timer.cancel()
        self._coming = [entry for entry in self._coming if not entry[2].cancelled() and entry[2].when() > now_s]

    def _silence(self) -> None:
        self._gone = True
        for _, _, timer in self._coming:
            timer.cancel()
        self._coming.clear()


class ScriptedOpener:
    """Opens a new scripted line each time; remembers them all.

    Attributes:
        refusals: so many openings fail first.
        attempted_at_s: when each opening was tried.
    """

    def __init__(self, script: Script, baud: int = 115_200) -> None:
        self.script = script
        self.baud = baud
        self.refusals = 0
        self.fixed_baud = False
        self.lines: list[ScriptedLine] = []
        self.attempted_at_s: list[float] = []

    async def __call__(self) -> Transport:
        """Open, or raise `TransportLost`."""
        self.attempted_at_s.append(asyncio.get_running_loop().time())
        if self.refusals:
            self.refusals -= 1
            raise TransportLost("no such device")
        line = ScriptedLine(self.script, self.baud)
        line.fixed_baud = self.fixed_baud
        self.lines.append(line)
        return line

    @property
    def line(self) -> ScriptedLine:
        """The line opened last."""
        return self.lines[-1]
