"""The contracts between the daemon and one drive: a `Drive` for each that is configured, and what it can do.

The line that it is on is a `Network`, in network.py. Values are encoder counts and
seconds; units, limits, states and authority are the daemon's.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any

from ldcnd.contract.commands import HomeMethod, PinMode, Verb
from ldcnd.contract.errors import BusError, NotSupported
from ldcnd.contract.meta import RegisterInfo
from ldcnd.contract.samples import MonitorName, TelemetryItem
from ldcnd.drives.parameter_access import MonitorValue, ParameterAccess
from ldcnd.drives.tracer import Tracer
from ldcnd.line.exchange import Exchange, Poller, Timing

LARGEST_COUNT = 0x7FFF_FFFF
"""Of a position counter of 32 bits, in either direction."""


class StopMode(Enum):
    """How a motor is brought to rest."""

    SMOOTH = "smooth"
    """Decelerate, then hold."""
    ABRUPT = "abrupt"
    """Hold the present position at once."""
    OFF = "off"
    """Open the loop and disable the amplifier: the motor coasts."""


@dataclass(frozen=True, slots=True)
class Fault:
    """Something the drive complains about.

    Attributes:
        code: stable code.
        text: what it means and what to do.
        stops: the drive has switched the motor off; false for a warning.
        loses_position: what the drive counts from then on is not where the axis is: it needs a new reference.
        hides_motion: shaft and encoder did not go where they were sent, or no encoder is seen: what the drive counts
            from then on does not prove that the axis stands.
        pushed: the motor has pushed with all its current, and nothing gave way, or the encoder did not count that.
    """

    code: str
    text: str
    stops: bool = True
    loses_position: bool = False
    hides_motion: bool = False
    pushed: bool = False


@dataclass(frozen=True, slots=True)
class PartialReading:
    """Which parts of a reading a poll has renewed, where no single exchange brings all of it.

    Attributes:
        behind_s: seconds from the request of the oldest word of state and rest to that of this poll.
        position: it has brought the position; otherwise that is the one of before.
        recounted: the counter may have been cleared since the last position: their difference is no distance.
    """

    behind_s: float
    position: bool
    recounted: bool = False


@dataclass(frozen=True, slots=True)
class AxisReading:
    """The values of one poll; position, velocity and state always, other items None when they were not polled.

    Attributes:
        position_counts: actual position.
        following_error_counts: commanded minus actual position.
        velocity_counts_per_s: actual velocity, positive in counting direction.
        velocity_resolution_counts_per_s: the smallest velocity the drive can report.
        adc_counts: analog input.
        enabled: the position loop is closed.
        profile_done: no profile is running (in velocity mode: the commanded velocity is reached).
        homing: armed for a home capture that has not come yet.
        captured: the home capture that this host has armed last has come, and nothing else has ended it.
        faults: what the drive complains about.
        reverse_limit: level of that limit switch input, `forward_limit` of the other; None while it is not shown.
        index: level of the encoder's index; None while it is not shown.
        stop_input: the drive's stop input is open; None while it is not shown.
        amplifier_enable: what the drive holds; None while that is not known.
        asked: the items of this poll; the line may have requested others since.
        cut_short: why the drive ended the motion before its end, by itself; empty when it did not.
        begun_anew: its own counter reads about 0, as after a reset.
        altered: what this host has not done to it and yet shows; empty when nothing does.
        velocity_uncertain: the servo rate, on which the scale of the velocity depends, is not confirmed: the velocity
            is the highest that it can be.
        position_uncertain: it was read as another one, and corrected by what was known of it.
        pieces: what of it is new; None where one exchange has brought all of it.
    """

    position_counts: int
    following_error_counts: int | None
    velocity_counts_per_s: float
    velocity_resolution_counts_per_s: float
    adc_counts: int | None
    enabled: bool
    profile_done: bool
    homing: bool
    faults: tuple[Fault, ...]
    captured: bool = False
    reverse_limit: bool | None = None
    forward_limit: bool | None = None
    index: bool | None = None
    stop_input: bool | None = None
    amplifier_enable: bool | None = None
    asked: frozenset[TelemetryItem] = frozenset()
    cut_short: str = ""
    begun_anew: bool = False
    altered: str = ""
    velocity_uncertain: bool = False
    position_uncertain: bool = False
    pieces: PartialReading | None = None

    def held_away_counts(self, target_counts: int, lags_counts: float) -> float:
        """Return how far from there its drive holds the axis; 0 where its loop may pull it there yet.

        Args:
            target_counts: where it was sent.
            lags_counts: how far its loop may lag, for a reading that does not tell how far it does.
        """
        lags = lags_counts if self.following_error_counts is None else abs(self.following_error_counts)
        return max(0.0, abs(target_counts - self.position_counts) - lags)

    def ended_beside(self, target_counts: int, lags_counts: float, within_counts: float) -> bool:
        """Tell whether its profile is done, and its drive holds the axis farther than this from there."""
        return self.profile_done and self.held_away_counts(target_counts, lags_counts) > within_counts


@dataclass(frozen=True, slots=True)
class CountsMotion:
    """A motion in counts: a target for a trapezoid, None for a constant velocity.

    Attributes:
        target_counts: where to stop, or None to run on.
        velocity_counts_per_s: positive for a trapezoid; signed for a constant velocity.
        acceleration_counts_per_s2: positive.
        servo_divisor: with which the registers of the drive hold just these values; None before they are rounded.
        by_s: latest instant, in loop time, to send a packet of it: its target follows from where the axis was in a
            reading, and would lie behind it later. Infinite where it does not.
        stays: its target is where the drive commands its shaft already: it leads onto no limit switch.
    """

    target_counts: int | None
    velocity_counts_per_s: float
    acceleration_counts_per_s2: float
    servo_divisor: int | None = None
    by_s: float = math.inf
    stays: bool = False


@dataclass(frozen=True, slots=True)
class Ceiling:
    """Limits that hold after rounding to registers, too; infinite for none.

    Attributes:
        velocity_counts_per_s: highest speed.
        acceleration_counts_per_s2: highest acceleration.
        duty: highest raw duty, 0 to 1.
    """

    velocity_counts_per_s: float = math.inf
    acceleration_counts_per_s2: float = math.inf
    duty: float = math.inf


NO_CEILING = Ceiling()
ROUNDING = 1e-9
"""Relative error of a conversion to floating point and back: it is no excess over a limit."""


def inward(rounded: int, most: float, least: float = -math.inf) -> int:
    """Return what was rounded, or the nearest whole number within these bounds where rounding has led out of them."""
    if rounded > most:
        return math.floor(most)
    return math.ceil(least) if rounded < least else rounded


def sensed_counts(full_scale: int) -> int:
    """Return how close to its target an analog motion counts as having reached it, in counts of the A/D converter.

    One value that noise has put onto the target ends it in the drive.

    Args:
        full_scale: of the converter.
    """
    return max(2, full_scale // 128)


@dataclass(frozen=True, slots=True)
class AnalogMotion:
    """A motion to a value of the analog position sensor; the drive finds the direction.

    Attributes:
        target_counts: of the A/D converter.
        velocity_counts_per_s: encoder counts, positive.
        acceleration_counts_per_s2: positive.
        servo_divisor: see `CountsMotion`.
    """

    target_counts: int
    velocity_counts_per_s: float
    acceleration_counts_per_s2: float
    servo_divisor: int | None = None


@dataclass(frozen=True, slots=True)
class PwmOutput:
    """A raw duty on the motor, with the position loop open.

    Attributes:
        duty: -1 to 1, positive in counting direction.
        acceleration_counts_per_s2: at which a smooth stop ends it.
        servo_divisor: see `CountsMotion`.
    """

    duty: float
    acceleration_counts_per_s2: float
    servo_divisor: int | None = None


@dataclass(frozen=True, slots=True)
class HomeCapture:
    """The signal that captures the home position during the motion, and how the motor stops then.

    A drive that cannot stop by itself runs on until it is stopped.

    Attributes:
        method: what captures.
        stop: how the motor stops.
        also: what else does; the first that comes counts.
        guarded: the limit switch ahead captures and stops, too, where the configuration has the drive stop on it.
    """

    method: HomeMethod
    stop: StopMode = StopMode.SMOOTH
    also: frozenset[HomeMethod] = frozenset()
    guarded: bool = False


@dataclass(frozen=True, slots=True)
class Gains:
    """Registers of the position loop, as in the manuals of the drives (Set Gain).

    Attributes:
        kp: position gain, 0 to 0x7FFF.
        kd: derivative gain, 0 to 0x7FFF.
        ki: integral gain, 0 to 0x7FFF.
        il: integration limit, 0 to 0x7FFF; the drive multiplies it by 256.
        ol: PWM output limit, 0 to 255; the LS-182AP manual recommends 250.
        cl: current limit, 0 to 255, odd when the sense voltage rises with the current; 0 is off, and the only value on
            Logosol drives.
        el: position error limit, 0 to 0x3FFF counts; 0x7FFF on PIC-SERVO SC.
        sr: servo rate divisor, 1 to 255.
        deadband: amplifier deadband compensation, 0 to 255; 0 on PIC-SERVO versions 1 to 3.
        step_multiplier: 1 to 255; 1 on everything but PIC-SERVO SC.
    """

    kp: int
    kd: int
    ki: int
    il: int
    ol: int
    cl: int
    el: int
    sr: int
    deadband: int = 0
    step_multiplier: int = 1


@dataclass(frozen=True, slots=True)
class AxisSpec:
    """The configuration of one drive.

    Attributes:
        name: of the axis.
        address: node address, 1 to 127.
        model: profile name of the family.
        gains: loaded at power-on; without them the loop stays open.
        identity: id and version that this drive reports although the family's table does not list them for the model.
        limit_stop: level of the limit switch inputs at which the drive itself stops a motion towards them; None when
            they are left alone.
    """

    name: str
    address: int
    model: str
    gains: Gains | None
    identity: tuple[int, int] | None = None
    limit_stop: bool | None = None


@dataclass(frozen=True, slots=True)
class ReadingListeners:
    """Whom a family's own poller tells; none of them waits.

    Attributes:
        observed: of a reading and the items that are new in it.
        monitored: of a monitor.
        missed: of a poll that brought nothing.
        alarmed: of an alarm that the drive has entered in its own history since that was last read.
    """

    observed: Callable[[AxisReading, frozenset[TelemetryItem], Timing], None]
    monitored: Callable[[MonitorValue, Timing], None]
    missed: Callable[[BusError], None]
    alarmed: Callable[[Fault], None]


@dataclass(frozen=True, slots=True)
class PathStatus:
    """What a drive shows of a path.

    Attributes:
        commanded_counts: where it commands its motor to be.
        points: still in its buffer.
        running: it walks through them.
        enabled: its loop is closed.
        timing: when that was so.
    """

    commanded_counts: int
    points: int
    running: bool
    enabled: bool
    timing: Timing


@dataclass(frozen=True, slots=True)
class Evidence:
    """The drive's evidence about the time since its position was last known.

    Attributes:
        counts: position, in counts since the drive was reset, as this host counts them.
        counter: the same as the drive itself counts it, which another host reads, too.
        mark: what the register for marks holds; 0 after a reset.
        enabled: the position loop is closed.
        position_lost: it may have missed counts.
    """

    counts: int
    counter: int
    mark: int
    enabled: bool
    position_lost: bool


def cannot(spec: AxisSpec, what: str) -> NotSupported:
    """Return the refusal of what a drive cannot do."""
    return NotSupported(f"axis {spec.name}: {spec.model} cannot {what}", axis=spec.name)


async def nothing() -> None:
    """Do nothing."""


class Drive(ABC):
    """One drive, as far as all are alike.

    An exchange says what it does (`Exchange.effect`): the bus checks the permit of one that changes anything when its
    turn has come, and that the drive is known to be this one.

    Attributes:
        spec: what the configuration says.
        identity: what the drive said it is; None before bring-up.
        capabilities: the truth about what the family and the model can do.
        adc_full_scale: counts of the A/D converter at full scale; None without one.
        shows_inputs: its readings carry the levels of its inputs.
        monitors: what is published beside the common items.
        tracer: of the drive's own recorder; None without one.
        parameters: the drive's parameters; None where they cannot be read.
    """

    spec: AxisSpec
    identity: str | None
    capabilities: frozenset[Verb]
    adc_full_scale: int | None = None
    shows_inputs: bool = False
    monitors: tuple[MonitorName, ...] = ()
    tracer: Tracer | None = None
    parameters: ParameterAccess | None = None

    def registers(self) -> tuple[RegisterInfo, ...]:
        """Return what is known of registers that cannot be read back."""
        return ()


class Readable(Drive):
    """One exchange reads it."""

    @abstractmethod
    def reading(self, items: frozenset[TelemetryItem]) -> Exchange[AxisReading]:
        """Build the exchange that reads these items besides position, velocity and the drive's state."""


