"""The family of SmartSteps: from the configuration of a line to its bus and its plan.

An exchange is 14 characters each way at 9600 baud, and a wait of which only the maximum is known.
Source: manual 2.1 "Basic specifications", 2.2.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

from typing_extensions import override

from ldcnd.contract.samples import MonitorName, TelemetryItem
from ldcnd.drives.cost import Cost, LineTiming, PriceList, cost_of
from ldcnd.drives.driver import AxisSpec
from ldcnd.drives.family import Demand, Family, HasParameterFiles, OpenLine, UnopenedLine, bus_settings
from ldcnd.drives.line_plan import Poll, Urgent
from ldcnd.drives.smartstep import commands
from ldcnd.drives.smartstep.addresses import TRACE_1_AREA, OperatingMode, TraceRegister
from ldcnd.drives.smartstep.config import SmartStepAxisConfig, SmartStepBusConfig
from ldcnd.drives.smartstep.drive import UnitSpec
from ldcnd.drives.smartstep.ledger import EepromLedger
from ldcnd.drives.smartstep.monitors import COUNTERS, HISTORY_LENGTH
from ldcnd.drives.smartstep.network import smartstep_line, smartstep_opener
from ldcnd.drives.smartstep.packet import SmartStepTranscript
from ldcnd.drives.smartstep.parameters import PARAMETERS, digit_texts
from ldcnd.drives.smartstep.poller import BASIC_WORDS, PUBLISHED, Basic, Item
from ldcnd.drives.smartstep.profiles import SMARTSTEP as PROFILE
from ldcnd.drives.smartstep.profiles import Echo, Framing, SmartStepProfile
from ldcnd.drives.smartstep.transfer import check_values, listed
from ldcnd.line.exchange import Exchange
from ldcnd.line.flight_recorder import Describe
from ldcnd.line.port_url import port_opener
from ldcnd.line.transport import Framing as SerialFraming
from ldcnd.line.transport import Opener

BAUD = 9600
COUNTER_WORDS = 3
"""High half, low half, high half again."""
ANY_UNIT = 1
"""The price is the same for every unit."""
LEDGER_FILE = "eeprom-writes.json"
ALARM_HISTORY_HZ = HISTORY_LENGTH / 60
"""One word a turn: an alarm that came and went between two readings of the state is found within a minute."""


class SmartStepFamily(Family[SmartStepBusConfig], HasParameterFiles):
    """OMRON SmartStep."""

    name = "smartstep"
    bus_config = SmartStepBusConfig

    @override
    def open_lines(self, state_dir: Path | None) -> OpenLine[SmartStepBusConfig]:
        ledger = EepromLedger(state_dir / LEDGER_FILE) if state_dir else None
        return partial(open_smartstep_line, ledger=ledger)

    @override
    def plan(self, settings: SmartStepBusConfig) -> Demand:
        timing = LineTiming(BAUD, BAUD, adapter_latency_s=settings.adapter_latency_ms / 1000)
        # the silence before each command counts as the host's
        timing = replace(timing, turnaround_s=max(timing.turnaround_s, PROFILE.quiet_s))
        return Demand(timing, _polls(settings, timing), _urgent(settings, timing), by_deadline=False)

    @override
    def describe(self, models: Mapping[int, str]) -> Describe:
        return SmartStepTranscript().describe

    @override
    def check_parameters(self, values: Mapping[str, int]) -> tuple[tuple[str, ...], tuple[str, ...]]:
        return check_values(values)

    @override
    def parameter(self, name: str, value: int) -> tuple[str, str, Sequence[str]]:
        parameter = listed(name)
        if parameter is None:
            return name, str(value), ()
        return (
            parameter.label,
            f"0x{value:04X}" if parameter.nibbles else str(value),
            digit_texts(parameter, value),
        )


SMARTSTEP = SmartStepFamily()


def open_smartstep_line(
    settings: SmartStepBusConfig,
    opener: Opener | None = None,
    *,
    ledger: EepromLedger | None = None,
) -> UnopenedLine:
    """Return a line that is not open yet; what concerns the line is the same for all of its drives.

    Args:
        settings: the line.
        opener: opens the line, its framing included, instead of its port.
        ledger: counts EEPROM writes.
    """
    profile = settings.profile(settings.axis[0])
    specs = tuple(
        UnitSpec(
            AxisSpec(axis.name, axis.address, axis.model, None),
            settings.profile(axis),
            rates_hz(axis),
            ledger,
        )
        for axis in settings.axis
    )
    line = smartstep_line(
        bus_settings(
            settings, BAUD, margin_s=profile.quiet_s, attempts=profile.attempts, echo=profile.echo is Echo.EXPECT
        ),
        opener or smartstep_opener(_port_opener(settings, profile), profile),
        specs,
    )
    return UnopenedLine(*line)


def _port_opener(settings: SmartStepBusConfig, profile: SmartStepProfile) -> Opener:
    framing: SerialFraming = "7e1" if profile.framing is Framing.SEVEN_EVEN else "8n1"
    return port_opener(settings.port, BAUD, framing, rs485=settings.rs485)


# -- the load of a line: items are read word by word, and the words of all its units take turns -------------


def rates_hz(axis: SmartStepAxisConfig) -> Mapping[Item, float]:
    """Return what is read of a unit and how often."""
    wanted: dict[Item, float] = {basic: axis.rates.read_hz[item] for basic, item in PUBLISHED.items()}
    wanted[Basic.ALARM_HISTORY] = ALARM_HISTORY_HZ
    audit_s = axis.smartstep.audit_s
    wanted[Basic.PARAMETERS] = len(PARAMETERS) / audit_s if audit_s else 0.0
    wanted.update(axis.smartstep.monitors.items())
    return wanted


def _polls(bus: SmartStepBusConfig, timing: LineTiming) -> list[Poll]:
    """Return every item of every unit with what all its words take together."""
    polls = []
    for axis in bus.axis:
        word = price_list(_planned(axis)).reading(frozenset())
        cost = cost_of(word, timing)
        for item, rate_hz in rates_hz(axis).items():
            if rate_hz > 0:
                words = words_of(item)
                polls.append(
                    Poll(
                        axis=axis.name,
                        items=(item.value,),
                        rate_hz=rate_hz,
                        cost=_times(words, cost),
                        mean_s=words * cost.longest_s,
                        exchanges=words,
                    )
                )
    return polls


def _urgent(bus: SmartStepBusConfig, timing: LineTiming) -> Urgent:
    """Return what goes before polls: the exchanges of commissioning and traces; nothing on this line stops a motor."""
    prices = [price_list(_planned(axis)) for axis in bus.axis]
    costs = [cost_of(exchange, timing) for price in prices for exchange in price.commands.values()]
    flush_s = len(prices[0].flush) * timing.bits_per_byte / timing.host_baud
    return Urgent(
        command_s=max(cost.longest_s for cost in costs),
        stop_s=0.0,
        recovery_s=flush_s + prices[0].settle_s,
        margin_s=bus.margin_ms / 1000,
    )


def _planned(axis: SmartStepAxisConfig) -> SmartStepProfile:
    return PROFILE.with_unit(first_character_s=axis.smartstep.planned_response_s)


def _times(words: int, cost: Cost) -> Cost:
    return Cost(
        request_s=words * cost.request_s,
        wait_s=words * cost.wait_s,
        reply_s=words * cost.reply_s,
        overhead_s=words * cost.overhead_s,
        ends_early=False,
        request_bytes=words * cost.request_bytes,
        reply_bytes=words * cost.reply_bytes,
    )


def price_list(profile: SmartStepProfile = PROFILE) -> PriceList:
    """Return the exchanges of a drive; a reading is one word, for any item."""
    chunk = commands.string_reference(ANY_UNIT, TRACE_1_AREA[0], profile.unit.trace.chunk_bytes, profile)
    exchanges: dict[str, Exchange[Any]] = {
        "read word": commands.reference(ANY_UNIT, 0),
        "write trace register": commands.write_trace_register(ANY_UNIT, next(iter(TraceRegister)), 0),
        "set operating mode": commands.set_operating_mode(ANY_UNIT, OperatingMode.NORMAL),
        "probe": commands.probe(ANY_UNIT),
        f"read string of {profile.unit.trace.chunk_bytes} bytes": chunk,
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
