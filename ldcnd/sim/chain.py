"""A simulated line: modules in daisy-chain order, the host's line to all of them, the reply line they share.

Time is an input everywhere: nothing here waits or reads a clock, so that an event loop, a virtual clock or a process
that paces a pseudo-terminal can drive the same chain. One chain uses one clock throughout.

Wiring (LS-182AP manual, "Addressing"; PIC-SERVO manual, 4.1): full duplex; a module receives from the host while its
address input is low, which is the address output of the module before it, so that the level of one output only concerns
the next module; two modules that reply at the same time corrupt each other's bytes.
"""

import heapq
import itertools
import math
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum
from functools import partial

from ldcnd.line.exchange import NEVER_S
from ldcnd.sim.faults import FaultInjector, FaultPlan, LineFault

BITS_PER_BYTE = 10
"""Start, eight data, stop (or seven data and parity)."""
BAUD_TOLERANCE = 0.045
"""A receiver samples the stop bit right up to about this difference of the two clocks."""
NOISE = b""
"""What a module understands of bytes at another rate than its own."""
_ALMOST = 1e-6
"""Byte times: an end that is this close counts as reached, whatever the rounding."""


class Delivery(Enum):
    """How reply bytes reach the host."""

    WHOLE = "whole"
    """A reply in one piece, when its last byte is complete: a port that wakes its reader once."""
    BYTEWISE = "bytewise"
    """Every byte when it is complete."""


@dataclass(frozen=True, slots=True)
class ModuleReply:
    """A transmission that a module begins.

    Attributes:
        starts_at_s: when the first start bit begins.
        byte_s: the time that one byte takes.
    """

    data: bytes
    starts_at_s: float
    byte_s: float


def received_at(data: bytes, ratio: float) -> bytes:
    """Return what a UART makes of bytes that are sent without a gap at another rate than its own.

    A byte begins where the line is low, is sampled in the middle of each of its bits, and is passed on with any stop
    bit, as a port does that checks no parity; the next one begins at the middle of the stop bit or later. A line that
    was low all the time is a break: one byte of 0, and nothing more until it is high again.

    Args:
        data: what is sent, with eight data bits.
        ratio: the receiver's rate, divided by the sender's.
    """
    levels = [level for value in data for level in (0, *(value >> bit & 1 for bit in range(8)), 1)]
    received, at, step = bytearray(), 0.0, 1.0 / ratio  # in bits of the sender

    def level(instant: float) -> int:
        return levels[int(instant)] if instant < len(levels) else 1

    while (start := next((bit for bit in range(int(at), len(levels)) if not levels[bit]), None)) is not None:
        at = max(at, float(start))
        if level(at + 0.5 * step):  # no start bit: a pulse too short for this rate
            at += 0.5 * step
            continue
        value = sum(level(at + (bit + 1.5) * step) << bit for bit in range(8))
        received.append(value)
        at += 9.5 * step
        if value == level(at) == 0:
            at = float(next((bit for bit in range(int(at), len(levels)) if levels[bit]), len(levels)))
    return bytes(received)


class Module(ABC):
    """A device on a line.

    Attributes:
        baud: the rate at which it listens and answers.
        address_out: whether it enables the next module to receive.
        latched: whether it receives independently of the module before it.
        yields_to_host: whether its transmission ends as soon as the host sends.
        next_event_s: when `advance` must be called next; `NEVER_S` when the module only waits for the host.
        remark: called with what the module makes of the host's bytes where no reply shows it; set by the chain.
    """

    baud: float = 19_200.0
    address_out: bool = True
    latched: bool = False
    yields_to_host: bool = True
    next_event_s: float = NEVER_S
    remark: Callable[[str], None] = staticmethod(lambda _: None)

    @abstractmethod
    def hear(self, value: int | None, at_s: float) -> None:
        """Take a byte of the host whose stop bit ended at that instant; None stands for a framing error."""

    def takes_whole(self, data: bytes) -> bool:  # noqa: ARG002 - the general answer
        """Tell whether these bytes, received without a gap, have no effect before the last one has ended.

        Only then `hear_all` may be called; for `NOISE`, a single framing error stands for all of them.
        """
        return False

    def hear_all(self, data: bytes, starts_at_s: float, byte_s: float) -> None:
        """Take several bytes without a gap, the first of which began at that instant; the same as calls of `hear`."""
        for number, value in enumerate(data, 1):
            self.hear(value, starts_at_s + number * byte_s)

    def catch_up(self, to_s: float) -> None:  # noqa: B027 - most modules have nothing to do between events
        """Do work now that would otherwise be done at the host's next request; changes nothing visible."""

    @abstractmethod
    def advance(self, to_s: float) -> ModuleReply | None:
        """Do what is due up to that instant, and return the reply that begins with it, if any."""


