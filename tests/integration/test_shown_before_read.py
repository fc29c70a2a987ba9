"""What a daemon knows of an axis before its drive was ever read, each face says: latch and pending stop are its own."""

import asyncio
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path

import msgpack
from prometheus_client import CollectorRegistry

from ldcnd.cli.looking import axes_table, rig_table
from ldcnd.client.fleet import survey
from ldcnd.client.overview import health_reports, overview
from ldcnd.console.conditions import Conditions
from ldcnd.contract.errors import TransportLost
from ldcnd.contract.samples import FaultSample, LinkState, StateSample, TelemetryItem
from ldcnd.daemon.service import describe
from ldcnd.lab.metrics import HealthCollector
from ldcnd.line.transport import Transport
from ldcnd.net.session import Publication
from ldcnd.sim.chain import Chain
from tests.integration.test_kept_references import chain_of, keeping
from tests.support.chain_rig import ChainRig, rig_on
from tests.support.rig import RunningRig

AXES = ("x", "y", "z", "c")


async def no_adapter() -> Transport:
    raise TransportLost("cannot open /dev/ldcn-x: it is not there")


@dataclass(frozen=True, slots=True)
class Exported:
    """What a scraper gets of a rig."""

    registry: CollectorRegistry
    collector: HealthCollector
    rig: str

    def of(self, metric: str, axis: str) -> float | None:
        return self.registry.get_sample_value(metric, {"rig": self.rig, "axis": axis})

    def conditions(self, axis: str) -> set[str]:
        return {
            each.labels["condition"]
            for family in self.registry.collect()
            for each in family.samples
            if each.name == "ldcnd_axis_condition" and each.labels["axis"] == axis
        }


@asynccontextmanager
async def scraped(rig: ChainRig, known: HealthCollector | None = None) -> AsyncIterator[Exported]:
    """Gather metrics as `ldcnd metrics` does; with those that were gathered from an earlier daemon."""
    collector = known or HealthCollector(rig.client.rig, asyncio.get_running_loop().time)
    registry = CollectorRegistry()
    registry.register(collector)

    async def follow(item: TelemetryItem) -> None:
        async with rig.client.samples(item=item) as samples:
            async for axis, sample in samples:
                assert isinstance(sample, StateSample | FaultSample)
                collector.take_state(axis, sample)

    async with health_reports(rig.client, collector.take):
        following = [asyncio.create_task(follow(item)) for item in (TelemetryItem.STATE, TelemetryItem.FAULT)]
        try:
            yield Exported(registry, collector, rig.client.rig)
        finally:
            for task in following:
                task.cancel()


@asynccontextmanager
async def console_of(rig: ChainRig | RunningRig) -> AsyncIterator[Mapping[str, Mapping[str, object]]]:
    """Yield what a console tells its pages of axes."""
    told: dict[str, Mapping[str, object]] = {}

    def put(publication: Publication) -> None:
        axis = publication.key.split("/")[-2]
        told[axis] = msgpack.unpackb(publication.payload)

    conditions = Conditions(rig.client.rig, put, asyncio.get_running_loop().time)
    telemetry = await rig.client.subscribe(rig.client.keys.all_telemetry, conditions.take)
    reports = await rig.client.subscribe(f"{rig.client.keys.health}/**", conditions.take)
    running = asyncio.create_task(conditions.run())
    try:
        yield told
    finally:
        running.cancel()
        await telemetry.close()
        await reports.close()


async def stopped_without_adapter(chain: Chain, tmp_path: Path) -> None:
    """Have a daemon stop axes whose line has no adapter, and end it."""
    async with rig_on(chain, keeping(tmp_path), up=False, opener=no_adapter) as rig:
        await rig.daemon.wait_serving()
        reply = await rig.client.stop(None)
        assert (reply.confirmed, set(reply.kept)) == ((), set(AXES))
        await rig.kill()


async def rows(rig: ChainRig) -> dict[str, str]:
    return {row.split()[0]: row for row in axes_table(await overview(rig.client))}


