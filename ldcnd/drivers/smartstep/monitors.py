"""The monitors by their public names: which words make each, and what they say.

Source: manual 3, "Correspondence of addresses and driver status displays" and the tables after it.
"""

from collections.abc import Mapping
from enum import IntFlag
from types import MappingProxyType

from ldcnd.drivers.monitor_value import MonitorValue
from ldcnd.drivers.smartstep import status
from ldcnd.drivers.smartstep.addresses import Register
from ldcnd.drivers.smartstep.counters import Counter
from ldcnd.drivers.smartstep.status import Monitor
from ldcnd.model.monitors import MonitorName

GAIN_SWITCH = Monitor(Register.GAIN_SWITCH, "", "Gain rotary switch", "")
FUNCTION_SWITCHES = Monitor(Register.FUNCTION_SWITCHES, "", "Function selection switches", "")

WORDS: Mapping[MonitorName, Monitor] = MappingProxyType(
    {
        MonitorName.SPEED_FEEDBACK: status.SPEED_FEEDBACK,
        MonitorName.SPEED_REFERENCE: status.SPEED_REFERENCE,
        MonitorName.TORQUE_REFERENCE: status.TORQUE_REFERENCE,
        MonitorName.PULSES_FROM_Z: status.PULSES_FROM_Z,
        MonitorName.ELECTRICAL_ANGLE: status.ELECTRICAL_ANGLE,
        MonitorName.INPUT_SIGNALS: status.INPUT_SIGNALS,
        MonitorName.OUTPUT_SIGNALS: status.OUTPUT_SIGNALS,
        MonitorName.REFERENCE_PULSE_SPEED: status.REFERENCE_PULSE_SPEED,
        MonitorName.POSITION_DEVIATION: status.POSITION_DEVIATION,
        MonitorName.CUMULATIVE_LOAD: status.CUMULATIVE_LOAD,
        MonitorName.REGENERATIVE_LOAD: status.REGENERATIVE_LOAD,
        MonitorName.BRAKE_LOAD: status.BRAKE_LOAD,
        MonitorName.GAIN_SWITCH: GAIN_SWITCH,
        MonitorName.FUNCTION_SWITCHES: FUNCTION_SWITCHES,
    }
)
"""Monitors of one word."""

COUNTERS: Mapping[MonitorName, Counter] = MappingProxyType(
    {MonitorName.INPUT_COUNTER: Counter.COMMAND, MonitorName.FEEDBACK_COUNTER: Counter.FEEDBACK}
)
"""Monitors of two words that are read by turns."""


def word_value(name: MonitorName, word: int) -> MonitorValue:
    """Return what the word of a monitor says."""
    monitor = WORDS[name]
    bits: IntFlag | None = None
    match name:
        case MonitorName.INPUT_SIGNALS:
            bits = status.input_levels(word)
        case MonitorName.OUTPUT_SIGNALS:
            bits = status.output_levels(word)
        case MonitorName.FUNCTION_SWITCHES:
            bits = status.function_switches(word)
        case MonitorName.GAIN_SWITCH:
            word = status.gain_switch(word)
        case _:
            pass
    if bits is None:
        return MonitorValue(name, monitor.value_of(word), monitor.unit, monitor.title)
    return MonitorValue(name, int(bits), "", monitor.title, tuple(bit.name or "" for bit in bits))


def counter_value(name: MonitorName, signed: int, *, resolved: bool) -> MonitorValue:
    """Return what a counter says."""
    low = COUNTERS[name].low
    title = low.title.removesuffix(" (rightmost 16 bits)")
    return MonitorValue(name, signed, low.unit, title, resolved=resolved)
