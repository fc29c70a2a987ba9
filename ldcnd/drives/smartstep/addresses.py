"""The address map without parameters and monitors, and the operating modes of 2000H, a closed list.

Related drives move their motor in other modes (jog, auto-tuning, origin search). So commands.py takes no number for
2000H, only a member of the enumeration.
Source: manual 3, 4, 5 (2) and 6 (2), address tables.
"""

from enum import IntEnum

EEPROM_AREA = range(0x1000)
RAM_AREA = range(0x1000, 0x2000)
RAM_OFFSET = 0x1000
TRACE_1_AREA = range(0x3000, 0x33E8)
TRACE_2_AREA = range(0x3800, 0x3BE8)
NEVER_VALID = 0xC000
"""The manual's own example of an address error: answers to it prove that a unit is alive and change nothing."""


class Register(IntEnum):
    """A single address that can be read with a reference command, unless it says otherwise."""

    OPERATING_MODE = 0x2000
    OPERATION = 0x2001
    """For setting only; the manual's "only for reading" is a misprint (poll 2000H instead)."""
    TRACE_1_OBJECT = 0x5000
    TRACE_2_OBJECT = 0x5001
    SMPTMS = 0x5002
    PTRGNO = 0x5003
    TRGC1 = 0x5004
    TRGC2 = 0x5005
    TRGADR = 0x5006
    TRACE_1_OBJECT_ADDRESS = 0x5100
    """Not explained; never written."""
    TRACE_2_OBJECT_ADDRESS = 0x5101
    GAIN_SWITCH = 0x8105
    FUNCTION_SWITCHES = 0x8106
    ALARM_HISTORY = 0x8500
    """Ten entries, to 8509H."""
    PRESENT_ALARM = 0x850A
    AUTO_TUNING_RESULT = 0x850B
    SOFTWARE_VERSION = 0x8518
    CYCLEC = 0x8700
    MAXTRQC = 0x8701
    OSVELCC = 0x8702
    DRIVER_TYPE = 0x8800


class TraceRegister(IntEnum):
    """Settings for a trace: all of them are written before Data Trace Mode is entered.

    The manual speaks of MAXTRQC and OSVELCC as settings that raise the resolution of a trace, and lists them among
    constants: whether a drive takes them is an assumption.
    """

    TRACE_1_OBJECT = Register.TRACE_1_OBJECT
    TRACE_2_OBJECT = Register.TRACE_2_OBJECT
    SMPTMS = Register.SMPTMS
    PTRGNO = Register.PTRGNO
    TRGC1 = Register.TRGC1
    TRGC2 = Register.TRGC2
    MAXTRQC = Register.MAXTRQC
    OSVELCC = Register.OSVELCC


class OperatingMode(IntEnum):
    """The drive's activity beside its normal work."""

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