@dataclass(slots=True)
class _Request:
    """Bytes on their way from the host."""

    values: deque[int | None]
    starts_at_s: float
    byte_s: float
    piecewise: bool = False

    @property
    def next_at_s(self) -> float:
        return self.starts_at_s + self.byte_s

    @property
    def ends_at_s(self) -> float:
        return self.starts_at_s + len(self.values) * self.byte_s


@dataclass(slots=True)
class _Transmission:
    """Bytes on their way to the host.

    Attributes:
        on_wire: False for bytes that an adapter holds back, echoes or repeats.
        yields: ends as soon as the host sends.
        gone: how many of the bytes were delivered, dropped or swallowed.
        spoilt_from: the first byte that another reply has spoilt; a third one does not restore it.
    """

    data: bytes
    starts_at_s: float
    byte_s: float
    on_wire: bool
    yields: bool
    gone: int = 0
    spoilt_from: int | None = None

    @property
    def ends_at_s(self) -> float:
        return self.end_of(len(self.data))

    def end_of(self, count: int) -> float:
        return self.starts_at_s + count * self.byte_s

    def complete(self, at_s: float) -> int:
        """Return how many bytes have ended by then."""
        return max(0, min(len(self.data), int((at_s - self.starts_at_s) / self.byte_s + _ALMOST)))

    def drop(self, count: int) -> None:
        """Take so many bytes off the front, counted from the beginning."""
        self.gone = max(self.gone, min(count, len(self.data)))


