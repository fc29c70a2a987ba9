"""From a configuration to what its lines promise, before anything is opened.

A plan that cannot hold is refused with the smallest changes that would make it hold, unless the line is told to skip
polls. Reckoned with the longest replies and waits; see docs/explanation/timing.md for the analysis.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

from ldcnd.bus.settings import ServoCycle
from ldcnd.config.axis import AxisConfig, RatesConfig
from ldcnd.config.bus import BAUDS, BusConfig
from ldcnd.config.rig import RigConfig
from ldcnd.drivers.ldcn.costs import price_list
from ldcnd.drivers.ldcn.profiles import CYCLE_CLOCKS
from ldcnd.drivers.ldcn.registers import BaudCodes, actual_baud, baud_at_reset, baud_divisor
from ldcnd.drivers.price_list import PriceList
from ldcnd.errors import ConfigError, ValueOutOfRange
from ldcnd.model.plan import BusPlan, ItemPlan, PollPlan, RigBudget
from ldcnd.model.samples import TelemetryItem
from ldcnd.planning import smartstep as smartstep_plan
from ldcnd.planning.cost import LineTiming, cost_of
from ldcnd.planning.line_plan import LinePlan, Poll, Urgent, in_time, largest, plan_line
from ldcnd.planning.response_times import PeriodicTask

SLOWEST_HZ = 0.01


def wanted_rates_hz(rates: RatesConfig, *, adc: bool) -> Mapping[TelemetryItem, float]:
    """Return the items that are polled and how often; `adc` tells whether the drive has a converter."""
    wanted = {
        TelemetryItem.POSITION: rates.position,
        TelemetryItem.VELOCITY: rates.velocity,
        TelemetryItem.ADC: rates.adc if adc else 0.0,
        TelemetryItem.STATE: rates.state,
    }
    return {item: rate for item, rate in wanted.items() if rate > 0}


def plan_rig(config: RigConfig) -> RigBudget:
    """Plan every line."""
    buses = tuple(plan_bus(bus) for bus in config.bus)
    return RigBudget(rig=config.rig, holds=all(bus.holds for bus in buses), buses=buses)


def require_plan(config: RigConfig) -> RigBudget:
    """Return the plan of a rig.

    Raises:
        ConfigError: a line cannot carry what is asked of it; says by how much, and what would make it fit.
    """
    plan = plan_rig(config)
    refused = [bus for bus in plan.buses if not bus.holds and bus.overload == "refuse"]
    if refused:
        raise ConfigError("\n".join(_refusal(bus) for bus in refused))
    return plan


def plan_bus(bus: BusConfig) -> BusPlan:
    """Plan one line."""
    bus = with_probes_that_fit(bus)
    line = _line(bus)
    by_deadline = bus.family == "ldcn"
    plan = plan_line(line.polls, line.urgent, by_deadline=by_deadline, cycle=servo_cycle(bus))
    return BusPlan(
        bus=bus.name,
        family=bus.family,
        baud=round(line.timing.host_baud),
        node_baud=line.timing.node_baud,
        turnaround_s=line.timing.turnaround_s,
        adapter_latency_s=line.timing.adapter_latency_s,
        load=plan.load,
        mean_load=plan.mean_load,
        commands_per_s=plan.commands_per_s,
        stop_wait_s=plan.stop_wait_s,
        stop_s=plan.stop_s,
        stop_after_loss_s=plan.stop_after_loss_s,
        stop_probe_hz=bus.stop_probe_hz if by_deadline else 0.0,
        holds=plan.holds,
        overload="skip" if bus.skips else "refuse",
        remedies=() if plan.holds else tuple(_remedies(_without_probes(bus))),
        polls=tuple(_described(bus, plan)),
    )


def servo_cycle(bus: BusConfig) -> ServoCycle | None:
    """Return the cycle that polls of the line are ordered by; None where they are not."""
    if bus.family != "ldcn" or bus.order != "phase":
        return None
    divisor = baud_divisor(bus.baud, BaudCodes(bus.divisors), bus.clock_hz)
    return ServoCycle(CYCLE_CLOCKS / bus.clock_hz, bus.baud / actual_baud(divisor, bus.clock_hz))


def with_probes_that_fit(bus: BusConfig) -> BusConfig:
    """Return the line without probes of its stop lane if nothing but them would make polls miss their turns."""
    if bus.family != "ldcn" or not bus.stop_probe_hz or _line(bus).fits:
        return bus
    return _without_probes(bus) if _line(_without_probes(bus)).fits else bus


def _without_probes(bus: BusConfig) -> BusConfig:
    return bus.model_copy(update={"stop_probe_hz": 0.0})


# -- what the line is asked to carry ---------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class _Line:
    """What a line is asked to carry, and how fast it is."""

    timing: LineTiming
    polls: list[Poll]
    urgent: Urgent
    by_deadline: bool

    @property
    def fits(self) -> bool:
        probes = [self.urgent.probe] if self.urgent.probe else []
        return in_time(self.polls, probes, by_deadline=self.by_deadline)


def _line(bus: BusConfig) -> _Line:
    if bus.family == "smartstep":
        timing = smartstep_plan.line_timing(bus)
        return _Line(
            timing, smartstep_plan.polls_of(bus, timing), smartstep_plan.urgent_of(bus, timing), by_deadline=False
        )
    prices = _prices(bus, bus.baud)
    timing = _timing(bus, bus.baud, prices)
    return _Line(timing, _polls(bus, timing, prices), _urgent(bus, timing, prices), by_deadline=True)


def _prices(bus: BusConfig, baud: int) -> Mapping[str, PriceList]:
    codes = BaudCodes(bus.divisors)
    models = {axis.model for axis in bus.axis}
    return MappingProxyType({model: price_list(model, baud, codes, bus.clock_hz) for model in sorted(models)})


def _timing(bus: BusConfig, baud: int, prices: Mapping[str, PriceList]) -> LineTiming:
    return LineTiming(
        host_baud=baud,
        node_baud=min(price.node_baud for price in prices.values()),
        adapter_latency_s=bus.adapter_latency_ms / 1000,
    )


def _polls(bus: BusConfig, timing: LineTiming, prices: Mapping[str, PriceList]) -> list[Poll]:
    polls = []
    for axis in bus.axis:
        price = prices[axis.model]
        rates_hz = wanted_rates_hz(axis.rates, adc=True)
        rate_hz = max(rates_hz.values())
        bare_s = cost_of(price.reading(frozenset()), timing).mean_s
        extra_s = {item: cost_of(price.reading(frozenset([item])), timing).mean_s - bare_s for item in rates_hz}
        mean_s = bare_s + math.fsum(extra_s[item] * rates_hz[item] / rate_hz for item in rates_hz)
        items = tuple(item.value for item in rates_hz)
        # drives in analog positioning send their converter's value with every reply
        longest = price.reading(frozenset(TelemetryItem))
        size = len(longest.request), longest.reply_bytes
        polls.append(Poll(axis.name, items, rate_hz, cost_of(longest, timing), mean_s, *size))
    return polls


def _urgent(bus: BusConfig, timing: LineTiming, prices: Mapping[str, PriceList]) -> Urgent:
    commands = [cost_of(exchange, timing) for price in prices.values() for exchange in price.commands.values()]
    stops = [cost_of(price.stop, timing) for price in prices.values() if price.stop]
    byte_s = timing.bits_per_byte / timing.host_baud
    at_reset = baud_at_reset(bus.clock_hz)
    return Urgent(
        command_s=max(command.longest_s for command in commands),
        stop_s=max((stop.longest_s for stop in stops), default=0.0),
        recovery_s=max(len(price.flush) * byte_s + price.settle_s for price in prices.values()),
        margin_s=bus.margin_ms / 1000,
        search_s=cost_of(_slowest(prices).probe, replace(timing, host_baud=at_reset, node_baud=at_reset)).longest_s,
        probe=_probe(bus, timing, prices),
    )


def _slowest(prices: Mapping[str, PriceList]) -> PriceList:
    return next(iter(prices.values()))  # asking who somebody is costs the same whoever it is


def _probe(bus: BusConfig, timing: LineTiming, prices: Mapping[str, PriceList]) -> PeriodicTask | None:
    if not bus.stop_probe_hz:
        return None
    return PeriodicTask(1.0 / bus.stop_probe_hz, cost_of(_slowest(prices).probe, timing).longest_s)


# -- what would make it fit ------------------------------------------------------------------------------------------


def _remedies(bus: BusConfig) -> list[str]:
    """Return changes of one setting each, any of which is enough."""
    line, remedies = _line(bus), []
    cap = largest(
        lambda hz: replace(line, polls=_capped(line.polls, hz)).fits,
        SLOWEST_HZ,
        max(poll.rate_hz for poll in line.polls),
    )
    if cap is not None:
        shown = math.floor(cap * 100) / 100 if cap < 10 else math.floor(cap * 10) / 10  # noqa: PLR2004 - digits
        remedies.append(f"no rate above {shown:g} Hz")
    for baud in BAUDS:
        faster = bus.model_copy(update={"baud": baud})
        if bus.family == "ldcn" and baud > bus.baud and _reached(bus, baud) and _line(faster).fits:
            remedies.append(f"baud = {baud}")
            break
    if bus.adapter_latency_ms and _line(bus.model_copy(update={"adapter_latency_ms": 0.0})).fits:
        remedies.append("adapter_latency_ms = 0, with an adapter that passes replies on at once")
    remedies.append('overload = "skip": polls then come as often as the line allows')
    return remedies


def _capped(polls: Sequence[Poll], most_hz: float) -> list[Poll]:
    return [replace(poll, rate_hz=min(poll.rate_hz, most_hz)) for poll in polls]


def _reached(bus: BusConfig, baud: int) -> bool:
    """Tell whether every drive of the line has this rate."""
    try:
        BusConfig.model_validate(bus.model_dump() | {"baud": baud})
        _prices(bus, baud)
    except (ValueError, ValueOutOfRange):
        return False
    return True


# -- saying it -------------------------------------------------------------------------------------------------------


def _described(bus: BusConfig, plan: LinePlan) -> list[PollPlan]:
    axes = {axis.name: axis for axis in bus.axis}
    return [
        PollPlan(
            axis=poll.axis,
            address=axes[poll.axis].address,
            request_bytes=poll.request_bytes,
            reply_bytes=poll.reply_bytes,
            rate_hz=poll.rate_hz,
            longest_s=poll.cost.longest_s,
            response_s=_bounded(response_s),
            holds=response_s <= poll.task.period_s,
            items=tuple(_items(axes[poll.axis], poll, response_s)),
            priority=axes[poll.axis].priority,
        )
        for poll, response_s in zip(plan.polls, plan.responses_s, strict=True)
    ]


def _items(axis: AxisConfig, poll: Poll, response_s: float) -> list[ItemPlan]:
    """Slower items ride along with the nearest poll, so they may be due half a poll period before it."""
    if len(poll.items) == 1:
        return [ItemPlan(item=poll.items[0], rate_hz=poll.rate_hz, response_s=_bounded(response_s))]
    riding_s = poll.task.period_s / 2
    return [
        ItemPlan(
            item=item.value,
            rate_hz=rate_hz,
            response_s=_bounded(response_s if rate_hz == poll.rate_hz else response_s + riding_s),
        )
        for item, rate_hz in wanted_rates_hz(axis.rates, adc=True).items()
    ]


def _bounded(response_s: float) -> float | None:
    return None if math.isinf(response_s) else response_s


def _refusal(bus: BusPlan) -> str:
    late = ", ".join(poll.axis for poll in bus.polls if not poll.holds)
    return (
        f"bus {bus.bus}: at {bus.baud} baud the polls need {bus.load:.0%} of the line when drives are slow"
        f" ({bus.mean_load:.0%} on average), and those of {late} can miss their turns;"
        f" any of these is enough: {'; '.join(bus.remedies)}"
    )
