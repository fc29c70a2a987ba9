"""What the daemon says of its own health, as a subscriber sees it."""

import asyncio
import json
from itertools import accumulate, pairwise

import pytest

from ldcnd.config.rig import load_config
from ldcnd.contract.codec import decode_received
from ldcnd.contract.health import BusHealth, DaemonHealth
from ldcnd.contract.keys import Keys
from ldcnd.contract.samples import LinkState
from ldcnd.daemon.health import _Rate
from ldcnd.drives.smartstep.family import LEDGER_FILE
from ldcnd.line.exchange import Lane
from ldcnd.line.flight_recorder import bucket_limit_s
from ldcnd.net.hand_over import PENDING_QUERIES
from ldcnd.net.session import SampleKind
from ldcnd.sim.ldcn.chain import build_chain
from ldcnd.testing.jumping_loop import JumpingLoop
from tests.support.rig import SIMULATED, running_rig

KEYS = Keys("sim")
MIXED = SIMULATED.with_name("mixed.toml")


async def bus_health(rig) -> BusHealth:
    (answer,) = await rig.session.query(KEYS.bus_health("line0"))
    return decode_received(BusHealth, answer.payload, answer.encoding)


@pytest.mark.long
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


async def test_no_report_names_a_rate_that_nothing_was_sampled_for_yet():
    async with running_rig() as rig:
        reports = []
        await rig.session.subscribe(KEYS.bus_health("line0"), reports.append)
        await asyncio.sleep(3.0)

    sampled = [
        axis
        for report in reports
        if report.kind is SampleKind.PUT
        for axis in decode_received(BusHealth, report.payload, report.encoding).axes
        if axis.sample_age_s is not None
    ]
    assert len(sampled) >= 8
    for axis in sampled:
        assert axis.rate_hz == pytest.approx(axis.rate_wanted_hz, rel=0.1)
        assert {item.item for item in axis.items if not item.granted_hz} == set()


async def test_samples_grow_old_while_the_adapter_is_unplugged():
    chain = build_chain(load_config(SIMULATED).sim[0].spec(starts_at_s=0.0))
    async with running_rig(chains={"line0": chain}) as rig:
        await asyncio.sleep(2.0)
        before = await bus_health(rig)

        chain.unplug(asyncio.get_running_loop().time())
        await asyncio.sleep(4.0)

        after = await bus_health(rig)
        assert (before.up, after.up) == (True, False)
        assert after.losses == before.losses + 1
        assert all(axis.rate_hz == 0 and axis.sample_age_s > 1.5 for axis in after.axes)
        assert all(axis.link is LinkState.DOWN for axis in after.axes)
        assert after.utilisation < before.utilisation / 2


async def daemon_health(rig) -> DaemonHealth:
    (answer,) = await rig.session.query(KEYS.health)
    return decode_received(DaemonHealth, answer.payload, answer.encoding)


@pytest.mark.long
async def test_a_loop_that_is_held_up_says_for_how_long_and_what_it_left_out():
    loop = asyncio.get_running_loop()
    async with running_rig() as rig:
        await asyncio.sleep(5.0)
        calm = await daemon_health(rig)

        loop.call_later(0.55, loop.hold_up, 0.3)
        await asyncio.sleep(1.5)
        held_up = await daemon_health(rig)
        loop.call_later(0.55, loop.hold_up, 2.5)
        await asyncio.sleep(6.0)
        left_out = await daemon_health(rig)

        assert (calm.loop_lag_s, calm.missed_reports) == (pytest.approx(0.0, abs=1e-6), 0)
        assert held_up.loop_lag_s == pytest.approx(0.3, abs=0.1)
        assert held_up.missed_reports == 0
        assert left_out.missed_reports == 2
        assert left_out.loop_lag_s == pytest.approx(0.0, abs=1e-6)  # and that is over


