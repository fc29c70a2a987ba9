"""A simulated servo drive: every command of the manuals on the registers behind one address, and its status packets.

Decisions where the manuals leave room:

* A trapezoidal move starts from standstill. Loaded in mid-move it is an offset on LS-182AP, a jump of the command
  velocity on older PIC-SERVOs, and just another goal on PIC-SERVO SC.
* Loads of Load Trajectory add up until the start; on PIC-SERVO SC each replaces all that still waited.
* On Logosol drives the loop can only be closed with Pic_ae = 1 and nothing latched. Position error and sensor fault are
  latched too, as the footnote of the diagnostics table demands.
* The motion lock of LS-182AP from version 22 on: homing on a limit switch locks; then nothing starts until Stop Motor
  with bit 7, which also keeps further homing from locking until the next reset.
* The address output of a PIC-SERVO SC with step and direction inputs, which rises on a servo fault, is seen to rise
  with the next packet for the drive, and falls when the loop is closed again.

Sources: LS-182AP manual, "Command description"; PIC-SERVO manual, 5.2, 5.3; PIC-SERVO SC data sheet, 4.6, 4.7, 5.
"""

from dataclasses import dataclass, replace

from ldcnd.drives.driver import Gains
from ldcnd.drives.ldcn.controls import (
    EXCLUSIVE_OPTIONS,
    IoOption,
    LimitPins,
    StartUp,
    StopControl,
)
from ldcnd.drives.ldcn.packet import AuxFlag, CommandCode, StatusFlag, StatusItem, StatusPacket, encode_status
from ldcnd.drives.ldcn.profiles import PIC_SERVO_CMC_ADVANCED, HomingControl, Profile, at_clock
from ldcnd.drives.ldcn.received import (
    AddPathPoints,
    IoControl,
    LoadTrajectory,
    PlainCommand,
    ReceivedCommand,
    ResetPosition,
    SetGain,
    SetHomingMode,
    StopMotor,
)
from ldcnd.drives.ldcn.registers import FRACTION
from ldcnd.drives.ldcn.trajectory import ProfileMode, Trajectory
from ldcnd.sim.ldcn.module import SimulatedModule
from ldcnd.sim.ldcn.power import FaultCondition, LogosolPower, PicServoPower, PowerStage, ScPower
from ldcnd.sim.ldcn.quirks import (
    ExcludedOptions,
    HalfPoint,
    ModuleSettings,
    PathWithoutServo,
    PositionErrorClearing,
    RelativeTo,
    ResetInMotion,
)
from ldcnd.sim.ldcn.servo import COUNTER_SPAN, ArmedSearch, ServoLoop
from ldcnd.sim.plant import MotorPlant, Shaft

SHORTS = range(-0x8000, 0x8000)
MOST_STEPS_HZ = 100_000
"""Pulses that come faster make PIC-SERVO SC late for its servo cycle (data sheet, 4.4.6)."""
_NO_TRAJECTORY = Trajectory(servo=False)
_ALL_INPUTS = LimitPins.LIMIT1_INPUT | LimitPins.LIMIT2_INPUT
_WAYS_TO_STOP = StopControl.MOTOR_OFF | StopControl.ABRUPT | StopControl.SMOOTH | StopControl.HERE
_LIMIT_PROTECTION = IoOption.LIMIT_OFF | IoOption.LIMIT_STOP


@dataclass(frozen=True, slots=True)
class SavedConfiguration:
    """The EEPROM of a PIC-SERVO SC; only a loss of its supply brings it back."""

    start_up: StartUp
    address: int
    group: int
    leader: bool
    speed: int
    acceleration: int
    gains: Gains
    protection: IoOption


