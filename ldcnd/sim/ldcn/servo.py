"""The servo loop of a simulated drive: encoder, profile generator, PID filter, output to the power stage, home capture.

One call of `run` lets servo cycles of 0.512 ms pass. Where nothing changes any more the rest of them is skipped.

The filter is that of both manuals (PIC-SERVO manual, 4.3), with one correction: the derivative term is printed with a
minus sign, which would drive the motor away from its target; it damps, as the text around it says. The integral error
is the running sum of the position error divided by 256, rounded down; the sum is bounded by 256 times IL, also on
PIC-SERVO SC, whose data sheet is silent about the factor. Deadband compensation is added to any output that is not 0;
PIC-SERVO version 4 and CMC add it to what the output limit has left, the others bound the sum.

Where the manuals leave room:

* A servo rate divisor of 0, which no manual allows, counts as 256.
* Encoder transitions faster than the model counts are lost permanently; so are those of a stuck encoder.
"""

import math
from dataclasses import dataclass

from ldcnd.drives.driver import Gains
from ldcnd.drives.ldcn.controls import IoOption
from ldcnd.drives.ldcn.profiles import HomingControl, Profile
from ldcnd.drives.ldcn.registers import FRACTION
from ldcnd.sim.ldcn.power import FaultCondition, PowerStage, Trip
from ldcnd.sim.ldcn.quirks import AnalogEnd, LimitInPath, ModuleSettings
from ldcnd.sim.ldcn.trajectory import PathBuffer, ProfileGenerator
from ldcnd.sim.plant import Shaft

FULL_PWM = 255
MOST_CURRENT_LIMIT = 255
"""Switches current limiting off on PIC-SERVO SC, as 0 does everywhere."""
COUNTER_SPAN = 1 << 32
STEADY_TICKS = 2
"""After so many servo ticks that have changed nothing, no later one will."""
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
class ArmedSearch:
    """One armed search.

    Attributes:
        control: what it was armed with.
        limit1: the level of the input when the search began; None while it is not watched. Likewise limit2, index.
    """

    control: HomingControl
    limit1: bool | None = None
    limit2: bool | None = None
    index: bool | None = None

    @classmethod
    def armed(cls, control: HomingControl, inputs: Inputs) -> "ArmedSearch":
        """Return a search that begins with these levels."""
        watched = (HomingControl.LIMIT1, inputs.limit1), (HomingControl.LIMIT2, inputs.limit2), (
            HomingControl.INDEX, inputs.index
        )  # fmt: skip
        return cls(control, *(level if control & source else None for source, level in watched))

    def limit_changed(self, limit1: bool, limit2: bool) -> bool:  # noqa: FBT001 - in every servo cycle
        """Tell whether a watched limit switch changed."""
        return (self.limit1 is not None and self.limit1 is not limit1) or (
            self.limit2 is not None and self.limit2 is not limit2
        )


