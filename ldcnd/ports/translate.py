"""What the packets of a guest mean in commands of an axis: a servo drive as an old program commands it.

A program speaks of counts of a counter that it believes to be its own, and its port has one. What moves, sets or
forgets is a command as of any client, so limits, interlocks, latches and books are those of everybody. Sources:
LS-182AP manual, "Load Trajectory", "Stop Motor"; PIC-SERVO manual, 5.2.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, fields, replace

from ldcnd.config.ports import StatusView
from ldcnd.contract.commands import (
    AxisCommand,
    BufferMode,
    CommandReply,
    Halt,
    Home,
    HomeMethod,
    HomeStop,
    MoveAbsolute,
    MoveRelative,
    MoveVelocity,
    Power,
    Reset,
    SetGains,
    SetPosition,
)
from ldcnd.contract.errors import NotSupported, StopLatched
from ldcnd.drives.driver import Gains
from ldcnd.drives.ldcn.controls import STOPS_ON_HOME, WAYS_TO_STOP, StopControl
from ldcnd.drives.ldcn.homing import homing_source
from ldcnd.drives.ldcn.packet import CommandCode, StatusFlag
from ldcnd.drives.ldcn.profiles import HomingControl, Profile
from ldcnd.drives.ldcn.received import (
    LoadTrajectory,
    PlainCommand,
    ReceivedCommand,
    ResetPosition,
    SetGain,
    SetHomingMode,
    StopMotor,
    UndefinedCommand,
    UndescribedCommand,
)
from ldcnd.drives.ldcn.servo import LdcnAxis
from ldcnd.drives.ldcn.trajectory import (
    ProfileMode,
    Trajectory,
    acceleration_counts_per_s2,
    velocity_counts_per_s,
)

_STOPS = {
    HomingControl.STOP_ABRUPT: HomeStop.ABRUPT,
    HomingControl.STOP_SMOOTH: HomeStop.SMOOTH,
    HomingControl.MOTOR_OFF: HomeStop.OFF,
}
_NO_HOMING = HomingControl(0)
_LEAVES_OFF = HomingControl.MOTOR_OFF | HomingControl.POSITION_ERROR


def name_of(command: ReceivedCommand) -> str:
    """Return what a person calls a command of a guest."""
    match command:
        case PlainCommand(code) | UndefinedCommand(code) | UndescribedCommand(code):
            return CommandCode(code).name.lower()
        case _:
            return type(command).__name__


def relief(command: ReceivedCommand, client: str, starts: Trajectory | None = None) -> AxisCommand[CommandReply] | None:
    """Return what takes the energy out that a guest's command takes out; None for what does more or something else.

    Without its amplifier bit Stop Motor switches the power driver off whatever else it says; going to a position is
    motion. A velocity of 0, and PWM 0 with the servo off, are the other ways of a program to stop.

    Args:
        command: of the guest.
        client: its name.
        starts: the trajectory that it starts; None for none.
    """
    if starts and not starts.servo:
        return None if starts.pwm_or_target else Power(on=False, client=client)
    if starts:
        return Halt(client=client) if starts.mode is ProfileMode.VELOCITY and not starts.velocity else None
    if not isinstance(command, StopMotor):
        return None
    if command.control & StopControl.MOTOR_OFF or not command.control & StopControl.AMP_ENABLE:
        return Power(on=False, client=client)
    if command.control & (StopControl.ABRUPT | StopControl.SMOOTH):
        return Halt(client=client)
    return None


@dataclass(frozen=True, slots=True)
class Meaning:
    """What a command of a guest means.

    Attributes:
        command: of the axis; None where nothing is to be done.
        from_rest: what the guest has loaded; the command is made of it again once the axis stands, as its distance
            counts from there. None where it need not stand.
        interrupts: it does not wait for the end of a motion under way.
        zeroes: the guest's counter has this value afterwards.
        zeroes_home: it is 0 at the captured home position afterwards.
    """

    command: AxisCommand[CommandReply] | None = None
    from_rest: Trajectory | None = None
    interrupts: bool = False
    zeroes: int | None = None
    zeroes_home: bool = False


class GuestHome(Home):
    """The search of a program: its drive would capture, stop there, and do nothing else."""

    alone = True


NOTHING = Meaning(interrupts=True)


class GuestServo:
    """One drive as its guest commands it.

    Attributes:
        drive: the drive.
        zero: count of the drive at which the guest's counter is 0.
        armed: how the guest has armed the capture of a home position; 0 for not at all. It stays so until a search has
            captured one, however many end without: "reset to zero once the home position has been captured" (LS-182AP
            manual, "System status").
        homing: id of the search that it has begun; empty without one.
        running: likewise of its motion in velocity mode, and of a search that is one.
        slews_at_s: when that has reached its velocity, in loop time.
    """

    def __init__(self, drive: LdcnAxis, status: Callable[[], StatusView], client: str) -> None:
        self.drive, self._status, self._client = drive, status, client
        # a home position keeps its number when the counter gets another zero, and when the next search begins
        self.zero = self._home_zero = self._search_zero = 0
        self._has_home = False  # its home register is 0 from a Hard Reset until a search of its own has captured
        self._found = False  # its latest search has
        self.homing = ""
        self._misplaced = False  # it has set its counter, and that was not done
        self._divisor: int | None = None  # of the servo rate that it has set last; None if it has set none
        self.restart()

    def hard_reset(self) -> None:
        """Begin at 0, as after a Hard Reset: "position ... set to zero" (PIC-SERVO manual, 4.1)."""
        self.restart()
        self.set_zero(self.drive.state.counts, 0)
        self._has_home = self._found = False
        self._misplaced, self._divisor = False, None

    def restart(self) -> None:
        """Forget what the guest has loaded, as its drive does with a reset; the next program finds its counter."""
        self._registers = self._runs = Trajectory()  # what is loaded, and what its motion was begun by
        self._holds = False  # the guest's drive has its servo on, whatever its amplifier does
        self.look()
        self.armed = _NO_HOMING
        self.homing = self.running = self._begun = ""  # the last is of any command
        self.slews_at_s = 0.0
        self._goes_on = False  # its motion in velocity mode has become a search, which on its drive begins nothing anew

    def home(self, wire_counts: int) -> int:
        """Return the guest's home register for that of the drive."""
        self.look()
        return self._shown(wire_counts, self._home_zero) if self._has_home else 0

    def look(self) -> None:
        """Take note of what its search has captured, and of its end; one that ends without has found nothing."""
        if not self.homing:
            return
        status = self._status()
        under_way = status.is_at(self.homing)
        # a search begins without a reference, and nothing but its capture gives it one
        if not self._found and (status.referenced if under_way else status.has_done(self.homing)):
            self._has_home, self._found, self._home_zero = True, True, self._search_zero
        if not under_way:
            self.homing, self._goes_on = "", False
            if self._found:
                self._holds = self._holds and not self.armed & _LEAVES_OFF
                self.armed = _NO_HOMING

    def require_home(self) -> None:
        """Refuse what needs the home position that the guest's latest search was to capture.

        Raises:
            NotSupported: it has captured none.
        """
        self.look()
        if not self._found:
            raise NotSupported("the latest search of the program has captured no home position")

    def counter(self, wire_counts: int) -> int:
        """Return the guest's counter for that of the drive; 32 bits, signed."""
        return self._shown(wire_counts, self.zero)

    def _shown(self, wire_counts: int, zero: int) -> int:
        counts = wire_counts + self.drive.state.offset_counts - zero
        return (counts + (1 << 31)) % (1 << 32) - (1 << 31)

    def set_zero(self, counts: float, value: int) -> None:
        """Let the guest's counter have a value where the drive's count is this."""
        self.zero = round(counts) - value

    def missed(self, command: ReceivedCommand) -> None:
        """Take note of a command that the guest counts on and that was not done, or perhaps not."""
        self._goes_on = False
        match command:
            case ResetPosition():
                self._misplaced = True
            case SetGain(gains):
                self._divisor = gains.sr

    def begun(
        self, command: AxisCommand[CommandReply], command_id: str, now_s: float, starts: Trajectory | None
    ) -> None:
        """Take note that a command of the guest is under way, with the trajectory that it was started by."""
        self.look()
        self.homing = self.running = ""
        self._begun = command_id
        self._goes_on = self._goes_on and isinstance(command, Home)
        if isinstance(command, Home):
            self.homing = command_id
        if starts:
            self._runs = starts
        if isinstance(command, Home | MoveVelocity) and starts and starts.mode is ProfileMode.VELOCITY:
            self.running = command_id
            self.slews_at_s = now_s + abs(command.velocity or 0.0) / (command.acceleration or math.inf)

    def flags(self, flags: StatusFlag, now_s: float) -> StatusFlag:
        """Return the status byte as a drive would send it that has the guest's commands itself.

        In velocity mode MOVE_DONE says that the velocity is reached (PIC-SERVO manual, 5.3); the daemon runs with
        trapezoids that end by themselves. Else it says that the move is over; the drive may have only its first part,
        past the goal, to come back from one side.
        """
        self.look()
        status = self._status()
        if self.armed:
            flags |= StatusFlag.HOME_IN_PROGRESS
        if self._goes_on or (self.running and status.is_at(self.running)):
            reached = now_s >= self.slews_at_s
            flags = flags | StatusFlag.MOVE_DONE if reached else flags & ~StatusFlag.MOVE_DONE
        elif self._begun and status.is_at(self._begun) and status.goes_on:
            flags &= ~StatusFlag.MOVE_DONE
        return flags

    def takes(self, command: ReceivedCommand) -> Trajectory | None:
        """Load what a command loads, when it comes; return the trajectory that it starts, None for none.

        What it starts is kept with it: others may have been loaded when its turn comes, or it never does.
        """
        match command:
            case LoadTrajectory(trajectory):
                self._load(trajectory)
                return self._registers if trajectory.start_now else None
            case PlainCommand(CommandCode.START_MOTION):
                return self._registers
        return None

    def meaning(self, command: ReceivedCommand, starts: Trajectory | None = None) -> Meaning:
        """Return what a command means now.

        Args:
            command: of the guest.
            starts: what `takes` has returned for it.

        Raises:
            NotSupported: there is no command of an axis that does the same.
            StopLatched: it would renumber an axis whose stop is latched.
        """
        if starts:
            return self._start(starts)
        match command:
            case LoadTrajectory():
                return NOTHING
            case PlainCommand(CommandCode.CLEAR_STICKY_BITS):
                return Meaning(Reset(faults_only=True, client=self._client))
            case StopMotor():
                return self._stop(command)
            case SetGain(gains):
                return self._gains(gains)
            case SetHomingMode(control):
                self.look()
                if self.homing and control == self.armed:
                    return NOTHING  # it is what its search looks for already
                self.armed, self.homing = control, ""
                return self._arm_in_motion() if control else NOTHING
            case ResetPosition(relative_to_home=True):
                self._misplaced = False  # unless it is refused, or one behind it is dropped
                return Meaning(zeroes_home=True)
            case ResetPosition(position):
                self._misplaced = False
                # it is sent at the start of many programs: after a stop a person expects the axis where it was stopped
                if self._status().stop_latched:
                    raise StopLatched("a stop is latched: the position is kept until `reset`")
                place = position / self._status().scale.counts_per_unit
                return Meaning(SetPosition(position=place, client=self._client), zeroes=position)
            case _:
                raise NotSupported("no command of an axis does the same")

    def _load(self, new: Trajectory) -> None:
        held = self._registers
        kept = {
            name: getattr(held, name) if getattr(new, name) is None else getattr(new, name)
            for name in ("position", "velocity", "acceleration", "pwm_or_target")
        }
        self._registers = replace(new, **kept, start_now=False)

    def stopped(self, control: StopControl) -> None:
        """Take note of a Stop Motor of the guest."""
        if control & WAYS_TO_STOP:
            self._goes_on = False
            self._holds = not control & StopControl.MOTOR_OFF

    def _stop(self, command: StopMotor) -> Meaning:
        control, enabled = command.control, self._status().enabled
        if control & StopControl.HERE:
            raise NotSupported("it would go to a position without a profile")
        if control & StopControl.AMP_ENABLE and self._holds and not enabled:
            return Meaning(Power(on=True, client=self._client))
        found = relief(command, self._client)  # the power driver alone is switched with the loop
        return NOTHING if found is None else Meaning(found, interrupts=True)

    def _gains(self, gains: Gains) -> Meaning:
        held, self._divisor = self.drive.wanted_gains, gains.sr
        if gains == held and self.drive.holds_gains:
            return NOTHING
        if gains.step_multiplier != (held.step_multiplier if held else 1):
            raise NotSupported("the step multiplier is set by the configuration")
        values = {each.name: getattr(gains, each.name) for each in fields(gains) if each.name != "step_multiplier"}
        return Meaning(SetGains(client=self._client, **values))

    # -- motion ------------------------------------------------------------------------------------------------------

    def _start(self, loaded: Trajectory) -> Meaning:
        self.look()
        if self.homing and self._found:
            self.armed = _NO_HOMING  # it comes to rest behind its capture: what follows is no search
        if not loaded.servo:
            if loaded.pwm_or_target:
                raise NotSupported("a raw duty has no end: the drive goes on when its program is gone")
            return Meaning(Power(on=False, client=self._client), interrupts=True)
        if loaded.pwm_or_target and loaded.mode is ProfileMode.VELOCITY and self.drive.profile.analog_target:
            raise NotSupported("a motion to an analog value has limits of its own: use move_analog")
        if loaded.mode is ProfileMode.VELOCITY:
            return self._run(loaded)
        return self._go(loaded)

    def _rates(self, loaded: Trajectory) -> tuple[float, float | None]:
        """Return velocity and acceleration in axis units; the default of the axis for one that was never loaded.

        Raises:
            NotSupported: the guest counts them in periods that the drive does not have.
        """
        gains, profile = self.drive.wanted_gains, self.drive.profile
        divisor, scale = (gains.sr if gains else 1), abs(self._status().scale.counts_per_unit)
        velocity = velocity_counts_per_s(loaded.velocity or 0, divisor, profile) / scale
        acceleration = acceleration_counts_per_s2(loaded.acceleration or 0, divisor, profile) / scale
        if velocity and profile.divisor_slows_profile and self._divisor not in (None, divisor):
            raise NotSupported(
                f"the program has set the servo rate divisor {self._divisor}, and the drive has {divisor}: it would"
                " move at another speed"
            )
        return velocity, acceleration or None

    def _arm_in_motion(self) -> Meaning:
        """Make a search of the motion under way: a drive that is armed in it stops where it captures."""
        status = self._status()
        if self.running and status.is_at(self.running):
            self._goes_on = True
            return self._run(self._runs)
        if self._begun and status.is_at(self._begun) and status.target_counts is not None:
            return self._go(replace(self._runs, position=status.target_counts - self.zero, relative=False))
        return NOTHING

    def _run(self, loaded: Trajectory) -> Meaning:
        velocity, acceleration = self._rates(loaded)
        if not velocity:
            return Meaning(Halt(client=self._client), interrupts=True)
        forward = loaded.reverse is (self._status().scale.counts_per_unit < 0)
        if self.armed:
            return Meaning(self._home(velocity if forward else -velocity, acceleration, None), from_rest=loaded)
        return Meaning(
            MoveVelocity(
                velocity=velocity if forward else -velocity,
                acceleration=acceleration,
                buffer_mode=BufferMode.ABORTING,
                client=self._client,
            ),
            interrupts=True,
        )

    def _go(self, loaded: Trajectory) -> Meaning:
        status, scale = self._status(), self._status().scale
        velocity, acceleration = self._rates(loaded)
        here = self.drive.state.counts if status.target_counts is None else status.target_counts
        if loaded.position is None:
            raise NotSupported("the program has loaded no position since it opened its port or reset its modules")
        target = here + loaded.position if loaded.relative else loaded.position + self.zero
        if not status.enabled and target == self.drive.state.counts:
            return NOTHING  # how a program initialises a drive: where it stands, with its motor off
        if self._misplaced and not loaded.relative:
            raise NotSupported("its counter is not what the program has set it to: set it again, or reset its module")
        if not velocity:
            raise NotSupported("it has no velocity")
        way = (target - here) / scale.counts_per_unit
        if self.armed:
            if not way and status.command is None:
                return NOTHING  # a profile without a way finds nothing: the search stays armed
            home = self._home(velocity if way > 0 else -velocity, acceleration, abs(way) or None)
            return Meaning(home, from_rest=loaded)
        if loaded.relative or scale.modulo is not None or not status.referenced:
            distance = MoveRelative(distance=way, velocity=velocity, acceleration=acceleration, client=self._client)
            return Meaning(distance, from_rest=loaded)
        return Meaning(
            MoveAbsolute(
                position=scale.position(target),
                velocity=velocity,
                acceleration=acceleration,
                buffer_mode=BufferMode.ABORTING,
                client=self._client,
            ),
            interrupts=True,
        )

    def _home(self, velocity: float, acceleration: float | None, distance: float | None) -> Home:
        armed = self.armed
        method = _method(self.drive.profile, armed & ~STOPS_ON_HOME)
        stop = _STOPS.get(armed & STOPS_ON_HOME)
        if method is HomeMethod.POSITION_ERROR:
            stop = HomeStop.OFF  # the error has opened the loop, and a drive does not close it by itself
        if stop is None and self.drive.profile.stops_on_home:
            raise NotSupported("a drive would go on behind its home position: homing that is armed stops there")
        # from here on: if it is not known whether the search has begun, its home position is not either
        self.homing, self._found, self._search_zero = "", False, self.zero
        return GuestHome(
            method=method,
            velocity=velocity,
            acceleration=acceleration,
            distance=distance,
            stop=stop or HomeStop.SMOOTH,
            client=self._client,
        )


def _method(profile: Profile, sources: HomingControl) -> HomeMethod:
    for method in HomeMethod:
        if homing_source(profile, method) == sources:
            return method
    raise NotSupported("a home position has one signal, and the program has armed several")
