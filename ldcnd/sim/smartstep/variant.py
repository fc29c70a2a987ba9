"""How a simulated SmartStep behaves where the manual leaves room.

The host's assumptions are in profiles.py; a test makes the two agree, or differ on purpose.
"""

from pydantic import Field

from ldcnd.contract.frozen import Frozen
from ldcnd.drives.smartstep.packet import ResponseStatus
from ldcnd.drives.smartstep.profiles import (
    ByteOrder,
    CommandPulseGear,
    CountUnit,
    StringChecksum,
    TraceWordLayout,
    TriggerMap,
)

BENCH_TRIGGER_MAP = TriggerMap(trace1=0x0000, trace2=0x0001, io=0x0002, rising=0x0100, falling=0x0200)
"""An invented layout: the real one is not known, and nothing outside a simulation may use this one."""


class SimulatedVariantConfig(Frozen):
    """How a simulated drive behaves where the manual leaves room; the defaults are the assumptions of the driver."""

    response_s: float = Field(default=0.01, ge=0, le=5)
    """Time from a command to the first character of its reply, in seconds; the manual allows 0.2."""
    string_checksum: StringChecksum = StringChecksum.HEADER
    """Bytes that the checksum of a string reply covers."""
    string_count_unit: CountUnit = CountUnit.BYTES
    """Unit of the count in a string reference."""
    longest_string_bytes: int = Field(default=1000, ge=1, le=1000)
    """More is an error in number of bytes."""
    trace_word_layout: TraceWordLayout = TraceWordLayout.MSB_IO
    """Place of the signal's bit and the value in a word of the trace memory."""
    trace_byte_order: ByteOrder = ByteOrder.BIG
    """Half of a word that comes first in a string."""
    command_pulse_gear: CommandPulseGear = CommandPulseGear.NUM_DEN
    """Gearing by which traced command pulses become the motor's speed."""
    trigger_map: TriggerMap = BENCH_TRIGGER_MAP
    """The bits of the trigger condition; invented ones when missing."""
    full_scale_settable: bool = True
    """8701H and 8702H take settings."""
    eeprom_changes_ram: bool = False
    """A write to EEPROM also changes the value in use."""
    hears_itself: bool = False
    """It takes its own replies for commands."""
    run_active_low: bool = True
    """RUN is on at level 0."""
    reset_active_low: bool = True
    """RESET is on at level 0."""
    alarm_output_high: bool = True
    """/ALM is 1 in alarm."""
    inp_active_low: bool = False
    """INP is on at level 0."""
    bkir_active_low: bool = False
    """BKIR is on at level 0."""


class SimulatedVariant(SimulatedVariantConfig):
    """One possible drive, with what only tests vary."""

    overrun_status: ResponseStatus = ResponseStatus.STRING_ADDRESS_ERROR
    """The answer to a string that begins inside a trace memory and ends beyond it."""
    counter_strings: bool = False
    """A string reference at 800CH reads both halves of a counter at one instant; otherwise it is an address error."""
    trigger_waits: bool = True
    """No trigger is taken before the pre-trigger points are filled."""
    clear_s: float = 0.01
    """Time that a counter clear takes, in seconds."""
    cyclec_us: int = 250
    """Value of 8700H."""
    maxtrqc: int = 300
    """Value of 8701H at power-on."""
    osvelcc: int = 4500
    """Value of 8702H at power-on."""
    software_version: int = 0x0001
    """Version that the drive reports."""
    encoder_counts_per_rev: int = 8000
    """The divisor of the speed formula."""