class ServoLoop:
    """The firmware's work in every servo cycle, and its registers.

    Args:
        profile: the dialect.
        shaft: the machine.
        stage: what drives it.
        quirks: see `ModuleSettings`.

    Attributes:
        position: the encoder counter, counts.
        velocity: its change in the last servo tick.
        home: the captured position.
        gains: the registers of Set Gain; all zero after a reset.
        trajectory: the command position.
        servo_on: the position loop is closed.
        pwm: signed output to the power stage, -255 to 255.
        pwm_register: what PWM mode puts out when it is entered, 0 to 255.
        analog_target: the A/D value that an absolute positioning motion goes to; the mode lasts beyond the arrival,
            and with it the check of the sensor.
        protection: limit protection as selected by I/O Control.
        step_mode: pulses at the step input move the command position.
        faulted: an error has opened the loop, and nothing has closed it since.
        search: the armed search for home.
        homed_on_limit: the last search ended on a limit switch.
        position_error: the sticky bits: error limit exceeded or loop opened,
        wrapped: position counter overflowed,
        overcurrent: current limiting occurred.
    """

    def __init__(self, profile: Profile, shaft: Shaft, stage: PowerStage, quirks: ModuleSettings) -> None:
        self.shaft = shaft
        self.stage = stage
        self.position = 0
        self.velocity = 0
        self.home = 0
        self.gains = _NO_GAINS
        self.trajectory = ProfileGenerator(PathBuffer(profile.path_points, quirks))
        self.servo_on = False
        self.pwm = self.pwm_register = 0
        self.analog_target: int | None = None
        self.protection = IoOption(0)
        self.step_mode = False
        self.faulted = False
        self._steps = 0.0  # a part of a pulse is left
        self.search: ArmedSearch | None = None
        self.homed_on_limit = False
        self.position_error = True
        self.wrapped = False
        self.overcurrent = False
        self._profile = profile
        self._quirks = quirks
        self._il_shift = 8 if quirks.il_times_256 else 0
        self._divisor = 1
        self._tick_cycles = 1
        self._path_every_cycle = quirks.path_ignores_divisor and profile.divisor_slows_profile
        # "OL limits the maximal PWM output value" (LS-182AP manual, "Set Gain"), "PWM = min(|out / 256| + DB, OL)" less
        # the adjustment (PIC-SERVO SC data sheet, 4.3); elsewhere deadband compensation "will be added to the magnitude
        # of the PWM output", which is "min(abs(output/256), output_limit) - current_limit_adjustment" (PIC-SERVO
        # manual, 5.2 "Set Gain", 4.3)
        self._deadband_within_limit = profile.pic_ae_diagnostics or profile.sc_extensions
        rate = profile.encoder_counts_per_s if quirks.encoder_counts_per_s is None else quirks.encoder_counts_per_s
        self._most_counts = round(rate * profile.servo_cycle_s) if rate else COUNTER_SPAN
        self._overload_cycles = round(quirks.overload_s / profile.servo_cycle_s)
        self._overloaded = 0  # cycles for which the motor current has been limited
        self._arrived = False  # at the analog target
        shaft.limit_current(quirks.peak_current_a if profile.pic_ae_diagnostics else 0.0)
        if shaft.plant.encoder_disconnected:
            stage.conditions.add(FaultCondition.ENCODER_STUCK)
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
        """Command position minus actual position as the filter took it in the last servo tick, counts; 0 if open.

        No manual says of which instant it is. With a divisor the axis moves on until the next tick.
        """
        return self.trajectory.position // FRACTION - self._ticked_position if self.servo_on else 0

    @property
    def move_done(self) -> bool:
        """Bit 0 of the status byte."""
        if self.trajectory.path.running:
            return self._quirks.path_move_done
        return not self.servo_on or (self.trajectory.done and (self.analog_target is None or self._arrived))

    def adc(self) -> int:
        """Read the A/D converter: the potentiometer on Logosol drives, the current sense input on PIC-SERVO."""
        full_scale = (1 << self._profile.adc_bits) - 1
        if self._profile.analog_target:
            lost = FaultCondition.SENSOR_LOST in self.stage.conditions
            return 0 if lost else round(self.shaft.potentiometer() * full_scale)
        sensed = round(abs(self.shaft.current_a(self._duty())) * self._quirks.sense_counts_per_a)
        falling = self.gains.cl != 0 and not self.gains.cl & 1
        return full_scale - min(sensed, full_scale) if falling else min(sensed, full_scale)

    def set_gains(self, gains: Gains) -> None:
        """Take effect on the next servo tick."""
        self.gains = gains
        self._divisor = gains.sr or 256
        self._tick_cycles = self._divisor if self._profile.divisor_slows_profile else 1
        self._cycles_left = min(self._cycles_left, self._tick_cycles)

    def renumber(self, position: int, *, goal_too: bool = False) -> None:
        """Call the present position by another number, for encoder and command alike, and with them the goal."""
        moved = position - self.position
        self._zero += self.position - position
        self._ticked_position += position - self.position
        self.position = position
        if goal_too:
            self.trajectory.shift(moved)
        else:
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
        self.faulted = False

    def open(self) -> None:
        """Open the position loop; the PWM value falls to 0 and pos_error is set."""
        self.servo_on = False
        # "The PWM value is reset to 0 internally on any condition which automatically disables the position servo"
        # (PIC-SERVO manual, 5.2 "Load Trajectory"), and by Stop Motor (4.5; LS-182AP manual, "Stop Motor")
        self.pwm = self.pwm_register = 0
        self.position_error = True
        self.analog_target = None
        path = self.trajectory.path
        if path.running:
            path.end(clear=self._quirks.path_cleared_by_fault)
        self.trajectory.follow(self.position, self.velocity)

    def put_out(self, pwm: int, register: int) -> None:
        """Open the loop on request and enter PWM mode, with a signed output and what the register holds."""
        self.open()
        self.pwm, self.pwm_register = pwm, register

    def run(self, cycles: int) -> None:
        """Let servo cycles pass."""
        steady = 0
        enough = STEADY_TICKS * self._divisor + self.shaft.delay_steps
        if self._is_plain:
            cycles, steady = self._run_plainly(cycles)
        while cycles > 0 and (steady <= enough or (self.analog_target is not None and not self._arrived)):
            cycles -= 1
            steady = steady + 1 if self._cycle() else 0
        if cycles > 0:
            self._cycles_left = (self._cycles_left - 1 - cycles) % self._tick_cycles + 1
        self._wrap()

    @property
    def _is_plain(self) -> bool:
        """Whether nothing but encoder, profile and filter works in the next cycle, and all three do."""
        return (
            self.servo_on
            and self._divisor == self._cycles_left == self._ticks_to_derivative == 1
            and self._ticked_position == self.position
            and self.stage.drives
            and not self.stage.conditions
            and not self.trajectory.path.running
            and self.analog_target is None
            and self.search is None
            and not self.protection
            and not self.step_mode
            and not self.gains.cl
            and not self.gains.deadband
            and not self._limited
            and not self.shaft.delay_steps
        )

    def _run_plainly(self, cycles: int) -> tuple[int, int]:
        """Do as `_cycle` does, in one piece; return how many cycles are left, and how many have changed nothing.

        Most of the time that a simulated rig takes is spent here. It ends with a cycle that turns out not to be plain,
        and where nothing changes any more.
        """
        shaft, trajectory, gains = self.shaft, self.trajectory, self.gains
        turn, advance, floor = shaft.step, trajectory.step, math.floor
        most, el, ol, kp, kd, ki = self._most_counts, gains.el, gains.ol, gains.kp, gains.kd, gains.ki
        bound = gains.il << self._il_shift
        before, zero, pwm, total = self.position, self._zero, self.pwm, self._error_sum
        previous, derivative, moved, within = self._previous_error, self._derivative, 0, True
        steady, overloaded = 0, self._overloaded > 0
        while cycles > 0 and steady <= STEADY_TICKS:
            cycles -= 1
            turn(pwm / FULL_PWM)
            position = floor(shaft.position_counts) - zero
            moved = position - before
            if not -most <= moved <= most:
                position = self._lose_counts(position, before)
                moved, zero = position - before, self._zero
            before = position
            advance()
            error = (trajectory.position >> 16) - position
            within = -el <= error <= el
            if not within:
                break
            derivative, previous = error - previous, error
            pwm_before, total_before = pwm, total
            total += error
            if not -bound <= total <= bound:
                total = bound if total > 0 else -bound
            output = kp * error + kd * derivative + ki * (total >> 8)
            pwm = (output if output >= 0 else -output) >> 8
            if pwm > ol:  # noqa: PLR1730 - min() costs twice as much
                pwm = ol
            if output < 0:
                pwm = -pwm
            if shaft.current_limited or overloaded:
                break
            if moved or pwm != pwm_before or total != total_before or shaft.velocity_counts or not trajectory.at_rest:
                steady = 0
            else:
                steady += 1
        self.position = self._ticked_position = before
        self.velocity, self.pwm, self._error_sum = moved, pwm, total
        self._previous_error, self._derivative = previous, derivative
        if not within:
            steady = 0
            self._give_up(Trip.POSITION_ERROR)
        if shaft.current_limited or overloaded:
            steady = 0
            self._count_overload()
        return cycles, steady

    def _duty(self) -> float | None:
        return self.pwm / FULL_PWM if self.stage.drives else None

    def _cycle(self) -> bool:
        """Let one servo cycle pass; tell whether it left everything as it was."""
        shaft, stage = self.shaft, self.stage
        pwm, error_sum, before, limited = self.pwm, self._error_sum, self.position, self._limited
        shaft.step(pwm / FULL_PWM if stage.drives else None)
        if not stage.conditions or FaultCondition.ENCODER_STUCK not in stage.conditions:
            position = math.floor(shaft.position_counts) - self._zero
            if abs(position - before) > self._most_counts:
                position = self._lose_counts(position, before)
            self.position = position
        else:
            self._zero = math.floor(shaft.position_counts) - before
        if self._path_every_cycle and self.trajectory.path.running:
            self.trajectory.step()
        if self.step_mode and self.servo_on:
            self._take_steps()
        self._cycles_left -= 1
        if self._cycles_left <= 0:
            self._cycles_left = self._tick_cycles
            self._tick()
        if self.gains.cl or self._limited:
            self._limit_current()
        if self.search:
            self._look_for_home(self.search)
        if self.protection:
            self._protect()
        if shaft.current_limited or self._overloaded:
            self._count_overload()
        return (
            shaft.velocity_counts == 0.0
            and self.position == before
            and self.pwm == pwm
            and self._error_sum == error_sum
            and self._limited == limited
            and self.trajectory.at_rest
            and not self._overloaded
            and not (self.step_mode and self._quirks.steps_hz)
        )

    def _take_steps(self) -> None:
        """Add the pulses of a cycle, times the step multiplier, to the command position (SC data sheet, 4.4.6)."""
        self._steps += self._quirks.steps_hz * self._profile.servo_cycle_s
        whole = int(self._steps)
        self._steps -= whole
        self.trajectory.position += whole * self.gains.step_multiplier * FRACTION

    def _lose_counts(self, position: int, before: int) -> int:
        """Return what the counter shows after transitions that came too fast; the rest is lost."""
        counted = before + (self._most_counts if position > before else -self._most_counts)
        self._zero += position - counted
        return counted

    def _count_overload(self) -> None:
        """Trip when the current has been limited for the overload time (LS-182AP manual, "Overcurrent Protection")."""
        self._overloaded = self._overloaded + 1 if self.shaft.current_limited else 0
        if self._overloaded >= self._overload_cycles:
            self._overloaded = 0
            self._give_up(Trip.OVERCURRENT)

    def _tick(self) -> None:
        """Let one servo tick pass: the profile generator and the filter run at the divided rate."""
        position = self.position
        self.velocity = position - self._ticked_position
        self._ticked_position = position
        trajectory = self.trajectory
        if not self.servo_on:
            if trajectory.path.running:
                trajectory.path.step()
            trajectory.follow(position, self.velocity)
            self.position_error = True
            return
        if self.analog_target is not None:
            self._approach_analog_target(self.analog_target)
        if not (self._path_every_cycle and trajectory.path.running):
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
        bound = gains.il << self._il_shift
        total = self._error_sum + error
        if not -bound <= total <= bound:
            total = bound if total > 0 else -bound
        self._error_sum = total
        output = gains.kp * error + gains.kd * self._derivative + gains.ki * (total >> 8)
        magnitude = (output if output >= 0 else -output) >> 8
        deadband = gains.deadband if output or self._quirks.deadband_at_zero else 0
        if self._deadband_within_limit:
            magnitude += deadband
        if magnitude > gains.ol:  # noqa: PLR1730 - min() costs twice as much, in every servo cycle
            magnitude = gains.ol
        if self._limited:
            magnitude -= min(magnitude, self._limited)
        if not self._deadband_within_limit and deadband:
            magnitude = min(magnitude + deadband, FULL_PWM)
        self.pwm = magnitude if output >= 0 else -magnitude

    def _give_up(self, cause: Trip) -> None:
        self.open()
        self.faulted = True
        self.stage.trip(cause)

    # -- absolute positioning, current limit, home -------------------------------------------------------------------

    def _approach_analog_target(self, target: int) -> None:
        """Stop smoothly at the target; give up when the sensor is gone, also after the arrival."""
        value = self.adc()
        low, high = SENSOR_RANGE
        if not low <= value / (1 << self._profile.adc_bits) <= high:
            self._give_up(Trip.SENSOR)
        elif self.trajectory.velocity == 0 and self.trajectory.done:
            self._arrived = True
        elif self._is_at_analog_target(value, target):
            self.trajectory.stop_smoothly()

    def _is_at_analog_target(self, value: int, target: int) -> bool:
        if self._quirks.analog_end is AnalogEnd.EQUAL:
            return value == target
        return value >= target if self._runs_forward else value <= target

    def run_to_analog_target(self, target: int, speed: int, acceleration: int) -> None:
        """Start an absolute positioning motion; the direction follows from the A/D value.

        Args:
            target: A/D value.
            speed: 16.16 counts per tick, at least 0.
            acceleration: 16.16 counts per tick squared.
        """
        value = self.adc()
        self.analog_target = target
        self._arrived = False
        self._runs_forward = target >= value
        self.trajectory.run_at(speed if self._runs_forward else -speed, acceleration)

    def _limit_current(self) -> None:
        """Take PWM units away per cycle of too much current, and give as many back per cycle without."""
        limit, on_sc = self.gains.cl, self._profile.sc_extensions
        threshold, step = (limit, 2) if on_sc else (limit & 0xFE, 1)
        value = self.adc()
        over = value > threshold if limit & 1 else value < threshold
        # "Setting CL to 0 effectively disables current limiting" (PIC-SERVO manual, 5.2 "Set Gain"), on PIC-SERVO SC
        # 255, too (data sheet, 5.2): then no current is above the limit, and "if the motor current is below the
        # specified limit, current_limit_adjustment is decremented [...] down to a minimum value of zero" (manual, 4.3)
        if not over or not limit or (on_sc and limit == MOST_CURRENT_LIMIT):
            self._limited = max(0, self._limited - step)
            return
        self.overcurrent = True
        self._limited += min(step, abs(self.pwm))
        if self.search and self.search.control & HomingControl.CURRENT:
            self._capture(self.search)

    # -- limit protection of PIC-SERVO SC ----------------------------------------------------------------------------

    def may_run(self, direction: int) -> bool:
        """Tell whether limit protection lets a motion in this direction begin: 1 forward, -1 reverse, 0 none."""
        if not self.protection or direction == 0:
            return True
        forward, reverse = self.shaft.on_forward_limit, self.shaft.on_reverse_limit
        return not ((forward and reverse) or (forward if direction > 0 else reverse))

    def _protect(self) -> None:
        """End what runs into a limit switch (PIC-SERVO SC data sheet, 4.7)."""
        if not self.servo_on:
            if not self.may_run(self.pwm):
                self.pwm = 0
            return
        path = self.trajectory.path
        if self.may_run(path.velocity if path.running else self.trajectory.velocity):
            return
        if path.running:
            match self._quirks.limit_in_path:
                case LimitInPath.NOTHING:
                    return
                case LimitInPath.KEEPS_PATH_MODE:
                    path.block()
                    return
                case LimitInPath.ENDS_PATH:
                    path.end(clear=self._quirks.path_cleared_by_stop)
        if self.protection & IoOption.LIMIT_OFF:
            self.open()
        else:
            self.trajectory.stop_abruptly()

    def _look_for_home(self, search: ArmedSearch) -> None:
        shaft = self.shaft
        limits = (shaft.on_reverse_limit, shaft.on_forward_limit)
        limit1, limit2 = reversed(limits) if self._profile.limit1_is_forward else limits
        if search.limit_changed(limit1, limit2):
            self.homed_on_limit = True
            self._capture(search)
        elif search.index is not None and shaft.on_index is not search.index:
            self._capture(search)

    def _capture(self, search: ArmedSearch) -> None:
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
