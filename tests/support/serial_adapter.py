"""A serial adapter that can be programmed: how long it keeps replies back, that it is unplugged, renamed, or disturbed.

What is modelled, and from where:

* `LatencyTimer`: FTDI chips. They send what they have received when a USB packet is full (64 bytes, two of them status:
  drivers/usb/serial/ftdi_sio.c, `ftdi_process_packet`) or when their latency timer has run since the last packet
  (`latency_timer`, 1 to 255 ms, 16 after plugging in: `write_latency_timer`).
* `Fifo`: 16550A. It interrupts when so many bytes have come (`rx_trig_bytes`: drivers/tty/serial/8250/8250_port.c,
  `do_set_rxtrig`), or when it holds some and none has come for four characters (data sheet, "character timeout").
* `AT_ONCE`: a 16550A with a trigger of one byte, a pseudo-terminal.
* Unplugging: usb-serial.c, `usb_serial_disconnect`, hangs the port up: the host reads an end, what was on either line
  is cut off where it was, and the name goes; behind the next plug it may be another one.
* A break, and noise while a plug is pushed in, reach the host as bytes 0 (n_tty.c, `n_tty_receive_break`, as pyserial
  leaves the flags).
* A port that takes a part of a request only: a full driver buffer (serial_core.c, `uart_write`).

`SerialAdapter` stands on the jumping clock between the bus and a simulated line; `TerminalAdapter` stands in real time
between a host's terminal and a line's.
"""

import asyncio
import math
import os
import select
import termios
import threading
import time
import tty
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from typing_extensions import override

from ldcnd.contract.errors import TransportLost
from ldcnd.line.line_discipline import actual_baud
from ldcnd.line.transport import Receiver, Transport
from ldcnd.sim.chain import Chain
from ldcnd.sim.line import SimulatedLine, open_simulated_line

LONGEST_WAIT_S = 0.02
READ_BYTES = 4096


class Holding(ABC):
    """When an adapter hands over what it has received."""

    @abstractmethod
    def due_s(self, held: int, last_byte_s: float, handed_over_s: float) -> float:
        """Return when so many bytes are handed over, if none follows.

        Args:
            held: at least one.
            last_byte_s: when the latest came.
            handed_over_s: when something was handed over before.
        """


@dataclass(frozen=True, slots=True)
class LatencyTimer(Holding):
    """An FTDI chip."""

    timer_s: float = 0.016
    packet_bytes: int = 62

    def due_s(self, held: int, last_byte_s: float, handed_over_s: float) -> float:
        """See `Holding`: the timer runs on, whether something is there or not."""
        if held >= self.packet_bytes:
            return last_byte_s
        rounds = max(1, math.ceil((last_byte_s - handed_over_s) / self.timer_s - 1e-9))
        return handed_over_s + rounds * self.timer_s


@dataclass(frozen=True, slots=True)
class Fifo(Holding):
    """A 16550A at one rate."""

    byte_s: float
    trigger: int = 8

    @override
    def due_s(self, held: int, last_byte_s: float, handed_over_s: float) -> float:
        return last_byte_s if held >= self.trigger else last_byte_s + 4 * self.byte_s


AT_ONCE = Fifo(byte_s=0.0, trigger=1)


class Held:
    """What an adapter has received and not handed over yet; time is an input."""

    def __init__(self, holding: Holding) -> None:
        self.holding = holding
        self._data = bytearray()
        self._last_byte_s = 0.0
        self._handed_over_s = 0.0

    def add(self, data: bytes, now_s: float) -> None:
        """Take bytes that have just come."""
        self._data += data
        self._last_byte_s = now_s

    def due_s(self) -> float:
        """Return when they are handed over; infinity when there are none."""
        if not self._data:
            return math.inf
        return self.holding.due_s(len(self._data), self._last_byte_s, self._handed_over_s)

    def take(self, now_s: float) -> bytes:
        """Hand over."""
        data = bytes(self._data)
        self._data.clear()
        self._handed_over_s = now_s
        return data


class SerialAdapter(Transport, Receiver):
    """An open adapter on the jumping clock; `Plug.open` makes it."""

    def __init__(self, line: SimulatedLine, holding: Holding, offered: Callable[[int], bool]) -> None:
        self._line = line
        self._held = Held(holding)
        self._offered = offered
        self._loop = asyncio.get_running_loop()
        self._receiver: Receiver | None = None
        self._timer: asyncio.TimerHandle | None = None
        self.takes_bytes = math.inf

    @override
    def attach(self, receiver: Receiver) -> None:
        self._receiver = receiver
        self._line.attach(self)

    @override
    def offers(self, baud: int) -> bool:
        return self._offered(baud)

    def write(self, data: bytes) -> None:
        """See `Transport`: what does not fit in whole ends the port."""
        taken = data[: int(min(len(data), self.takes_bytes))]
        self.takes_bytes -= len(taken)
        self._line.write(taken)
        if len(taken) < len(data):
            raise TransportLost(f"the adapter took {len(taken)} of {len(data)} bytes")

    def expect(self, reply_bytes: int) -> None:
        """See `Transport`: adapters on USB are not told."""

    def discard_input(self) -> None:
        """See `Transport`: what the chip still holds comes later, as it does from real ones."""
        self._line.discard_input()

    @override
    def set_baud(self, baud: int) -> None:
        self._line.set_baud(baud)

    @override
    async def close(self) -> None:
        self._disarm()
        self._receiver = None
        await self._line.close()

    @override
    def data_received(self, data: bytes) -> None:
        self._held.add(data, self._loop.time())
        self._disarm()
        self._timer = self._loop.call_at(max(self._held.due_s(), self._loop.time()), self._hand_over)

    @override
    def transport_lost(self, reason: str) -> None:
        self._disarm()
        if self._receiver:
            self._receiver.transport_lost(reason)

    def _hand_over(self) -> None:
        self._timer = None
        if self._receiver:
            self._receiver.data_received(self._held.take(self._loop.time()))

    def _disarm(self) -> None:
        if self._timer:
            self._timer.cancel()
            self._timer = None


