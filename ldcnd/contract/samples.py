"""Telemetry: what is published on `tele/<axis>/<item>`."""

from collections.abc import Mapping
from enum import StrEnum
from typing import Annotated

from pydantic import Field

from ldcnd.contract.frozen import LARGEST_INTEGER, Frozen

StopCount = Annotated[int, Field(ge=0, le=LARGEST_INTEGER)]
"""How often all that was sent to an axis before was made void; see `StateSample.stops`."""


class AxisState(StrEnum):
    """PLCopen axis states."""

    DISABLED = "disabled"
    STANDSTILL = "standstill"
    HOMING = "homing"
    DISCRETE_MOTION = "discrete_motion"
    CONTINUOUS_MOTION = "continuous_motion"
    STOPPING = "stopping"
    ERROR_STOP = "error_stop"

    @property
    def is_motion(self) -> bool:
        """Whether a motion is under way."""
        return self in _MOTIONS

    @property
    def words(self) -> str:
        """The state as every face says it to people."""
        return _STATE_WORDS.get(self, self.value.replace("_", " "))


_MOTIONS = frozenset({AxisState.HOMING, AxisState.DISCRETE_MOTION, AxisState.CONTINUOUS_MOTION, AxisState.STOPPING})
_STATE_WORDS = {
    AxisState.DISCRETE_MOTION: "moving",  # others may move a drive, and nothing tells of a target then
    AxisState.CONTINUOUS_MOTION: "moving at a velocity",
}


class Moving(StrEnum):
    """Whether the axis moves; unknown is an answer of its own and never means no."""

    YES = "yes"
    NO = "no"
    UNKNOWN = "unknown"


class Unseen(StrEnum):
    """Why an axis may turn whose encoder does not count: nothing has shown yet that it does."""

    MOTOR_OFF = "motor_off"
    """Its motor is off; it stands once it has not counted for a time that its configuration gives."""
    LEFT_TURNING = "left_turning"
    """So, too, and it turned when it was read last, or an earlier daemon has left it so: its power stays off."""
    UNDER_POWER = "under_power"
    """Others have closed its loop: it stands once it has counted in a motion of this daemon, or its motor is off."""


class Quality(StrEnum):
    """How much a sample is worth."""

    GOOD = "good"
    UNCERTAIN = "uncertain"
    """Measured, but uncertain: the drive missed polls lately, or its scale is not configured."""
    BAD = "bad"
    """Not a measurement any more: the last known value of a drive that does not answer."""


class LinkState(StrEnum):
    """Whether the drive answers."""

    UP = "up"
    DEGRADED = "degraded"
    """It missed its latest polls."""
    DOWN = "down"


class TelemetryItem(StrEnum):
    """The last chunk of a telemetry key."""

    POSITION = "position"
    VELOCITY = "velocity"
    ADC = "adc"
    INPUTS = "inputs"
    LATCH = "latch"
    IO = "io"
    FAULT = "fault"
    STATE = "state"
    SHADOW = "shadow"


class Sample(Frozen):
    """Fields of every telemetry payload."""

    t: int
    """Instant at which the value was true, UTC in ns since 1970."""
    t_error_ns: int = Field(ge=0)
    """The true instant lies within this many ns of `t`, as far as the wire tells."""
    seq: int = Field(ge=0)
    """Grows by one with every sample of this item; a gap is a loss."""
    quality: Quality
    """How much the value is worth."""


class PositionSample(Sample):
    """Position of an axis."""

    value: float
    """Position in axis units; on an axis with a modulo from 0 up to it."""
    unit: str
    """The axis unit."""
    turns: int | None = None
    """Whole turns below `value` since the axis was referenced; null without a modulo."""
    counts: int
    """Encoder counts since the drive was reset, also beyond the 32 bits of its counter."""
    following_error: float | None
    """Commanded minus actual position in axis units; null when the drive does not report it."""


