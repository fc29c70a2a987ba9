"""What a trace records, how often, and what starts it, as the words of 5000H to 5005H.

Source: manual 4, settings 3 to 8.
"""

from dataclasses import dataclass
from enum import Enum, IntEnum

from ldcnd.drivers.smartstep.profiles import SmartStepProfile, TriggerWordSource
from ldcnd.drivers.smartstep.trace_memory import POINTS
from ldcnd.errors import NotSupported, ValueOutOfRange

NO_TRIGGER = 0x0000
"""Both edges disabled under any layout with positive enable bits (INFERRED_HIGH)."""
SHORTEST_INTERVAL = 2
"""The drive does not refuse 0 and 1, so ldcnd does."""
LONGEST_INTERVAL = 0xFFFF


class DataObject(IntEnum):
    """The value of a trace point. 02H, speed command on related drives, is not listed."""

    TORQUE_REFERENCE = 0x00
    SPEED_FEEDBACK = 0x01
    COMMAND_PULSE_SPEED = 0x03
    POSITION_DEVIATION = 0x04


class IoObject(IntEnum):
    """The I/O bit of a trace point; function codes, not the bit numbers of 8005H and 8006H."""

    RUN = 0x00
    RESET = 0x06
    ALM = 0x80
    INP = 0x81
    BKIR = 0x87


class TriggerObject(Enum):
    """What a trigger watches."""

    TRACE_1 = "trace1"
    TRACE_2 = "trace2"
    IO = "io"


class Edge(Enum):
    """Which change is a trigger."""

    RISING = "rising"
    FALLING = "falling"
    BOTH = "both"


@dataclass(frozen=True, slots=True)
class TriggerWord:
    """The word of 5004H and where it comes from, to be kept with the result."""

    word: int
    source: TriggerWordSource


def object_word(data: DataObject, io: IoObject) -> int:
    """Return the word of 5000H or 5001H: I/O code in the left byte, data code in the right one."""
    return io << 8 | data


def sampling_interval(period_s: float, cyclec_us: int) -> int:
    """Return SMPTMS, the sampling interval in units of CYCLEC, nearest to a wanted period.

    Args:
        period_s: of one point.
        cyclec_us: 8700H of this drive, microseconds; read for each trace.

    Raises:
        ValueOutOfRange: the drive reports no time unit, or the interval is not 2 to FFFFH units.
    """
    if cyclec_us <= 0:
        raise ValueOutOfRange(f"a sampling time unit of {cyclec_us} us is impossible", value=cyclec_us)
    unit_s = cyclec_us * 1e-6
    shortest_s, longest_s = SHORTEST_INTERVAL * unit_s, LONGEST_INTERVAL * unit_s
    if not SHORTEST_INTERVAL - 0.5 <= period_s / unit_s < LONGEST_INTERVAL + 0.5:
        raise ValueOutOfRange(
            f"a sampling period of {period_s} s is not {shortest_s} to {longest_s} s",
            value=period_s,
            nearest=min(max(period_s, shortest_s), longest_s),
        )
    return min(max(round(period_s / unit_s), SHORTEST_INTERVAL), LONGEST_INTERVAL)


def period_s(smptms: int, cyclec_us: int) -> float:
    """Return the time between two points."""
    return smptms * cyclec_us * 1e-6


def duration_s(smptms: int, cyclec_us: int) -> float:
    """Return the time that a trace records."""
    return POINTS * period_s(smptms, cyclec_us)


def trigger_word(profile: SmartStepProfile, watched: TriggerObject, edge: Edge) -> TriggerWord:
    """Return the trigger condition by the profile's map.

    Raises:
        NotSupported: the profile has no map; there is none to ship, as the manual's figure is lost.
    """
    bits = profile.trigger_map
    if profile.trigger_word is not TriggerWordSource.CONFIGURED or bits is None:
        raise NotSupported(
            "the bits of the trigger condition are not known for this drive",
            remedy="trace without a trigger, or find the bits on a bench and configure trigger_word",
        )
    word = {TriggerObject.TRACE_1: bits.trace1, TriggerObject.TRACE_2: bits.trace2, TriggerObject.IO: bits.io}[watched]
    if edge is not Edge.FALLING:
        word |= bits.rising
    if edge is not Edge.RISING:
        word |= bits.falling
    return TriggerWord(word, TriggerWordSource.CONFIGURED)


def raw_trigger_word(profile: SmartStepProfile, word: int) -> TriggerWord:
    """Return a trigger condition that the caller knows by number.

    Raises:
        NotSupported: the profile does not allow it.
        ValueOutOfRange: it does not fit 16 bits.
    """
    if profile.trigger_word is not TriggerWordSource.RAW:
        raise NotSupported("the profile does not allow a raw trigger word", value=word)
    if not 0 <= word <= 0xFFFF:  # noqa: PLR2004 - one register
        raise ValueOutOfRange(f"trigger word {word} does not fit 16 bits", value=word, limit=0xFFFF)
    return TriggerWord(word, TriggerWordSource.RAW)


def no_trigger() -> TriggerWord:
    """Return the condition that is never waited for."""
    return TriggerWord(NO_TRIGGER, TriggerWordSource.NONE)