class PollsItself(Drive):
    """One exchange cannot read it: its family has a poller for it."""

    @abstractmethod
    def own_poller(self, start_at_s: float, listeners: ReadingListeners) -> Poller[Any]:
        """Return the poller, which begins at an instant of the loop's clock."""


class QuietDrive(Readable):
    """The calls to a drive that moves which need no permission: none of them can make it move.

    What only some drives can do refuses here with `NotSupported`; `capabilities` and the attributes say who can.

    Attributes:
        retargets: it takes a new trapezoid in mid-move and keeps velocity and acceleration within their limits.
        wanted_gains: what is loaded at power-on, and before a motion where the drive is not known to hold it: what was
            acknowledged last, before that the configuration's; None without either. It may be set to others.
        holds_gains: the drive is known to hold them; a drive whose gains are not loaded by the host holds its own.
        home_methods: what can mark the reference position; none for a drive that captures nothing.
        capture_s: sampling period of the capture inputs: a shorter pulse can be missed, and the captured position
            lags by up to the distance moved in this time.
        deceleration_counts_per_s2: at which a smooth stop would brake now; None while that is not known.
        path_period_s: between two points of a path; 0 for a drive that walks none.
        path_packet: maximum number of points in one packet.
        path_most_counts: largest step from one point to the next.
    """

    retargets: bool = False
    wanted_gains: Gains | None = None
    holds_gains: bool = True
    home_methods: frozenset[HomeMethod] = frozenset()
    capture_s: float = 0.0
    deceleration_counts_per_s2: float | None = None
    path_period_s: float = 0.0
    path_packet: int = 0
    path_most_counts: int = 0

    @abstractmethod
    def quantise(self, motion: CountsMotion, most: Ceiling = NO_CEILING, *, in_motion: bool = False) -> CountsMotion:
        """Return the motion as the drive's registers will hold it: the nearest values that are not above these.

        Args:
            motion: in counts.
            most: its limits.
            in_motion: it is loaded while another is under way, so that no gains are loaded before it.

        Raises:
            ValueOutOfRange: a value does not fit its register, or the smallest one is above; says which one would do.
        """

    def quantise_output(self, output: PwmOutput, most: Ceiling = NO_CEILING) -> PwmOutput:  # noqa: ARG002 - refused
        """Return a raw duty as the drive's registers will hold it, as `quantise`.

        Raises:
            NotSupported: the drive takes none.
        """
        raise cannot(self.spec, "take a raw duty")

    @abstractmethod
    def exchanges(
        self, legs: Sequence[CountsMotion], here: AxisReading, gains: Gains | None
    ) -> tuple[Exchange[Any], ...]:
        """Return what `load` and `start` would change the drive with for motions one after another; nothing is sent.

        Args:
            legs: each begins where the one before has ended.
            here: where the first begins.
            gains: loaded before it; None for none.

        Raises:
            RequestRefused: as `load`.
        """

    def holds(self, gains: Gains) -> bool:  # noqa: ARG002 - it holds its own
        """Tell whether the drive is known to hold these gains."""
        return True

    def room_counts(self, *, forward: bool) -> int:  # noqa: ARG002 - part of the contract
        """Return how far the position counter reaches in a direction, from where the axis was last."""
        return LARGEST_COUNT

    @abstractmethod
    async def stop(self, mode: StopMode) -> StopMode:
        """Bring the motor to rest, before anything else that waits for the line; cancels an armed homing.

        Returns:
            How: a motor that was switched off, or is being, is switched off again whatever the request, as a stop that
            holds would close its loop.
        """

    @abstractmethod
    async def reset(self) -> None:
        """Clear the drive's faults as its manual prescribes; the loop is open afterwards if there were any."""

    async def clear_warnings(self) -> None:
        """Clear what is remembered although it has not stopped anything; the loop stays as it is."""

    async def captured_home(self) -> int:
        """Return the captured home position, in counts."""
        raise cannot(self.spec, "home")

    def stands_on(self, limit: HomeMethod, reading: AxisReading) -> bool:  # noqa: ARG002
        """Tell whether a reading shows the axis on a limit switch that ends its motions."""
        return False

    def check_path(self) -> None:
        """Refuse a path that this drive cannot walk.

        Raises:
            NotSupported: it has no path mode.
            WrongState: what it holds of its options is not known.
        """
        raise cannot(self.spec, "walk a path")

    def path_exchanges(self) -> tuple[Exchange[Any], ...]:
        """Return what `add_points` sends for a full packet, for looking at only."""
        return ()

    async def path_status(self) -> PathStatus:
        """Read what it shows of a path: points that are sent at a fixed rate; it stands at the last one."""
        raise cannot(self.spec, "walk a path")


