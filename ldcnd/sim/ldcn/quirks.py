"""How one simulated module behaves where manuals and data sheets leave room, switch by switch.

The default of a switch is what the document of the model says, or, where it says nothing, what hosts in the field rely
on. docs/reference/simulator.md lists them with their reasons.
"""

from enum import StrEnum
from typing import Literal

from pydantic import Field, SerializerFunctionWrapHandler, model_serializer

from ldcnd.contract.frozen import Frozen
from ldcnd.drives.ldcn.profiles import CLOCK_HZ
from ldcnd.drives.ldcn.registers import SERVO_CYCLE_S

MOST_DRIFT_PPM = 30_000.0
"""Beyond any crystal: with the 3.3 % by which the printed divisor misses 57600, a drive no longer follows that rate."""


class CommandBuffer(StrEnum):
    """Effect of a new packet on a command that waits for the end of the servo cycle."""

    OVERWRITTEN = "overwritten"
    """It is lost with the other packet's address byte, for this module or another (PIC-SERVO manual, 4.1)."""
    KEPT = "kept"
    """Only a whole packet for the same module replaces it."""


class PositionErrorClearing(StrEnum):
    """Event that clears the sticky pos_error bit once the loop is closed."""

    BY_COMMAND = "by_command"
    """Clear Sticky Bits only, as both manuals say."""
    BY_CLOSING = "by_closing"
    """Closing the loop does, too."""


class AnalogEnd(StrEnum):
    """Condition at which a motion to an analog target begins to stop."""

    EQUAL = "equal"
    """When the A/D value is equal to the target, as the LS-182AP manual says; a value that is skipped ends nothing."""
    REACHED_OR_PASSED = "reached_or_passed"


class UnknownBaud(StrEnum):
    """Effect of a code of Set Baud Rate that the data sheet of PIC-SERVO SC does not list."""

    KEPT = "kept"
    """It stays at its rate."""
    DIVIDED = "divided"
    """It takes the code for a divisor, as older parts do."""


class ResetInMotion(StrEnum):
    """Effect of Reset Position on the goal of a trapezoidal move that is under way."""

    GOAL_KEPT = "goal_kept"
    """The goal keeps its number, and so becomes another place."""
    GOAL_SHIFTED = "goal_shifted"
    """The goal stays the same place."""
    IGNORED = "ignored"
    """Reset Position does nothing then."""


class ExcludedOptions(StrEnum):
    """Effect of options of I/O Control that the data sheet of PIC-SERVO SC does not allow together."""

    OBEYED = "obeyed"
    """Each does what it does alone; of both kinds of limit protection, turning the motor off wins."""
    CLEARED = "cleared"
    """Neither takes effect."""
    IGNORED = "ignored"
    """The whole command has no effect."""


class HalfPoint(StrEnum):
    """Effect of an odd byte at the end of Add Path Points."""

    IGNORED = "ignored"
    COMPLETED = "completed"
    """The missing byte counts as 0."""
    PACKET_DROPPED = "packet_dropped"


class PathWithoutServo(StrEnum):
    """Behaviour of path mode while the servo is off."""

    WAITS = "waits"
    """Points are taken, a start does nothing."""
    POINTS_REFUSED = "points_refused"
    """Neither points nor a start are taken."""
    RUNS = "runs"
    """A path uses its points up, and nothing moves."""


class RelativeTo(StrEnum):
    """Command position to which a relative goal of PIC-SERVO SC is added, when it is loaded first and started later."""

    START = "start"
    LOAD = "load"


class PathOverflow(StrEnum):
    """Effect of path points that exceed the buffer."""

    DROP_EXCESS = "drop_excess"
    DROP_PACKET = "drop_packet"
    OVERWRITE = "overwrite"
    """The oldest points are lost."""


class LimitInPath(StrEnum):
    """Effect of limit protection on a path."""

    ENDS_PATH = "ends_path"
    KEEPS_PATH_MODE = "keeps_path_mode"
    """The axis stands still while its points are used up."""
    NOTHING = "nothing"