class VelocitySample(Sample):
    """How fast the axis moves; positive forward."""

    value: float
    """Velocity in axis units a second."""
    unit: str
    """The axis unit, a second."""
    counts_per_s: float
    """Velocity in encoder counts a second; the drive reports whole counts per servo tick."""
    resolution: float | None = None
    """The smallest velocity that the drive can report, in axis units a second; null from a daemon of before."""


class AdcSample(Sample):
    """The analog input of the drive."""

    counts: int = Field(ge=0)
    """Raw value."""
    full_scale: int = Field(gt=0)
    """Raw value at full scale."""
    volts: float
    """Voltage at the input, as configured for full scale."""


class InputLevels(Frozen):
    """The inputs of a drive and its amplifier enable; null while one is not shown."""

    reverse_limit: bool | None
    """Level of the reverse limit switch input; true is high. A Logosol drive shows it while its power driver is on."""
    forward_limit: bool | None
    """Level of the forward limit switch input; likewise."""
    index: bool | None
    """Level of the encoder's index; true is high."""
    stop_input: bool | None
    """The stop input is open, which keeps the motor off; a Logosol drive shows it while its power driver is off."""
    amplifier_enable: bool | None
    """The amplifier enable that the drive holds; null when it is not known, such as after a lost acknowledgement."""


class InputsSample(InputLevels, Sample):
    """The inputs of a drive and its amplifier enable, which every poll carries; null while one is not shown."""


class LatchSample(Sample):
    """Position latched by a probe; published once for each probe that found something."""

    value: float
    """Position in axis units."""
    unit: str
    """The axis unit."""
    counts: int
    """Raw encoder counts of the drive."""
    error: float = Field(ge=0)
    """The edge lies up to this far before `value`, in axis units: the way of a servo cycle at the probe's velocity, and
    a count. What the input circuit delays comes on top."""
    sources: tuple[str, ...]
    """The possible sources of the latch."""
    command_id: str
    """Id of the probe command that latched this position."""


class IoReading(Frozen):
    """The lines of an I/O module, and its outputs."""

    levels: tuple[bool, ...]
    """Levels of the lines, the first is line 1; true is high. Outputs show their pins, too."""
    outputs: tuple[int, ...] | None
    """Lines that are outputs; null while that is not known, such as after a take-over."""
    adc: tuple[int, ...]
    """The analog inputs, 0 to 255."""
    counter: int
    """Counter or timer: 32 bits that wrap silently; only differences mean something."""
    pwm: tuple[float, ...] | None
    """Shares of time for which the PWM outputs are on; null while they are not known."""


class IoSample(Sample, IoReading):
    """The lines of an I/O module, and its outputs; published under the name of the module."""

    volts: tuple[float, ...]
    """The same in volts, 5 V at full scale."""
    named: Mapping[str, bool | None] = {}
    """Values of the named inputs, debounced, and levels of the named outputs, true for high; null while one is not
    known: it changes too fast, or its pin shows another level than was written."""


class PastFault(Frozen):
    """A fault that an axis has had."""

    code: str
    """Stable code of the fault."""
    text: str
    """Meaning and remedy."""
    since: int
    """Instant at which the daemon first saw the fault, UTC in ns since 1970."""
    source: str
    """Who said so: drive or daemon."""
    hides_motion: bool = False
    """Shaft and encoder did not go where they were sent, so that readings do not prove that the axis stands."""


class FaultEntry(PastFault):
    """One active fault."""

    source: str
    """Who says so: drive or daemon."""
    stops: bool = True
    """The motor is off because of it; false for a warning."""
    page: str | None = None
    """Path of its page below a console or the documentation: what to check, how to clear it."""

    @property
    def past(self) -> PastFault:
        """What is kept of it when it is over."""
        return PastFault.model_validate(self.model_dump(include=set(PastFault.model_fields)))