class Moves(QuietDrive):
    """It moves. Commands raise the `BusError` that befell them; none is repeated when that could move twice.

    Attributes:
        keeps_mark: it has a register that a host can set to the present position, and that a reset clears. A mark that
            is still there proves that the drive was not reset since, so that its counter goes on from where it was.
        about_to_renumber: awaited before the drive's counter is given another number; it may refuse that.
    """

    keeps_mark: bool = False
    about_to_renumber: Callable[[], Awaitable[None]] = staticmethod(nothing)

    @abstractmethod
    async def power(self, *, on: bool) -> None:
        """Close the loop at the present position, or open it and disable the amplifier; nothing moves."""

    @abstractmethod
    async def load(
        self,
        motion: CountsMotion | AnalogMotion | PwmOutput,
        *,
        home: HomeCapture | None = None,
        stands_when_done: bool,
    ) -> None:
        """Prepare a motion, and the capture of a home position on the way; nothing moves.

        Args:
            motion: to prepare.
            home: what to capture.
            stands_when_done: once the drive shows a finished profile and no velocity, the axis is known to stand. In
                velocity mode a profile is finished as soon as the velocity is reached, which may be too slow to show.
                There is no default: a shaft that may creep must not get other gains.

        Raises:
            NotSupported: the drive has no such motion.
            ValueOutOfRange: a value does not fit its register.
            WrongState: it was rounded for another servo rate divisor than the drive has now.
            DriveFault: the sensor that the motion relies on is out of its range.
        """

    @abstractmethod
    async def start(self) -> None:
        """Start what was loaded; never repeated. What has met its limit switch by then is stopped: see `cut_short`."""

    async def set_gains(
        self,
        gains: Gains,  # noqa: ARG002 - as are all arguments of what refuses
        *,
        stands_when_done: bool,  # noqa: ARG002
    ) -> None:
        """Load the registers of the position loop, which act at once; see `load`.

        Raises:
            WrongState: the servo rate would change while the axis moves.
        """
        raise cannot(self.spec, "take gains")

    async def track(self, position_counts: int, *, stands_when_done: bool) -> None:  # noqa: ARG002
        """Go to a position at once, without a profile; never repeated. See `load`."""
        raise cannot(self.spec, "track")

    async def set_outputs(self, limit1: PinMode | None, limit2: PinMode | None) -> None:  # noqa: ARG002
        """Use limit switch pins as outputs or inputs; None leaves a pin as it is.

        Raises:
            NotSupported: the model cannot.
            RegisterUnknown: what a pin that is not named is used as is not known.
        """
        raise cannot(self.spec, "set outputs")

    async def add_points(self, steps: Sequence[int]) -> PathStatus:  # noqa: ARG002
        """Append points, counts from one to the next; never repeated."""
        raise cannot(self.spec, "walk a path")

    async def evidence(self) -> Evidence:
        """Read what the drive shows of the time since its position was last known.

        Raises:
            BusError: the line failed.
        """
        raise cannot(self.spec, "keep a mark")

    async def leave_mark(self) -> None:
        """Have the drive set the register to its position; nothing moves. The register may be that of captures.

        Raises:
            BusError: the line failed.
        """
        raise cannot(self.spec, "keep a mark")
