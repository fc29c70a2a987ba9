"""What exchanges cost, reckoned and measured on the simulated line."""

import asyncio
import math

import pytest

from ldcnd.contract.samples import TelemetryItem
from ldcnd.drives.cost import LineTiming, cost_of
from ldcnd.drives.ldcn import commands
from ldcnd.drives.ldcn.commands import Node
from ldcnd.drives.ldcn.family import price_list
from ldcnd.drives.ldcn.profiles import PROFILES
from ldcnd.drives.ldcn.registers import SERVO_CYCLE_S, actual_baud, baud_divisor
from ldcnd.drives.smartstep.family import price_list as smartstep_price_list
from ldcnd.drives.smartstep.parameters import PN000
from ldcnd.line.exchange import Exchange
from ldcnd.line.settings import LINGER_S
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain
from ldcnd.sim.ldcn.quirks import ModuleSettings
from ldcnd.sim.line import SimulatedLine, open_simulated_line
from ldcnd.sim.smartstep.cable import smartstep_chain
from ldcnd.sim.smartstep.unit import SimulatedUnit
from ldcnd.sim.smartstep.variant import SimulatedVariant
from tests.support.recording_receiver import RecordingReceiver

NO_HOST = 0.0


def timing(baud: int, node_baud: float) -> LineTiming:
    return LineTiming(baud, node_baud, turnaround_s=NO_HOST)


async def taken_s(line: SimulatedLine, receiver: RecordingReceiver, exchange: Exchange[object]) -> float:
    """Run one exchange on the bare line; return how long it took from its first bit to its last."""
    loop = asyncio.get_running_loop()
    before = len(receiver.data)
    began_s = loop.time()
    line.write(exchange.request)
    await receiver.wait_for(before + exchange.reply_bytes)
    return loop.time() - began_s


@pytest.mark.parametrize("baud", [9600, 19_200, 57_600, 115_200])
async def test_every_exchange_takes_on_the_line_what_its_price_says(baud):
    settings = ModuleSettings(version=20, phase_s=0.0, drift_ppm=0.0)
    chain = build_chain(ChainSpec((ModuleSpec("ls182ap", settings=settings),)))
    line = await open_simulated_line(chain)
    receiver = RecordingReceiver()
    line.attach(receiver)
    prices = price_list("ls-182ap", baud)
    line_timing = timing(baud, prices.node_baud)
    unaddressed = Node(0, PROFILES["pic-servo-v4"])
    await taken_s(line, receiver, commands.set_address(unaddressed, 1, 0xFF))
    line.write(commands.set_baud(commands.LeaderlessGroup(0xFF), baud).request)
    await asyncio.sleep(0.05)
    line.set_baud(baud)

    for exchange in [prices.reading(frozenset(TelemetryItem)), *prices.commands.values()]:
        await asyncio.sleep(0.00037)
        cost = cost_of(exchange, line_timing)
        heard_at_s = asyncio.get_running_loop().time() + cost.request_s
        cycle_over_s = math.floor(heard_at_s / SERVO_CYCLE_S + 1) * SERVO_CYCLE_S
        wait_s = cycle_over_s - heard_at_s

        seconds = await taken_s(line, receiver, exchange)

        assert seconds == pytest.approx(cost.request_s + wait_s + cost.reply_s, abs=1e-9)
        assert cost.wire_s < seconds <= cost.longest_s + 1e-9
        assert cost.overhead_s == (0.0 if exchange.repeatable else LINGER_S)
    await line.close()


async def test_a_smartstep_word_takes_28_characters_and_the_drives_delay():
    delay_s = 0.02
    unit = SimulatedUnit(SimulatedVariant(response_s=delay_s), {PN000: 1 << 8})
    line = await open_simulated_line(smartstep_chain([unit]))
    receiver = RecordingReceiver()
    line.attach(receiver)
    prices = smartstep_price_list()
    exchange = prices.reading(frozenset())
    cost = cost_of(exchange, timing(9600, prices.node_baud))

    seconds = await taken_s(line, receiver, exchange)

    assert cost.wire_s == pytest.approx(28 * 10 / 9600)
    assert seconds == pytest.approx(cost.wire_s + delay_s, abs=1e-9)
    assert seconds <= cost.longest_s
    await line.close()


def test_drives_answer_at_the_rate_that_their_clock_makes():
    assert price_list("ls-182ap", 115_200).node_baud == pytest.approx(113_636.36, abs=0.01)
    assert price_list("ls-182ap", 57_600).node_baud == pytest.approx(59_523.8, abs=0.1)
    assert price_list("pic-servo-v4", 19_200).node_baud == actual_baud(baud_divisor(19_200))


def test_a_poll_of_position_velocity_and_state_matches_the_arithmetic_of_the_wire():
    prices = price_list("pic-servo-v4", 115_200)

    cost = cost_of(prices.reading(frozenset()), timing(115_200, 115_200.0))

    assert cost.request_s == pytest.approx(5 * 10 / 115_200)
    assert cost.reply_s == pytest.approx(9 * 10 / 115_200)
    assert cost.wait_s == SERVO_CYCLE_S
    assert cost.mean_s == pytest.approx(cost.wire_s + 0.000256)


def test_the_converter_costs_what_its_width_says():
    wide, narrow = price_list("ls-182ap", 19_200), price_list("pic-servo-v4", 19_200)
    adc = frozenset([TelemetryItem.ADC])

    def extra(prices):
        return prices.reading(adc).reply_bytes - prices.reading(frozenset()).reply_bytes

    assert (extra(wide), extra(narrow)) == (2, 1)


def test_adapter_and_host_add_to_every_exchange_and_the_adapter_only_to_replies():
    slow = LineTiming(115_200, 115_200, turnaround_s=0.0001, adapter_latency_s=0.001)
    prices = price_list("ls-182ap", 115_200)

    read = cost_of(prices.reading(frozenset()), slow)
    silent = cost_of(commands.hard_reset(commands.LeaderlessGroup(0xFF)), slow)

    assert read.overhead_s == pytest.approx(0.0011)
    assert silent.overhead_s == pytest.approx(0.0001)
    assert silent.mean_s == silent.longest_s