async def test_a_stop_that_no_drive_has_confirmed_is_said_by_every_face_of_the_next_daemon(tmp_path):
    chain = chain_of()
    await stopped_without_adapter(chain, tmp_path)
    async with rig_on(chain, keeping(tmp_path), up=False, opener=no_adapter) as rig:
        await rig.daemon.wait_serving()
        listed_at_once = await rows(rig)
        async with scraped(rig) as exported, console_of(rig) as pages:
            await asyncio.sleep(30.0)
            listed = await rows(rig)
            (report,) = await survey(rig.session)
            status = describe(rig.daemon.rig)
            pending = {axis: exported.of("ldcnd_axis_stop_pending", axis) for axis in AXES}
            latched = {axis: exported.of("ldcnd_axis_stop_latched", axis) for axis in AXES}
            conditions = {axis: exported.conditions(axis) for axis in AXES}
            consoled = {axis: [trouble["kind"] for trouble in pages[axis]["troubles"]] for axis in AXES}

    for axis in AXES:
        assert "stop NOT CONFIRMED by the drive" in listed_at_once[axis]
        assert "stop NOT CONFIRMED by the drive, line down" in listed[axis]
        assert "was" not in listed[axis].split()  # nothing was ever read of it
        assert "stop NOT CONFIRMED by the drive" in conditions[axis]
        assert "daemon silent" not in conditions[axis]
        assert consoled[axis] == ["stop_pending", "line_down"]
        assert f"{axis}: a stop is NOT confirmed by the drive: use the machine's emergency stop" in report.problems
    assert pending == latched == dict.fromkeys(AXES, 1.0)
    assert "x, y, z, c: a stop is NOT confirmed by the drive" in status
    assert "  ! x: a stop is NOT confirmed by the drive: use the machine's emergency stop" in rig_table(report)


async def test_metrics_that_outlive_a_daemon_say_what_the_next_one_knows(tmp_path):
    chain = chain_of()
    async with rig_on(chain, keeping(tmp_path), up=False, opener=no_adapter) as rig:
        await rig.daemon.wait_serving()
        async with scraped(rig) as exported:
            await rig.client.stop(None)
            await asyncio.sleep(10.0)
            before = exported.conditions("x")
        await rig.kill()
    async with rig_on(chain, keeping(tmp_path), up=False, opener=no_adapter) as rig:
        async with scraped(rig, exported.collector) as exported:
            await asyncio.sleep(10.0)
            after, up = exported.conditions("x"), exported.registry.get_sample_value("ldcnd_daemon_up", {"rig": "sim"})
            pending = exported.of("ldcnd_axis_stop_pending", "x")
            await rig.kill()
            await asyncio.sleep(10.0)
            silent, left = exported.conditions("x"), exported.of("ldcnd_axis_stop_pending", "x")

    assert before == after == {"stop NOT CONFIRMED by the drive", "line down"}
    assert (up, pending) == (1.0, 1.0)
    assert "daemon silent" in silent
    assert left is None


async def test_an_axis_that_was_never_read_is_said_to_be_unknown_and_not_what_it_was(tmp_path):
    async with rig_on(chain_of(), keeping(tmp_path), up=False, opener=no_adapter) as rig:
        await rig.daemon.wait_serving()
        at_once = await overview(rig.client)
        await asyncio.sleep(10.0)
        later = await overview(rig.client)

    assert {now.condition.state for now in (*at_once, *later)} == {"unknown"}
    assert {now.condition.mark for now in at_once} == {"line is being opened"}
    assert {now.condition.mark for now in later} == {"line down"}


async def test_a_drive_that_does_not_answer_is_no_silence_of_its_daemon(tmp_path):
    chain = chain_of()
    async with rig_on(chain, keeping(tmp_path)) as rig, scraped(rig) as exported:
        await rig.until("c", lambda state: state.link is LinkState.UP)
        chain.modules[3].power(on=False, at_s=asyncio.get_running_loop().time())
        await rig.until("c", lambda state: state.link is LinkState.DOWN)
        await asyncio.sleep(30.0)
        conditions, latched = exported.conditions("c"), exported.of("ldcnd_axis_stop_latched", "c")

    assert "no answer" in conditions
    assert latched == 0.0
