"""A simulated chain as a byte pipe of the running event loop; the one fake of the whole project, at its lowest seam.

On a virtual clock it is reproducible bit by bit. On the wall clock its replies come as late as the loop's timers: use
`pty` where pacing matters.
"""

import asyncio

from typing_extensions import override

from ldcnd.contract.errors import TransportLost
from ldcnd.line.transport import Receiver, Transport
from ldcnd.sim.chain import Chain


class SimulatedLine(Transport):
    """The open pipe to a chain; the modules outlive it."""

    def __init__(self, chain: Chain) -> None:
        self._chain = chain
        self._loop = asyncio.get_running_loop()
        self._receiver: Receiver | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._timer_at_s: float | None = None
        self._farewell: asyncio.Handle | None = None
        self._gone: str | None = None
        now_s = self._loop.time()
        chain.advance(now_s)
        chain.discard(now_s)
        chain.on_loss = self._lost

    @property
    def wire_busy_s(self) -> float:
        """Return for how long bytes have been on the chain's lines since it was built."""
        return self._chain.wire_busy_s

    @override
    def attach(self, receiver: Receiver) -> None:
        self._receiver = receiver
        self._chain.discard(self._loop.time())
        self._arm()

    @override
    def write(self, data: bytes) -> None:
        if self._gone:
            raise TransportLost(self._gone)
        self._chain.write(self._loop.time(), data)
        self._arm()

    def expect(self, reply_bytes: int) -> None:
        """Do nothing: the chain's delivery decides how replies are cut into pieces."""

    @override
    def discard_input(self) -> None:
        self._chain.discard(self._loop.time())
        self._arm()

    @override
    def set_baud(self, baud: int) -> None:
        if self._gone:
            raise TransportLost(self._gone)
        self._chain.baud = baud

    @override
    async def close(self) -> None:
        self._disarm()
        if self._farewell:
            self._farewell.cancel()
            self._farewell = None
        if self._gone is None:
            self._gone = "the simulated line is closed"
            self._chain.on_loss = None
        self._receiver = None

    def _lost(self, reason: str) -> None:
        """Stop at once, and tell the receiver in the loop's next turn: it may be in the middle of a write."""
        self._gone = reason
        self._chain.on_loss = None
        self._disarm()
        self._farewell = self._loop.call_soon(self._tell_loss)

    def _tell_loss(self) -> None:
        self._farewell = None
        if self._receiver and self._gone:
            self._receiver.transport_lost(self._gone)

    def _arm(self) -> None:
        """Keep exactly one timer, at the chain's next event."""
        at_s = None if self._gone else self._chain.next_event_s()
        if self._timer and at_s == self._timer_at_s:
            return
        self._disarm()
        self._timer_at_s = at_s
        if at_s is not None:
            self._timer = self._loop.call_at(at_s, self._due, at_s)

    def _disarm(self) -> None:
        if self._timer:
            self._timer.cancel()
            self._timer = None

    def _due(self, at_s: float) -> None:
        self._timer = None
        # a loop may call a little early, within the resolution of its clock
        for _, data in self._chain.advance(max(at_s, self._loop.time())):
            if self._receiver:
                self._receiver.data_received(data)
        self._arm()


async def open_simulated_line(chain: Chain, baud: int | None = None) -> SimulatedLine:
    """Open the line to a chain; nothing is reset, the modules are as they were left.

    Args:
        chain: the modules.
        baud: the rate of the port; None for the one at which it was left.

    Raises:
        TransportLost: the simulated adapter is unplugged.
    """
    if not chain.plugged(asyncio.get_running_loop().time()):
        raise TransportLost("the simulated adapter is unplugged", remedy="plug it in again")
    chain.baud = baud or chain.baud
    return SimulatedLine(chain)
