"""The servo loop of a simulated drive: encoder, profile generator, PID filter, output to the power stage, home capture.

One call of `run` lets servo cycles of 0.512 ms pass. Where nothing changes any more the rest of them is skipped.

The filter is that of both manuals (PIC-SERVO manual, 4.3), with one correction: the derivative term is printed with a
minus sign, which would drive the motor away from its target; it damps, as the text around it says. The integral error
is the running sum of the position error divided by 256, rounded down; the sum is bounded by 256 times IL. Deadband
compensation is added to any output that is not 0.
"""

import math
from dataclasses import dataclass

from ldcnd.drivers.ldcn.controls import HomingControl
from ldcnd.drivers.ldcn.profiles import Profile
from ldcnd.drivers.ldcn.registers import FRACTION, Gains
from ldcnd.sim.ldcn.power import Condition, PowerStage, Trip
from ldcnd.sim.ldcn.trajectory import ProfileGenerator
from ldcnd.sim.plant import Shaft

FULL_PWM = 255
COUNTER_SPAN = 1 << 32
SENSOR_RANGE = (8 / 1024, 1015 / 1024)
"""Outside this share of the A/D range an absolute positioning sensor counts as disconnected (LS-182AP manual)."""
_NO_GAINS = Gains(kp=0, kd=0, ki=0, il=0, ol=0, cl=0, el=0, sr=1)


@dataclass(frozen=True, slots=True)
class Inputs:
    """The inputs that can capture the home position, as levels."""

    limit1: bool
    limit2: bool
    index: bool


@dataclass(frozen=True, slots=True)
class HomeSearch:
    """One armed search: what it waits for, and how the inputs were when it began."""

    control: HomingControl
    armed_with: Inputs

    def limit_changed(self, inputs: Inputs) -> bool:
        """Tell whether a watched limit switch changed."""
        return bool(
            (self.control & HomingControl.LIMIT1 and inputs.limit1 != self.armed_with.limit1)
            or (self.control & HomingControl.LIMIT2 and inputs.limit2 != self.armed_with.limit2)
        )

    def index_changed(self, inputs: Inputs) -> bool:
        """Tell whether the watched index changed."""
        return bool(self.control & HomingControl.INDEX) and inputs.index != self.armed_with.index


