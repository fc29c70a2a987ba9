"""Adapters as drivers of the kernel make them, on the jumping clock: replies kept back, plugs pulled, noise."""

import asyncio
import contextlib

import pytest

from ldcnd.contract.commands import Halt, Home, MoveAbsolute, MoveVelocity, Power, SetPosition
from ldcnd.contract.errors import LdcndError
from ldcnd.contract.samples import AxisState, FaultSample, LinkState, Moving, PositionSample, Quality, TelemetryItem
from ldcnd.contract.traces import TakeTrace
from tests.support.chain_rig import drive, simulated_config
from tests.support.plugged_rig import RATES, Plugged, X, Y, plugged, slow_config
from tests.support.serial_adapter import AT_ONCE, Fifo, LatencyTimer

REST_S = 2.0
"""Within so long of being back a drive that must stand does."""


async def powered(line: Plugged, *axes: str) -> None:
    for axis in axes:
        await line.rig.client.command(axis, Power(on=True))


async def moving(line: Plugged, axis: str, position: float, velocity: float) -> None:
    await powered(line, axis)
    request = MoveAbsolute(position=position, velocity=velocity)
    await line.rig.client.command(axis, request)
    await asyncio.sleep(0.7)


# -- kept back -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("holding", "baud"),
    [
        (LatencyTimer(0.016), 115_200),
        (LatencyTimer(0.016), 19_200),
        (Fifo(10 / 115_200, 8), 115_200),
        (Fifo(10 / 19_200, 14), 19_200),
    ],
    ids=str,
)
@pytest.mark.sweep(2)
async def test_a_line_works_whatever_its_adapter_keeps_back(holding, baud):
    settings = simulated_config(RATES, margin_ms=25, overload="skip", baud=baud)
    async with plugged(holding, settings) as line:
        statistics = line.rig.line.bus.statistics
        unanswered = statistics.timeouts  # whoever comes behind the last drive was asked, and is not there
        await powered(line, "x")
        reply = await line.rig.client.command("x", MoveAbsolute(position=5.0))
        ended = await line.rig.client.wait_for_end("x", reply.command_id)
        before = statistics.exchanges
        await asyncio.sleep(4.0)

        assert (ended.state, ended.last_error) == (AxisState.STANDSTILL, None)
        assert statistics.exchanges - before > 50
        assert (statistics.timeouts, statistics.corrupt_replies, statistics.stray_bytes) == (unanswered, 0, 0)
        assert abs(drive(line.chain, X).loop.position - 5000) <= 1


@pytest.mark.parametrize(
    ("holding", "held", "last_byte_s", "due_s"),
    [
        (LatencyTimer(0.016), 2, 0.005, 0.016),
        (LatencyTimer(0.016), 2, 0.017, 0.032),
        (LatencyTimer(0.016), 62, 0.005, 0.005),
        (LatencyTimer(0.001), 2, 0.0052, 0.006),
        (Fifo(0.001, 8), 7, 0.010, 0.014),
        (Fifo(0.001, 8), 8, 0.010, 0.010),
        (AT_ONCE, 1, 0.010, 0.010),
    ],
)
def test_an_adapter_hands_over_when_its_chip_does(holding, held, last_byte_s, due_s):
    assert holding.due_s(held, last_byte_s, handed_over_s=0.0) == pytest.approx(due_s)


# -- unplugged -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("velocity", [1.5, 40.0])
@pytest.mark.sweep(2)
async def test_a_move_that_nobody_could_see_is_halted_however_slow_it_is(velocity):
    async with plugged() as line:
        await moving(line, "x", 95.0, velocity)
        await line.outage(0.3)
        await asyncio.sleep(REST_S)

        assert await line.stands(X)
        state = await line.rig.client.state("x")
        assert state.moving is Moving.NO
        assert drive(line.chain, X).loop.position < 94_000


async def test_a_stop_while_the_adapter_is_away_is_carried_out_when_it_is_back():
    async with plugged(settings=slow_config(loss={"bus": "run_to_target"})) as line:
        await moving(line, "x", 95.0, 5.0)
        await moving(line, "y", 95.0, 1.5)
        line.plug.pull()
        await line.rig.until("x", lambda state: state.link is LinkState.DOWN)
        stopped = await line.rig.client.stop()
        await asyncio.sleep(1.0)
        assert stopped.confirmed == ()
        assert not await line.stands(X)

        line.plug.push()
        await line.back()
        await asyncio.sleep(REST_S)

        assert await line.stands(X)
        assert await line.stands(Y)
        assert [(await line.rig.client.state(axis)).stop_latched for axis in ("x", "y")] == [True, True]


async def test_a_move_goes_on_where_its_policy_says_so_and_no_stop_was_asked_for():
    async with plugged(settings=slow_config(loss={"bus": "run_to_target"})) as line:
        await moving(line, "x", 60.0, 20.0)
        await line.outage(0.3)
        await asyncio.sleep(4.0)

        assert abs(drive(line.chain, X).loop.position - 60_000) <= 1


