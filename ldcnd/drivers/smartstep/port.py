"""A port as a SmartStep line needs it: a pause before each packet, and parity in software where the port has none.

Wraps any transport; the bus sees seven-bit characters. A packet is held back until the line has been quiet, so a drive
has time to release its transmitter; the manual gives no time, so the profile does.
"""

import asyncio
from collections import deque

from ldcnd.drivers.smartstep.parity import add_parity, strip_parity
from ldcnd.drivers.smartstep.profiles import Framing, SmartStepProfile
from ldcnd.errors import TransportLost
from ldcnd.transport.transport import Opener, Receiver, Transport

BAUD = 9600
"""The only rate (manual 2.1)."""


class SmartStepPort(Transport):
    """An open port with manners; also the receiver of the port that it wraps."""

    def __init__(self, port: Transport, framing: Framing, quiet_s: float) -> None:
        self._port = port
        self._soft_parity = framing is Framing.SOFT_PARITY
        self._quiet_s = quiet_s
        self._loop = asyncio.get_running_loop()
        self._receiver: Receiver | None = None
        self._quiet_from_s = 0.0
        self._held_back: deque[bytes] = deque()
        self._timer: asyncio.TimerHandle | None = None

    # -- transport ---------------------------------------------------------------------------------------------------

    def attach(self, receiver: Receiver) -> None:
        """See `Transport`."""
        self._receiver = receiver
        self._port.attach(self)

    def write(self, data: bytes) -> None:
        """See `Transport`; what has to wait for silence leaves a few milliseconds later."""
        self._held_back.append(add_parity(data) if self._soft_parity else data)
        if self._timer is None:
            wait_s = self._quiet_from_s + self._quiet_s - self._loop.time()
            if wait_s > 0:
                self._timer = self._loop.call_later(wait_s, self._release)
            else:
                self._send()

    def expect(self, reply_bytes: int) -> None:
        """See `Transport`."""
        self._port.expect(reply_bytes)

    def collect(self) -> None:
        """See `Transport`."""
        self._port.collect()

    def discard_input(self) -> None:
        """See `Transport`."""
        self._port.discard_input()

    def set_baud(self, baud: int) -> None:
        """See `Transport`."""
        self._port.set_baud(baud)

    async def close(self) -> None:
        """See `Transport`; what is held back is dropped."""
        self._forget()
        self._receiver = None
        await self._port.close()

    # -- receiver ----------------------------------------------------------------------------------------------------

    def data_received(self, data: bytes) -> None:
        """See `Receiver`."""
        self._quiet_from_s = self._loop.time()
        if self._receiver:
            self._receiver.data_received(strip_parity(data) if self._soft_parity else data)

    def transport_lost(self, reason: str) -> None:
        """See `Receiver`."""
        self._forget()
        if self._receiver:
            self._receiver.transport_lost(reason)

    # -- silence -----------------------------------------------------------------------------------------------------

    def _release(self) -> None:
        self._timer = None
        try:
            self._send()
        except TransportLost as error:
            self.transport_lost(error.message)

    def _send(self) -> None:
        while self._held_back:
            self._port.write(self._held_back.popleft())

    def _forget(self) -> None:
        self._held_back.clear()
        if self._timer:
            self._timer.cancel()
            self._timer = None


def smartstep_opener(opener: Opener, profile: SmartStepProfile) -> Opener:
    """Return an opener of the same port for a line of these drives."""

    async def open_port() -> Transport:
        return SmartStepPort(await opener(), profile.framing, profile.quiet_s)

    return open_port
