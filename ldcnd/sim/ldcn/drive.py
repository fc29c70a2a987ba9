"""A simulated servo drive: every command of the manuals on the registers behind one address, and its status packets.

Decisions where the manuals leave room:

* A trapezoidal move always starts from standstill; loaded in mid-move it is an offset on LS-182AP, and a jump of the
  command velocity on PIC-SERVO.
* On Logosol drives the loop can only be closed with Pic_ae = 1 and nothing latched. Position error and sensor fault are
  latched too, as the footnote of the diagnostics table demands.
* The motion lock of LS-182AP from version 22 on: homing on a limit switch locks; then nothing starts until Stop Motor
  with bit 7, which also keeps further homing from locking until the next reset.

Sources: LS-182AP manual, "Command description"; PIC-SERVO manual, 5.2, 5.3.
"""

from ldcnd.drivers.ldcn.controls import HomingControl, LimitPins, StopControl
from ldcnd.drivers.ldcn.packet import Command
from ldcnd.drivers.ldcn.profiles import Profile
from ldcnd.drivers.ldcn.received import (
    IoControl,
    LoadTrajectory,
    PlainCommand,
    ReceivedCommand,
    ResetPosition,
    SetGain,
    SetHomingMode,
    StopMotor,
)
from ldcnd.drivers.ldcn.registers import SERVO_CYCLE_S
from ldcnd.drivers.ldcn.status import AuxFlag, Status, StatusFlag, StatusItem, encode_status
from ldcnd.drivers.ldcn.trajectory import ProfileMode, Trajectory
from ldcnd.sim.ldcn.module import ModuleSettings, PositionErrorClearing, SimulatedModule
from ldcnd.sim.ldcn.power import Condition, LogosolPower, PicServoPower, PowerStage
from ldcnd.sim.ldcn.servo import COUNTER_SPAN, HomeSearch, ServoLoop
from ldcnd.sim.plant import MotorPlant, Shaft

SHORTS = range(-0x8000, 0x8000)
_NO_TRAJECTORY = Trajectory(servo=False)
_ALL_INPUTS = LimitPins.LIMIT1_INPUT | LimitPins.LIMIT2_INPUT


