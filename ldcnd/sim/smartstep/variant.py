"""How a simulated SmartStep behaves where the manual leaves room.

The host's assumptions are in profiles.py; a test makes the two agree, or differ on purpose.
"""

from dataclasses import dataclass

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


@dataclass(frozen=True, slots=True)
class SimulatedVariant:
    """One possible drive.

    Attributes:
        response_s: from a command's CR to the first reply character; 0.2 is the longest allowed.
        string_checksum: any but AUTO.
        longest_string_bytes: more is an error in number of bytes.
        overrun_status: the answer to a string that begins inside a trace memory and ends beyond it.
        eeprom_changes_ram: an EEPROM write also changes the value in use.
        counter_strings: a string reference at 800CH reads both halves of a counter at one instant; otherwise it is an
            address error.
        hears_itself: two wires, and the receiver stays on while the drive sends.
        alarm_output_high: /ALM is 1 in alarm.
        run_active_low: RUN is on at level 0, `reset_active_low` the same for RESET.
        trigger_waits: no trigger is taken before the pre-trigger points are filled.
        clear_s: how long a counter clear takes.
        cyclec_us: 8700H; `maxtrqc` 8701H, `osvelcc` 8702H at power-on.
        full_scale_settable: 8701H and 8702H take settings; otherwise they are address errors.
        command_pulse_gear: by which way of gearing the traced command pulses become the motor's speed.
    """

    response_s: float = 0.01
    string_checksum: StringChecksum = StringChecksum.HEADER
    string_count_unit: CountUnit = CountUnit.BYTES
    longest_string_bytes: int = 1000
    overrun_status: ResponseStatus = ResponseStatus.STRING_ADDRESS_ERROR
    eeprom_changes_ram: bool = False
    counter_strings: bool = False
    hears_itself: bool = False
    trace_word_layout: TraceWordLayout = TraceWordLayout.MSB_IO
    trace_byte_order: ByteOrder = ByteOrder.BIG
    trigger_map: TriggerMap = BENCH_TRIGGER_MAP
    trigger_waits: bool = True
    alarm_output_high: bool = True
    run_active_low: bool = True
    reset_active_low: bool = True
    clear_s: float = 0.01
    cyclec_us: int = 250
    maxtrqc: int = 300
    osvelcc: int = 4500
    full_scale_settable: bool = True
    command_pulse_gear: CommandPulseGear = CommandPulseGear.NUM_DEN
    software_version: int = 0x0001
    encoder_counts_per_rev: int = 8000
