"""The configuration of one axis: its drive, its machine, and what it may do."""

import math
from collections.abc import Mapping
from enum import StrEnum
from fractions import Fraction
from typing import Any, ClassVar, Literal, Self

from pydantic import Field, model_validator

from ldcnd.contract.commands import HomeMethod, HomeStop, MotionKind
from ldcnd.contract.frozen import Frozen
from ldcnd.contract.meta import AxisLimits
from ldcnd.contract.plan import PollPriority
from ldcnd.contract.samples import TelemetryItem
from ldcnd.contract.units import AxisUnits, Dimension, Ratio, UnitTable, g_velocity, quantity_text, unit_table
from ldcnd.drives.driver import Gains
from ldcnd.drives.toml import CountsPerUnit, DeviceIdentity, Name

LEAST_TURN_COUNTS = 4
"""Of a rotary axis: one count must be no larger than the way to the other side."""
MOST_ORIGIN_COUNTS = 2**40
"""No place is called by a number farther off than this: a double still tells single counts well apart there."""
TURN_ROUNDING = 1e-15
"""Share of a turn by which the product of two doubles misses a whole number of counts that is meant."""


def turn_counts(modulo: float, counts_per_unit: float) -> float:
    """Return the encoder counts in a turn: a whole number where they are one but for the rounding of doubles."""
    turn = modulo * abs(counts_per_unit)
    off = math.remainder(turn, 1.0)
    return turn - off if abs(off) <= TURN_ROUNDING * turn else turn


def whole_turn(modulo: float, counts_per_unit: float) -> str:
    """Return, as a ratio, the counts per unit with which a turn is the nearest whole number of counts."""
    length = Fraction(str(modulo))
    return f"{round(modulo * abs(counts_per_unit)) * length.denominator}/{length.numerator}"


QUANTITIES: Mapping[str, Dimension] = {
    **dict.fromkeys(("velocity", "limits.velocity", "home.velocity", "home.find_velocity"), Dimension.VELOCITY),
    **dict.fromkeys(("acceleration", "limits.acceleration"), Dimension.ACCELERATION),
    **dict.fromkeys(("modulo", "limits.position_min", "limits.position_max", "home.position"), Dimension.POSITION),
    **dict.fromkeys(("home.distance", "home.move_to", "settle.window", "analog.distance"), Dimension.POSITION),
    **dict.fromkeys(("tracking.step", "approach.distance"), Dimension.POSITION),
}
"""Settings of an axis that may be written with a unit, and what they measure."""


def units_of_table(axis: Mapping[str, Any]) -> AxisUnits:
    """Return the units of an axis as its table in a file gives them.

    Raises:
        ValueError: the table does not make any.
    """
    try:
        unit, counts, radius_m = axis.get("unit", "count"), axis.get("counts_per_unit"), axis.get("radius_m")
        counts = Ratio(counts) if isinstance(counts, str) else counts
        table = unit_table(
            unit, counts, axis.get("velocity_unit"), axis.get("acceleration_unit"), axis.get("units", {})
        )
        return AxisUnits(unit, table, g_velocity(table, radius_m) if radius_m else None)
    except (AttributeError, TypeError) as error:
        raise ValueError(str(error)) from error


class GainsConfig(Frozen):
    """Registers of the position loop, as in the drive's manual; 0 < kp and 0 < el or the loop cannot close."""

    kp: int = Field(gt=0, le=0x7FFF)
    """Position gain."""
    kd: int = Field(default=0, ge=0, le=0x7FFF)
    """Derivative gain."""
    ki: int = Field(default=0, ge=0, le=0x7FFF)
    """Integral gain."""
    il: int = Field(default=0, ge=0, le=0x7FFF)
    """Integration limit; the drive multiplies it by 256."""
    ol: int = Field(default=250, gt=0, le=0xFF)
    """Output limit, of 255."""
    cl: int = Field(default=0, ge=0, le=0xFF)
    """Current limit: odd values for a sense voltage that rises with the current, 0 for none; PIC-SERVO only."""
    el: int = Field(gt=0, le=0x7FFF)
    """Position error, in counts, beyond which the drive opens its loop; at most 16383, PIC-SERVO SC 32767."""
    sr: int = Field(default=1, ge=1, le=0xFF)
    """Servo rate divisor: the servo cycle is this number times 0.512 ms."""
    deadband: int = Field(default=0, ge=0, le=0xFF)
    """Added to the amplifier's output around zero."""

    @property
    def registers(self) -> Gains:
        """The same as a drive holds it, where other values may be, too."""
        return Gains(**self.model_dump())


