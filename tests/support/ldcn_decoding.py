"""LDCN and NMC commands back from their bytes, strictly: what a module would tolerate is refused."""

from ldcnd.contract.errors import BadReply
from ldcnd.drives.ldcn.packet import decode_packet
from ldcnd.drives.ldcn.profiles import Profile
from ldcnd.drives.ldcn.received import Interpretation, interpret
from ldcnd.drives.ldcn.trajectory import REVERSE, SPEED_MASK, PathPoint, point_cycles


def decode_command(profile: Profile, data: bytes) -> Interpretation:
    """Take exactly one packet that is as the manual wants it for this device.

    Raises:
        BadReply: a damaged frame, a count that does not fit the command, or a command that the device does not define.
    """
    interpretation = interpret(profile, decode_packet(data))
    if interpretation.oddities:
        raise BadReply("; ".join(interpretation.oddities))
    return interpretation


def decode_point(word: int, *, fast_path: bool) -> PathPoint:
    """Take a word as the module would; bits below the step count as a fraction of it and are cut off."""
    cycles = point_cycles(word, fast_path=fast_path)
    counts = (word & SPEED_MASK) * cycles // 256  # the speed has 8 bits of fraction
    return PathPoint(-counts if word & REVERSE else counts, cycles)
