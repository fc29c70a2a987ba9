"""Simulated modules without a servo loop: PIC-I/O with what is connected to it, and modules that are only identified.

A line of a PIC-I/O that is an output has the level of its latch. An input has the level of the output that is wired to
it, or the opposite one, as a sensor at the other end of a cylinder has, or the one that it is driven to from outside,
or is pulled up. Where the data sheet leaves room:

* Output latches, stored outputs and PWM values are 0 after a reset; a line that becomes an output shows its latch.
* Counter and timer are 0 and off after a reset, and keep their count while they are off.

Source: PIC-I/O data sheet, 2.2, 3.1.
"""

from types import MappingProxyType
from typing import Annotated, Self

from pydantic import Field, model_validator

from ldcnd.contract.frozen import Frozen
from ldcnd.drives.ldcn.packet import StatusItem
from ldcnd.drives.ldcn.pic_io import (
    ALL_LINES,
    CHECKSUM_ERROR,
    COUNTER_LINE,
    ITEM_BYTES,
    LINES,
    TIMER_HZ,
    IoItem,
    IoStatus,
    SetDirection,
    SetOutput,
    SetPwmOutputs,
    SetSynchOutput,
    SetTimerMode,
    SynchInput,
    SynchOutput,
    encode_io_status,
)
from ldcnd.drives.ldcn.profiles import PIC_STEP, SK_2310G2, Profile
from ldcnd.drives.ldcn.received import ReceivedCommand
from ldcnd.drives.ldcn.registers import SERVO_CYCLE_S
from ldcnd.sim.ldcn.machine import LineNumber, Surroundings
from ldcnd.sim.ldcn.module import SimulatedModule
from ldcnd.sim.ldcn.quirks import ModuleSettings

COUNTER_SPAN = 1 << 32
_TICKS_PER_CYCLE = round(TIMER_HZ * SERVO_CYCLE_S)
STEP_ITEM_BYTES = (4, 1, 2, 1, 4, 2, 1, 0)
"""Position, A/D, step time, inputs, home, identity, outputs of a PIC-STEP, as hosts of it expect them."""
IDENTITY_ONLY_ITEM_BYTES = (0, 0, 0, 0, 0, 2, 0, 0)
"""Of modules whose other items are not known."""
ITEM_BYTES_BY_PROFILE = MappingProxyType({PIC_STEP.name: STEP_ITEM_BYTES, SK_2310G2.name: ITEM_BYTES})
"""An SK-2310g2 answers with the items of a PIC-I/O, as seen on real hardware; further items of a second mask byte are
not simulated."""


Byte = Annotated[int, Field(ge=0, le=255)]


class IoWiring(Frozen):
    """Wiring of a PIC-I/O."""

    low: tuple[LineNumber, ...] = ()
    """Lines held low from outside, or pulled down; the others are pulled up."""
    wires: tuple[tuple[LineNumber, LineNumber], ...] = ()
    """Pairs of a line and the line that it drives while it is an output."""
    inverted_wires: tuple[tuple[LineNumber, LineNumber], ...] = ()
    """The same, driven to the opposite level: a cylinder's second sensor sees what the first does not."""
    adc: tuple[Byte, Byte, Byte] = (0, 0, 0)
    """Values of the three A/D inputs, 0 to 255 for 0 to 5 V."""
    pulses_hz: float = Field(default=0.0, ge=0, le=4_000_000)
    """A square wave at I/O 10, for the counter."""

    @model_validator(mode="after")
    def _one_driver(self) -> Self:
        driven = [line for _, line in (*self.wires, *self.inverted_wires)]
        for line in driven:
            if driven.count(line) > 1:
                raise ValueError(f"wires, inverted_wires: line {line} is driven by more than one line")
        return self