class HomeConfig(Frozen):
    """How `home` searches when the request does not say."""

    method: HomeMethod
    """Signal that marks the reference position."""
    velocity: float
    """Units a second, positive forward; on the index at most 0.75 of an index width in a servo cycle."""
    find_velocity: float | None = Field(default=None, gt=0)
    """Speed at which a limit switch is found first, units a second; the reference is then taken over at `velocity`."""
    index_width: int = Field(default=1, ge=1)
    """Counts for which the index pulse lasts: 1 for one that is gated with both tracks, 4 for one that is not."""
    position: float = 0.0
    """Value of the reference position, in axis units."""
    timeout_s: float = Field(default=60.0, gt=0, le=3600)
    """Longest search, in seconds."""
    distance: float | None = Field(default=None, gt=0)
    """Longest search, in axis units."""
    stop: HomeStop = HomeStop.SMOOTH
    """How the motor stops there."""
    move_to: float | None = None
    """Position to move to afterwards, in axis units."""
    switch_active: Literal["high", "low"] = "high"
    """Level of a limit switch input while the switch is actuated."""


class SettleConfig(Frozen):
    """Condition at which a motion to a target is done: its profile has ended and the axis stays near the target."""

    window: float | None = Field(default=None, gt=0)
    """How far from the target it may be, in axis units; without it 1/400 of the position error limit `el`, at least 5 \
counts."""
    time_s: float = Field(default=0.05, ge=0, le=10)
    """Time for which the axis must have stayed within the window, in seconds."""
    timeout_s: float = Field(default=1.0, gt=0, le=60)
    """Longest time for that, from the end of the profile, in seconds."""
    unsettled: Literal["report", "fault"] = "report"
    """Reaction when it takes longer: report ends the motion as done with `settled` false, and an event; fault as \
failed, with the fault `not_settled`."""

    stalls: bool = False
    """What it meets may stop the axis (a gripper); else standing in mid-motion costs power and reference."""

    @model_validator(mode="after")
    def _reachable(self) -> Self:
        if self.timeout_s <= self.time_s:
            raise ValueError(f"settle.timeout_s {self.timeout_s:g} is not above settle.time_s {self.time_s:g}")
        return self


class PwmConfig(Frozen):
    """Bounds of `set_pwm`; without this table the axis refuses it."""

    duty: float = Field(gt=0, le=1)
    """Highest duty in either direction."""
    duration_s: float = Field(default=10.0, gt=0, le=600)
    """Longest time that a duty stays on."""


class AnalogConfig(Frozen):
    """Bounds of `move_analog` when the request names none; the daemon keeps them, the drive has none."""

    timeout_s: float = Field(default=10.0, gt=0, le=3600)
    """Longest motion, in seconds."""
    distance: float | None = Field(default=None, gt=0)
    """Longest way from where it begins, in axis units; without it as far as the velocity goes in the time."""


class TrackingConfig(Frozen):
    """Bounds of `track`; without this table the axis refuses it."""

    step: float = Field(gt=0)
    """Longest way from one set-point to the next, in axis units; must stay below the position error limit `el`."""
    rate: float = Field(gt=0, le=500)
    """Most set-points a second."""


class ApproachConfig(Frozen):
    """Side from which a move comes to its goal, where the mechanics have play."""

    direction: Literal["positive", "negative"]
    """The direction of the last motion."""
    distance: float = Field(gt=0)
    """How far before the goal it begins, in axis units: more than the play."""

    @property
    def signed(self) -> float:
        """The last motion, in axis units."""
        return self.distance if self.direction == "positive" else -self.distance


class LossPolicy(StrEnum):
    """Reaction of an axis to the loss of a client, the line or the daemon."""

    RUN_TO_TARGET = "run_to_target"
    """Let the motion end by itself; every motion of a referenced axis with limits ends in the drive. What has
    no end there is halted: a raw duty at any loss, the others when the daemon ends, which ends them while it runs."""
    HALT = "halt"
    """Decelerate, then hold."""
    QUICK_STOP = "quick_stop"
    """Hold the present position at once."""
    POWER_OFF = "power_off"
    """Open the loop: the motor coasts, a hanging load falls."""


class LossConfig(Frozen):
    """Reaction of the axis to the loss of a client, the line or the daemon in mid-motion."""

    client: LossPolicy = LossPolicy.HALT
    """The lease under which it moves was not renewed; no further motion begins."""
    bus: LossPolicy = LossPolicy.HALT
    """The line was lost; acts as soon as it is back and the drive still moves."""
    daemon: LossPolicy = LossPolicy.HALT
    """The daemon is shut down; `run_to_target` halts what no drive ends."""