class Plug:
    """An adapter's plug, and the names that it goes by.

    Attributes:
        holding: of the adapter from the next plugging in on.
        name: of its node in /dev now; a line is configured by a link that follows it.
        offers: which rates it has.
    """

    def __init__(self, chain: Chain, holding: Holding = AT_ONCE) -> None:
        self.holding = holding
        self.name = "ttyUSB0"
        self.offers: Callable[[int], bool] = lambda _baud: True
        self._chain = chain
        self._open: SerialAdapter | None = None

    async def open(self) -> Transport:
        """Open the adapter, as an opener of the bus."""
        self._open = SerialAdapter(await open_simulated_line(self._chain), self.holding, self.offers)
        return self._open

    def pull(self) -> None:
        """Unplug it: bytes on either line are cut off, and the drives do not hear of it."""
        self._chain.unplug(asyncio.get_running_loop().time())

    def push(self, name: str | None = None) -> None:
        """Plug it in again, perhaps under another name."""
        self.name = name or self.name
        self._chain.replug()

    def noise(self, data: bytes) -> None:
        """Let the host receive what no drive has sent; a break is a byte 0."""
        if self._open:
            self._open.data_received(data)

    def fill_up(self, free_bytes: int = 0) -> None:
        """Let the driver take so many more bytes only."""
        if self._open:
            self._open.takes_bytes = free_bytes


class TerminalAdapter:
    """An adapter between a host's terminal and the terminal of a line, in real time; `run` is its thread's work.

    Attributes:
        link: what the host opens; it leads to another terminal after each plugging in.
    """

    def __init__(self, line: Path, link: Path, holding: Holding = AT_ONCE) -> None:
        self.link = link
        self._line_path = line
        self._held = Held(holding)
        self._lock = threading.Lock()
        self._line = -1
        self._host = -1
        self._baud = 0

    def push(self) -> None:
        """Plug it in: a new terminal, and the link to it."""
        with self._lock:
            self._line = os.open(self._line_path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
            tty.setraw(self._line)
            self._host, near = os.openpty()
            tty.setraw(near)
            os.set_blocking(self._host, False)
            new = self.link.with_suffix(".new")
            new.symlink_to(os.ttyname(near))
            new.replace(self.link)
            os.close(near)

    def pull(self) -> None:
        """Unplug it: the host's terminal is hung up, and the link is gone."""
        with self._lock:
            if self._host < 0:
                return
            self.link.unlink(missing_ok=True)
            for descriptor in (self._host, self._line):
                os.close(descriptor)
            self._host = self._line = -1
            self._baud = 0
            self._held.take(0.0)

    def run(self, stopped: threading.Event) -> None:
        """Carry bytes until stopped."""
        while not stopped.is_set():
            with self._lock:
                ends = [end for end in (self._host, self._line) if end >= 0]
                wait_s = min(max(0.0, self._held.due_s() - time.monotonic()), LONGEST_WAIT_S)
                ready = select.select(ends, [], [], min(wait_s, 0.001))[0] if ends else []
                for end in ready:
                    with suppress(OSError):  # a terminal that no host has open
                        self._carry(end)
                if self._host >= 0 and self._held.due_s() <= (now_s := time.monotonic()):
                    with suppress(OSError):
                        os.write(self._host, self._held.take(now_s))
            if not ready:
                stopped.wait(0.0005)

    def _carry(self, end: int) -> None:
        data = os.read(end, READ_BYTES)
        if end == self._host:
            self._tune(actual_baud(self._host) or 0)
            os.write(self._line, data)
        else:
            self._held.add(data, time.monotonic())

    def _tune(self, baud: int) -> None:
        """Send at the rate that the host has set, as an adapter does."""
        if baud != self._baud:
            attributes = termios.tcgetattr(self._line)
            attributes[4] = attributes[5] = getattr(termios, f"B{baud}")
            termios.tcsetattr(self._line, termios.TCSANOW, attributes)
            self._baud = baud


@contextmanager
def terminal_adapter(line: Path, link: Path, holding: Holding = AT_ONCE) -> Iterator[TerminalAdapter]:
    """Run an adapter in a thread of its own, plugged in, until the context ends."""
    adapter, stopped = TerminalAdapter(line, link, holding), threading.Event()
    adapter.push()
    thread = threading.Thread(target=adapter.run, args=(stopped,), name="adapter")
    thread.start()
    try:
        yield adapter
    finally:
        stopped.set()
        thread.join(5)
        assert not thread.is_alive()
        adapter.pull()
