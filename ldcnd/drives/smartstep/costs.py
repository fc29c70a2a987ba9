"""The price list of a SmartStep: 14 characters each way at 9600 baud, and a wait that only its maximum is known of.

Source: manual 2.1 "Basic specifications", 2.2.
"""

from functools import partial
from types import MappingProxyType
from typing import Any

from ldcnd.contract.samples import MonitorName, TelemetryItem
from ldcnd.drives.cost import PriceList
from ldcnd.drives.smartstep import commands
from ldcnd.drives.smartstep.addresses import TRACE_1_AREA, OperatingMode, TraceRegister
from ldcnd.drives.smartstep.commands import string_reference
from ldcnd.drives.smartstep.monitors import COUNTERS
from ldcnd.drives.smartstep.poller import BASIC_WORDS, Item
from ldcnd.drives.smartstep.profiles import SMARTSTEP, SmartStepProfile
from ldcnd.line.exchange import Exchange

BAUD = 9600
COUNTER_WORDS = 3
"""High half, low half, high half again."""
ANY_UNIT = 1
"""The price is the same for every unit."""


def price_list(profile: SmartStepProfile = SMARTSTEP) -> PriceList:
    """Return the exchanges of a drive; a reading is one word, for any item."""
    chunk = string_reference(ANY_UNIT, TRACE_1_AREA[0], profile.trace_chunk_bytes, profile)
    exchanges: dict[str, Exchange[Any]] = {
        "read word": commands.reference(ANY_UNIT, 0),
        "write trace register": commands.write_trace_register(ANY_UNIT, next(iter(TraceRegister)), 0),
        "set operating mode": commands.set_operating_mode(ANY_UNIT, OperatingMode.NORMAL),
        "probe": commands.probe(ANY_UNIT),
        f"read string of {profile.trace_chunk_bytes} bytes": chunk,
    }
    return PriceList(
        node_baud=float(BAUD),
        reading=partial(_reading, profile),
        commands=MappingProxyType(
            {name: commands.with_response_time(exchange, profile) for name, exchange in exchanges.items()}
        ),
        probe=commands.with_response_time(commands.probe(ANY_UNIT), profile),
        stop=None,
        flush=commands.FLUSH,
        settle_s=profile.quiet_s,
    )


def words_of(item: Item) -> int:
    """Return how many words an item is; a counter near a carry takes more."""
    if isinstance(item, MonitorName):
        return COUNTER_WORDS if item in COUNTERS else 1
    return len(BASIC_WORDS[item]) if item in BASIC_WORDS else COUNTER_WORDS


def _reading(profile: SmartStepProfile, _items: frozenset[TelemetryItem]) -> Exchange[Any]:
    return commands.with_response_time(commands.reference(ANY_UNIT, 0), profile)
