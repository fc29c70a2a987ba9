"""A simulated SmartStep behind its packets: memory, motor, alarms, signals, modes and trace, with time as an input.

What no command can do, a person's hand does here: signals, power, pulses, faults. Parameter ranges are those of
parameters.py, recollected ones included: a real drive may differ. The motor follows a pulse train through a position
loop of first order in closed form, deviation' = reference speed - gain x deviation, so any step in time is one
calculation; its units are encoder counts and seconds.
Source: manual 2.2, note on EEPROM; 3 to 6.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

from ldcnd.drives.smartstep.addresses import EEPROM_AREA, RAM_AREA, RAM_OFFSET, OperatingMode, Register, operating_mode
from ldcnd.drives.smartstep.monitors import (
    HISTORY_LENGTH,
    NO_ALARM,
    R7D_AP,
    AlarmKind,
    FunctionSwitch,
    InputSignal,
    OutputSignal,
    alarm,
)
from ldcnd.drives.smartstep.packet import HIGHEST_WORD, ResponseStatus
from ldcnd.drives.smartstep.parameters import (
    PARAMETERS,
    PN000,
    PN102,
    PN202,
    PN203,
    PN402,
    PN403,
    PN500,
    PN505,
    Limits,
    Parameter,
    unit_number,
)
from ldcnd.drives.smartstep.profiles import CommandPulseGear
from ldcnd.drives.smartstep.trace_data import FULL_SCALE, DataObject, IoObject, TracePoint
from ldcnd.sim.smartstep.recorder import SimulatedRecorder
from ldcnd.sim.smartstep.variant import SimulatedVariant

EEPROM_LIFE = 10_000


class SimulatedMemory:
    """Words by parameter number.

    Attributes:
        writes: how often each EEPROM word was written.
        worn: writes before the simulation began; the life is that of the EEPROM as a whole (manual 2.2, note).
    """

    def __init__(self, stored: Mapping[Parameter, int], *, eeprom_changes_ram: bool) -> None:
        self.writes = {parameter.number: 0 for parameter in PARAMETERS}
        self.worn = 0
        self._limits = {parameter.number: _limits(parameter) for parameter in PARAMETERS}
        self._eeprom = {parameter.number: _factory_value(parameter) for parameter in PARAMETERS}
        self._eeprom.update({parameter.number: value for parameter, value in stored.items()})
        self._ram = dict(self._eeprom)
        self._eeprom_changes_ram = eeprom_changes_ram

    def power_on(self) -> None:
        """Load RAM from EEPROM."""
        self._ram = dict(self._eeprom)

    def active(self, parameter: Parameter) -> int:
        """Return the value in use."""
        return self._ram[parameter.number]

    def stored(self, parameter: Parameter) -> int:
        """Return the value kept over power-off."""
        return self._eeprom[parameter.number]

    def read(self, address: int) -> int | None:
        """Return the word at an address of the parameter areas; None where there is none."""
        if address in EEPROM_AREA:
            return self._eeprom.get(address)
        return self._ram.get(address - RAM_OFFSET) if address in RAM_AREA else None

    def holds(self, address: int) -> bool:
        """Tell whether there is a word at this address."""
        return self.read(address) is not None

    def write(self, address: int, value: int) -> bool:
        """Store a word at an address that exists; return False when the value is out of its range."""
        number = address if address in EEPROM_AREA else address - RAM_OFFSET
        limits = self._limits[number]
        if not limits.lowest <= value <= limits.highest:
            return False
        if address in RAM_AREA:
            self._ram[number] = value
            return True
        self.writes[number] += 1
        if self.worn + sum(self.writes.values()) <= EEPROM_LIFE:
            self._eeprom[number] = value
            if self._eeprom_changes_ram:
                self._ram[number] = value
        return True


def _limits(parameter: Parameter) -> Limits:
    return parameter.limits.value if parameter.limits else Limits(0, HIGHEST_WORD)


def _factory_value(parameter: Parameter) -> int:
    return parameter.default or 0


_FRICTION_PERCENT = 5.0
_PERCENT_PER_COUNT_S2 = 2e-4
_JAM_PERCENT_PER_COUNT = 0.5
_COAST_S = 0.05
_TREMBLE_PERIOD_S = 0.0073


@dataclass(slots=True)
class SimulatedMotor:
    """Where the motor is and how it moves; public fields may be changed between two calls of `advance`.

    Attributes:
        pulse_rate: command units per second, signed; what the pulse generator sends.
        gear: encoder counts per command unit.
        gain: of the position loop, 1/s.
        servo_on: otherwise the motor coasts to rest and the deviation counter stays at zero.
        jammed: the shaft is held.
        load_percent: a constant torque of the load.
        tremble: the feedback jumps between its value and this much more, as on the edge of a count.
    """

    counts_per_rev: int = 8000
    pulse_rate: float = 0.0
    gear: float = 4.0
    gain: float = 40.0
    servo_on: bool = False
    jammed: bool = False
    load_percent: float = 0.0
    tremble: int = 0
    at_s: float = 0.0
    command_units: float = 0.0
    position: float = 0.0
    deviation: float = 0.0
    speed: float = 0.0
    acceleration: float = 0.0

    def advance(self, to_s: float) -> None:
        """Move on in time; an earlier time changes nothing."""
        step_s = to_s - self.at_s
        if step_s <= 0:
            return
        self.at_s = to_s
        self.command_units += self.pulse_rate * step_s
        if not self.servo_on:
            self._coast(step_s)
        elif self.jammed:
            self.deviation += self.reference_speed * step_s
            self.speed = self.acceleration = 0.0
        else:
            self._follow(step_s)

    @property
    def reference_speed(self) -> float:
        """The pulse train in counts per second."""
        return self.pulse_rate * self.gear

    @property
    def feedback(self) -> int:
        """The encoder's count, trembling included."""
        up = self.tremble if int(self.at_s / _TREMBLE_PERIOD_S) % 2 else 0
        return math.floor(self.position) + up

    @property
    def torque_percent(self) -> float:
        """Torque of rated, unlimited."""
        if not self.servo_on:
            return 0.0
        if self.jammed:
            return self.load_percent + _JAM_PERCENT_PER_COUNT * self.deviation
        friction = math.copysign(_FRICTION_PERCENT, self.speed) if abs(self.speed) > 1.0 else 0.0
        return self.load_percent + friction + _PERCENT_PER_COUNT_S2 * self.acceleration

    def rpm(self, counts_per_s: float) -> float:
        """Return counts per second as r/min."""
        return counts_per_s * 60.0 / self.counts_per_rev

    def _coast(self, step_s: float) -> None:
        fading = math.exp(-step_s / _COAST_S)
        self.position += self.speed * _COAST_S * (1.0 - fading)
        self.speed *= fading
        self.acceleration = -self.speed / _COAST_S
        self.deviation = 0.0

    def _follow(self, step_s: float) -> None:
        settled = self.reference_speed / self.gain
        before = self.deviation
        self.deviation = settled + (before - settled) * math.exp(-self.gain * step_s)
        self.position += self.reference_speed * step_s - (self.deviation - before)
        self.speed = self.gain * self.deviation
        self.acceleration = self.gain * (self.reference_speed - self.speed)


