"""What a command query carries, verb by verb."""

from enum import StrEnum
from typing import Annotated, Literal

from pydantic import Field

from ldcnd.model.frozen import Frozen
from ldcnd.model.parameters import (
    AlarmReport,
    CounterName,
    CounterReply,
    DriveProfile,
    Memory,
    ParameterDump,
    ParameterList,
    ParameterReply,
)
from ldcnd.model.replies import CommandReply
from ldcnd.model.traces import LONGEST_WAIT_S, MOST_CHANNELS, MOST_SAMPLES, TraceAbortReply, TraceReply, TraceTrigger
from ldcnd.model.verb import Verb as Verb  # noqa: PLC0414 - who sends a request needs its verb: one import has both

LONGEST_NAME = 64
"""Characters of a name or an id that a client gives."""


class Request(Frozen):
    """The base of every command payload: what proves that it may be carried out, and only once."""

    command_id: str | None = Field(default=None, min_length=1, max_length=LONGEST_NAME)
    """Names the command; the same id is carried out at most once and answered alike. Given by the daemon if missing."""
    client: str | None = Field(default=None, max_length=LONGEST_NAME)
    """Who sends it: a name for people, in events and the log; not authenticated. A lease knows its own."""
    lease: str | None = None
    """The lease under which it is sent."""
    sequence: int | None = Field(default=None, ge=0)
    """Grows with every command under the lease; an older one that comes later is refused."""
    instance: str | None = None
    """The run of the daemon that it is meant for, as in `meta/daemon`; after a restart, which forgets all command ids,
    a command that was sent again is refused instead of being carried out twice."""
    not_after: int | None = None
    """Do not start it after this instant, UTC in ns since 1970; needs clocks that agree."""


class PowerRequest(Request):
    """Close or open the position loop; nothing moves."""

    on: bool
    """True closes the loop at the present position, false opens it and disables the amplifier."""


class BufferMode(StrEnum):
    """What a move does that finds the axis moving; PLCopen's buffer modes, and a refusal."""

    REFUSE = "refuse"
    """It is refused: whoever sends it did not know."""
    ABORTING = "aborting"
    """The axis is halted first; what it was doing ends as aborted."""
    BUFFERED = "buffered"
    """It waits until what the axis is doing has ended."""


class MoveRequest(Request):
    """What the moves have in common."""

    buffer_mode: BufferMode = BufferMode.REFUSE
    """What happens if the axis moves already; the answer comes when the drive has acknowledged the new move."""


class MoveAbsoluteRequest(MoveRequest):
    """Move to a position on a trapezoidal profile."""

    position: float
    """Target in axis units."""
    velocity: float | None = Field(default=None, gt=0)
    """Speed in units a second; the axis default when missing."""
    acceleration: float | None = Field(default=None, gt=0)
    """Acceleration in units a second squared; the axis default when missing."""


class MoveRelativeRequest(MoveRequest):
    """Move by a distance from where the axis is told to be; becomes absolute when it is admitted."""

    distance: float
    """Distance in axis units, signed."""
    velocity: float | None = Field(default=None, gt=0)
    """Speed in units a second; the axis default when missing."""
    acceleration: float | None = Field(default=None, gt=0)
    """Acceleration in units a second squared; the axis default when missing."""


class MoveVelocityRequest(MoveRequest):
    """Move at a constant velocity until told otherwise or until the software limit."""

    velocity: float
    """Velocity in units a second, positive forward, not 0."""
    acceleration: float | None = Field(default=None, gt=0)
    """Acceleration in units a second squared; the axis default when missing."""


class HaltRequest(Request):
    """Decelerate to standstill; another command may follow."""


class StopRequest(Request):
    """Decelerate to standstill and latch: nothing moves again before reset."""


class QuickStopRequest(Request):
    """Stop without a ramp, holding position, and latch: nothing moves again before reset."""


class HomeMethod(StrEnum):
    """What marks the reference position."""

    INDEX = "index"
    FORWARD_LIMIT = "forward_limit"
    REVERSE_LIMIT = "reverse_limit"
    POSITION_ERROR = "position_error"
    CURRENT = "current"