class RatesConfig(Frozen):
    """How often an item is published, in Hz; 0 for never."""

    position: float = Field(default=10.0, ge=0, le=2000)
    """Position, with the following error where the drive reports it."""
    velocity: float = Field(default=10.0, ge=0, le=2000)
    """Velocity."""
    adc: float = Field(default=2.0, ge=0, le=2000)
    """Analog input."""
    state: float = Field(default=5.0, gt=0, le=2000)
    """The drive's status and state; cannot be switched off, faults come with it."""

    def wanted_hz(self, *, adc: bool) -> Mapping[TelemetryItem, float]:
        """Return the items that are polled and how often; `adc` tells whether the drive has a converter."""
        wanted = {
            TelemetryItem.POSITION: self.position,
            TelemetryItem.VELOCITY: self.velocity,
            TelemetryItem.ADC: self.adc if adc else 0.0,
            TelemetryItem.STATE: self.state,
        }
        return {item: rate for item, rate in wanted.items() if rate > 0}

    @property
    def heard_hz(self) -> float:
        """How often the drive is heard, in Hz."""
        return max(self.position, self.velocity, self.state)

    @property
    def proven_hz(self) -> float:
        """How often all is read that tells its state, its place and whether it moves, in Hz: with each poll."""
        return self.heard_hz

    @property
    def slowest(self) -> str:
        """The items whose rates hold that back; empty where any poll tells all."""
        return ""


