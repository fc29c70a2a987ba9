"""Done means settled and seen, on the simulated rig and the jumping clock."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

import pytest

from ldcnd.axis.rest import window_counts
from ldcnd.client.axis import Axis
from ldcnd.client.rig import Rig
from ldcnd.config.rig import RigConfig, load_config
from ldcnd.contract.commands import Halt, MoveAbsolute, MoveRelative, MoveVelocity, Power, Reset, Stop
from ldcnd.contract.errors import DriveFault, WrongState
from ldcnd.contract.events import CommandEvent, CommandStatus, ReadEvents, ReadOutcome
from ldcnd.contract.questions import Why
from ldcnd.contract.samples import AxisState, FaultSample, PositionSample, TelemetryItem
from ldcnd.drives.axis_config import RatesConfig, SettleConfig
from tests.support.rig import SIMULATED, RunningRig, running_rig

DISTANCES = {"x": 5.0, "y": -5.0, "z": 5.0, "c": 90.0}
SELDOM = RatesConfig(position=0.2, velocity=0, adc=0, state=0.2)
NEVER_SETTLES = SettleConfig(time_s=0.4, timeout_s=0.5, window=0.001)


def with_axes(**changed: Any) -> RigConfig:
    """Return the simulated rig, each of its axes changed."""
    config = load_config(SIMULATED)
    (bus,) = config.bus
    axes = tuple(axis.model_copy(update=changed) for axis in bus.axis)
    return config.model_copy(update={"bus": (bus.model_copy(update={"axis": axes}),)})


@asynccontextmanager
async def controlled(rig: RunningRig, name: str) -> AsyncIterator[Axis]:
    await rig.until(name, lambda state: state.link == "up")
    async with Rig(rig.client, await rig.client.daemon()).control(name, client="test") as axis:
        yield axis


async def events_of(rig: RunningRig, command_id: str) -> list[CommandEvent]:
    return [event for event in (await rig.client.ask(ReadEvents())).events if event.command_id == command_id]


async def moved(rig: RunningRig, axis: str, distance: float) -> CommandEvent:
    """Return the event that ends a relative move."""
    reply = await rig.client.command(axis, MoveRelative(distance=distance))
    await rig.client.wait_for_end(axis, reply.command_id)
    return (await events_of(rig, reply.command_id))[-1]


@pytest.mark.parametrize("axis", DISTANCES)
@pytest.mark.sweep(2)
async def test_a_move_is_done_within_its_window_and_says_where(axis):
    async with running_rig() as rig:
        await rig.power_on(axis)
        config = rig.daemon.rig.axes[axis].config
        window = window_counts(config) / config.counts_per_unit

        done = await moved(rig, axis, DISTANCES[axis])

        assert (done.status, done.settled) == (CommandStatus.DONE, True)
        assert abs(done.position - DISTANCES[axis]) <= window
        assert done.following_error == pytest.approx(DISTANCES[axis] - done.position, abs=1.01 / config.counts_per_unit)


async def test_who_asks_right_after_done_gets_a_position_that_was_measured_after_it():
    async with running_rig(with_axes(rates=SELDOM)) as rig:
        await rig.power_on("x")
        async with rig.client.samples("x", TelemetryItem.POSITION) as positions:
            done = await moved(rig, "x", 5.0)
            now = await rig.client.last("x", TelemetryItem.POSITION)
            published = [sample async for sample in _until(positions, done.position)]

    assert isinstance(now, PositionSample)
    assert now.value == published[-1].value == done.position
    assert now.t <= done.t < now.t + 20_000_000


async def _until(positions: Any, value: float) -> Any:
    async with asyncio.timeout(1.0):
        async for _, sample in positions:
            yield sample
            if sample.value == value:
                return


async def test_the_end_is_seen_in_time_whatever_the_rates():
    async with running_rig(with_axes(rates=SELDOM)) as rig:
        await rig.power_on("x")
        loop = asyncio.get_running_loop()
        await moved(rig, "x", -5.0)
        began_s = loop.time()

        await moved(rig, "x", 5.0)

        assert loop.time() - began_s < 0.35 + 0.25  # the profile, what the loop takes, and the settle time


async def test_short_moves_end_as_soon_as_they_have_settled():
    async with running_rig(with_axes(rates=SELDOM)) as rig:
        await rig.power_on("c")
        began_s = asyncio.get_running_loop().time()

        for _ in range(10):
            await moved(rig, "c", 0.1)

        assert asyncio.get_running_loop().time() - began_s < 10 * 0.25


async def test_a_move_that_does_not_settle_is_done_and_an_event_says_so():
    async with running_rig(with_axes(settle=NEVER_SETTLES)) as rig:
        await rig.power_on("x")

        done = await moved(rig, "x", 5.0)
        others = [event for event in (await rig.client.ask(ReadEvents(axis="x"))).events if event.verb == "unsettled"]

        assert (done.status, done.settled, done.reason) == (CommandStatus.DONE, False, None)
        assert [(event.status, event.code) for event in others] == [(CommandStatus.FAILED, "not_settled")]
        assert "move_relative did not stay within 0.001 mm of its target for 0.4 s in 0.5 s" in others[0].reason
        assert (await rig.client.state("x")).state is AxisState.STANDSTILL


async def test_a_move_that_does_not_settle_is_a_fault_where_the_configuration_says_so():
    config = with_axes(settle=NEVER_SETTLES.model_copy(update={"unsettled": "fault"}))
    async with running_rig(config) as rig:
        await rig.power_on("x")

        failed = await moved(rig, "x", 5.0)
        fault = await rig.client.last("x", TelemetryItem.FAULT)
        state = await rig.client.state("x")
        why = await rig.client.ask(Why(), "x")
        with pytest.raises(WrongState, match="still moves, or may") as refusal:
            await rig.client.command("x", Reset())
        assert {why.causes[0].remedy, refusal.value.remedy} == {
            'send power {"on": false}; look at it, for it may move unseen; remove the cause, then send reset'
        }
        await rig.client.command("x", Power(on=False))
        await rig.client.command("x", Reset())

        assert (failed.status, failed.settled) == (CommandStatus.FAILED, False)
        assert isinstance(fault, FaultSample)
        assert [(entry.code, entry.source) for entry in fault.active] == [("not_settled", "daemon")]
        assert (state.state, state.referenced) == (AxisState.ERROR_STOP, True)
        after = await rig.until("x", lambda state: state.state is AxisState.DISABLED)
        assert after.last_error is None


@pytest.mark.parametrize("end", [Halt(), Stop()])
async def test_what_ends_a_move_while_it_settles_aborts_it(end):
    async with running_rig(with_axes(settle=SettleConfig(time_s=5.0, timeout_s=6.0))) as rig:
        await rig.power_on("x")
        reply = await rig.client.command("x", MoveAbsolute(position=5.0))
        await asyncio.sleep(1.0)
        settling = await rig.client.state("x")

        await rig.client.command("x", end)
        await rig.until("x", lambda state: state.command is None)

        assert (settling.state, settling.moving) == (AxisState.DISCRETE_MOTION, "yes")
        assert (await events_of(rig, reply.command_id))[-1].status is CommandStatus.ABORTED


async def test_a_halt_says_where_and_has_nothing_to_settle_at():
    async with running_rig() as rig:
        await rig.power_on("x")
        await rig.client.command("x", MoveVelocity(velocity=10.0))
        await asyncio.sleep(0.5)

        reply = await rig.client.command("x", Halt())
        await rig.client.wait_for_end("x", reply.command_id)

        outcome = await rig.client.ask(ReadOutcome(command_id=reply.command_id))
        assert (outcome.status, outcome.settled) == (CommandStatus.DONE, None)
        assert outcome.position == pytest.approx(5.0, abs=1.0)


async def test_a_program_gets_position_and_settled_with_the_end_of_its_move():
    async with running_rig() as rig, controlled(rig, "x") as axis:
        await axis.power(on=True)
        ended = await (await axis.move_absolute(5.0)).done()

        assert ended.settled
        assert ended.position == pytest.approx(5.0, abs=0.0101)
        assert ended.following_error == pytest.approx(5.0 - ended.position, abs=0.0011)


async def test_a_program_learns_that_its_move_did_not_settle():
    config = with_axes(settle=NEVER_SETTLES.model_copy(update={"unsettled": "fault"}))
    async with running_rig(config) as rig, controlled(rig, "x") as axis:
        await axis.power(on=True)
        with pytest.raises(DriveFault, match="did not settle"):
            await (await axis.move_absolute(5.0)).done()