class HomeStop(StrEnum):
    """How the motor stops when the reference position was found."""

    SMOOTH = "smooth"
    """Decelerate, then hold."""
    ABRUPT = "abrupt"
    """Hold at once."""
    OFF = "off"
    """Open the loop: the motor coasts and the axis is disabled afterwards."""


class HomeRequest(Request):
    """Find the reference position; what is missing comes from the axis's configuration.

    An axis that stands on the limit switch it is to run onto moves off it first.
    """

    method: HomeMethod | None = None
    """What marks the reference position."""
    velocity: float | None = None
    """Search velocity in units a second, positive forward, not 0."""
    acceleration: float | None = Field(default=None, gt=0)
    """Acceleration in units a second squared."""
    position: float | None = None
    """What the position is called there, in axis units."""
    timeout_s: float | None = Field(default=None, gt=0, le=3600)
    """Longest search, in seconds; moving off a limit switch first counts as a search of its own."""
    distance: float | None = Field(default=None, gt=0)
    """Longest search, in axis units; a missing one is as far as the velocity goes in that time."""
    stop: HomeStop | None = None
    """How the motor stops there."""
    move_to: float | None = None
    """Where to go afterwards, in axis units; a missing one stays where the motor stopped."""


class ResetRequest(Request):
    """Clear the stop latch and the drive's faults; after a drive fault the axis is disabled. Nothing moves."""


class SetPositionRequest(Request):
    """Tell a standing axis where it is; afterwards it is referenced."""

    position: float
    """What the present position is called, in axis units."""


class SetGainsRequest(Request):
    """Change the position loop of a drive; register values as in its manual, the missing ones stay as they are."""

    kp: int | None = Field(default=None, ge=0, le=0x7FFF)
    """Position gain."""
    kd: int | None = Field(default=None, ge=0, le=0x7FFF)
    """Velocity gain."""
    ki: int | None = Field(default=None, ge=0, le=0x7FFF)
    """Integral gain."""
    il: int | None = Field(default=None, ge=0, le=0x7FFF)
    """Integration limit."""
    ol: int | None = Field(default=None, ge=0, le=0xFF)
    """Output limit."""
    cl: int | None = Field(default=None, ge=0, le=0xFF)
    """Current limit: 0 is off; odd where the sense voltage rises with the current, even where it falls."""
    el: int | None = Field(default=None, ge=0, le=0x3FFF)
    """Position error limit."""
    deadband: int | None = Field(default=None, ge=0, le=0xFF)
    """Amplifier deadband compensation."""
    sr: int | None = Field(default=None, ge=1, le=0xFF)
    """Servo rate divisor; it changes what velocities mean to the drive, so only a standing axis takes it."""


class MoveAnalogRequest(Request):
    """Move until the analog position sensor reads a value; the drive finds the direction itself."""

    target: int = Field(ge=0)
    """A/D counts, 0 to full scale; the ends of the range mean a broken sensor and are refused."""
    velocity: float | None = Field(default=None, gt=0)
    """Speed in units a second; the axis default when missing."""
    acceleration: float | None = Field(default=None, gt=0)
    """Acceleration in units a second squared; the axis default when missing."""


class SetPwmRequest(Request):
    """Put a raw duty on the motor, with the position loop open, for a limited time; then the axis stops and holds."""

    duty: float = Field(ge=-1, le=1)
    """Share of the supply voltage, positive forward."""
    duration_s: float = Field(gt=0)
    """How long, in seconds."""


class TrackRequest(Request):
    """Go to a position at once, without a profile: one set-point of a stream."""

    position: float
    """Set-point in axis units."""


class PinMode(StrEnum):
    """What a limit switch pin does."""

    INPUT = "input"
    HIGH = "high"
    LOW = "low"


class SetOutputsRequest(Request):
    """Use limit switch pins as outputs, or as inputs again; a missing pin stays as it is."""

    limit1: PinMode | None = None
    """The pin of limit switch 1 (reverse)."""
    limit2: PinMode | None = None
    """The pin of limit switch 2 (forward)."""


class ListParametersRequest(Request):
    """List what is known of the drive's parameters; asks nothing of the drive."""


class ReadParameterRequest(Request):
    """Read one parameter from both memories."""

    parameter: str
    """Its number, such as Pn100, or the manual's name in any case."""
    unlisted: bool = False
    """Allow a number that the manual does not list."""


