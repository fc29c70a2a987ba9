"""The operating modes of address 2000H, a closed list.

Related drives move their motor in other modes (jog, auto-tuning, origin search). So commands.py takes no number for
2000H, only a member of this enumeration.
Source: manual 4, settings 1; 5 (2); 6 (2).
"""

from enum import IntEnum


class OperatingMode(IntEnum):
    """What the drive is doing beside its normal work."""

    NORMAL = 0x0000
    DATA_TRACE = 0x2000
    COMMAND_COUNTER_CLEAR = 0x2003
    FEEDBACK_COUNTER_CLEAR = 0x2004


def operating_mode(word: int) -> OperatingMode | int:
    """Return the mode that a drive reports, as a plain number when it is not a documented one."""
    try:
        return OperatingMode(word)
    except ValueError:
        return word