async def test_the_latencies_of_a_lane_add_up():
    async with running_rig() as rig:
        await asyncio.sleep(5.0)

        polls = (await bus_health(rig)).lanes[Lane.POLL]

        assert sum(polls.counts) == polls.exchanges > 100
        assert polls.total_s / polls.exchanges <= polls.longest_s
        shares = list(accumulate(polls.counts))
        middle = next(bucket for bucket, share in enumerate(shares) if share >= polls.exchanges / 2)
        assert polls.p50_s == min(bucket_limit_s(middle), polls.longest_s)


async def test_queries_that_are_too_many_are_counted():
    async with running_rig() as rig:
        await asyncio.sleep(2.0)
        before = await daemon_health(rig)
        key, many = KEYS.command("_", "holders"), PENDING_QUERIES + 10

        async with asyncio.TaskGroup() as group:
            for number in range(many):
                group.create_task(rig.session.query(key), name=f"query {number}")
        await asyncio.sleep(2.0)

        assert before.dropped == 0
        after = await daemon_health(rig)
        assert (after.dropped, after.waiting_queries) == (10, 0)


async def test_the_wear_of_an_eeprom_is_reported_for_the_drives_that_have_one(tmp_path):
    (tmp_path / LEDGER_FILE).write_text(json.dumps({"feed": {"Pn100": 7, "Pn101": 5}}))
    config = load_config(MIXED).model_copy(update={"state_dir": tmp_path})
    async with running_rig(config) as rig:
        await asyncio.sleep(2.0)

        answers = await rig.session.query(Keys(config.rig).bus_health("*"))

        axes = {
            axis.axis: axis.eeprom_writes
            for answer in answers
            for axis in decode_received(BusHealth, answer.payload, answer.encoding).axes
        }
        assert axes == {"x": None, "feed": 12, "spool": 0}


@pytest.mark.long
async def test_rates_of_drives_that_pace_themselves_are_reported_like_those_of_others(tmp_path):
    config = load_config(MIXED).model_copy(update={"state_dir": tmp_path})
    async with running_rig(config) as rig:
        await asyncio.sleep(60.0)
        for _ in range(5):
            await asyncio.sleep(1.0)
            answers = await rig.session.query(Keys(config.rig).bus_health("*"))
            reports = [decode_received(BusHealth, answer.payload, answer.encoding) for answer in answers]
            (feed,) = [axis for report in reports for axis in report.axes if axis.axis == "feed"]

            assert {item.item for item in feed.items} == {"position", "velocity", "state"}
            assert feed.rate_hz == pytest.approx(feed.rate_wanted_hz, rel=0.1)
            for item in feed.items:
                assert item.granted_hz == pytest.approx(item.asked_hz, rel=0.1)


def test_rate_is_told_from_the_instants_of_samples_also_by_two_reports_at_one_instant():
    rate = _Rate(0.0, 1, 0, 2.0)
    reports = ((9, 2_000_000_000, 2.05), (10, 2_250_000_000, 2.05), (10, 2_250_000_000, 3.2))

    assert [rate.of(*report, 0.9) for report in reports] == [4.0, 4.0, 4.0]
    assert rate.of(10, 2_250_000_000, 4.3, 0.9) == 0.0


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


@pytest.mark.parametrize("frozen_s", [0.9, 4.0])
@pytest.mark.sweep(2)
async def test_a_daemon_that_was_frozen_goes_on_and_reports_no_sooner_than_after_half_a_period(frozen_s):
    loop = asyncio.get_running_loop()
    assert isinstance(loop, JumpingLoop)
    async with running_rig() as rig:
        taken = []
        declaration = await rig.session.subscribe(KEYS.health, lambda _: taken.append(loop.time()))
        for tenth in (0.0, 0.1, 0.3, 0.6):
            await asyncio.sleep(1.0 + tenth)
            loop.hold_up(frozen_s)
        await asyncio.sleep(2.5)
        await declaration.close()

    assert len(taken) >= 7
    assert min(later - earlier for earlier, later in pairwise(taken)) > 0.49
