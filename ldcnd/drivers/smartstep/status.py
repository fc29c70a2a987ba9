"""Status displays: the monitors Un, signal bits, switches and identity words.

Signal bits are electrical levels: 1 is high, 0 is low, whatever a signal means; bits that the manual calls not used are
dropped.
Source: manual 3, "Correspondence of addresses and driver status displays" and the tables after it.
"""

from dataclasses import dataclass
from enum import IntEnum, IntFlag

from ldcnd.drivers.smartstep.profiles import SmartStepProfile


@dataclass(frozen=True, slots=True)
class Monitor:
    """One word of the status displays.

    Attributes:
        label: the monitor's number on the display.
        unit: empty for bits.
        signed: two's complement.
    """

    address: int
    label: str
    title: str
    unit: str
    signed: bool = False

    def value_of(self, word: int) -> int:
        """Return the word as a number in `unit`."""
        return signed_word(word) if self.signed else word


def signed_word(word: int) -> int:
    """Return 16 bits as two's complement."""
    return word - 0x10000 if word & 0x8000 else word


SPEED_FEEDBACK = Monitor(0x8000, "Un000", "Speed feedback", "r/min", signed=True)
SPEED_REFERENCE = Monitor(0x8001, "Un001", "Speed reference", "r/min", signed=True)
TORQUE_REFERENCE = Monitor(0x8002, "Un002", "Torque reference", "%", signed=True)
PULSES_FROM_Z = Monitor(0x8003, "Un003", "Number of pulses from phase Z", "pulses")
ELECTRICAL_ANGLE = Monitor(0x8004, "Un004", "Electrical angle", "degrees")
INPUT_SIGNALS = Monitor(0x8005, "Un005", "Input signal monitoring", "")
OUTPUT_SIGNALS = Monitor(0x8006, "Un006", "Output signal monitoring", "")
REFERENCE_PULSE_SPEED = Monitor(0x8007, "Un007", "Reference pulse speed display", "r/min", signed=True)
POSITION_DEVIATION = Monitor(0x8008, "Un008", "Position deviation (deviation counter)", "command units", signed=True)
CUMULATIVE_LOAD = Monitor(0x8009, "Un009", "Cumulative load ratio", "%")
REGENERATIVE_LOAD = Monitor(0x800A, "Un00A", "Regenerative load ratio", "%")
BRAKE_LOAD = Monitor(0x800B, "Un00B", "Dynamic brake resistance load ratio", "%")
INPUT_COUNTER_LOW = Monitor(0x800C, "Un00C", "Input pulse counter (rightmost 16 bits)", "command units")
INPUT_COUNTER_HIGH = Monitor(0x800D, "Un00C", "Input pulse counter (leftmost 16 bits)", "command units")
FEEDBACK_COUNTER_LOW = Monitor(0x800E, "Un00D", "Feedback pulse counter (rightmost 16 bits)", "pulses")
FEEDBACK_COUNTER_HIGH = Monitor(0x800F, "Un00D", "Feedback pulse counter (leftmost 16 bits)", "pulses")

MONITORS: tuple[Monitor, ...] = (
    SPEED_FEEDBACK,
    SPEED_REFERENCE,
    TORQUE_REFERENCE,
    PULSES_FROM_Z,
    ELECTRICAL_ANGLE,
    INPUT_SIGNALS,
    OUTPUT_SIGNALS,
    REFERENCE_PULSE_SPEED,
    POSITION_DEVIATION,
    CUMULATIVE_LOAD,
    REGENERATIVE_LOAD,
    BRAKE_LOAD,
    INPUT_COUNTER_LOW,
    INPUT_COUNTER_HIGH,
    FEEDBACK_COUNTER_LOW,
    FEEDBACK_COUNTER_HIGH,
)
"""In order of address, without a gap."""


class InputSignal(IntFlag):
    """Bits of 8005H."""

    RUN = 0x0001  # CN1-14
    RESET = 0x0010  # CN1-18


class OutputSignal(IntFlag):
    """Bits of 8006H."""

    ALM = 0x0001  # CN1-34
    INP = 0x0002  # CN1-8
    BKIR = 0x0040  # CN1-7


class FunctionSwitch(IntFlag):
    """Bits of 8106H; 1 is on."""

    ONLINE_AUTO_TUNING = 0x01  # No. 1
    DYNAMIC_BRAKE = 0x02  # No. 2
    COMMAND_PULSE_INPUT = 0x04  # No. 3
    RESOLUTION_4 = 0x08  # No. 4
    RESOLUTION_5 = 0x10  # No. 5
    PARAMETERS_RULE = 0x20  # No. 6; which level means so is RECOLLECTED


class DriverType(IntEnum):
    """Words of 8800H; the manual prints the same word for R7D-APL and R7D-APH, so they cannot be told apart."""

    R7D_AP = 0x000C


def input_levels(word: int) -> InputSignal:
    """Return the levels in 8005H."""
    return InputSignal(word & (InputSignal.RUN | InputSignal.RESET))


def output_levels(word: int) -> OutputSignal:
    """Return the levels in 8006H."""
    return OutputSignal(word & (OutputSignal.ALM | OutputSignal.INP | OutputSignal.BKIR))


def function_switches(word: int) -> FunctionSwitch:
    """Return the switches in 8106H."""
    return FunctionSwitch(word & 0x3F)


def gain_switch(word: int) -> int:
    """Return the position of the gain rotary switch in 8105H, 0 to 15."""
    return word & 0xF


def driver_type(word: int) -> DriverType | int:
    """Return the type in 8800H, as a plain number when it is not listed."""
    return DriverType.R7D_AP if word == DriverType.R7D_AP else word


def run_is_on(profile: SmartStepProfile, levels: InputSignal) -> bool:
    """Tell whether RUN asks for servo-on; which level does is a doubt of the profile."""
    return bool(levels & InputSignal.RUN) is not profile.run_active_low


def reset_is_on(profile: SmartStepProfile, levels: InputSignal) -> bool:
    """Tell whether RESET asks for an alarm reset; which level does is a doubt of the profile."""
    return bool(levels & InputSignal.RESET) is not profile.reset_active_low


def alarm_is_out(profile: SmartStepProfile, levels: OutputSignal) -> bool:
    """Tell whether /ALM says alarm; which level does is a doubt of the profile."""
    return bool(levels & OutputSignal.ALM) is profile.alarm_output_high
