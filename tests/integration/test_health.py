"""What the daemon says of its own health, as a subscriber sees it."""

import asyncio
import json
from itertools import pairwise

import pytest

from ldcnd.messaging.codec import decode_received
from ldcnd.messaging.keys import Keys
from ldcnd.messaging.session import SampleKind
from ldcnd.model.axes import LinkState
from ldcnd.model.health import BusHealth, DaemonHealth
from tests.support.rig import running_rig

KEYS = Keys("sim")


async def bus_health(rig) -> BusHealth:
    (answer,) = await rig.session.query(KEYS.bus_health("line0"))
    return decode_received(BusHealth, answer.payload, answer.encoding)


async def test_reports_are_published_once_a_second_and_numbered():
    async with running_rig() as rig:
        taken = []
        declaration = await rig.session.subscribe(KEYS.health, taken.append)

        await asyncio.sleep(10.5)
        await declaration.close()

        reports = [decode_received(DaemonHealth, sample.payload, sample.encoding) for sample in taken]
        steps_ns = [after.t - before.t for before, after in pairwise(reports)]
        assert 10 <= len(reports) <= 11
        assert steps_ns == pytest.approx([1_000_000_000] * len(steps_ns), abs=1_000_000)
        assert [report.seq for report in reports] == list(range(reports[0].seq, reports[0].seq + len(reports)))
        assert reports[-1].published > reports[0].published + 1000


async def test_a_line_at_work_is_busy_and_its_axes_get_the_rates_they_asked_for():
    async with running_rig() as rig:
        await asyncio.sleep(5.0)

        health = await bus_health(rig)

        statistics = rig.daemon.rig.buses[0].bus.statistics
        assert health.up
        assert 0.05 < health.utilisation < 1.0
        assert health.exchanges <= statistics.exchanges
        assert [lane.lane for lane in health.lanes] == ["stop", "command", "poll", "background"]
        assert health.lanes[2].exchanges > 100
        assert 0 < health.lanes[2].p50_s <= health.lanes[2].p99_s <= health.lanes[2].longest_s
        for axis in health.axes:
            assert axis.link is LinkState.UP
            assert axis.rate_hz == pytest.approx(axis.rate_wanted_hz, rel=0.05)
            assert axis.sample_age_s < 2 / axis.rate_wanted_hz


async def test_samples_grow_old_while_nobody_polls():
    async with running_rig() as rig:
        await asyncio.sleep(2.0)
        service = rig.daemon.rig.buses[0]
        before = await bus_health(rig)

        for poller in tuple(service._pollers.values()):
            service.bus.remove_poller(poller)
        await asyncio.sleep(3.0)

        after = await bus_health(rig)
        assert all(axis.rate_hz == 0 and axis.sample_age_s > 1.5 for axis in after.axes)
        assert after.utilisation < before.utilisation / 2


async def test_reports_leave_the_network_with_the_daemon():
    deleted = []
    async with running_rig() as rig:
        await asyncio.sleep(2.0)
        await rig.session.subscribe("ldcn/sim/meta/health/**", deleted.append)
        rig.daemon.end()
        await asyncio.sleep(3.0)

        gone = {sample.key for sample in deleted if sample.kind is SampleKind.DELETE}
        assert gone == {KEYS.health, KEYS.bus_health("line0")}


async def test_health_can_be_asked_for_as_json():
    async with running_rig() as rig:
        await asyncio.sleep(2.0)

        answers = await rig.session.query("ldcn/sim/meta/health/**")

        assert {answer.key for answer in answers} == {KEYS.health, KEYS.bus_health("line0")}
        assert all(json.loads(answer.payload)["t"] > 0 for answer in answers)
