"""How one simulated module behaves where manuals and data sheets leave room, switch by switch.

The default of a switch is what the document of the model says, or, where it says nothing, what hosts in the field rely
on. docs/reference/simulator.md lists them with their reasons.
"""

from dataclasses import dataclass
from enum import StrEnum

from ldcnd.drives.ldcn.profiles import CLOCK_HZ


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


@dataclass(frozen=True, slots=True)
class ModuleSettings:
    """Version, clock and quirks of one module.

    Attributes:
        version: second byte of its identity.
        phase_s: where its servo cycles lie, 0 to 0.000512.
        clock_hz: of the module.
        drift_ppm: how much longer its servo cycles and its bits are than nominal.
        reply_latency_s: added between the end of the cycle and the reply.
        reset_dead_s: how long it is deaf after Hard Reset and power-up; no manual says it.
        always_obeys_global_reset: obeys Hard Reset to FF in any group; PIC-SERVO up to version 5 and PIC-I/O do so only
            in group FF.
        yields_to_host: drops its reply as soon as the host sends, also one that is due.
        command_buffer: effect of a new packet on a command that has not been executed yet.
        address_in_latched: once it has an address it receives, whatever the level of its address input.
        unknown_baud: effect of an unlisted code of Set Baud Rate on PIC-SERVO SC.
        undefined_status_bits: of a PIC-I/O's status byte, of which only bit 1 is defined.
        undefined_level_bits: of the upper half of a PIC-I/O's second input byte.
        synch_output_once: a PIC-I/O applies stored outputs once, not with each Synch Output.
        counter_cleared_by_mode: Set Timer Mode sets a PIC-I/O's counter to 0.
        stop_clears_velocity: stopping smoothly or abruptly sets the velocity register to 0.
        position_error_clearing: what clears pos_error.
        sense_counts_per_a: A/D counts per ampere of motor current (PIC-SERVO).
        encoder_counts_per_s: faster transitions are lost; None for the model's rate, 0 for no limit.
        analog_end: when a motion to an analog target begins to stop (Logosol).
        peak_current_a: the motor current cannot exceed it (Logosol); 0 for no limit.
        overload_s: limited for so long without a pause, the drive trips.
        deadband_at_zero: deadband compensation is also added to an output of 0.
        il_times_256: the integral sum is bounded by 256 times IL instead of by IL.
        velocity_sign: of the velocity item while the motor runs forward, 1 or -1; None for the model's.
        relative_to: what a relative goal is added to.
        reset_in_motion: what Reset Position does to the goal of a move that is under way.
        home_shifts: Reset Position also shifts the captured home position.
        aux_after_reset: auxiliary bit 4 is set after a reset as at any standstill, before the loop is closed first.
        path_overflow: what happens to points that the buffer has no room for.
        half_point: what becomes of an odd byte behind the points.
        path_without_servo: what path mode does while the servo is off.
        path_takes_points_in_motion: points are taken during another motion, too.
        path_starts_empty: a start with an empty buffer begins a path with the first point that comes.
        path_restarts: another start goes on to the next point at once.
        path_cleared_by_stop: Stop Motor, or another motion, clears the points that are left.
        path_cleared_by_fault: the servo being switched off by an error does.
        path_counts_point_under_way: the number of points left includes the one that is walked through.
        path_ends_with_buffer: PATH_MODE falls when the last point begins, not when it ends.
        path_rate_at_load: the fast path option counts when a point is loaded, not when it begins.
        path_move_done: MOVE_DONE is set during a path,
        path_slew: and auxiliary bit 4 is.
        path_ignores_divisor: the servo rate divisor of a CMC does not slow its path.
        path_ended_by_enable: Stop Motor with the enable bit alone ends a path.
        excluded_options: what PIC-SERVO SC does with options that exclude each other.
        gains_keep_multiplier: Set Gain without a step multiplier leaves that as it is instead of setting it to 1.
        steps_hz: of a pulse train at the step input of PIC-SERVO SC; negative in reverse.
        limit_in_path: what limit protection does to a path.
        advanced_sticky: a CMC keeps its advanced features when a later Stop Motor lacks their bit.
        items_before_advanced: a CMC sends status items 6 and 7 before its advanced features are on.
    """

    version: int
    clock_hz: int = CLOCK_HZ
    phase_s: float = 0.0
    drift_ppm: float = 0.0
    reply_latency_s: float = 0.0
    reset_dead_s: float = 0.001
    always_obeys_global_reset: bool = False
    yields_to_host: bool = True
    command_buffer: CommandBuffer = CommandBuffer.OVERWRITTEN
    address_in_latched: bool = False
    unknown_baud: UnknownBaud = UnknownBaud.KEPT
    undefined_status_bits: int = 0
    undefined_level_bits: int = 0
    synch_output_once: bool = False
    counter_cleared_by_mode: bool = False
    stop_clears_velocity: bool = True
    position_error_clearing: PositionErrorClearing = PositionErrorClearing.BY_COMMAND
    sense_counts_per_a: float = 12.0
    encoder_counts_per_s: float | None = None
    analog_end: AnalogEnd = AnalogEnd.EQUAL
    peak_current_a: float = 9.0
    overload_s: float = 0.65
    deadband_at_zero: bool = False
    il_times_256: bool = True
    velocity_sign: int | None = None
    relative_to: RelativeTo = RelativeTo.START
    reset_in_motion: ResetInMotion = ResetInMotion.GOAL_KEPT
    home_shifts: bool = False
    aux_after_reset: bool = False
    path_overflow: PathOverflow = PathOverflow.DROP_EXCESS
    half_point: HalfPoint = HalfPoint.IGNORED
    path_without_servo: PathWithoutServo = PathWithoutServo.WAITS
    path_takes_points_in_motion: bool = True
    path_starts_empty: bool = False
    path_restarts: bool = False
    path_cleared_by_stop: bool = True
    path_cleared_by_fault: bool = False
    path_counts_point_under_way: bool = False
    path_ends_with_buffer: bool = False
    path_rate_at_load: bool = False
    path_move_done: bool = True
    path_slew: bool = True
    path_ignores_divisor: bool = False
    path_ended_by_enable: bool = False
    excluded_options: ExcludedOptions = ExcludedOptions.OBEYED
    gains_keep_multiplier: bool = False
    steps_hz: float = 0.0
    limit_in_path: LimitInPath = LimitInPath.ENDS_PATH
    advanced_sticky: bool = True
    items_before_advanced: bool = False
