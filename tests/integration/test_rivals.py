"""What another program than the daemon puts on the keys of an axis is shown by no face as a value of the axis."""

import asyncio
import json
import struct
from contextlib import asynccontextmanager

import pytest
import zenoh
from mcap.reader import make_reader

from ldcnd.client.events import follow_events
from ldcnd.client.overview import health_reports
from ldcnd.client.rig import Rig
from ldcnd.client.rig_client import RigClient
from ldcnd.config.rig import RigConfig, load_config
from ldcnd.contract.codec import Encoding, encode
from ldcnd.contract.commands import Halt, MoveVelocity, Power, SetPosition
from ldcnd.contract.errors import ShuttingDown
from ldcnd.contract.health import DaemonHealth
from ldcnd.contract.keys import Keys
from ldcnd.contract.samples import AxisState, LinkState, Moving, PositionSample, Quality, StateSample
from ldcnd.lab.epics.gateway import gateway
from ldcnd.lab.recording.recorder import Recorder
from ldcnd.net.session import Qos
from ldcnd.testing.memory_session import MemoryBroker
from tests.support.command_line import virtual_rig
from tests.support.console_rig import page, running_console
from tests.support.epics_records import shows
from tests.support.process import ROOT, client, daemon
from tests.support.recordings import LARGE, recorded_rig
from tests.support.rig import EPOCH_NS, SIMULATED, running_rig

FALSE_MM = 77.0
FALSE = PositionSample(
    t=EPOCH_NS, t_error_ns=0, seq=5, quality=Quality.GOOD, value=FALSE_MM, unit="mm", counts=77_000, following_error=0.0
)
FALSE_STATE = StateSample(
    t=EPOCH_NS, t_error_ns=0, seq=5, quality=Quality.GOOD, state=AxisState.STANDSTILL, enabled=True, referenced=True,
    moving=Moving.NO, link=LinkState.UP, stop_latched=False, command=None, target=FALSE_MM,
)  # fmt: skip


@asynccontextmanager
async def rival(broker, rig="sim"):
    """Publish a false position and a false state of x all the time, until the context ends."""

    async def deceive(session):
        while True:
            for item, sample in (("position", FALSE), ("state", FALSE_STATE)):
                payload, encoding = encode(sample, Encoding.MSGPACK)
                session.publish(f"ldcn/{rig}/tele/x/{item}", payload, encoding=encoding, qos=Qos.TELEMETRY)
            await asyncio.sleep(0.05)

    async with broker.session() as session:
        deceiving = asyncio.create_task(deceive(session), name="rival")
        try:
            yield session
        finally:
            deceiving.cancel()
            await asyncio.wait([deceiving])


async def values(samples, count=40):
    found = [await anext(samples) for _ in range(count)]
    return [sample.value for _, sample in found if isinstance(sample, PositionSample)]


async def test_a_client_reads_the_positions_of_the_daemon_alone():
    async with running_rig() as running:
        heard = []
        running.client.watch_rivals(lambda: heard.append(running.client.rivals))
        async with rival(running.broker), running.client.samples("x") as samples:
            found = await values(samples)
            rig = Rig(running.client, await running.client.daemon())
            async with rig.watch("x") as axis:
                await asyncio.sleep(1.0)
                position, state = axis.position.value, axis.state

    assert found
    assert FALSE_MM not in found
    assert position != FALSE_MM
    assert not state.enabled
    assert heard == ["another program publishes on the keys of rig sim; such values are left out, 1 so far"]


@pytest.mark.long
async def test_neither_events_nor_health_come_from_another_program():
    reports = []
    async with running_rig() as running, running.broker.session() as other:
        async with follow_events(running.client) as events, health_reports(running.client, reports.append):
            lie = DaemonHealth(t=EPOCH_NS, seq=10**9, loop_lag_s=9.0, published=0, missed_reports=0)
            for _ in range(5):
                payload, encoding = encode(lie, Encoding.JSON)
                other.publish("ldcn/sim/meta/health", payload, encoding=encoding, qos=Qos.EVENT)
                other.publish("ldcn/sim/tele/x/event", b"{}", encoding="application/json", qos=Qos.EVENT)
                await asyncio.sleep(1.0)
            await running.client.command("x", Power(on=True))
            event = await anext(events)
            await asyncio.sleep(10.0)

    assert event.verb == "power"
    assert reports
    assert lie.seq not in [report.seq for report in reports]


async def test_the_next_run_of_the_daemon_is_believed_and_its_first_samples_are_not_lost():
    broker = MemoryBroker()
    async with running_rig(broker=broker) as first:
        async with rival(broker), first.client.samples("x", "position") as samples:
            await values(samples, 10)
            first.daemon.end()
            await asyncio.sleep(5.0)
            async with running_rig(broker=broker) as second:
                await second.until("x", lambda state: state.link is LinkState.UP)
                await second.client.command("x", SetPosition(position=12.0))
                async with asyncio.timeout(20):
                    while (await anext(samples))[1].value != pytest.approx(12.0, abs=0.1):
                        pass
                found = await values(samples)

    assert FALSE_MM not in found
    assert found[-1] == pytest.approx(12.0, abs=0.1)


async def test_a_record_of_epics_shows_the_positions_of_the_daemon_alone():
    async with running_rig() as running:
        rig = Rig(running.client, await running.client.daemon())
        async with rival(running.broker), gateway(rig, prefix="T:", moves=()) as made:
            await shows(made, "T:x.SEVR", "NO_ALARM")
            found = set()
            for _ in range(200):
                await asyncio.sleep(0.01)
                found.add(made.variables["T:x.RBV"].value)
            enabled = made.variables["T:x.CNEN"].value

    assert FALSE_MM not in found
    assert enabled in (0, "Disable")


