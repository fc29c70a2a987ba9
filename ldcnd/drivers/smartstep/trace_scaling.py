"""Trace data in units: torque in %, speed in r/min, deviation in command units, and back for the trigger level.

The printed formulas for command pulse speed divide numerator and denominator one way and the other; the profile says
which is taken (at gear 1/1 all agree), and raw counts are to be kept beside the result.
Source: manual 4, "Unit conversion" (twice).
"""

from dataclasses import dataclass

from ldcnd.drivers.smartstep.profiles import CommandPulseGear, SmartStepProfile
from ldcnd.drivers.smartstep.trace_setup import DataObject
from ldcnd.drivers.smartstep.trace_words import FULL_SCALE
from ldcnd.errors import BadReply, ValueOutOfRange

_US_PER_MINUTE = 60_000_000


@dataclass(frozen=True, slots=True)
class TraceConstants:
    """What scales a trace; read from the drive for each one.

    Attributes:
        cyclec_us: 8700H.
        maxtrqc: 8701H, torque in % at data 15,000.
        osvelcc: 8702H, speed in r/min at data 15,000.
        gear_numerator: RATB, Pn202.
        gear_denominator: RATA, Pn203.

    Raises:
        BadReply: a constant is zero, which no scaling survives.
    """

    cyclec_us: int
    maxtrqc: int
    osvelcc: int
    gear_numerator: int = 1
    gear_denominator: int = 1

    def __post_init__(self) -> None:
        if not all((self.cyclec_us, self.maxtrqc, self.osvelcc, self.gear_numerator, self.gear_denominator)):
            raise BadReply(f"trace constants cannot be zero: {self}")


def unit_of(data: DataObject) -> str:
    """Return the unit of scaled data."""
    match data:
        case DataObject.TORQUE_REFERENCE:
            return "%"
        case DataObject.SPEED_FEEDBACK | DataObject.COMMAND_PULSE_SPEED:
            return "r/min"
        case DataObject.POSITION_DEVIATION:
            return "command units"


def scale(profile: SmartStepProfile, constants: TraceConstants, data: DataObject) -> float:
    """Return what one count of trace data is worth in `unit_of(data)`."""
    match data:
        case DataObject.TORQUE_REFERENCE:
            return constants.maxtrqc / FULL_SCALE
        case DataObject.SPEED_FEEDBACK:
            return constants.osvelcc / FULL_SCALE
        case DataObject.COMMAND_PULSE_SPEED:
            per_minute = _US_PER_MINUTE / (2 * constants.cyclec_us)
            return _gear(profile, constants) * per_minute / profile.encoder_counts_per_rev
        case DataObject.POSITION_DEVIATION:
            return 1.0


def trigger_level(profile: SmartStepProfile, constants: TraceConstants, data: DataObject, level: float) -> int:
    """Return the word of 5005H for a level in `unit_of(data)`.

    Raises:
        ValueOutOfRange: the level does not fit 16 bits with sign.
    """
    unit = scale(profile, constants, data)
    count = round(level / unit)
    if not -0x8000 <= count <= 0x7FFF:  # noqa: PLR2004 - 16 bits with sign
        raise ValueOutOfRange(
            f"trigger level {level} {unit_of(data)} is {count} in trace data, beyond 16 bits",
            value=level,
            limit=0x7FFF * unit,
        )
    return count & 0xFFFF


def _gear(profile: SmartStepProfile, constants: TraceConstants) -> float:
    match profile.command_pulse_gear:
        case CommandPulseGear.NUM_DEN:
            return constants.gear_numerator / constants.gear_denominator
        case CommandPulseGear.DEN_NUM:
            return constants.gear_denominator / constants.gear_numerator
        case CommandPulseGear.NONE:
            return 1.0
