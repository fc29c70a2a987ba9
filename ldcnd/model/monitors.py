"""Monitors: what a drive displays beside position and velocity, published on `tele/<axis>/monitor/<name>`."""

from enum import StrEnum

from ldcnd.model.samples import Sample


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


class MonitorSample(Sample):
    """One monitor of a drive, in the drive's own unit."""

    value: int
    """The value with its sign; for signals and switches their word."""
    unit: str
    """Unit of the value; empty for signals and switches."""
    title: str
    """The manual's words."""
    high: tuple[str, ...] = ()
    """For signals, those whose level is high, whatever that means; for switches, those that are on."""