async def test_a_recording_has_the_positions_of_the_daemon_alone(tmp_path):
    async with recorded_rig(tmp_path / "run.mcap") as recorded, rival(recorded.rig.broker):
        await asyncio.sleep(3.0)

    recording = (tmp_path / "run.mcap").read_bytes()
    assert recorded.published["ldcn/sim/tele/x/position"] > 20
    assert b"77.0" not in recording
    assert recorded.recorder.losses.missing.total() == 0


async def test_a_page_of_the_console_shows_the_positions_of_the_daemon_and_that_there_is_another_program():
    async with running_console() as console, rival(console.rig.broker):
        async with page(console.app, console.browser, "?rig=sim") as socket:
            frames = []
            async with asyncio.timeout(30):
                while len(frames) < 30:
                    frames.append(await socket.frame())
        (shown,) = [rig for rig in (await console.browser.get("/api/rigs")).document["rigs"] if rig["name"] == "sim"]

    assert frames
    assert not any(struct.pack(">d", FALSE_MM) in frame for frame in frames)
    assert shown["connected"] is True
    assert "another program publishes on the keys of rig sim" in shown["problem"]


def test_axis_watch_shows_the_positions_of_the_daemon_and_that_there_is_another_program(monkeypatch):
    with virtual_rig(monkeypatch, load_config(SIMULATED)) as virtual:
        holding = rival(virtual.rig.broker)
        virtual.wait(holding.__aenter__())
        watched = virtual.run("watch x --item position --count 20")
        virtual.wait(holding.__aexit__(None, None, None))

    assert watched.code == 0
    assert len(watched.printed.splitlines()) == 20
    assert "77" not in watched.printed
    assert watched.errors.count("another program publishes on the keys of rig sim") == 1


@pytest.mark.long
async def test_values_of_a_daemon_that_came_back_with_another_unit_are_in_a_file_that_describes_it(tmp_path):
    document = load_config(SIMULATED).model_dump(mode="json", exclude_unset=True)
    document["bus"][0]["axis"][0] |= {"unit": "um", "counts_per_unit": 2}
    broker = MemoryBroker()
    async with running_rig(broker=broker) as first, first.broker.session() as session:
        watching = RigClient(session, "sim")
        path, describe = tmp_path / "run.mcap", watching.descriptions
        with Recorder(path, await describe(), lambda: EPOCH_NS, LARGE, describe) as recorder:
            async with watching.published(recorder.take) as gave_way, asyncio.TaskGroup() as group:
                group.create_task(recorder.run(gave_way), name="recorder")
                await asyncio.sleep(2.0)
                first.daemon.end()
                await asyncio.sleep(2.0)
                for changed in (None, RigConfig.model_validate(document)):
                    async with running_rig(changed, broker=broker):
                        await asyncio.sleep(3.0)
                recorder.end()

    found = {}
    for file in sorted(tmp_path.iterdir()):
        with file.open("rb") as stream:
            reader = make_reader(stream)
            (described,) = [json.loads(each.data) for each in reader.iter_attachments() if each.name == "axes/x.json"]
            samples = [json.loads(each.data) for *_, each in reader.iter_messages(["/ldcn/sim/tele/x/position"])]
            found[file.name] = described["unit"], {sample["unit"] for sample in samples}
    assert found == {"run.mcap": ("mm", {"mm"}), "run-2.mcap": ("um", {"um"})}
    assert recorder.losses.missing.total() == 0


@pytest.mark.real_time
@pytest.mark.long
async def test_a_plain_zenoh_session_deceives_no_client():
    async with daemon(ROOT / "config" / "simulated.toml") as endpoint, client(endpoint) as rig:
        config = {"mode": "client", "connect": {"endpoints": [endpoint]}, "scouting": {"multicast": {"enabled": False}}}
        payload, encoding = encode(FALSE, Encoding.JSON)
        with zenoh.open(zenoh.Config.from_json5(json.dumps(config))) as session:
            async with rig.samples("x", "position") as samples:
                found = []
                async with asyncio.timeout(30):
                    while len(found) < 20 or not rig.rivals:
                        session.put("ldcn/sim/tele/x/position", payload, encoding=encoding)
                        found.append((await anext(samples))[1].value)

    assert FALSE_MM not in found


@pytest.mark.promise("stop-in-any-state")
@pytest.mark.parametrize("own", [True, False])
async def test_a_daemon_that_ends_hides_no_halt_and_no_stop_of_the_one_that_has_the_line(own):
    async with running_rig() as running, running.broker.session() as other:
        await running.until("x", lambda state: state.link == "up")
        client = running.client
        await client.command("x", Power(on=True))

        def refuse(query):
            asyncio.get_running_loop().call_later(0.5, query.refuse, ShuttingDown("the daemon is stopping"))

        keys = Keys("sim")
        for key in ("ldcn/sim/@cmd/**", *keys.all_stops):
            await other.serve(key, refuse, complete=True)
        if not own:  # the client takes the other one for its daemon
            info = (await client.daemon()).model_copy(update={"instance": "rival", "started": EPOCH_NS + 10**12})
            told = encode(info, Encoding.JSON)
            await other.serve(keys.daemon, lambda query: query.reply(*told), complete=True)
            client = RigClient(running.session, "sim")
            assert (await client.daemon()).instance == "rival"
        await running.client.command("x", MoveVelocity(velocity=5.0, instance="run1"))
        halted = await client.command("x", Halt(instance="run1"))
        stopped = await client.stop()

    assert halted.status == "accepted"
    assert stopped.confirmed == ("x", "y", "z", "c")