class ReadAllParametersRequest(Request):
    """Read every listed parameter from both memories; takes seconds on a slow line."""


class WriteParameterRequest(Request):
    """Write one parameter, in RAM unless EEPROM is named; nothing is sent when it has the value already."""

    parameter: str
    """Its number, such as Pn100, or the manual's name in any case."""
    value: int = Field(ge=0, le=0xFFFF)
    """The new value, a word without sign."""
    memory: Memory = Memory.RAM
    """RAM forgets at power-off; EEPROM endures 10,000 writes and must be asked for by name."""
    unlisted: bool = False
    """Allow a number that the manual does not list."""
    confirm_unit: int | None = Field(default=None, ge=0, le=15)
    """The unit number that the drive will have after its next power-on, when this write changes it."""


class ClearCounterRequest(Request):
    """Set a pulse counter to 0; the motor must stand."""

    counter: CounterName
    """Which counter."""


class ReadAlarmsRequest(Request):
    """Read the present alarm and the alarm history."""


class ReadProfileRequest(Request):
    """Tell how the drive is taken to behave, doubts included; asks nothing of the drive."""


class TraceRequest(Request):
    """Record channels of an axis against time; moves nothing."""

    channels: tuple[str, ...] = Field(min_length=1, max_length=MOST_CHANNELS)
    """What to record; `meta/axes/<axis>` lists what the axis has."""
    interval_s: Annotated[float, Field(gt=0)] | Literal["fastest"] = "fastest"
    """Time between two samples, in seconds, or "fastest"."""
    samples: int = Field(default=500, ge=2, le=MOST_SAMPLES)
    """How many samples; a drive's own recorder always takes as many as it has room for."""
    pre_trigger: int = Field(default=0, ge=0)
    """So many of them before the trigger; ignored without one."""
    trigger: TraceTrigger | None = None
    """What to wait for; a missing one starts at once."""
    timeout_s: float = Field(default=30.0, gt=0, le=LONGEST_WAIT_S)
    """Longest wait for the trigger, in seconds."""


class TraceAbortRequest(Request):
    """End the trace that is under way, or one that was left armed in the drive; its samples are lost."""


REQUEST_MODELS: dict[Verb, type[Request]] = {
    Verb.POWER: PowerRequest,
    Verb.MOVE_ABSOLUTE: MoveAbsoluteRequest,
    Verb.MOVE_RELATIVE: MoveRelativeRequest,
    Verb.MOVE_VELOCITY: MoveVelocityRequest,
    Verb.HALT: HaltRequest,
    Verb.STOP: StopRequest,
    Verb.QUICK_STOP: QuickStopRequest,
    Verb.HOME: HomeRequest,
    Verb.RESET: ResetRequest,
    Verb.SET_POSITION: SetPositionRequest,
    Verb.SET_GAINS: SetGainsRequest,
    Verb.LIST_PARAMETERS: ListParametersRequest,
    Verb.READ_PARAMETER: ReadParameterRequest,
    Verb.READ_ALL_PARAMETERS: ReadAllParametersRequest,
    Verb.WRITE_PARAMETER: WriteParameterRequest,
    Verb.CLEAR_COUNTER: ClearCounterRequest,
    Verb.READ_ALARMS: ReadAlarmsRequest,
    Verb.READ_PROFILE: ReadProfileRequest,
    Verb.MOVE_ANALOG: MoveAnalogRequest,
    Verb.SET_PWM: SetPwmRequest,
    Verb.TRACK: TrackRequest,
    Verb.SET_OUTPUTS: SetOutputsRequest,
    Verb.TRACE: TraceRequest,
    Verb.TRACE_ABORT: TraceAbortRequest,
}

REPLY_MODELS: dict[Verb, type[CommandReply]] = {
    Verb.LIST_PARAMETERS: ParameterList,
    Verb.READ_PARAMETER: ParameterReply,
    Verb.READ_ALL_PARAMETERS: ParameterDump,
    Verb.WRITE_PARAMETER: ParameterReply,
    Verb.CLEAR_COUNTER: CounterReply,
    Verb.READ_ALARMS: AlarmReport,
    Verb.READ_PROFILE: DriveProfile,
    Verb.TRACE: TraceReply,
    Verb.TRACE_ABORT: TraceAbortReply,
}
"""What is answered with more than a `CommandReply`."""