class SimulatedDrive(SimulatedModule):
    """One servo drive with the machine on its shaft.

    Attributes:
        shaft: the machine, for looking at and for pushing.
        stage: the power stage.
        loop: the servo loop.
    """

    def __init__(self, profile: Profile, settings: ModuleSettings, plant: MotorPlant) -> None:
        self.shaft = Shaft(plant, SERVO_CYCLE_S)
        self.stage: PowerStage
        self.loop: ServoLoop
        self._conditions: set[Condition] = set()
        self._overrun = False
        super().__init__(profile, settings)

    def set_condition(self, condition: Condition, *, present: bool, at_s: float) -> None:
        """Let something go wrong around the drive, or be right again, at that instant of the line's clock."""
        self.catch_up(at_s)
        if present:
            self._conditions.add(condition)
        else:
            self._conditions.discard(condition)
        self.shaft.stalled = Condition.STALLED in self._conditions
        if Condition.SLOW_PROCESSOR in self._conditions:
            self._overrun = True
        self.stage.check()
        self._obey_stage()

    # -- module ------------------------------------------------------------------------------------------------------

    def restart(self) -> None:
        """See `SimulatedModule`: everything but the shaft and its troubles starts anew."""
        self.stage = LogosolPower() if self.profile.pic_ae_diagnostics else PicServoPower()
        self.stage.conditions = self._conditions
        self.stage.check()
        self.loop = ServoLoop(self.profile, self.shaft, self.stage, self.settings.sense_counts_per_a)
        self._trajectory = _NO_TRAJECTORY
        self._goal = 0
        self._new_goal = False
        self._speed = 0
        self._acceleration = 0
        self._pwm_or_target = 0
        self._pins = _ALL_INPUTS
        self._overrun = False
        self._locked = False
        self._may_lock = self.profile.motion_lock_from is not None and (
            self.settings.version >= self.profile.motion_lock_from
        )

    def run(self, cycles: int) -> None:
        """See `SimulatedModule`."""
        self.loop.run(cycles)
        if self.loop.homed_on_limit:
            self.loop.homed_on_limit = False
            self._locked = self._may_lock

    def execute(self, command: ReceivedCommand) -> None:
        """See `SimulatedModule`."""
        loop = self.loop
        match command:
            case ResetPosition(position, relative_to_home):
                loop.renumber(loop.position - loop.home if relative_to_home else position)
            case LoadTrajectory(trajectory):
                self._load(trajectory)
            case PlainCommand(Command.START_MOTION):
                self._start()
            case SetGain(gains):
                loop.set_gains(gains)
            case StopMotor(control, position):
                self._stop(control, position)
            case IoControl(control) if self.profile.limit_outputs:
                self._pins = LimitPins(control & 0x0F)
            case SetHomingMode(control):
                self._arm_homing(control)
            case PlainCommand(Command.CLEAR_STICKY_BITS):
                self._clear_sticky_bits()
            case PlainCommand(Command.SAVE_CURRENT_POSITION_AS_HOME):
                loop.home = loop.position

    def status(self, items: StatusItem, *, checksum_error: bool) -> bytes:
        """See `SimulatedModule`."""
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
            self.profile,
            items,
            Status(
                flags,
                position=_long(loop.position),
                adc=loop.adc() if items & StatusItem.ADC else 0,
                velocity=_short(loop.velocity),
                aux=self._aux() if items & StatusItem.AUX else AuxFlag(0),
                home=_long(loop.home),
                device_id=self.profile.device_id,
                version=self.settings.version,
                position_error=_short(loop.following_error),
                bit7=0,
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
        flags = self.stage.aux(AuxFlag(0) if loop.inputs.index else AuxFlag.INDEX)
        if loop.wrapped:
            flags |= AuxFlag.POSITION_WRAP
        if loop.servo_on:
            flags |= AuxFlag.SERVO_ON
        if loop.trajectory.accel_done:
            flags |= AuxFlag.ACCEL_DONE
        if loop.trajectory.slew_done:
            flags |= AuxFlag.SLEW_DONE
        if self._overrun:
            flags |= AuxFlag.SERVO_OVERRUN
        if self._locked:
            flags |= AuxFlag.MOTION_LOCKED
        return flags

    # -- commands ----------------------------------------------------------------------------------------------------

    def _load(self, trajectory: Trajectory) -> None:
        self._trajectory = trajectory
        if trajectory.position is not None:
            self._goal = trajectory.position
            self._new_goal = True
        if trajectory.velocity is not None:
            self._speed = trajectory.velocity
        if trajectory.acceleration is not None:
            self._acceleration = trajectory.acceleration
        if trajectory.pwm_or_target is not None:
            self._pwm_or_target = trajectory.pwm_or_target
        if trajectory.start_now:
            self._start()

    def _start(self) -> None:
        """Execute what was loaded last."""
        new_goal, self._new_goal = self._new_goal, False
        if self._locked:
            return
        loop, trajectory = self.loop, self._trajectory
        if not trajectory.servo:
            loop.open()
            loop.pwm = -self._pwm_or_target if trajectory.reverse else self._pwm_or_target
            return
        if not self.stage.allows_servo:
            return
        profiler = loop.trajectory
        moving = loop.servo_on and profiler.mode is ProfileMode.TRAPEZOIDAL and not profiler.done
        self._close()
        if trajectory.mode is ProfileMode.VELOCITY:
            self._run_at_velocity(trajectory)
        elif moving and self.profile.offset_on_the_fly:
            if new_goal:
                profiler.add_offset(self._goal)
        else:
            loop.analog_target = None
            profiler.go_to(self._goal, self._speed, self._acceleration)

    def _run_at_velocity(self, trajectory: Trajectory) -> None:
        loop = self.loop
        if self.profile.analog_target and trajectory.pwm_or_target is not None:
            loop.run_to_analog_target(self._pwm_or_target, self._speed, self._acceleration)
            return
        loop.analog_target = None
        loop.trajectory.run_at(-self._speed if trajectory.reverse else self._speed, self._acceleration)

    def _stop(self, control: StopControl, position: int | None) -> None:
        self.stage.enable(on=bool(control & StopControl.AMP_ENABLE))
        if control & StopControl.LOCK_DISABLE and self._may_lock:
            self._locked = self._may_lock = False
        if self.settings.stop_clears_velocity:
            self._speed = 0
        self._obey_stage()
        loop = self.loop
        if control & StopControl.MOTOR_OFF:
            loop.open()
            return
        if not self.profile.stop_here:
            position = None
        profiled = control & (StopControl.ABRUPT | StopControl.SMOOTH)
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
        sources = control & HomingControl(self.profile.homing_sources)
        loop.search = HomeSearch(control, loop.inputs) if sources else None

    def _clear_sticky_bits(self) -> None:
        loop = self.loop
        loop.position_error = not loop.servo_on
        loop.wrapped = loop.overcurrent = False
        self._overrun = Condition.SLOW_PROCESSOR in self._conditions
        self.stage.clear()

    def _close(self) -> None:
        if not self.loop.servo_on and self.settings.position_error_clearing is PositionErrorClearing.BY_CLOSING:
            self.loop.position_error = False
        self.loop.close()

    def _obey_stage(self) -> None:
        if self.loop.servo_on and not self.stage.allows_servo:
            self.loop.open()
        elif not self.stage.drives:
            self.loop.pwm = 0 if not self.loop.servo_on else self.loop.pwm


def _short(value: int) -> int:
    """Return the nearest number of 16 bits."""
    return min(max(value, SHORTS.start), SHORTS.stop - 1)


def _long(value: int) -> int:
    """Return what a counter of 32 bits makes of a number."""
    return (value + COUNTER_SPAN // 2) % COUNTER_SPAN - COUNTER_SPAN // 2