class SimulatedDrive(SimulatedModule):
    """One servo drive with the machine on its shaft.

    Attributes:
        shaft: the machine, for looking at and for pushing.
        stage: the power stage.
        loop: the servo loop.
        saved: the EEPROM; None where nothing was saved.
    """

    def __init__(self, profile: Profile, settings: ModuleSettings, plant: MotorPlant) -> None:
        profile = at_clock(profile, settings.clock_hz)
        self.shaft = Shaft(plant, profile.servo_cycle_s)
        self.stage: PowerStage
        self.loop: ServoLoop
        self.saved: SavedConfiguration | None = None
        self._conditions: set[FaultCondition] = set()
        self._overrun = False
        if settings.velocity_sign is not None:
            profile = replace(profile, velocity_sign=settings.velocity_sign)
        self._compatible = self._advanced = profile
        if profile.advanced_stop:
            self._advanced = at_clock(
                replace(PIC_SERVO_CMC_ADVANCED, velocity_sign=profile.velocity_sign), settings.clock_hz
            )
            items = self._advanced if settings.items_before_advanced else profile
            self._compatible = replace(items, path_points=0)
        super().__init__(profile, settings)

    def set_condition(self, condition: FaultCondition, *, present: bool, at_s: float) -> None:
        """Let something go wrong around the drive, or be right again, at that instant of the line's clock."""
        self.catch_up(at_s)
        if present:
            self._conditions.add(condition)
        else:
            self._conditions.discard(condition)
        self.shaft.stalled = FaultCondition.STALLED in self._conditions
        self.shaft.limits_actuated = FaultCondition.LIMITS_ACTUATED in self._conditions
        if FaultCondition.SLOW_PROCESSOR in self._conditions:
            self._overrun = True
        self.stage.check()
        self._obey_stage()

    def suffers(self, condition: FaultCondition) -> bool:
        """Tell whether something is wrong around the drive at present."""
        return condition in self._conditions

    # -- module ------------------------------------------------------------------------------------------------------

    @property
    def dialect(self) -> Profile:
        """A CMC accepts its own commands only after Stop Motor with bit 5."""
        return self._advanced if self._is_advanced else self._compatible

    def restart(self) -> None:
        """Restart everything but the shaft and its faults."""
        if self.profile.pic_ae_diagnostics:
            self.stage = LogosolPower()
        else:
            self.stage = ScPower() if self.profile.sc_extensions else PicServoPower()
        self.stage.conditions = self._conditions
        self.stage.check()
        self.loop = ServoLoop(self.profile, self.shaft, self.stage, self.settings)
        self._trajectory = _NO_TRAJECTORY
        self._goal = 0
        self._new_goal = False
        self._speed = 0
        self._acceleration = 0
        self._pins = _ALL_INPUTS
        self._overrun = False
        self._locked = False
        self._may_lock = self.profile.motion_lock_from is not None and (
            self.settings.version >= self.profile.motion_lock_from
        )
        self._is_advanced = False
        self._energised_by_address = StartUp(0)
        self._shows_slew = self.settings.aux_after_reset

    def run(self, cycles: int) -> None:
        """Let servo cycles pass; a home search that ends on a limit may lock motion."""
        self.loop.run(cycles)
        if self.profile.sc_extensions:
            self.address_out = self.address != 0 and not (self.loop.step_mode and self.loop.faulted)
        if self.loop.step_mode:
            self._overrun = self._overrun or abs(self.settings.steps_hz) > MOST_STEPS_HZ
        if self.loop.homed_on_limit:
            self.loop.homed_on_limit = False
            self._locked = self._may_lock

    def execute(self, command: ReceivedCommand) -> None:
        """Execute a command of servo drives."""
        loop = self.loop
        match command:
            case ResetPosition(position, relative_to_home):
                self._renumber(loop.position - loop.home if relative_to_home else position)
            case LoadTrajectory(trajectory):
                self._load(trajectory)
            case PlainCommand(CommandCode.START_MOTION):
                self._start()
            case SetGain(gains, without_multiplier):
                if without_multiplier and self.settings.gains_keep_multiplier:
                    gains = replace(gains, step_multiplier=loop.gains.step_multiplier)
                loop.set_gains(gains)
            case StopMotor(control, position):
                self._stop(control, position)
            case IoControl(control):
                self._set_options(control)
            case SetHomingMode(control):
                self._arm_homing(control)
            case AddPathPoints(points, half):
                self._add_points(points, half)
            case PlainCommand(CommandCode.CLEAR_STICKY_BITS):
                self._clear_sticky_bits()
            case PlainCommand(CommandCode.SAVE_CURRENT_POSITION_AS_HOME):
                loop.home = loop.position

    def status(self, items: StatusItem, *, checksum_error: bool) -> bytes:
        """Return a status packet in the layout of the dialect."""
        loop = self.loop
        flags = self.stage.flags(self._limits())
        if loop.move_done:
            flags |= StatusFlag.MOVE_DONE
        if checksum_error:
            flags |= StatusFlag.CHECKSUM_ERROR
        if loop.overcurrent:
            flags |= StatusFlag.OVERCURRENT
        if loop.position_error:
            flags |= StatusFlag.POSITION_ERROR
        if loop.search:
            flags |= StatusFlag.HOME_IN_PROGRESS
        return encode_status(
            self.dialect,
            items,
            StatusPacket(
                flags,
                position=_long(loop.position),
                adc=loop.adc() if items & StatusItem.ADC else 0,
                velocity=_short(loop.velocity),
                aux=self._aux() if items & StatusItem.AUX else AuxFlag(0),
                home=_long(loop.home),
                device_id=self.profile.device_id,
                version=self.settings.version,
                position_error=_short(loop.following_error),
                bit7=loop.trajectory.path.points_left,
            ),
        )

    def _limits(self) -> StatusFlag:
        inputs = self.loop.inputs
        pins = self._pins
        limit1 = inputs.limit1 if pins & LimitPins.LIMIT1_INPUT else pins & LimitPins.LIMIT1_HIGH
        limit2 = inputs.limit2 if pins & LimitPins.LIMIT2_INPUT else pins & LimitPins.LIMIT2_HIGH
        flags = StatusFlag.LIMIT1 if limit1 else StatusFlag(0)
        return flags | StatusFlag.LIMIT2 if limit2 else flags

    def _aux(self) -> AuxFlag:
        loop = self.loop
        trajectory, live = loop.trajectory, self.profile.live_aux
        flags = self.stage.aux(AuxFlag.INDEX if loop.inputs.index is live else AuxFlag(0))
        accelerates, slews = trajectory.accel_done, trajectory.slew_done
        if live:
            running = trajectory.path.running
            accelerates = trajectory.accelerating and not running
            slews = (self.settings.path_slew if running else trajectory.steady) and self._shows_slew
        for present, flag in (
            (loop.wrapped, AuxFlag.POSITION_WRAP),
            (loop.servo_on, AuxFlag.SERVO_ON),
            (accelerates, AuxFlag.ACCEL_DONE),
            (slews, AuxFlag.SLEW_DONE),
            (self._overrun, AuxFlag.SERVO_OVERRUN),
            (trajectory.path.path_mode, AuxFlag.PATH_MODE),
            (self._locked, AuxFlag.MOTION_LOCKED),
        ):
            if present:
                flags |= flag
        return flags

    # -- the EEPROM of PIC-SERVO SC ----------------------------------------------------------------------------------

    def save(self, start_up: int) -> None:
        """Save the configuration; without the bit for saving the EEPROM is erased."""
        control = StartUp(start_up)
        if not control & StartUp.SAVE:
            self.saved = None
            return
        self.saved = SavedConfiguration(
            control,
            self.address,
            self.group,
            self.leader,
            self._speed,
            self._acceleration,
            self.loop.gains,
            self.loop.protection,
        )

    def restore(self) -> None:
        """Take over what the EEPROM holds, at power-up."""
        saved = self.saved
        if saved is None:
            return
        self._speed, self._acceleration = saved.speed, saved.acceleration
        self.loop.set_gains(saved.gains)
        self.loop.step_mode = bool(saved.start_up & StartUp.STEP_DIRECTION)
        if saved.start_up & StartUp.LIMIT_PROTECTION:
            self.loop.protection = saved.protection
        self._energised_by_address = saved.start_up & (StartUp.AMPLIFIER_ON | StartUp.SERVO_ON)
        if saved.start_up & StartUp.ADDRESSES:
            self.address, self.group, self.leader = saved.address, saved.group, saved.leader
            self.address_out = True
            self.addressed()

    def addressed(self) -> None:
        """Energise the motor as saved for the start-up."""
        start_up, self._energised_by_address = self._energised_by_address, StartUp(0)
        if start_up & StartUp.AMPLIFIER_ON:
            self.stage.enable(on=True)
        if start_up & StartUp.SERVO_ON and self.stage.allows_servo:
            self._close()

    # -- commands ----------------------------------------------------------------------------------------------------

    def _renumber(self, position: int) -> None:
        """Set the present position: 0; on PIC-SERVO SC also relative to home, or any number."""
        loop, rule = self.loop, self.settings.reset_in_motion
        profiler = loop.trajectory
        moving = loop.servo_on and profiler.mode is ProfileMode.TRAPEZOIDAL and not profiler.done
        if moving and rule is ResetInMotion.IGNORED:
            return
        if self.settings.home_shifts:
            loop.home += position - loop.position
        loop.renumber(position, goal_too=moving and rule is ResetInMotion.GOAL_SHIFTED)

    def _set_options(self, control: int) -> None:
        loop = self.loop
        if self.profile.limit_outputs:
            self._pins = LimitPins(control & 0x0F)
        else:
            for pair in EXCLUSIVE_OPTIONS:
                if control & pair == pair and self.settings.excluded_options is ExcludedOptions.IGNORED:
                    return
                if control & pair == pair and self.settings.excluded_options is ExcludedOptions.CLEARED:
                    control &= ~pair
            loop.protection = IoOption(control) & _LIMIT_PROTECTION
            loop.step_mode = bool(control & IoOption.STEP_DIRECTION)
        loop.trajectory.path.fast = bool(control & IoOption.FAST_PATH)

    def _add_points(self, points: tuple[int, ...], half: int | None) -> None:
        loop, settings = self.loop, self.settings
        if not points and half is None:
            if loop.servo_on or settings.path_without_servo is PathWithoutServo.RUNS:
                loop.trajectory.start_path()
            return
        if not loop.servo_on and settings.path_without_servo is PathWithoutServo.POINTS_REFUSED:
            return
        if not (loop.trajectory.done or loop.trajectory.path.running or settings.path_takes_points_in_motion):
            return
        if half is not None and settings.half_point is HalfPoint.PACKET_DROPPED:
            return
        if half is not None and settings.half_point is HalfPoint.COMPLETED:
            points += (half,)
        loop.trajectory.path.add(points)

    def _load(self, trajectory: Trajectory) -> None:
        if trajectory.relative and self.settings.relative_to is RelativeTo.LOAD and trajectory.position is not None:
            trajectory = replace(trajectory, position=self._from_command_position(trajectory.position), relative=False)
        self._trajectory = trajectory
        if not self.profile.sc_extensions:
            self._take_registers()
        if trajectory.start_now:
            self._start()

    def _take_registers(self) -> None:
        """Let the values of the last load take effect in the registers."""
        trajectory = self._trajectory
        if trajectory.position is not None:
            relative = trajectory.relative
            self._goal = self._from_command_position(trajectory.position) if relative else trajectory.position
            self._new_goal = True
        if trajectory.velocity is not None:
            self._speed = trajectory.velocity
        if trajectory.acceleration is not None:
            self._acceleration = trajectory.acceleration
        if trajectory.pwm_or_target is not None:
            self.loop.pwm_register = trajectory.pwm_or_target

    def _from_command_position(self, counts: int) -> int:
        return self.loop.trajectory.position // FRACTION + counts

    def _start(self) -> None:
        """Execute what was loaded last."""
        if self._locked:
            return
        if self.profile.sc_extensions:
            self._take_registers()
        new_goal, self._new_goal = self._new_goal, False
        loop, trajectory = self.loop, self._trajectory
        if not trajectory.servo:
            self._run_pwm(trajectory)
            return
        if not self.stage.allows_servo:
            return
        profiler = loop.trajectory
        moving = loop.servo_on and profiler.mode is ProfileMode.TRAPEZOIDAL and not profiler.done
        self._close()
        if not loop.may_run(self._direction(trajectory)):
            return
        self._end_path()
        if trajectory.mode is ProfileMode.VELOCITY:
            self._run_at_velocity(trajectory)
        elif moving and self.profile.offset_on_the_fly:
            if new_goal:
                profiler.add_offset(self._goal)
        else:
            loop.analog_target = None
            on_the_fly = self.profile.sc_extensions
            profiler.go_to(self._goal, self._speed, self._acceleration, from_velocity=on_the_fly)

    def _direction(self, trajectory: Trajectory) -> int:
        """Return the sign of the velocity that a motion needs."""
        if trajectory.mode is ProfileMode.VELOCITY:
            speed = -self._speed if trajectory.reverse else self._speed
            return (speed > 0) - (speed < 0)
        ahead = self._goal * FRACTION - self.loop.trajectory.position
        return (ahead > 0) - (ahead < 0)

    def _run_pwm(self, trajectory: Trajectory) -> None:
        loop = self.loop
        register = loop.pwm_register
        pwm = -register if trajectory.reverse else register
        if self.profile.sc_extensions and trajectory.pwm_or_target is None:
            pwm = loop.pwm
        self._end_path()
        loop.put_out(pwm if loop.may_run(pwm) else 0, register)

    def _run_at_velocity(self, trajectory: Trajectory) -> None:
        loop = self.loop
        if self.profile.analog_target and trajectory.pwm_or_target is not None:
            loop.run_to_analog_target(trajectory.pwm_or_target, self._speed, self._acceleration)
            return
        loop.analog_target = None
        loop.trajectory.run_at(-self._speed if trajectory.reverse else self._speed, self._acceleration)

    def _end_path(self) -> None:
        path = self.loop.trajectory.path
        if path.running:
            path.end(clear=self.settings.path_cleared_by_stop)

    def _stop(self, control: StopControl, position: int | None) -> None:
        self.stage.enable(on=bool(control & StopControl.AMP_ENABLE))
        if control & StopControl.LOCK_DISABLE and self._may_lock:
            self._locked = self._may_lock = False
        if self.profile.advanced_stop:
            keeps = self._is_advanced and self.settings.advanced_sticky
            self._is_advanced = keeps or bool(control & StopControl.ADVANCED)
        profiled = control & (StopControl.ABRUPT | StopControl.SMOOTH)
        if profiled and self.settings.stop_clears_velocity:
            self._speed = 0
        loop = self.loop
        if control & _WAYS_TO_STOP or self.settings.path_ended_by_enable:
            loop.trajectory.path.end(clear=self.settings.path_cleared_by_stop)
        self._obey_stage()
        if control & StopControl.MOTOR_OFF:
            loop.open()
            return
        if not self.profile.stop_here:
            position = None
        if not self.stage.allows_servo or not (profiled or position is not None):
            return
        self._close()
        loop.analog_target = None
        if control & StopControl.ABRUPT:
            loop.trajectory.stop_abruptly()
        elif control & StopControl.SMOOTH:
            loop.trajectory.stop_smoothly()
        elif position is not None:
            loop.trajectory.jump_to(position)

    def _arm_homing(self, control: HomingControl) -> None:
        loop = self.loop
        sources = control & self.profile.homing_sources
        loop.search = ArmedSearch.armed(control, loop.inputs) if sources else None

    def _clear_sticky_bits(self) -> None:
        loop = self.loop
        loop.position_error = not loop.servo_on
        loop.wrapped = loop.overcurrent = False
        self._overrun = FaultCondition.SLOW_PROCESSOR in self._conditions
        self.stage.clear()

    def _close(self) -> None:
        if not self.loop.servo_on and self.settings.position_error_clearing is PositionErrorClearing.BY_CLOSING:
            self.loop.position_error = False
        self._shows_slew = True
        self.loop.close()

    def _obey_stage(self) -> None:
        if self.loop.servo_on and not self.stage.allows_servo:
            self.loop.open()
        elif not self.stage.drives and not self.loop.servo_on:
            self.loop.pwm = self.loop.pwm_register = 0


def _short(value: int) -> int:
    """Return the nearest number of 16 bits."""
    return min(max(value, SHORTS.start), SHORTS.stop - 1)


def _long(value: int) -> int:
    """Return what a counter of 32 bits makes of a number."""
    return (value + COUNTER_SPAN // 2) % COUNTER_SPAN - COUNTER_SPAN // 2
