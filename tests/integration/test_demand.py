"""Demand-driven polling of a whole daemon: on the jumping clock, and once over real Zenoh."""

import asyncio
import time

import pytest

from ldcnd.config import RigConfig, TelemetryConfig, load_config
from ldcnd.daemon.assembly import build_daemon
from ldcnd.daemon.demand import LINGER_S
from ldcnd.daemon.planning import plan_rig
from ldcnd.messaging.codec import decode_received
from ldcnd.messaging.keys import Keys
from ldcnd.messaging.zenoh_session import open_zenoh_session
from ldcnd.messaging.zenoh_settings import ZenohSettings
from ldcnd.model.axes import AxisState, LinkState
from ldcnd.model.health import BusHealth
from ldcnd.model.requests import MoveAbsoluteRequest, PowerRequest, Verb
from ldcnd.model.samples import TelemetryItem
from tests.support.rig import SIMULATED, running_rig
from tests.support.session_pair import free_endpoint

KEYS = Keys("sim")
WANTED_HZ = {"position": 20.0, "velocity": 20.0, "adc": 5.0, "state": 5.0}
IDLE_HZ = {"position": 1.0, "velocity": 1.0, "adc": 1.0, "state": 5.0}


def on_demand() -> RigConfig:
    return load_config(SIMULATED).model_copy(update={"telemetry": TelemetryConfig(on_demand=True)})


async def rates(rig, axis: str = "x") -> tuple[dict[str, float], dict[str, float]]:
    """Return what an axis is asked for and what it was granted in the last second."""
    (answer,) = await rig.session.query(KEYS.bus_health("line0"))
    health = decode_received(BusHealth, answer.payload, answer.encoding)
    (found,) = (one for one in health.axes if one.axis == axis)
    return {item.item: item.asked_hz for item in found.items}, {item.item: item.granted_hz for item in found.items}


async def test_a_rig_polls_everything_unless_it_is_told_to_follow_the_demand():
    async with running_rig() as rig:
        await asyncio.sleep(3.2)

        asked, granted = await rates(rig)

    assert asked == WANTED_HZ
    assert granted == pytest.approx(WANTED_HZ, abs=1)


async def test_what_nobody_takes_is_polled_at_its_idle_rate_and_the_state_at_its_own():
    async with running_rig(on_demand()) as rig:
        await asyncio.sleep(5.2)

        asked, granted = await rates(rig)
        last = await rig.client.last("x", TelemetryItem.POSITION)

    assert asked == IDLE_HZ
    assert granted == pytest.approx(IDLE_HZ, abs=1)
    assert last  # whoever asks has an answer all the same


async def test_a_subscriber_raises_its_item_within_one_poll_period_and_no_other():
    async with running_rig(on_demand()) as rig:
        loop = asyncio.get_running_loop()
        await asyncio.sleep(5.2)

        async with rig.client.samples("x", "position") as positions:
            subscribed_s = loop.time()
            await anext(positions)
            waited_s = loop.time() - subscribed_s
            await asyncio.sleep(2.2)
            asked, granted = await rates(rig)
            others, _ = await rates(rig, "y")

    assert waited_s < 2 / WANTED_HZ["position"]  # the poll that was under way, and a period
    assert asked == IDLE_HZ | {"position": 20.0}
    assert granted["position"] == pytest.approx(20.0, abs=1)
    assert others == IDLE_HZ | {"position": 1.0}


async def test_the_rate_falls_when_the_last_subscriber_has_gone_for_a_while():
    async with running_rig(on_demand()) as rig:
        async with rig.client.samples("x", "position"), rig.client.samples():
            await asyncio.sleep(2.2)
            taken, _ = await rates(rig)
        await asyncio.sleep(0.5 * LINGER_S)
        lingering, _ = await rates(rig)
        await asyncio.sleep(LINGER_S + 1.2)
        left, granted = await rates(rig)

    assert taken == lingering == WANTED_HZ
    assert left == IDLE_HZ
    assert granted["position"] == pytest.approx(1.0, abs=1)


async def test_an_axis_at_work_is_watched_although_nobody_takes_its_telemetry():
    async with running_rig(on_demand()) as rig:
        await rig.until("x", lambda state: state.link is LinkState.UP)
        await rig.client.command("x", Verb.POWER, PowerRequest(on=True))
        await asyncio.sleep(2.0)
        await rig.client.command("x", Verb.MOVE_ABSOLUTE, MoveAbsoluteRequest(position=50.0))
        await asyncio.sleep(2.2)
        moving = await rig.client.state("x")
        asked, granted = await rates(rig)
        resting, _ = await rates(rig, "y")
        await rig.until("x", lambda state: state.state is AxisState.STANDSTILL)
        await asyncio.sleep(2.2)
        afterwards, _ = await rates(rig)

    assert moving
    assert moving.state is AxisState.DISCRETE_MOTION
    assert asked == WANTED_HZ
    assert granted["position"] == pytest.approx(20.0, abs=1)
    assert resting == afterwards == IDLE_HZ


async def test_the_demand_outlives_the_loss_of_the_line():
    async with running_rig(on_demand()) as rig:
        (service,) = rig.daemon.rig.buses
        async with rig.client.samples("x", "position") as positions:
            await asyncio.sleep(1.0)
            service.bus.drop("pulled")
            await service.wait_down()
            await service.wait_up()
            await asyncio.sleep(3.2)
            asked, _ = await rates(rig)
            async with asyncio.timeout(1.0):
                await anext(positions)

    assert asked == IDLE_HZ | {"position": 20.0}


async def test_changed_rates_count_at_once_for_what_is_taken_and_what_is_not():
    config = on_demand()
    async with running_rig(config) as rig:
        (bus,) = config.bus
        axes = tuple(
            axis.model_copy(update={"rates": axis.rates.model_copy(update={"position": 10.0, "idle": 0.5})})
            for axis in bus.axis
        )
        changed = config.model_copy(update={"bus": (bus.model_copy(update={"axis": axes}),)})
        rig.daemon.reconfigure(changed, plan_rig(changed))
        async with rig.client.samples("x", "position"):
            await asyncio.sleep(1.2)
            asked, _ = await rates(rig)

    assert asked == {"position": 10.0, "velocity": 0.5, "adc": 0.5, "state": 5.0}


@pytest.mark.real_time
async def test_over_zenoh_a_subscriber_raises_the_rate_and_its_end_lowers_it():
    endpoint = free_endpoint()
    async with (
        open_zenoh_session(ZenohSettings(listen=(endpoint,))) as session,
        open_zenoh_session(ZenohSettings(connect=(endpoint,), mode="client")) as client,
        asyncio.TaskGroup() as group,
    ):
        daemon = build_daemon(on_demand(), session, time.time_ns, "demand")
        running = group.create_task(daemon.run(), name="daemon")
        (bus,) = daemon.rig.buses

        async def asked(position_hz: float) -> None:
            async with asyncio.timeout(20):
                while bus.asked_hz("x").get(TelemetryItem.POSITION) != position_hz:
                    await asyncio.sleep(0.02)  # nothing tells when a line has changed its rates

        try:
            async with asyncio.timeout(20):
                await daemon.wait_up()
            await asked(1.0)
            declaration = await client.subscribe(KEYS.telemetry_pattern("*", "*"), lambda _: None)
            await asked(20.0)
            await declaration.close()
            await asked(1.0)
        finally:
            daemon.end()
            await running