class FaultSample(Sample):
    """Faults of the axis."""

    active: tuple[FaultEntry, ...]
    """Faults that stand now."""
    first: FaultEntry | None
    """The fault that came first since the last reset, a warning only if none stops: the likely cause of the rest."""


MOST_SHADOW_FIGURES = 8
"""One observer tells no more of an axis."""


class FigureRange(Frozen):
    """The mean of a figure of some motions, and what it was learnt to be."""

    value: float
    """Mean of the last motions."""
    usual: float
    """What the axis had taught for motions of this speed."""
    low: float | None
    """Below this mean there is an alarm; null without a lower limit."""
    high: float
    """Above this mean likewise."""
    unit: str
    """Unit of these values."""


class ShadowFigure(FigureRange):
    """One figure of an axis, as an observer finds it in its motions."""

    figure: str = Field(pattern="^[a-z_]{1,20}$")
    """Name of the figure: friction, inertia or misfit of `ldcnd shadow`."""
    motions: int = Field(ge=1, le=LARGEST_INTEGER)
    """Number of motions in the mean."""
    alarm: bool
    """An alarm stands."""
    meaning: str | None = None
    """What may be behind it; null without an alarm."""


class ShadowSample(Sample):
    """What an observer, such as `ldcnd shadow`, says of an axis; the daemon passes it on and judges nothing."""

    learning: bool
    """It still learns what is usual."""
    judged: int = Field(ge=0)
    """Motions that have taught or were judged since the observer began."""
    figures: tuple[ShadowFigure, ...]
    """Those of which enough is known."""


UNKNOWN_HOLDER = ""
"""Stands for a holder of control of whom nothing is known."""


class CurrentCommand(Frozen):
    """The command that the axis carries out."""

    command_id: str
    """Id from the command's reply."""
    verb: str
    """The verb of the command."""
    since: int
    """Instant at which it was accepted, UTC in ns since 1970."""
    target: float | None = None
    """Position at which it ends, in axis units; the distance left is from the position to here. Null without an end
    of its own, and for a motion at a velocity on an axis with a modulo."""
    expected_end: int | None = None
    """Instant at which its profile should end, UTC in ns since 1970; settling comes on top. Null without an end of
    its own."""


class StateSample(Sample):
    """State of an axis; `t` grows even when nothing changes: a sign of life of the line itself."""

    state: AxisState
    """PLCopen state."""
    enabled: bool
    """The position loop is closed."""
    referenced: bool
    """The position is valid: the axis was homed or its position was set since its drive was last reset, and neither
    the link nor the encoder was lost since then, nor has the counter wrapped."""
    moving: Moving
    """Whether it moves; unknown when the drive does not answer, and where `motion_hidden_by` or `unseen` says why."""
    link: LinkState
    """Whether the drive answers."""
    stop_latched: bool
    """A stop is latched; only reset clears it."""
    stop_pending: bool = False
    """A stop was requested and the drive has not confirmed it: it is sent again until it does, and nothing moves. One
    that it had confirmed to an earlier daemon is sent again as well, and is pending only if it is not in 5 s."""
    command: CurrentCommand | None
    """The command under way."""
    last_error: str | None = None
    """Why the last command ended other than done, until the next command is accepted."""
    interlock: str = ""
    """The interlock that has ended it and what that lacks, for as long; empty where none has."""
    motion_hidden_by: str = ""
    """Code that says why readings do not prove that the axis stands: shaft and encoder did not go where they were sent,
    or ceased to move too suddenly. Empty while they do, and again after reset."""
    unseen: Unseen | None = None
    """Why an axis that shows no count may turn, where nothing has shown yet that its encoder counts; null elsewhere."""
    has_reference: bool = True
    """Whether its drive can have a reference; false where `home` and `set_position` are not among its commands."""
    reference_lost: bool = False
    """The position was valid and is not any more; false on an axis that was never homed, and again once it is valid."""
    target: float | None = None
    """Position to which the axis was sent last, in axis units; once something else has stopped or moved it, where it
    came to rest. Null while it moves without a target, while its position loop is open, and while it is not known."""
    unit: str | None = None
    """The axis unit, that of targets; null from a daemon of an earlier version."""
    speed_override: float = Field(default=100.0, ge=0, le=100)
    """Percent of every velocity, for the whole rig; nothing moves at 0."""
    holder: str | None = UNKNOWN_HOLDER
    """The client in control of the axis; null without one, empty where that is not known."""
    was_read: bool = True
    """Its drive was read since its daemon began; until then the daemon shows what it has kept, and what it commands."""
    stops: StopCount | None = None
    """How often all that was sent to the axis before was made void since its daemon began: by stops, halts or power off
    of anybody, by interlocks, lost control or losses; see `after_stops` of commands. Null from an earlier version."""

    @property
    def has_ended(self) -> bool:
        """Whether nothing is to be waited for: it stands, or no time will tell whether it does."""
        if self.moving is Moving.UNKNOWN and self.link is LinkState.UP and self.command is None:
            return bool(self.motion_hidden_by) or self.unseen is Unseen.UNDER_POWER
        return self.moving is Moving.NO