@pytest.mark.parametrize("instant_s", [0.0, 0.004, 0.03])
@pytest.mark.sweep(2)
async def test_a_stop_that_is_cut_off_by_the_plug_is_carried_out_when_it_is_back(instant_s):
    async with plugged(settings=slow_config(loss={"bus": "run_to_target"})) as line:
        await moving(line, "x", 95.0, 5.0)
        loop = asyncio.get_running_loop()
        loop.call_at(loop.time() + instant_s, line.plug.pull)
        with contextlib.suppress(LdcndError):
            await line.rig.client.stop("x")
        await asyncio.sleep(1.0)
        line.plug.push()
        await line.back()
        await asyncio.sleep(REST_S)

        assert await line.stands(X)
        assert (await line.rig.client.state("x")).stop_latched


@pytest.mark.long
async def test_a_homing_that_is_cut_off_leaves_the_axis_at_rest_without_a_reference():
    async with plugged() as line:
        await powered(line, "y")
        reply = await line.rig.client.command("y", Home())
        await asyncio.sleep(1.0)
        await line.outage(0.5)
        ended = await line.rig.client.wait_for_end("y", reply.command_id)
        await asyncio.sleep(REST_S)

        assert await line.stands(Y)
        assert not ended.referenced
        assert not (await line.rig.client.state("y")).referenced


async def test_a_halt_and_a_trace_that_are_cut_off_end_and_the_axis_stands():
    async with plugged() as line:
        await moving(line, "x", 95.0, 10.0)
        await line.rig.client.command("x", TakeTrace(channels=("position",), interval_s=0.02, samples=200))
        halting = asyncio.ensure_future(line.rig.client.command("x", Halt()))
        await asyncio.sleep(0.001)
        line.plug.pull()
        await asyncio.wait([halting])
        halting.exception()
        await asyncio.sleep(1.0)
        line.plug.push()
        await line.back()
        await asyncio.sleep(REST_S)

        assert await line.stands(X)
        assert drive(line.chain, X).loop.position < 90_000


async def test_a_fault_is_called_the_same_before_and_after_the_plug_was_pulled():
    async with plugged() as line:
        await powered(line, "x")
        await line.rig.client.command("x", SetPosition(position=-90.0))
        drive(line.chain, X).shaft.stalled = True
        await line.rig.client.command("x", MoveAbsolute(position=90.0, velocity=40.0))
        await line.rig.until("x", lambda state: state.state is AxisState.ERROR_STOP)
        before = await line.rig.client.last("x", TelemetryItem.FAULT)
        await line.outage(1.0)
        await asyncio.sleep(1.0)
        after = await line.rig.client.last("x", TelemetryItem.FAULT)

    assert isinstance(before, FaultSample)
    assert isinstance(after, FaultSample)
    assert [fault.code for fault in before.active] == ["position_error"]
    assert {fault.code for fault in after.active} <= {"position_error", "loop_opened"}


async def test_nothing_that_is_not_known_is_published_as_good_while_the_adapter_is_away():
    async with plugged() as line:
        await moving(line, "x", 90.0, 5.0)
        line.plug.pull()
        await line.rig.until("x", lambda state: state.link is LinkState.DOWN)
        async with line.rig.client.samples("x") as samples:
            await asyncio.sleep(3.0)
            position = await line.rig.client.last("x", TelemetryItem.POSITION)
            state = await line.rig.client.state("x")
            line.plug.push()
            del samples

        assert (position.quality, state.quality, state.moving) == (Quality.BAD, Quality.BAD, Moving.UNKNOWN)
        assert not state.referenced


# -- disturbed -------------------------------------------------------------------------------------------------------


@pytest.mark.long
async def test_breaks_and_noise_make_no_value_and_the_line_is_back_in_step():
    async with plugged() as line:
        await moving(line, "x", 90.0, 5.0)
        seen: list[PositionSample] = []
        async with line.rig.client.samples("x", TelemetryItem.POSITION) as samples:
            for number in range(40):
                line.plug.noise(b"\x00" if number % 2 else bytes([number, 0xAA, 0xFF, 3 * number & 0xFF]))
                await asyncio.sleep(0.0231 * (number % 7))
                _, sample = await anext(samples)
                assert isinstance(sample, PositionSample)
                seen.append(sample)
        statistics = line.rig.line.bus.statistics

    good = [sample.value for sample in seen if sample.quality is Quality.GOOD]
    assert len(good) > 20
    assert good == sorted(good)
    assert max(good) < 95.0
    assert statistics.resynchronisations >= 20


async def test_a_request_that_the_driver_takes_in_part_ends_the_port_and_it_is_opened_again():
    async with plugged() as line:
        await moving(line, "x", 90.0, 5.0)
        line.plug.fill_up(free_bytes=3)
        await line.rig.until("x", lambda state: state.link is LinkState.DOWN)
        await line.back()
        await asyncio.sleep(REST_S)

        assert line.rig.line.bus.statistics.openings == 2
        assert "took" in line.rig.line.bus.loss_reason
        assert await line.stands(X)


async def test_a_line_is_not_looked_for_at_rates_that_the_adapter_does_not_have():
    rates = []

    def offered(baud: int) -> bool:
        rates.append(baud)
        return baud <= 115_200

    async with plugged() as line:
        line.plug.offers = offered
        await line.outage()

        assert (await line.rig.client.state("x")).link is LinkState.UP
    assert rates


async def test_a_velocity_move_without_end_is_halted_after_the_plug_was_pulled():
    async with plugged() as line:
        await powered(line, "x")
        await line.rig.client.command("x", MoveVelocity(velocity=3.0))
        await asyncio.sleep(0.5)
        await line.outage(0.5)
        await asyncio.sleep(REST_S)

        assert await line.stands(X)