class ModuleSettings(Frozen):
    """How one module behaves where manuals and data sheets leave room; what is left out is as the model has it."""

    version: int = Field(default=1, ge=0, le=255)
    """Second byte of its identity; the model's when left out."""
    clock_hz: int = Field(default=CLOCK_HZ, ge=10_000_000, le=20_000_000)
    """Its clock, PIC-SERVO up to version 5; servo cycle and rates follow it."""
    phase_s: float = Field(default=0.0, ge=0, lt=SERVO_CYCLE_S)
    """Phase of its servo cycles, in seconds; drawn from the seed when left out."""
    drift_ppm: float = Field(default=0.0, ge=-MOST_DRIFT_PPM, le=MOST_DRIFT_PPM)
    """How much longer its servo cycles and its bits are than nominal; drawn from the seed when left out."""
    reply_latency_s: float = Field(default=0.0, ge=0, le=10)
    """Added between the end of the servo cycle and the reply."""
    reset_dead_s: float = Field(default=0.001, ge=0, le=10)
    """How long it is deaf after Hard Reset and power-up, in seconds. A host that takes a port for drained as soon as \
it has written needs 0: a terminal does not wait for the line."""
    always_obeys_global_reset: bool = False
    """Whether Hard Reset to FF is obeyed in any group, or only in group FF; the model's way when left out."""
    yields_to_host: bool = True
    """Whether it drops its reply as soon as the host sends."""
    command_buffer: CommandBuffer = CommandBuffer.OVERWRITTEN
    """Effect of a new packet on a command that has not been executed yet."""
    address_in_latched: bool = False
    """Whether it receives the host's packets once it has an address, whatever the level of its address input."""
    unknown_baud: UnknownBaud = UnknownBaud.KEPT
    """Effect of an unlisted code of Set Baud Rate on PIC-SERVO SC."""
    undefined_status_bits: int = Field(default=0, ge=0, le=255)
    """Set in a PIC-I/O's status byte, of which only bit 1 is defined."""
    undefined_level_bits: int = Field(default=0, ge=0, le=15)
    """The upper half of a PIC-I/O's second input byte."""
    synch_output_once: bool = False
    """Whether a PIC-I/O applies stored outputs once, or with each Synch Output."""
    counter_cleared_by_mode: bool = False
    """Whether Set Timer Mode sets a PIC-I/O's counter to 0."""
    stop_clears_velocity: bool = True
    """Whether stopping smoothly or abruptly sets the velocity register to 0; the model's way when left out."""
    position_error_clearing: PositionErrorClearing = PositionErrorClearing.BY_COMMAND
    """Event that clears the position error bit: Clear Sticky Bits only, or closing the loop, too."""
    sense_counts_per_a: float = Field(default=12.0, ge=0)
    """A/D counts per ampere of motor current, PIC-SERVO."""
    encoder_counts_per_s: float | None = Field(default=None, ge=0)
    """Faster encoder transitions are lost; the model's rate when left out, 0 for no limit."""
    analog_end: AnalogEnd = AnalogEnd.EQUAL
    """Whether a motion to an analog target begins to stop at the exact value only, or also behind it."""
    peak_current_a: float = Field(default=9.0, ge=0)
    """The motor current cannot exceed it, Logosol; 0 for no limit."""
    overload_s: float = Field(default=0.65, gt=0)
    """How long a Logosol drive limits its current without a pause before it trips."""
    deadband_at_zero: bool = False
    """Whether deadband compensation is also added to an output of 0."""
    il_times_256: bool = True
    """Whether the integral sum is bounded by 256 times IL or by IL."""
    velocity_sign: Literal[-1, 1] | None = None
    """Sign of the velocity item while the motor runs forward; the model's when left out."""
    relative_to: RelativeTo = RelativeTo.START
    """Command position to which a relative goal is added, PIC-SERVO SC: that of the load or of the start."""
    reset_in_motion: ResetInMotion = ResetInMotion.GOAL_KEPT
    """Effect of Reset Position on the goal of a move that is under way."""
    home_shifts: bool = False
    """Whether Reset Position also shifts the captured home position."""
    aux_after_reset: bool = False
    """Whether auxiliary bit 4 is set after a reset, PIC-SERVO SC."""
    path_overflow: PathOverflow = PathOverflow.DROP_EXCESS
    """Effect of path points that exceed the buffer."""
    half_point: HalfPoint = HalfPoint.IGNORED
    """Effect of an odd byte after path points."""
    path_without_servo: PathWithoutServo = PathWithoutServo.WAITS
    """Behaviour of path mode while the servo is off."""
    path_takes_points_in_motion: bool = True
    """Whether path points are taken during another motion, too."""
    path_starts_empty: bool = False
    """Whether a start with an empty buffer begins a path with the first point that comes."""
    path_restarts: bool = False
    """Whether another start goes on to the next point at once."""
    path_cleared_by_stop: bool = True
    """Whether Stop Motor clears the path points that are left."""
    path_cleared_by_fault: bool = False
    """Whether the servo being switched off by an error does."""
    path_counts_point_under_way: bool = False
    """Whether the number of points left includes the one under way."""
    path_ends_with_buffer: bool = False
    """Whether PATH_MODE falls when the last point begins, or when it ends."""
    path_rate_at_load: bool = False
    """Whether the fast path option counts when a point is loaded, or when it begins."""
    path_move_done: bool = True
    """Whether MOVE_DONE is set during a path."""
    path_slew: bool = True
    """Whether auxiliary bit 4 is set during a path."""
    path_ignores_divisor: bool = False
    """Whether the servo rate divisor of a CMC leaves its path as it is."""
    path_ended_by_enable: bool = False
    """Whether Stop Motor with the enable bit alone ends a path."""
    excluded_options: ExcludedOptions = ExcludedOptions.OBEYED
    """Effect of options of I/O Control that exclude each other, PIC-SERVO SC."""
    gains_keep_multiplier: bool = False
    """Whether Set Gain without a step multiplier leaves that as it is, PIC-SERVO SC."""
    steps_hz: float = Field(default=0.0, ge=-1_000_000, le=1_000_000)
    """A pulse train at the step input of PIC-SERVO SC, negative in reverse."""
    limit_in_path: LimitInPath = LimitInPath.ENDS_PATH
    """Effect of limit protection on a path, PIC-SERVO SC."""
    advanced_sticky: bool = True
    """Whether a CMC keeps its advanced features when a later Stop Motor lacks their bit."""
    items_before_advanced: bool = False
    """Whether a CMC sends status items 6 and 7 before its advanced features are on."""

    @model_serializer(mode="wrap")
    def _only_what_is_given(self, dump: SerializerFunctionWrapHandler):  # type: ignore[no-untyped-def] # noqa: ANN202 - a type would stand in the schema
        """Leave out what the model of the module decides: a dump that is read again means the same."""
        return {name: value for name, value in dump(self).items() if name in self.model_fields_set}
