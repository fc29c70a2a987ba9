"""A host that is late, on the jumping clock: it writes a little after it means to and notes replies a little after they
have come.
"""

import asyncio
import random

from typing_extensions import override

from ldcnd.line.transport import Receiver, Transport
from ldcnd.sim.chain import Chain
from ldcnd.sim.line import SimulatedLine, open_simulated_line


class LateHost(Transport, Receiver):
    """A transport to a simulated line; half of each delay lies before the request, half behind the reply.

    In order: nothing overtakes what was written or received before it.

    Attributes:
        busy_s: for how long a request was under way, from the wish to send it to the note that its reply is there.
    """

    def __init__(self, line: SimulatedLine, least_s: float, most_s: float, seed: int) -> None:
        self._line = line
        self._range_s = (least_s / 2, most_s / 2)
        self._dice = random.Random(seed)
        self._loop = asyncio.get_running_loop()
        self._receiver: Receiver | None = None
        self.busy_s = 0.0
        self._asked_at_s = 0.0
        self._written_by_s = self._received_by_s = 0.0
        self._pending: set[asyncio.TimerHandle] = set()

    @override
    def attach(self, receiver: Receiver) -> None:
        self._receiver = receiver
        self._line.attach(self)

    @override
    def write(self, data: bytes) -> None:
        self._asked_at_s = self._loop.time()
        self._written_by_s = at_s = max(self._written_by_s, self._loop.time() + self._dice.uniform(*self._range_s))
        self._later(at_s, lambda: self._line.write(data))

    @override
    def expect(self, reply_bytes: int) -> None:
        self._line.expect(reply_bytes)

    @override
    def discard_input(self) -> None:
        self._line.discard_input()

    @override
    def set_baud(self, baud: int) -> None:
        self._line.set_baud(baud)

    @override
    async def close(self) -> None:
        for handle in self._pending:
            handle.cancel()
        await self._line.close()

    @override
    def data_received(self, data: bytes) -> None:
        self._received_by_s = at_s = max(self._received_by_s, self._loop.time() + self._dice.uniform(*self._range_s))
        if self._receiver:
            self.busy_s += at_s - self._asked_at_s
            receiver = self._receiver
            self._later(at_s, lambda: receiver.data_received(data))

    @override
    def transport_lost(self, reason: str) -> None:
        if self._receiver:
            self._receiver.transport_lost(reason)

    def _later(self, at_s: float, action: object) -> None:
        def run() -> None:
            self._pending.discard(handle)
            action()  # type: ignore[operator]  # any callable without arguments

        handle = self._loop.call_at(at_s, run)
        self._pending.add(handle)


async def open_late_host(chain: Chain, least_s: float, most_s: float, seed: int = 1) -> LateHost:
    """Open the line to a chain through a host that takes so long between a reply and the next request."""
    return LateHost(await open_simulated_line(chain), least_s, most_s, seed)