class AxisConfig(Frozen):
    """One drive on a line; a family says which keys its drives need or do not have."""

    reloadable: ClassVar[tuple[str, ...]] = ()
    """Keys that may change while the daemon runs."""

    name: Name
    """Its chunk in every key; unique on the rig."""
    model: str
    """The drive model."""
    address: int = Field(ge=0, le=127)
    """Node address or unit number."""
    unit: str = "count"
    """Unit of its positions; programs have velocities in it a second, accelerations in it a second squared. A number
    may be written as a text with another unit that fits: velocity = "3000 rpm"."""
    velocity_unit: str | None = None
    """Unit in which people read velocities, and in which they are meant without a unit, here and where they are typed,
    such as rpm; without it `unit` a second."""
    acceleration_unit: str | None = None
    """Unit of accelerations likewise, such as rpm/s; without it `unit` a second squared."""
    units: Mapping[str, str] = {}
    """Further units by name, each with how many of `unit` it is, exactly: { turn = "1/3" }."""
    radius_m: float | None = Field(default=None, gt=0)
    """Radius of a rotor, in metres: its velocities are shown with the acceleration there, and taken in g."""
    counts_per_unit: CountsPerUnit | None = None
    """Encoder counts per unit, or a ratio as text: "10000/360". Without it the axis works in counts and says so."""
    direction: Literal["forward", "reverse"] = "forward"
    """Sign between counts and units; with reverse, forward in axis units is backward in encoder counts."""
    modulo: float | None = Field(default=None, gt=0)
    """A rotary axis: positions repeat after this distance in axis units, such as 360: whole counts, unless
    `counts_per_unit` is a ratio. It turns endlessly, and takes no position limits."""
    velocity: float = Field(default=0.0, ge=0)
    """Velocity of moves that do not name one, units a second; 0 for a drive that takes no motion over its line."""
    acceleration: float = Field(default=0.0, ge=0)
    """Acceleration of moves that do not name one, units a second squared; 0 likewise."""
    limits: AxisLimits = AxisLimits()
    """Software limits, in axis units."""
    gains: GainsConfig | None = None
    """Gains of the position loop, registers as in the drive's manual; without them this drive's loop stays open."""
    gain_sets: Mapping[Name, GainsConfig] = {}
    """Further sets of gains by name, with the `sr` of `gains`; `set_gains` loads one by its name."""
    gains_for: Mapping[MotionKind, Name] = {}
    """Set of gains for each kind of motion, loaded at standstill before one begins; `gains` serve the others, and the \
loop closes with those for `position`."""
    reference: Literal["required", "at_reset"] = "required"
    """Whether absolute moves need home or set_position first, or the place where the drive was powered on \
counts as 0. The latter only for a line that no host has used since: after a restart with powered drives, home again."""
    home: HomeConfig | None = None
    """How `home` searches when the request does not say."""
    pwm: PwmConfig | None = None
    """Bounds of `set_pwm`; without them the axis takes no raw duty."""
    analog: AnalogConfig = AnalogConfig()
    """Bounds of `move_analog`."""
    tracking: TrackingConfig | None = None
    """Bounds of `track`; without them the axis follows no set-points."""
    settle: SettleConfig = SettleConfig()
    """Condition at which a motion to a target is done."""
    approach: ApproachConfig | None = None
    """`move_absolute` and `move_relative` come to their goal from one side, by two motions where one would not do; \
other motions, also those of a group, do not."""
    rates: RatesConfig = RatesConfig()
    """How often each item is published."""
    priority: PollPriority = "normal"
    """How its polls fare while the line cannot carry all of them: the highest go first; low ones give way, but still \
come now and then."""
    loss: LossConfig = LossConfig()
    """Reaction of the axis to the loss of a client, the line or the daemon in mid-motion."""
    limit_switches: Literal["ignore", "stop"] = "ignore"
    """Use of the limit switches. With stop, the drive itself decelerates when a motion runs onto the limit switch \
ahead, also if the host is dead; moving off a switch stays possible. Not for `track`, paths, or drives that do not \
stop on their limit inputs."""
    jog_horizon_s: float = Field(default=60.0, gt=0, le=3600)
    """Time after which the drive itself ends a motion at constant velocity that no software limit ends, seconds."""
    longest_run_s: float | None = Field(default=None, gt=0, le=86_400)
    """Longest duration of a `move_velocity`, and of one that asks for none, in seconds; without it `jog_horizon_s`."""
    coast_s: float | None = Field(default=None, gt=0, le=3600)
    """Shortest time from its velocity limit to rest with the motor off, in seconds: a shaft that stands sooner is not
    believed, nor for four times as long, until it has counted, one not read yet, lost in motion, or reset while it may
    have moved. Within a motion `limits.acceleration` bounds it."""
    jog_reach_s: float = Field(default=5.0, gt=0, le=3600)
    """How far ahead the goal of a jog is, in seconds, in a drive that takes no other goal before it stands: if the \
daemon dies it runs on for as long, and a jog that is held for longer pauses there."""
    adc_volts: float = Field(default=5.0, gt=0)
    """Voltage at full scale of the A/D converter."""
    identity: DeviceIdentity | None = None
    """Id and version of this drive, when they are not among those known for its model: it is treated as that model."""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        limits = self.limits
        if self.counts_per_unit is None and self.unit != "count":
            raise ValueError(f"unit {self.unit!r} needs counts_per_unit")
        if (
            limits.position_min is not None
            and limits.position_max is not None
            and limits.position_min >= limits.position_max
        ):
            raise ValueError(
                f"limits: position_min {self._text(limits.position_min, Dimension.POSITION)} is not below"
                f" position_max {self._text(limits.position_max, Dimension.POSITION)}"
            )
        if self.modulo is not None and (limits.position_min, limits.position_max) != (None, None):
            raise ValueError("modulo: an axis that turns without an end has no position limits")
        if self.modulo is not None:
            self._check_turn(self.modulo)
        if limits.velocity is not None and self.velocity > limits.velocity:
            raise ValueError(f"velocity {self._above(self.velocity, limits.velocity, Dimension.VELOCITY)}")
        if limits.acceleration is not None and self.acceleration > limits.acceleration:
            raise ValueError(
                f"acceleration {self._above(self.acceleration, limits.acceleration, Dimension.ACCELERATION)}"
            )
        # made once here, so that what is wrong with them is said of the file
        _ = self.unit_table, self.g_velocity
        self._check_home()
        self._check_gain_sets()
        self._check_tracking()
        return self

    @property
    def unit_table(self) -> UnitTable:
        """The units that are taken for its positions, velocities and accelerations."""
        return unit_table(self.unit, self.counts_per_unit, self.velocity_unit, self.acceleration_unit, self.units)

    @property
    def g_velocity(self) -> float | None:
        """Velocity at which 1 g acts at the radius, units a second; None without a radius."""
        return g_velocity(self.unit_table, self.radius_m) if self.radius_m else None

    @property
    def axis_units(self) -> AxisUnits:
        """The units in which people read its numbers."""
        return AxisUnits(self.unit, self.unit_table, self.g_velocity)

    @property
    def signed_counts_per_unit(self) -> float:
        """Encoder counts per unit, 1 when the axis works in counts; negative where forward is backward in counts."""
        counts_per_unit = float(self.counts_per_unit or 1.0)
        return -counts_per_unit if self.direction == "reverse" else counts_per_unit

    @property
    def meaning(self) -> tuple[str, float | None, str, float | None]:
        """What a number in units of the axis means: unit, scale, direction and turn; see `AxisInfo.meaning`."""
        return self.unit, self.counts_per_unit, self.direction, self.modulo

    @property
    def farthest(self) -> float:
        """The farthest position that anything may be given as its own, in axis units."""
        return MOST_ORIGIN_COUNTS / abs(self.signed_counts_per_unit)

    @property
    def switch_active(self) -> Literal["high", "low"]:
        """Level of a limit switch input while the switch is actuated."""
        return self.home.switch_active if self.home else "high"

    def _text(self, value: float, dimension: Dimension) -> str:
        """Return a number of the file about as it is there, with its unit."""
        return quantity_text(value, self.axis_units, dimension, ".10g")

    def _above(self, value: float, limit: float, dimension: Dimension) -> str:
        of = dimension.value
        return f"{self._text(value, dimension)} is above limits.{of} {self._text(limit, dimension)}"

    def _check_turn(self, modulo: float) -> None:
        """Refuse a turn that is no whole number of counts and no ratio: what it lacks would add up with every turn."""
        turn, said = modulo * abs(self.signed_counts_per_unit), f"modulo {self._text(modulo, Dimension.POSITION)}"
        if not LEAST_TURN_COUNTS <= turn <= MOST_ORIGIN_COUNTS:
            raise ValueError(f"{said} is not {LEAST_TURN_COUNTS} to {MOST_ORIGIN_COUNTS} encoder counts")
        if isinstance(self.counts_per_unit, Ratio) or turn_counts(modulo, self.signed_counts_per_unit).is_integer():
            return
        scale = whole_turn(modulo, self.signed_counts_per_unit)
        raise ValueError(
            f"{said} is {turn:.15g} encoder counts, which must be whole, or the places of all turns drift: write"
            f' counts_per_unit = "{scale}", or the ratio that it is'
        )

    def _check_home(self) -> None:
        """Refuse speeds with which every search would be refused."""
        if self.home is None:
            return
        if self.home.velocity == 0:
            raise ValueError("home.velocity is 0: its sign is the way of the search")
        for name, velocity in (
            ("velocity", abs(self.home.velocity)),
            ("find_velocity", self.home.find_velocity or 0.0),
        ):
            if self.limits.velocity is not None and velocity > self.limits.velocity:
                raise ValueError(f"home.{name} {self._above(velocity, self.limits.velocity, Dimension.VELOCITY)}")
        if abs(self.home.position) > (most := self.farthest):
            raise ValueError(
                f"home.position {self._text(self.home.position, Dimension.POSITION)} is beyond"
                f" {self._text(most, Dimension.POSITION)}"
            )

    def _check_gain_sets(self) -> None:
        """Refuse sets that `gains` do not stand for, and names of sets that there are not."""
        for name, gains in self.gain_sets.items():
            # velocity and acceleration "will also have to be modified" with it (LS-182AP manual, "Servo Control")
            if self.gains is None or gains.sr != self.gains.sr:
                raise ValueError(f"gain_sets.{name}: its sr is not that of gains")
        for kind, name in self.gains_for.items():
            if name not in self.gain_sets:
                raise ValueError(f"gains_for.{kind.value}: there is no set {name!r} in gain_sets")

    def _check_tracking(self) -> None:
        """Refuse bounds of `track` that would trip the drive or outrun the axis."""
        tracking, limits = self.tracking, self.limits
        if tracking is None:
            return
        step_counts = tracking.step * abs(self.signed_counts_per_unit)
        for gains in filter(None, (self.gains, *self.gain_sets.values())):
            # "if the stopping position is too far ... a position error will be generated" (both manuals, "Stop Motor")
            if step_counts >= gains.el:
                raise ValueError(f"tracking.step is {step_counts:g} counts, not below gains.el {gains.el}")
        if limits.velocity is not None and tracking.step * tracking.rate > limits.velocity:
            fastest = tracking.step * tracking.rate
            raise ValueError(f"tracking.step x rate {self._above(fastest, limits.velocity, Dimension.VELOCITY)}")


class MovedAxisConfig(AxisConfig):
    """A drive that takes motion over its line."""

    reloadable: ClassVar[tuple[str, ...]] = (
        "limits",
        "coast_s",  # counted from the velocity limit: never taken without it
        "velocity",
        "acceleration",
        "settle",
        "rates",
        "priority",
    )
    """Read by every command, or by the poller that is made when they change."""

    velocity: float = Field(gt=0)
    """Velocity of moves that do not name one, units a second."""
    acceleration: float = Field(gt=0)
    """Acceleration of moves that do not name one, units a second squared."""