class ServoLoop:
    """What the firmware does in every servo cycle, and the registers it works on.

    Attributes:
        position: the encoder counter, counts.
        velocity: its change in the last servo tick.
        home: the captured position.
        gains: the registers of Set Gain; all zero after a reset.
        trajectory: the command position.
        servo_on: the position loop is closed.
        pwm: signed output to the power stage, -255 to 255.
        analog_target: the A/D value that an absolute positioning motion goes to.
        search: the armed search for home.
        homed_on_limit: the last search ended on a limit switch.
        position_error: the sticky bits: error limit exceeded or loop opened,
        wrapped: position counter overflowed,
        overcurrent: current limiting occurred.
    """

    def __init__(self, profile: Profile, shaft: Shaft, stage: PowerStage, sense_counts_per_a: float) -> None:
        self.shaft = shaft
        self.stage = stage
        self.position = 0
        self.velocity = 0
        self.home = 0
        self.gains = _NO_GAINS
        self.trajectory = ProfileGenerator()
        self.servo_on = False
        self.pwm = 0
        self.analog_target: int | None = None
        self.search: HomeSearch | None = None
        self.homed_on_limit = False
        self.position_error = True
        self.wrapped = False
        self.overcurrent = False
        self._profile = profile
        self._divisor = 256
        self._tick_cycles = self._divisor if profile.divisor_slows_profile else 1
        self._sense_counts_per_a = sense_counts_per_a
        self._zero = math.floor(shaft.position_counts)
        self._ticked_position = 0
        self._previous_error = 0
        self._derivative = 0
        self._error_sum = 0
        self._limited = 0  # PWM units taken away by current limiting
        self._cycles_left = 1
        self._ticks_to_derivative = 1
        self._runs_forward = True

    # -- registers ---------------------------------------------------------------------------------------------------

    @property
    def inputs(self) -> Inputs:
        """The levels of the inputs at this moment."""
        shaft = self.shaft
        limits = (shaft.on_reverse_limit, shaft.on_forward_limit)
        limit1, limit2 = reversed(limits) if self._profile.limit1_is_forward else limits
        return Inputs(limit1, limit2, shaft.on_index)

    @property
    def following_error(self) -> int:
        """Command position minus actual position, counts; 0 with the loop open."""
        return self.trajectory.position // FRACTION - self.position if self.servo_on else 0

    @property
    def move_done(self) -> bool:
        """Bit 0 of the status byte."""
        return not self.servo_on or (self.trajectory.done and self.analog_target is None)

    def adc(self) -> int:
        """Read the A/D converter: the potentiometer on Logosol drives, the current sense input on PIC-SERVO."""
        full_scale = (1 << self._profile.adc_bits) - 1
        if self._profile.analog_target:
            lost = Condition.SENSOR_LOST in self.stage.conditions
            return 0 if lost else round(self.shaft.potentiometer() * full_scale)
        sensed = round(abs(self.shaft.current_a(self._duty())) * self._sense_counts_per_a)
        falling = self.gains.cl != 0 and not self.gains.cl & 1
        return full_scale - min(sensed, full_scale) if falling else min(sensed, full_scale)

    def set_gains(self, gains: Gains) -> None:
        """Take effect on the next servo tick."""
        self.gains = gains
        self._divisor = gains.sr or 256
        self._tick_cycles = self._divisor if self._profile.divisor_slows_profile else 1
        self._cycles_left = min(self._cycles_left, self._tick_cycles)

    def renumber(self, position: int) -> None:
        """Call the present position by another number, for encoder and command alike."""
        self._zero += self.position - position
        self._ticked_position += position - self.position
        self.position = position
        self.trajectory.renumber(position)

    # -- the loop ----------------------------------------------------------------------------------------------------

    def close(self) -> None:
        """Close the position loop where the motor is."""
        if self.servo_on:
            return
        self.trajectory.follow(self.position, self.velocity)
        self._previous_error = self._derivative = self._error_sum = 0
        self.pwm = 0
        self.servo_on = True

    def open(self) -> None:
        """Open the position loop; the PWM value falls to 0 and pos_error is set."""
        self.servo_on = False
        self.pwm = 0
        self.position_error = True
        self.analog_target = None
        self.trajectory.follow(self.position, self.velocity)

    def run(self, cycles: int) -> None:
        """Let servo cycles pass."""
        steady = 0
        enough = 2 * self._divisor
        while cycles > 0:
            cycles -= 1
            steady = steady + 1 if self._cycle() else 0
            if steady > enough and self.analog_target is None:
                # two servo ticks have changed nothing, so no later one will
                self._cycles_left = (self._cycles_left - 1 - cycles) % self._tick_cycles + 1
                break
        self._wrap()

    def _duty(self) -> float | None:
        return self.pwm / FULL_PWM if self.stage.drives else None

    def _cycle(self) -> bool:
        """Let one servo cycle pass; tell whether it left everything as it was."""
        shaft, stage = self.shaft, self.stage
        pwm, error_sum, before = self.pwm, self._error_sum, self.position
        shaft.step(pwm / FULL_PWM if stage.drives else None)
        if not stage.conditions or Condition.ENCODER_STUCK not in stage.conditions:
            self.position = math.floor(shaft.position_counts) - self._zero
        self._cycles_left -= 1
        if self._cycles_left <= 0:
            self._cycles_left = self._tick_cycles
            self._tick()
        if self.gains.cl:
            self._limit_current()
        if self.search:
            self._look_for_home(self.search)
        return (
            shaft.velocity_counts == 0.0
            and self.position == before
            and self.pwm == pwm
            and self._error_sum == error_sum
            and self.trajectory.at_rest
        )

    def _tick(self) -> None:
        """Let one servo tick pass: the profile generator and the filter run at the divided rate."""
        position = self.position
        self.velocity = position - self._ticked_position
        self._ticked_position = position
        trajectory = self.trajectory
        if not self.servo_on:
            trajectory.follow(position, self.velocity)
            self.position_error = True
            return
        if self.analog_target is not None:
            self._approach_analog_target(self.analog_target)
        trajectory.step()
        error = (trajectory.position >> 16) - position
        gains = self.gains
        if not -gains.el <= error <= gains.el:
            self._give_up(Trip.POSITION_ERROR)
            if self.search and self.search.control & HomingControl.POSITION_ERROR:
                self._capture(self.search)
            return
        self._filter(error, gains)

    def _filter(self, error: int, gains: Gains) -> None:
        self._ticks_to_derivative -= 1
        if self._ticks_to_derivative <= 0:
            self._ticks_to_derivative = 1 if self._profile.divisor_slows_profile else self._divisor
            self._derivative = error - self._previous_error
            self._previous_error = error
        bound = gains.il << 8
        total = self._error_sum + error
        if not -bound <= total <= bound:
            total = bound if total > 0 else -bound
        self._error_sum = total
        output = gains.kp * error + gains.kd * self._derivative + gains.ki * (total >> 8)
        magnitude = (output if output >= 0 else -output) >> 8
        if magnitude > gains.ol:  # noqa: PLR1730 - min() costs twice as much, in every servo cycle
            magnitude = gains.ol
        if self._limited:
            magnitude -= min(magnitude, self._limited)
        if output and gains.deadband:
            magnitude = min(magnitude + gains.deadband, FULL_PWM)
        self.pwm = magnitude if output >= 0 else -magnitude

    def _give_up(self, cause: Trip) -> None:
        self.open()
        self.stage.trip(cause)

    # -- absolute positioning, current limit, home -------------------------------------------------------------------

    def _approach_analog_target(self, target: int) -> None:
        """Stop smoothly once the A/D value has reached or passed the target; give up when the sensor is gone."""
        value = self.adc()
        low, high = SENSOR_RANGE
        if not low <= value / (1 << self._profile.adc_bits) <= high:
            self._give_up(Trip.SENSOR)
        elif self.trajectory.velocity == 0 and self.trajectory.done:
            self.analog_target = None
        elif (value >= target) if self._runs_forward else (value <= target):
            self.trajectory.stop_smoothly()

    def run_to_analog_target(self, target: int, speed: int, acceleration: int) -> None:
        """Start an absolute positioning motion; the direction follows from the A/D value.

        Args:
            target: A/D value.
            speed: 16.16 counts per tick, at least 0.
            acceleration: 16.16 counts per tick squared.
        """
        value = self.adc()
        self.analog_target = target
        self._runs_forward = target >= value
        self.trajectory.run_at(speed if self._runs_forward else -speed, acceleration)

    def _limit_current(self) -> None:
        """Take one PWM unit away per cycle of too much current, and give one back per cycle without."""
        threshold, value = self.gains.cl & 0xFE, self.adc()
        over = value > threshold if self.gains.cl & 1 else value < threshold
        if not over:
            self._limited = max(0, self._limited - 1)
            return
        self.overcurrent = True
        self._limited += min(1, abs(self.pwm))
        if self.search and self.search.control & HomingControl.CURRENT:
            self._capture(self.search)

    def _look_for_home(self, search: HomeSearch) -> None:
        inputs = self.inputs
        if search.limit_changed(inputs):
            self.homed_on_limit = True
            self._capture(search)
        elif search.index_changed(inputs):
            self._capture(search)

    def _capture(self, search: HomeSearch) -> None:
        self.home = self.position
        self.search = None
        if not self._profile.stops_on_home:
            return
        if search.control & HomingControl.MOTOR_OFF:
            self.open()
        elif self.servo_on and search.control & HomingControl.STOP_ABRUPT:
            self.analog_target = None
            self.trajectory.stop_abruptly()
        elif self.servo_on and search.control & HomingControl.STOP_SMOOTH:
            self.analog_target = None
            self.trajectory.stop_smoothly()

    def _wrap(self) -> None:
        """Keep the counter in 32 bits."""
        turns = (self.position + COUNTER_SPAN // 2) // COUNTER_SPAN
        if turns:
            self.wrapped = True
            self._zero += turns * COUNTER_SPAN
            self._ticked_position -= turns * COUNTER_SPAN
            self.position -= turns * COUNTER_SPAN
            self.trajectory.shift(-turns * COUNTER_SPAN)