class MonitorName(StrEnum):
    """The last chunk of a monitor key."""

    SPEED_FEEDBACK = "speed_feedback"
    SPEED_REFERENCE = "speed_reference"
    TORQUE_REFERENCE = "torque_reference"
    PULSES_FROM_Z = "pulses_from_z"
    ELECTRICAL_ANGLE = "electrical_angle"
    INPUT_SIGNALS = "input_signals"
    OUTPUT_SIGNALS = "output_signals"
    REFERENCE_PULSE_SPEED = "reference_pulse_speed"
    POSITION_DEVIATION = "position_deviation"
    CUMULATIVE_LOAD = "cumulative_load"
    REGENERATIVE_LOAD = "regenerative_load"
    BRAKE_LOAD = "brake_load"
    INPUT_COUNTER = "input_counter"
    FEEDBACK_COUNTER = "feedback_counter"
    GAIN_SWITCH = "gain_switch"
    FUNCTION_SWITCHES = "function_switches"
    AUTO_TUNING_RESULT = "auto_tuning_result"


class MonitorContent(Frozen):
    """What one monitor of a drive says, in the drive's own unit."""

    value: int
    """The value with its sign; for signals and switches their word."""
    unit: str
    """Unit of the value; empty for signals and switches."""
    title: str
    """The manual's words."""
    high: tuple[str, ...] = ()
    """Signals whose level is high, whatever that means; of switches, those that are on."""
    active: tuple[str, ...] | None = None
    """Signals that are on, by the active levels of the configuration, without those of which it has none; null for what
    has no active level."""


class MonitorSample(Sample, MonitorContent):
    """One monitor of a drive, in the drive's own unit."""


SAMPLE_MODELS: dict[TelemetryItem, type[Sample]] = {
    TelemetryItem.POSITION: PositionSample,
    TelemetryItem.VELOCITY: VelocitySample,
    TelemetryItem.ADC: AdcSample,
    TelemetryItem.INPUTS: InputsSample,
    TelemetryItem.LATCH: LatchSample,
    TelemetryItem.IO: IoSample,
    TelemetryItem.FAULT: FaultSample,
    TelemetryItem.STATE: StateSample,
    TelemetryItem.SHADOW: ShadowSample,
}

SAMPLE_ITEMS: dict[type[Sample], TelemetryItem] = {model: item for item, model in SAMPLE_MODELS.items()}
_ITEMS = frozenset(item.value for item in TelemetryItem)


def sample_model(item: str) -> type[Sample] | None:
    """Return the model of an item such as `position` or `monitor/speed_feedback`; None for one unknown here."""
    if item.startswith("monitor/"):
        return MonitorSample
    return SAMPLE_MODELS[TelemetryItem(item)] if item in _ITEMS else None
