"""The family of LDCN and NMC drives: from the configuration of a line to its bus and its plan.

The sizes of exchanges are those of the packets themselves. Sources: LS-182AP manual, "Command Description"; PIC-SERVO
manual, 4.1 (the wait of one servo cycle), 5.2.
"""

import itertools
import math
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

from typing_extensions import override

from ldcnd.contract.samples import TelemetryItem
from ldcnd.drives.cost import LineTiming, PriceList, cost_of
from ldcnd.drives.driver import Gains
from ldcnd.drives.family import Demand, Family, OpenLine, UnopenedLine, bus_settings
from ldcnd.drives.ldcn import commands
from ldcnd.drives.ldcn.commands import Node
from ldcnd.drives.ldcn.config import LdcnBusConfig
from ldcnd.drives.ldcn.controls import StopControl
from ldcnd.drives.ldcn.identity import read_identity
from ldcnd.drives.ldcn.io_module import poll_io
from ldcnd.drives.ldcn.line_rate import NULLS, NULLS_SETTLE_S
from ldcnd.drives.ldcn.network import PERIOD_S, ldcn_line, watch_module
from ldcnd.drives.ldcn.packet import StatusItem
from ldcnd.drives.ldcn.profiles import CLOCK_HZ, CYCLE_CLOCKS, PROFILES, HomingControl, Support, at_clock
from ldcnd.drives.ldcn.registers import BaudCodes, actual_baud, baud_at_reset, baud_divisor
from ldcnd.drives.ldcn.servo import reading_items
from ldcnd.drives.ldcn.trajectory import ProfileMode, Trajectory
from ldcnd.drives.ldcn.transcript import LdcnTranscript
from ldcnd.drives.line_plan import Poll, Urgent
from ldcnd.drives.response_times import PeriodicTask
from ldcnd.line.exchange import Exchange
from ldcnd.line.flight_recorder import Describe
from ldcnd.line.port_url import SOCKET, port_opener
from ldcnd.line.settings import ServoCycle
from ldcnd.line.transport import Opener

ANY_ADDRESS = 1
"""The price is the same at every address."""


def price_list(model: str, baud: int, codes: BaudCodes = BaudCodes.MANUAL, clock_hz: int = CLOCK_HZ) -> PriceList:
    """Return the exchanges of a module at a rate.

    Args:
        model: a key of `PROFILES`.
        baud: nominal rate.
        codes: the family of baud rate divisors in use.
        clock_hz: of the module.

    Raises:
        ValueOutOfRange: no divisor makes this rate.
    """
    profile = at_clock(PROFILES[model], clock_hz)
    node = Node(ANY_ADDRESS, profile)
    everything = StatusItem.POSITION | StatusItem.ADC | StatusItem.VELOCITY | StatusItem.AUX | StatusItem.HOME
    common = {
        # identity, and what only some models have: it adds nothing to the reply of the others
        "read status, all items": commands.read_status(node, everything | StatusItem(0xE0)),
        "no operation": commands.no_operation(node),
    }
    full = profile.support is Support.FULL
    return PriceList(
        node_baud=actual_baud(baud_divisor(baud, codes, clock_hz), clock_hz),
        reading=partial(_reading, node),
        commands=MappingProxyType(common | (_servo_commands(node) if full else {})),
        probe=read_identity(ANY_ADDRESS),
        stop=commands.stop_motor(node, StopControl.AMP_ENABLE | StopControl.SMOOTH) if full else None,
        flush=NULLS,
        settle_s=NULLS_SETTLE_S,
    )


def _reading(node: Node, items: frozenset[TelemetryItem]) -> Exchange[Any]:
    return commands.read_status(node, reading_items(node.profile, items))


def _servo_commands(node: Node) -> dict[str, Exchange[Any]]:
    trajectory = Trajectory(
        position=0,
        velocity=0,
        acceleration=1,
        pwm_or_target=0,
        servo=True,
        mode=ProfileMode.TRAPEZOIDAL,
        reverse=False,
        start_now=False,
    )
    gains = Gains(kp=1, kd=0, ki=0, il=0, ol=255, cl=0, el=1, sr=1, deadband=0)
    return {
        "load trajectory": commands.load_trajectory(node, trajectory),
        "start motion": commands.start_motion(node),
        "set gain": commands.set_gain(node, gains),
        "stop motor": commands.stop_motor(node, StopControl.AMP_ENABLE | StopControl.SMOOTH),
        "set homing": commands.set_homing(node, HomingControl(0)),
        "clear sticky bits": commands.clear_sticky_bits(node),
        "save home": commands.save_home(node),
    }


