"""The limit switch pins of PIC-SERVO version 4, which can be outputs (PIC-SERVO manual, 5.2, "I/O Control")."""

from ldcnd.drivers.ldcn.controls import LimitPins
from ldcnd.model.requests import HomeMethod, PinMode

INPUTS = LimitPins.LIMIT1_INPUT | LimitPins.LIMIT2_INPUT
"""After power-up."""


def with_modes(pins: LimitPins, limit1: PinMode | None, limit2: PinMode | None) -> LimitPins:
    """Return the control byte with other modes; None leaves a pin as it is."""
    pins = _with_mode(pins, limit1, LimitPins.LIMIT1_INPUT, LimitPins.LIMIT1_HIGH)
    return _with_mode(pins, limit2, LimitPins.LIMIT2_INPUT, LimitPins.LIMIT2_HIGH)


def blocks_homing(pins: LimitPins, method: HomeMethod) -> bool:
    """Tell whether the pin that a capture relies on is an output."""
    match method:
        case HomeMethod.REVERSE_LIMIT:
            return not pins & LimitPins.LIMIT1_INPUT
        case HomeMethod.FORWARD_LIMIT:
            return not pins & LimitPins.LIMIT2_INPUT
        case _:
            return False


def _with_mode(pins: LimitPins, mode: PinMode | None, is_input: LimitPins, is_high: LimitPins) -> LimitPins:
    match mode:
        case None:
            return pins
        case PinMode.INPUT:
            return pins & ~is_high | is_input
        case PinMode.HIGH:
            return pins & ~is_input | is_high
        case PinMode.LOW:
            return pins & ~(is_input | is_high)
