"""The commands of an axis by name: what requests carry them, and which of them a drive can do, is told elsewhere."""

from enum import StrEnum


class Verb(StrEnum):
    """What an axis can be asked to do, and the last chunk of the key; what it cannot is refused as not_supported."""

    POWER = "power"
    MOVE_ABSOLUTE = "move_absolute"
    MOVE_RELATIVE = "move_relative"
    MOVE_VELOCITY = "move_velocity"
    HALT = "halt"
    STOP = "stop"
    QUICK_STOP = "quick_stop"
    HOME = "home"
    RESET = "reset"
    SET_POSITION = "set_position"
    SET_GAINS = "set_gains"
    LIST_PARAMETERS = "list_parameters"
    READ_PARAMETER = "read_parameter"
    READ_ALL_PARAMETERS = "read_all_parameters"
    WRITE_PARAMETER = "write_parameter"
    CLEAR_COUNTER = "clear_counter"
    READ_ALARMS = "read_alarms"
    READ_PROFILE = "read_profile"
    MOVE_ANALOG = "move_analog"
    SET_PWM = "set_pwm"
    TRACK = "track"
    SET_OUTPUTS = "set_outputs"
    TRACE = "trace"
    TRACE_ABORT = "trace_abort"


PARAMETER_CAPABILITIES = frozenset(
    {
        Verb.LIST_PARAMETERS,
        Verb.READ_PARAMETER,
        Verb.READ_ALL_PARAMETERS,
        Verb.WRITE_PARAMETER,
        Verb.CLEAR_COUNTER,
        Verb.READ_ALARMS,
        Verb.READ_PROFILE,
    }
)
"""What a drive with readable parameters can do and one with a position loop of its own cannot."""

TRACE_CAPABILITIES = frozenset({Verb.TRACE, Verb.TRACE_ABORT})
"""What every drive can do that can be polled."""