class LdcnFamily(Family[LdcnBusConfig]):
    """LDCN (Logosol) and NMC (J R Kerr)."""

    name = "ldcn"
    bus_config = LdcnBusConfig
    bauds = (9600, 19_200, 57_600, 115_200, 230_400)

    @override
    def open_lines(self, state_dir: Path | None) -> OpenLine[LdcnBusConfig]:
        return open_ldcn_line

    @override
    def plan(self, settings: LdcnBusConfig) -> Demand:
        prices = _prices(settings)
        timing = LineTiming(
            host_baud=settings.baud,
            node_baud=min(price.node_baud for price in prices.values()),
            adapter_latency_s=settings.adapter_latency_ms / 1000,
        )
        return Demand(
            timing,
            _polls(settings, timing, prices) + _module_polls(settings, timing),
            _urgent(settings, timing, prices),
            cycle=servo_cycle(settings),
        )

    @override
    def describe(self, models: Mapping[int, str]) -> Describe:
        return LdcnTranscript({node: PROFILES[model] for node, model in models.items() if model in PROFILES}).describe


LDCN = LdcnFamily()


def open_ldcn_line(settings: LdcnBusConfig, opener: Opener | None = None) -> UnopenedLine:
    """Return a line that is not open yet, which is opened by its port or by `opener`."""
    # every line begins at the rate of power-up; a serial server keeps its own, which the configuration names
    baud = settings.baud if settings.port.startswith(SOCKET) else baud_at_reset(settings.clock_hz)
    line = ldcn_line(
        bus_settings(settings, baud, cycle=servo_cycle(settings), coalesce_s=settings.coalesce_ms / 1000),
        opener or port_opener(settings.port, baud, working_baud=settings.baud, rs485=settings.rs485),
        tuple(axis.spec() for axis in settings.axis),
        settings.baud,
        settings.spec(),
    )
    return UnopenedLine(*line)


# -- the load of a line ----------------------------------------------------------------------------------------------


def servo_cycle(bus: LdcnBusConfig) -> ServoCycle | None:
    """Return the cycle that polls of the line are ordered by; None where they are not."""
    if bus.order != "phase":
        return None
    divisor = baud_divisor(bus.baud, BaudCodes(bus.divisors), bus.clock_hz)
    return ServoCycle(CYCLE_CLOCKS / bus.clock_hz, bus.baud / actual_baud(divisor, bus.clock_hz))


def _prices(bus: LdcnBusConfig) -> Mapping[str, PriceList]:
    codes = BaudCodes(bus.divisors)
    models = {axis.model for axis in bus.axis}
    return MappingProxyType({model: price_list(model, bus.baud, codes, bus.clock_hz) for model in sorted(models)})


def _polls(bus: LdcnBusConfig, timing: LineTiming, prices: Mapping[str, PriceList]) -> list[Poll]:
    polls = []
    for axis in bus.axis:
        price = prices[axis.model]
        rates_hz = axis.rates.wanted_hz(adc=True)
        rate_hz = max(rates_hz.values())
        bare_s = cost_of(price.reading(frozenset()), timing).mean_s
        extra_s = {item: cost_of(price.reading(frozenset([item])), timing).mean_s - bare_s for item in rates_hz}
        mean_s = bare_s + math.fsum(extra_s[item] * rates_hz[item] / rate_hz for item in rates_hz)
        items = tuple(item.value for item in rates_hz)
        # drives in analog positioning send their converter's value with every reply
        longest = price.reading(frozenset(TelemetryItem))
        polls.append(Poll(axis.name, items, rate_hz, cost_of(longest, timing), mean_s))
    return polls


def _module_polls(bus: LdcnBusConfig, timing: LineTiming) -> list[Poll]:
    """Return the polls of modules that are no axes: of all inputs for a PIC-I/O with a name, of one byte for others."""
    polls, nth = [], itertools.count()
    for module in bus.module:
        exchange: Exchange[Any]
        if module.name:
            exchange, item, rate_hz = poll_io(module, next(nth)), TelemetryItem.IO.value, module.rate
        else:
            exchange, item, rate_hz = watch_module(module.address), "status byte", 1.0 / PERIOD_S
        cost = cost_of(exchange, timing)
        name = module.name or f"address {module.address}"
        polls.append(Poll(name, (item,), rate_hz, cost, cost.mean_s, address=module.address))
    return polls


def _urgent(bus: LdcnBusConfig, timing: LineTiming, prices: Mapping[str, PriceList]) -> Urgent:
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
    return next(iter(prices.values()))  # reading an identity costs the same at every module


def _probe(bus: LdcnBusConfig, timing: LineTiming, prices: Mapping[str, PriceList]) -> PeriodicTask | None:
    if not bus.stop_probe_hz:
        return None
    return PeriodicTask(1.0 / bus.stop_probe_hz, cost_of(_slowest(prices).probe, timing).longest_s)