OVERSPEED_RPM = 4500.0
OVERSPEED = 0x0051
DEVIATION_OVER = 0x00D0
_DEVIATION_STEP = 256
_POLE_PAIRS = 4


class SimulatedSmartStep:
    """The state of a drive; every call that may change it says when.

    Attributes:
        unit: the unit number since power-on.
        motor: free to be disturbed by tests.
        memory: the parameters.
        mode: 2000H.
        alarm_code: 850AH.
        alarm_history: 8500H to 8509H, newest first; survives power-off.
        inputs: levels of the input signals.
        gain_switch: 0 to 15.
    """

    def __init__(self, variant: SimulatedVariant, stored: Mapping[Parameter, int]) -> None:
        self.variant = variant
        self.memory = SimulatedMemory(stored, eeprom_changes_ram=variant.eeprom_changes_ram)
        self.alarm_history = [NO_ALARM] * HISTORY_LENGTH
        self.gain_switch = 4
        self._pulse_rate = 0.0
        self.switches = FunctionSwitch.PARAMETERS_RULE
        self.inputs = InputSignal(0)
        if variant.run_active_low:
            self.inputs |= InputSignal.RUN
        if variant.reset_active_low:
            self.inputs |= InputSignal.RESET
        self.power_on(0.0)

    # -- what a person does ------------------------------------------------------------------------------------------

    def power_on(self, at_s: float) -> None:
        """Start afresh: RAM from EEPROM, unit number and gear from Pn000, Pn202 and Pn203, counters at zero."""
        self.memory.power_on()
        self.unit = unit_number(self.memory.active(PN000))
        self.mode: OperatingMode = OperatingMode.NORMAL
        self.alarm_code = NO_ALARM
        self.recorder = SimulatedRecorder(self.variant)
        self.motor = SimulatedMotor(
            counts_per_rev=self.variant.encoder_counts_per_rev,
            gear=self.memory.active(PN202) / self.memory.active(PN203),
            pulse_rate=self._pulse_rate,
            at_s=at_s,
        )
        self._command_zero = 0
        self._feedback_zero = 0
        self._clear_done_s: float | None = None
        self._apply_inputs()

    def set_run(self, at_s: float, *, on: bool) -> None:
        """Switch CN1-14."""
        self.advance(at_s)
        self.inputs = _with_level(self.inputs, InputSignal.RUN, high=on is not self.variant.run_active_low)
        self._apply_inputs()

    def press_reset(self, at_s: float) -> None:
        """Give a pulse on CN1-18: clears an alarm."""
        self.advance(at_s)
        self.alarm_code = NO_ALARM
        self._apply_inputs()

    def set_pulse_rate(self, units_per_s: float, at_s: float) -> None:
        """Change the pulse train; it comes from elsewhere and goes on while the drive has no power."""
        self.advance(at_s)
        self._pulse_rate = self.motor.pulse_rate = units_per_s

    def set_jammed(self, at_s: float, *, jammed: bool) -> None:
        """Hold the shaft, or let it go."""
        self.advance(at_s)
        self.motor.jammed = jammed

    def provoke(self, code: int, at_s: float) -> None:
        """Raise an alarm or a warning; an alarm stops the motor."""
        self.advance(at_s)
        self._raise_alarm(code)

    # -- time --------------------------------------------------------------------------------------------------------

    def advance(self, to_s: float) -> None:
        """Run until then, recording the trace points on the way."""
        while self.recorder.next_s is not None and self.recorder.next_s <= to_s:
            self._live(self.recorder.next_s)
            if self.recorder.record(self._trace_point):
                self.mode = OperatingMode.NORMAL
        self._live(to_s)
        if self._clear_done_s is not None and self._clear_done_s <= to_s:
            self._clear_done_s = None
            self.mode = OperatingMode.NORMAL

    def _live(self, to_s: float) -> None:
        self.motor.gain = float(self.memory.active(PN102))
        self.motor.advance(to_s)
        if not self.motor.servo_on:
            return
        # Judged at the end of a step, because nothing is read in between.
        if abs(self._deviation_units) > self.memory.active(PN505) * _DEVIATION_STEP:
            self._raise_alarm(DEVIATION_OVER)
        elif abs(self.motor.rpm(self.motor.speed)) > OVERSPEED_RPM:
            self._raise_alarm(OVERSPEED)

    # -- what a command does -----------------------------------------------------------------------------------------

    def read(self, address: int) -> int | None:
        """Return the word that a reference command gets now; None for an address error."""
        if address in EEPROM_AREA or address in RAM_AREA:
            return self.memory.read(address)
        if 0x8000 <= address <= 0x800F:  # noqa: PLR2004 - Un000 to Un00D
            return self._monitor(address) & 0xFFFF
        if 0 <= address - Register.ALARM_HISTORY < HISTORY_LENGTH:
            return self.alarm_history[address - Register.ALARM_HISTORY]
        constants: dict[int, int] = {
            Register.OPERATING_MODE: self.mode,
            Register.TRACE_1_OBJECT_ADDRESS: 0,
            Register.TRACE_2_OBJECT_ADDRESS: 0,
            Register.GAIN_SWITCH: self.gain_switch,
            Register.FUNCTION_SWITCHES: self.switches,
            Register.PRESENT_ALARM: self.alarm_code,
            Register.AUTO_TUNING_RESULT: 100,
            Register.SOFTWARE_VERSION: self.variant.software_version,
            Register.CYCLEC: self.variant.cyclec_us,
            Register.DRIVER_TYPE: R7D_AP,
        }
        return constants.get(address, self.recorder.read(address))

    def write(self, address: int, value: int) -> ResponseStatus:
        """Carry out a setting command now and return its response status."""
        if address == Register.OPERATING_MODE:
            return self._enter(value)
        if address == Register.OPERATION:
            return self._execute(value)
        if self.mode is OperatingMode.DATA_TRACE:
            return ResponseStatus.SETTING_ADDRESS_ERROR
        if self.memory.holds(address):
            accepted: bool | None = self.memory.write(address, value)
        else:
            accepted = self.recorder.write(address, value)
        if accepted is None:
            return ResponseStatus.SETTING_ADDRESS_ERROR
        return ResponseStatus.SETTING if accepted else ResponseStatus.SETTING_DATA_ERROR

    def _enter(self, value: int) -> ResponseStatus:
        mode = operating_mode(value)
        if not isinstance(mode, OperatingMode):
            return ResponseStatus.SETTING_DATA_ERROR
        self.mode = mode
        self.recorder.stop()
        self._clear_done_s = None
        return ResponseStatus.SETTING

    def _execute(self, value: int) -> ResponseStatus:
        if value != 1:
            return ResponseStatus.SETTING_DATA_ERROR
        match self.mode:
            case OperatingMode.DATA_TRACE:
                self.recorder.start(self.motor.at_s)
            case OperatingMode.COMMAND_COUNTER_CLEAR:
                self._command_zero = math.floor(self.motor.command_units)
                self._clear_done_s = self.motor.at_s + self.variant.clear_s
            case OperatingMode.FEEDBACK_COUNTER_CLEAR:
                self._feedback_zero = self.motor.feedback
                self._clear_done_s = self.motor.at_s + self.variant.clear_s
            case OperatingMode.NORMAL:
                pass
        return ResponseStatus.SETTING

    # -- what the monitors show --------------------------------------------------------------------------------------

    @property
    def command_counter(self) -> int:
        """The input pulse counter, 32 bits."""
        return (math.floor(self.motor.command_units) - self._command_zero) & 0xFFFF_FFFF

    @property
    def feedback_counter(self) -> int:
        """The feedback pulse counter, 32 bits."""
        return (self.motor.feedback - self._feedback_zero) & 0xFFFF_FFFF

    @property
    def outputs(self) -> OutputSignal:
        """Levels of the output signals."""
        variant, servo_on = self.variant, self.motor.servo_on
        in_position = servo_on and abs(self._deviation_units) <= self.memory.active(PN500)
        in_alarm = alarm(self.alarm_code).kind is AlarmKind.ALARM
        levels = OutputSignal.ALM if in_alarm is variant.alarm_output_high else OutputSignal(0)
        levels |= OutputSignal.INP if in_position is not variant.inp_active_low else OutputSignal(0)
        return levels | (OutputSignal.BKIR if servo_on is not variant.bkir_active_low else OutputSignal(0))

    @property
    def _deviation_units(self) -> float:
        return self.motor.deviation / self.motor.gear

    @property
    def _torque(self) -> float:
        highest, lowest = self.memory.active(PN402), -self.memory.active(PN403)
        return min(max(self.motor.torque_percent, lowest), highest)

    def _monitor(self, address: int) -> int:
        motor = self.motor
        turn = motor.feedback % motor.counts_per_rev
        reference_rpm = motor.rpm(motor.reference_speed)
        words = (
            motor.rpm(motor.speed),
            motor.rpm(motor.gain * motor.deviation),
            self._torque,
            turn,
            turn * _POLE_PAIRS * 360 // motor.counts_per_rev % 360,
            self.inputs,
            self.outputs,
            reference_rpm,
            min(max(self._deviation_units, -0x8000), 0x7FFF),
            abs(self._torque),
            0,
            0,
            self.command_counter & 0xFFFF,
            self.command_counter >> 16,
            self.feedback_counter & 0xFFFF,
            self.feedback_counter >> 16,
        )
        return round(words[address - 0x8000])

    @property
    def _pulse_gear(self) -> float:
        """Motor counts for one traced pulse, by the variant's way of gearing."""
        match self.variant.command_pulse_gear:
            case CommandPulseGear.NUM_DEN:
                return self.motor.gear
            case CommandPulseGear.DEN_NUM:
                return 1.0 / self.motor.gear
            case CommandPulseGear.NONE:
                return 1.0

    def _trace_point(self, data: DataObject, io: IoObject) -> TracePoint:
        motor = self.motor
        match data:
            case DataObject.TORQUE_REFERENCE:
                value = self._torque * FULL_SCALE / (self.recorder.read(Register.MAXTRQC) or 1)
            case DataObject.SPEED_FEEDBACK:
                value = motor.rpm(motor.speed) * FULL_SCALE / (self.recorder.read(Register.OSVELCC) or 1)
            case DataObject.COMMAND_PULSE_SPEED:
                value = motor.reference_speed / self._pulse_gear * 2 * self.variant.cyclec_us * 1e-6
            case DataObject.POSITION_DEVIATION:
                value = self._deviation_units
        levels = {
            IoObject.RUN: self.inputs & InputSignal.RUN,
            IoObject.RESET: self.inputs & InputSignal.RESET,
            IoObject.ALM: self.outputs & OutputSignal.ALM,
            IoObject.INP: self.outputs & OutputSignal.INP,
            IoObject.BKIR: self.outputs & OutputSignal.BKIR,
        }
        return TracePoint(round(value), bool(levels[io]))

    # -- alarms ------------------------------------------------------------------------------------------------------

    def _raise_alarm(self, code: int) -> None:
        self.alarm_code = code
        self.alarm_history = [code, *self.alarm_history[:-1]]
        self._apply_inputs()

    def _apply_inputs(self) -> None:
        run = bool(self.inputs & InputSignal.RUN) is not self.variant.run_active_low
        self.motor.servo_on = run and alarm(self.alarm_code).kind is not AlarmKind.ALARM
        if not self.motor.servo_on:
            self.motor.deviation = 0.0


def _with_level(levels: InputSignal, signal: InputSignal, *, high: bool) -> InputSignal:
    return levels | signal if high else levels & ~signal