class SimulatedIo(SimulatedModule):
    """A PIC-I/O.

    Attributes:
        outputs: bits of the lines that are outputs.
        latch: the levels to which outputs are set.
        pwm: both PWM values, 0 to 255.
        around: the parts and switches of the machine at its terminals.
    """

    def __init__(
        self,
        profile: Profile,
        settings: ModuleSettings,
        wiring: IoWiring | None = None,
        around: Surroundings | None = None,
    ) -> None:
        wiring = wiring or IoWiring()
        self._wires = [(line, driver, 0) for driver, line in wiring.wires]
        self._wires += [(line, driver, 1) for driver, line in wiring.inverted_wires]
        self._wired_low = self._low = sum(1 << line - 1 for line in wiring.low)
        self._adc = list(wiring.adc)
        self._pulses_per_cycle = wiring.pulses_hz * SERVO_CYCLE_S
        self._unplugged = 0  # lines that something outside drives, whatever was wired to them
        self.around = around or Surroundings()
        self.outputs = 0
        self.latch = 0
        super().__init__(profile, settings)

    @property
    def levels(self) -> int:
        """The levels of the twelve pins."""
        outside = self._outside
        levels = self.around.levels(outside, self.settings.phase_s + self._cycles_done * self._cycle_s)
        for line, driver, inverted in self._wires:
            if self.outputs & 1 << driver - 1:
                levels = levels & ~(1 << line - 1) | ((self.latch >> driver - 1 & 1) ^ inverted) << line - 1
        return self._driven(levels & ~self._unplugged | outside & self._unplugged)

    @property
    def _outside(self) -> int:
        """The levels that the pins of inputs have where no sensor is at them."""
        return ~self._low & ALL_LINES

    def _driven(self, levels: int) -> int:
        """Return the levels of the pins: of outputs those of their latches, of inputs those that they have outside."""
        return levels & ~self.outputs | self.latch & self.outputs

    def drive_line(self, line: int, *, high: bool, at_s: float) -> None:
        """Drive a line, 1 to 12, from outside at that instant of the line's clock; an output wins over it.

        The sensor or switch that was at the line is unplugged.
        """
        self.catch_up(at_s)
        before = self.levels
        self._low = self._low & ~(1 << line - 1) | (0 if high else 1 << line - 1)
        self._unplugged |= 1 << line - 1
        self._count_edges(before)

    def plug_in(self, line: int, at_s: float) -> None:
        """Connect again what was at a line before `drive_line`."""
        self.catch_up(at_s)
        before, bit = self.levels, 1 << line - 1
        self._low = self._low & ~bit | self._wired_low & bit
        self._unplugged &= ~bit
        self._count_edges(before)

    def jam(self, part: str, *, jammed: bool, at_s: float) -> None:
        """Let something hold a part of the machine, or let go of it, at that instant of the line's clock."""
        self.catch_up(at_s)
        self.around.jam(part, jammed=jammed)

    def set_adc(self, channel: int, value: int, at_s: float) -> None:
        """Change the voltage at an A/D input, 1 to 3, to 0 to 255 for 0 to 5 V."""
        self.catch_up(at_s)
        self._adc[channel - 1] = value

    # -- module ------------------------------------------------------------------------------------------------------

    def restart(self) -> None:
        """All lines become inputs; what is connected stays."""
        self.outputs = 0
        self.latch = 0
        self.pwm = (0, 0)
        self._stored = SetSynchOutput(0, 0, 0)
        self._spent = False
        self._mode = SetTimerMode(enabled=False)
        self._counted = 0  # under earlier modes
        self._raw = 0.0  # edges or clocks under this mode, before the prescaler
        self._captured = (0, 0)

    def run(self, cycles: int) -> None:
        """The module's own clock drives the timer, the world outside the counter; the machine goes on moving."""
        self.around.run(cycles * self._cycle_s, self._driven(self._outside))
        if not self._mode.enabled:
            return
        if not self._mode.counter:
            self._raw += cycles * _TICKS_PER_CYCLE
        elif not self.outputs & 1 << COUNTER_LINE - 1:
            self._raw += cycles * self._pulses_per_cycle * self._cycle_s / SERVO_CYCLE_S

    def execute(self, command: ReceivedCommand) -> None:
        """Execute a command of PIC-I/O."""
        before = self.levels
        match command:
            case SetDirection(inputs):
                self.outputs = ~inputs & ALL_LINES
            case SetPwmOutputs(pwm1, pwm2):
                self.pwm = (pwm1, pwm2)
            case SetOutput(levels):
                self._set_latch(levels)
            case SetSynchOutput():
                self._stored, self._spent = command, False
            case SynchOutput():
                self._apply_stored()
            case SetTimerMode():
                self._counted = 0 if self.settings.counter_cleared_by_mode else self._count
                self._raw = 0.0
                self._mode = command
            case SynchInput():
                self._captured = (self.levels, self._count)
        self._count_edges(before)

    def status(self, items: StatusItem, *, checksum_error: bool) -> bytes:
        """Return a status packet."""
        adc1, adc2, adc3 = self._adc
        levels, counter = self._captured
        undefined = self.settings.undefined_level_bits << LINES
        status = IoStatus(
            rejected=checksum_error,
            levels=self.levels | undefined,
            adc1=adc1,
            adc2=adc2,
            adc3=adc3,
            counter=self._count,
            device_id=self.profile.device_id,
            version=self.settings.version,
            captured_levels=levels | undefined,
            captured_counter=counter,
        )
        return encode_io_status(IoItem(items), status, undefined_bits=self.settings.undefined_status_bits)

    def _apply_stored(self) -> None:
        if self._spent:
            return
        self._set_latch(self._stored.levels)
        self.pwm = (self._stored.pwm1, self._stored.pwm2)
        self._spent = self.settings.synch_output_once

    @property
    def _count(self) -> int:
        return (self._counted + int(self._raw) // self._mode.prescale) % COUNTER_SPAN

    def _set_latch(self, levels: int) -> None:
        """Set the outputs; bits of lines that are inputs are ignored."""
        self.latch = self.latch & ~self.outputs | levels & self.outputs

    def _count_edges(self, before: int) -> None:
        """Count a rising edge at the counter's line, while that is an input."""
        bit = 1 << COUNTER_LINE - 1
        if self._mode.enabled and self._mode.counter and self.levels & ~before & ~self.outputs & bit:
            self._raw += 1


class SimulatedOther(SimulatedModule):
    """A module that keeps its place in the chain and answers with zeros in the widths of its kind."""

    def __init__(self, profile: Profile, settings: ModuleSettings) -> None:
        self._item_bytes = ITEM_BYTES_BY_PROFILE.get(profile.name, IDENTITY_ONLY_ITEM_BYTES)
        super().__init__(profile, settings)

    def restart(self) -> None:
        """Take the state of power-up."""

    def run(self, cycles: int) -> None:
        """Nothing here moves."""

    def execute(self, command: ReceivedCommand) -> None:
        """Acknowledged, without any effect."""

    def status(self, items: StatusItem, *, checksum_error: bool) -> bytes:
        """Return a status packet."""
        body = bytearray([CHECKSUM_ERROR if checksum_error else 0])
        identity = bytes((self.profile.device_id, self.settings.version))
        for bit, width in enumerate(self._item_bytes):
            if items & 1 << bit:
                body += identity if 1 << bit == StatusItem.IDENTITY else bytes(width)
        body.append(sum(body) & 0xFF)
        return bytes(body)