class Chain:
    """Modules in daisy-chain order: the address input of the first one is low.

    Attributes:
        modules: for inspection; fixed.
        baud: the host's rate.
        wire_busy_s: for how long bytes have been on either line so far.
        injector: damages packets on their way; tests exchange it.
        on_loss: called with the reason when the adapter disappears; set by the open line.
        on_remark: called with what a module remarks, behind its number in the chain; set by an observer.
    """

    def __init__(
        self,
        modules: Sequence[Module],
        faults: FaultPlan | None = None,
        *,
        baud_check: bool = True,
        delivery: Delivery = Delivery.WHOLE,
    ) -> None:
        self.modules = tuple(modules)
        self.baud = 19_200
        self.wire_busy_s = 0.0
        self.on_loss: Callable[[str], None] | None = None
        self.on_remark: Callable[[str], None] | None = None
        for number, module in enumerate(self.modules, 1):
            module.remark = partial(self._remark, number)
        self._reached = self.modules
        self._mute: set[Module] = set()
        self._unheard: set[Module] = set()
        self._baud_check = baud_check
        self._delivery = delivery
        self.injector = FaultInjector(faults or FaultPlan())
        self._requests: deque[_Request] = deque()
        self._host_free_s = -math.inf
        self._transmissions: list[_Transmission] = []
        self._unplugged_until_s = -math.inf
        self._agenda: list[tuple[float, int, Callable[[float], None]]] = []  # a heap
        self._agenda_numbers = itertools.count()

    # -- the host's side ---------------------------------------------------------------------------------------------

    def write(self, now_s: float, data: bytes) -> None:
        """Queue bytes on the host's line, behind those that are still leaving."""
        if not data or not self.plugged(now_s):
            return
        request = self.injector.request(data, now_s)
        if request.unplugged_s:
            self.unplug(now_s, request.unplugged_s)
            return
        byte_s = BITS_PER_BYTE / (self.baud if self._baud_check else self.modules[0].baud)
        starts_at_s = max(now_s, self._host_free_s)
        self._requests.append(_Request(deque(request.values), starts_at_s, byte_s))
        self._host_free_s = starts_at_s + len(data) * byte_s
        self.wire_busy_s += len(data) * byte_s
        if request.echoed:
            self._transmissions.append(_Transmission(data, starts_at_s, byte_s, on_wire=False, yields=False))

    def leaving_s(self, now_s: float) -> float:
        """Return how long the bytes that the host has written are still leaving, seconds."""
        return max(0.0, self._host_free_s - now_s)

    def next_event_s(self) -> float | None:
        """Return when `advance` has something to do next, or None while all modules wait for the host."""
        at_s = self._next_inner_event_s()
        if self._requests:
            at_s = min(at_s, self._requests[0].ends_at_s)
        for transmission in self._transmissions:
            whole = self._delivery is Delivery.WHOLE
            at_s = min(at_s, transmission.ends_at_s if whole else transmission.end_of(transmission.gone + 1))
        return None if at_s == NEVER_S else at_s

    def advance(self, now_s: float) -> list[tuple[float, bytes]]:
        """Let time pass; return the bytes that reached the host, each piece with the instant of its end."""
        self.pass_until(now_s)
        return self._received(now_s)

    def pass_until(self, now_s: float) -> None:
        """Let time pass; what reaches the host meanwhile is returned by the next `advance`."""
        while True:
            byte_at_s = self._requests[0].next_at_s if self._requests else NEVER_S
            inner_at_s = self._next_inner_event_s()
            if byte_at_s > now_s < inner_at_s:
                return
            if inner_at_s <= byte_at_s:
                self._wake(inner_at_s)
            elif not (self._requests[0].ends_at_s <= now_s < inner_at_s and self._spread_request(self._requests[0])):
                self._spread_byte(byte_at_s)

    def discard(self, now_s: float) -> None:
        """Drop the bytes in the host's port; bytes that are still on the wire will arrive."""
        for transmission in self._transmissions:
            transmission.drop(transmission.complete(now_s))
        self._sweep()

    # -- what happens by itself --------------------------------------------------------------------------------------

    def schedule(self, at_s: float, action: Callable[[float], None]) -> None:
        """Schedule an action on the modules at an instant of the line's clock; it gets the instant."""
        heapq.heappush(self._agenda, (at_s, next(self._agenda_numbers), action))

    def _remark(self, number: int, text: str) -> None:
        if self.on_remark:
            self.on_remark(f"module {number}: {text}")

    # -- the cable ---------------------------------------------------------------------------------------------------

    def cut_behind(self, place: int) -> None:
        """Cut the cable: modules behind that place, 0 for the host's end, neither hear nor are heard, and run on."""
        self._reached = self.modules[:place]
        self._unheard = self._mute | set(self.modules[place:])

    def join(self) -> None:
        """Let the cable reach every module again."""
        self.cut_behind(len(self.modules))

    def mute(self, place: int, *, on: bool) -> None:
        """Let the transmitter of the module at that place, from 1 on, fail, or work again: it hears and obeys."""
        module = self.modules[place - 1]
        if on:
            self._mute.add(module)
        else:
            self._mute.discard(module)
        self.cut_behind(len(self._reached))

    def begin(self, fault: LineFault) -> None:
        """Let something more go wrong on the wires, as its probability and its instants say."""
        self.injector.begin(fault)

    def end(self, fault: LineFault) -> None:
        """Take back what `begin` or the plan has brought."""
        self.injector.end(fault)

    # -- the adapter -------------------------------------------------------------------------------------------------

    def plugged(self, now_s: float) -> bool:
        """Tell whether the adapter is there."""
        return now_s >= self._unplugged_until_s

    def unplug(self, now_s: float, for_s: float = math.inf) -> None:
        """Remove the adapter: bytes on either line are lost, the modules keep running."""
        self._unplugged_until_s = now_s + for_s
        self._requests.clear()
        self._transmissions.clear()
        self._host_free_s = -math.inf
        if self.on_loss:
            self.on_loss("the simulated adapter was unplugged")

    def replug(self) -> None:
        """Put the adapter back."""
        self._unplugged_until_s = -math.inf

    # -- the wires ---------------------------------------------------------------------------------------------------

    def _next_inner_event_s(self) -> float:
        """Return when a module or the agenda is due next."""
        at_s = self._agenda[0][0] if self._agenda else NEVER_S
        for module in self.modules:  # runs for every byte on the line
            if module.next_event_s < at_s:  # noqa: PLR1730 - min() costs twice as much
                at_s = module.next_event_s
        return at_s

    def _wake(self, at_s: float) -> None:
        while self._agenda and self._agenda[0][0] <= at_s:
            due_s, _, action = heapq.heappop(self._agenda)
            action(due_s)
        for module in self.modules:
            if module.next_event_s <= at_s:
                reply = module.advance(at_s)
                if reply:
                    self._begin(reply, module)

    def _spread_byte(self, at_s: float) -> None:
        """Pass one byte of the host to every module."""
        request = self._requests[0]
        value = request.values.popleft()
        request.starts_at_s += request.byte_s
        if not request.values:
            self._requests.popleft()
        if value is None:
            return
        self._interrupt(at_s)
        slowest, fastest = self._understood_bauds()
        hears = True
        for module in self._reached:
            if hears or module.latched:
                module.hear(value if slowest <= module.baud <= fastest else None, at_s)
            hears = module.address_out

    def _spread_request(self, request: _Request) -> bool:
        """Pass a whole request to every module at once, where that makes no difference; tell whether it did.

        Nearly every request is a single packet, and most modules have nothing to do with it.
        """
        slowest, fastest = self._understood_bauds()
        if request.piecewise or None in request.values:
            return False
        data = bytes(value for value in request.values if value is not None)
        for module in self._reached:
            if not module.takes_whole(data if slowest <= module.baud <= fastest else NOISE):
                request.piecewise = True
                return False
        self._requests.popleft()
        self._interrupt(request.next_at_s)
        hears = True
        for module in self._reached:
            if hears or module.latched:
                if slowest <= module.baud <= fastest:
                    module.hear_all(data, request.starts_at_s, request.byte_s)
                else:
                    module.hear(None, request.ends_at_s)
            hears = module.address_out
        return True

    def _understood_bauds(self) -> tuple[float, float]:
        """Return the range of modules' rates at which they and the host understand each other."""
        if not self._baud_check:
            return 0.0, math.inf
        return self.baud * (1.0 - BAUD_TOLERANCE), self.baud * (1.0 + BAUD_TOLERANCE)

    def _interrupt(self, at_s: float) -> None:
        """End the transmissions of modules that yield to the host."""
        if not self._transmissions:
            return
        for transmission in self._transmissions:
            if transmission.yields:
                transmission.data = transmission.data[: transmission.complete(at_s)]
        self._sweep()

    def _begin(self, reply: ModuleReply, module: Module) -> None:
        if module in self._unheard:
            return
        self.wire_busy_s += len(reply.data) * reply.byte_s
        slowest, fastest = self._understood_bauds()
        data, byte_s = reply.data, reply.byte_s
        if not slowest <= module.baud <= fastest:
            data, byte_s = received_at(data, self.baud * byte_s / BITS_PER_BYTE), BITS_PER_BYTE / self.baud
            if not data:
                return
        faulty = self.injector.reply(data, reply.starts_at_s)
        held_back = faulty.delay_s > 0.0
        transmission = _Transmission(
            faulty.data,
            reply.starts_at_s + faulty.delay_s,
            byte_s,
            on_wire=not held_back,
            yields=module.yields_to_host and not held_back,
        )
        if transmission.on_wire:
            self._collide(transmission)
        self._transmissions.append(transmission)
        for copy in range(1, faulty.copies):
            repeated_at_s = transmission.starts_at_s + copy * len(faulty.data) * byte_s
            self._transmissions.append(_Transmission(faulty.data, repeated_at_s, byte_s, on_wire=False, yields=False))
        self._sweep()

    def _collide(self, late: _Transmission) -> None:
        """Merge overlapping transmissions: the host frames the earlier bytes, misread; the later ones are lost."""
        for early in self._transmissions:
            if not early.on_wire or early.ends_at_s <= late.starts_at_s:
                continue
            intact = early.complete(late.starts_at_s)
            end = len(early.data) if early.spoilt_from is None else early.spoilt_from
            if intact < end:
                spoilt = zip(early.data[intact:end], late.data + bytes(end), strict=False)
                damaged = bytes(ours ^ (theirs | 1) for ours, theirs in spoilt)
                early.data, early.spoilt_from = early.data[:intact] + damaged + early.data[end:], intact
            swallowed = math.ceil((early.ends_at_s - late.starts_at_s) / late.byte_s - _ALMOST)
            late.drop(swallowed)

    def _received(self, now_s: float) -> list[tuple[float, bytes]]:
        pieces: list[tuple[float, bytes]] = []
        for transmission in self._transmissions:
            count = transmission.complete(now_s)
            data, gone = transmission.data, transmission.gone
            if self._delivery is Delivery.BYTEWISE:
                pieces += [(transmission.end_of(at + 1), data[at : at + 1]) for at in range(gone, count)]
                transmission.drop(count)
            elif count == len(data):
                pieces.append((transmission.ends_at_s, data[gone:]))
                transmission.drop(count)
        if pieces:
            self._sweep()
            pieces.sort(key=lambda piece: piece[0])
        return pieces

    def _sweep(self) -> None:
        self._transmissions = [each for each in self._transmissions if each.gone < len(each.data)]
