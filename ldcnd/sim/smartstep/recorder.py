"""The data trace of a simulated drive: two rings of 500 words, filled at SMPTMS x CYCLEC, with triggers.

Source: manual 4. The bits of the trigger condition are those of the variant, as the manual's are lost.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from ldcnd.drives.smartstep.addresses import Register
from ldcnd.drives.smartstep.monitors import signed_word
from ldcnd.drives.smartstep.trace_data import (
    HIGHEST_PRE_TRIGGER,
    POINTS,
    DataObject,
    IoObject,
    TracePoint,
    encode_word,
    object_word,
    period_s,
)
from ldcnd.sim.smartstep.variant import SimulatedVariant

Sampler = Callable[[DataObject, IoObject], TracePoint]
"""Reads the drive at the instant of a point."""


@dataclass(frozen=True, slots=True)
class _Trigger:
    """A decoded trigger condition."""

    io: bool
    second: bool
    level: int
    rising: bool
    falling: bool

    def is_met(self, before: Sequence[TracePoint], now: Sequence[TracePoint]) -> bool:
        if self.rising and self.falling:  # manual 4 (7): "when the data is changed from its previous value"
            return self._watched(before) != self._watched(now)
        past, present = self._above(before), self._above(now)
        return (self.rising and present and not past) or (self.falling and past and not present)

    def _watched(self, points: Sequence[TracePoint]) -> int:
        point = points[self.second]
        return bool(point.io) if self.io else point.value

    def _above(self, points: Sequence[TracePoint]) -> bool:
        return bool(self._watched(points)) if self.io else self._watched(points) >= self.level


class SimulatedRecorder:
    """Registers 5000H to 5006H, 8701H, 8702H and the trace memories.

    Attributes:
        rings: the words of trace 1 and trace 2, by point.
        next_s: when the next point is due; None while nothing is recorded.
    """

    def __init__(self, variant: SimulatedVariant) -> None:
        self.rings = ([0] * POINTS, [0] * POINTS)
        self.next_s: float | None = None
        self._variant = variant
        self._registers = dict.fromkeys(range(Register.TRACE_1_OBJECT, Register.TRGADR + 1), 0)
        self._registers[Register.SMPTMS] = 2
        self._registers[Register.MAXTRQC] = variant.maxtrqc
        self._registers[Register.OSVELCC] = variant.osvelcc
        self._objects: tuple[tuple[DataObject, IoObject], ...] = ()
        self._trigger: _Trigger | None = None
        self._before: Sequence[TracePoint] = ()
        self._recorded = 0
        self._points_left: int | None = None

    def read(self, address: int) -> int | None:
        """Return a register's word; None where there is none."""
        return self._registers.get(address)

    def write(self, address: int, value: int) -> bool | None:
        """Set a register; return False for a value that the drive refuses, None for an address that cannot be set."""
        if address not in self._registers or address == Register.TRGADR:
            return None
        if address in (Register.MAXTRQC, Register.OSVELCC) and not self._variant.full_scale_settable:
            return None
        if not self._accepts(address, value):
            return False
        self._registers[address] = value
        return True

    def start(self, at_s: float) -> None:
        """Begin to record, or to wait for the trigger."""
        self._objects = tuple(
            (DataObject(word & 0xFF), IoObject(word >> 8))
            for word in (self._registers[Register.TRACE_1_OBJECT], self._registers[Register.TRACE_2_OBJECT])
        )
        self._trigger = self._decode_trigger()
        self._before = ()
        self._recorded = 0
        self._points_left = POINTS if self._trigger is None else None
        self.next_s = at_s + self._period_s

    def stop(self) -> None:
        """Give up; the memories keep what they have."""
        self.next_s = None

    def record(self, sample: Sampler) -> bool:
        """Store the point that is due and return whether it was the last one."""
        if self.next_s is None:
            return False
        points = [sample(data, io) for data, io in self._objects]
        index = self._recorded % POINTS
        for ring, point in zip(self.rings, points, strict=True):
            ring[index] = encode_word(point, self._variant.trace_word_layout)
        if self._points_left is None and self._is_triggered(points):
            self._registers[Register.TRGADR] = index
            self._points_left = POINTS - self._registers[Register.PTRGNO]
        self._before = points
        self._recorded += 1
        self.next_s += self._period_s
        if self._points_left is not None:
            self._points_left -= 1
        if self._points_left == 0:
            self.next_s = None
        return self._points_left == 0

    @property
    def _period_s(self) -> float:
        return period_s(max(1, self._registers[Register.SMPTMS]), self._variant.cyclec_us)

    def _is_triggered(self, points: Sequence[TracePoint]) -> bool:
        if self._trigger is None or not self._before:
            return False
        if self._variant.trigger_waits and self._recorded < self._registers[Register.PTRGNO]:
            return False
        return self._trigger.is_met(self._before, points)

    def _decode_trigger(self) -> _Trigger | None:
        word, level = self._registers[Register.TRGC1], self._registers[Register.TRGC2]
        bits = self._variant.trigger_map
        rising, falling = bool(word & bits.rising), bool(word & bits.falling)
        if not rising and not falling:
            return None
        watched = word & ~(bits.rising | bits.falling)
        io = watched == bits.io
        return _Trigger(io, bool(level) if io else watched == bits.trace2, signed_word(level), rising, falling)

    def _accepts(self, address: int, value: int) -> bool:
        bits = self._variant.trigger_map
        match address:
            case Register.TRACE_1_OBJECT | Register.TRACE_2_OBJECT:
                return value in {object_word(data, io) for data in DataObject for io in IoObject}
            case Register.PTRGNO:
                return value <= HIGHEST_PRE_TRIGGER
            case Register.MAXTRQC | Register.OSVELCC:
                return value > 0
            case Register.TRGC1:
                return value & ~(bits.rising | bits.falling) in (bits.trace1, bits.trace2, bits.io)
            case _:
                return True
