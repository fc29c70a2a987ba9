"""Recordings of a whole daemon on the jumping clock, read back with the format's own reader."""

import asyncio
import json
import resource
import shutil
import signal
import sys
from asyncio.subprocess import PIPE

import msgpack
import pytest
from click.testing import CliRunner
from mcap.reader import make_reader

from ldcnd.cli.main import cli
from ldcnd.config.rig import RigConfig
from ldcnd.contract.codec import Encoding, encode
from ldcnd.contract.commands import MoveAbsolute, Power, Verb
from ldcnd.contract.errors import ConfigError
from ldcnd.contract.events import CommandEvent, CommandStatus
from ldcnd.contract.health import DaemonHealth
from ldcnd.contract.samples import AxisState, LinkState, PositionSample, Quality
from ldcnd.lab.recording.mcap_file import FACTS
from ldcnd.lab.recording.recorder import FLUSH_PERIOD_S, Recorder
from ldcnd.lab.recording.recovery import recover
from ldcnd.net.session import Publication, SampleKind
from tests.support.process import ROOT
from tests.support.recordings import LARGE, checked_topics, recorded_rig, thirty_one_axes
from tests.support.rig import EPOCH_NS

HEALTH = "ldcn/sim/meta/health"


def messages(path):
    with path.open("rb") as stream:
        return [
            (channel.topic, message.data)
            for _, channel, message in make_reader(stream, validate_crcs=True).iter_messages(log_time_order=False)
        ]


def attached(path):
    with path.open("rb") as stream:
        return {attachment.name: json.loads(attachment.data) for attachment in make_reader(stream).iter_attachments()}


def facts(path):
    with path.open("rb") as stream:
        (found,) = [record.metadata for record in make_reader(stream).iter_metadata() if record.name == FACTS]
    return found


async def record_a_move(path, seconds, **options):
    """Record a rig whose axis x moves to 5 mm; return how many values were published on each key."""
    async with recorded_rig(path, **options) as recorded:
        await recorded.rig.until("x", lambda state: state.state is AxisState.DISABLED)
        await recorded.rig.client.command("x", Power(on=True))
        await recorded.rig.client.command("x", MoveAbsolute(position=5.0))
        await asyncio.sleep(seconds)
    return recorded.published


async def thirty_one_axes_are_in_the_file(path, seconds, position_hz):
    async with recorded_rig(path, thirty_one_axes(position_hz)) as recorded:
        await recorded.rig.until("a7", lambda state: state.state is AxisState.DISABLED)
        await recorded.rig.client.command("a7", Power(on=True))
        await asyncio.sleep(seconds)

    topics = checked_topics(path)
    assert topics == recorded.published
    positions = [count for topic, count in topics.items() if topic.endswith("/position")]
    assert len(positions) == 31
    assert min(positions) > 0.8 * seconds * position_hz  # with 20 Hz the line is full
    assert topics["ldcn/sim/tele/a7/event"] >= 2
    assert facts(path)["missing"] == "0"
    return topics.total()


@pytest.mark.timeout(240)
@pytest.mark.long
async def test_every_value_of_31_axes_is_in_the_file_and_fits_the_schema_in_the_file(tmp_path):
    await thirty_one_axes_are_in_the_file(tmp_path / "run.mcap", 6.0, position_hz=5.0)


@pytest.mark.soak
@pytest.mark.timeout(1800)
async def test_ten_minutes_of_31_axes_are_in_the_file_and_fit_the_schema_in_the_file(tmp_path):
    print(await thirty_one_axes_are_in_the_file(tmp_path / "run.mcap", 600.0, position_hz=20.0), "messages")


async def test_the_file_says_what_was_recorded(tmp_path):
    path = tmp_path / "run.mcap"

    await record_a_move(path, 1.0)

    documents = attached(path)
    described = {"daemon.json", "commands.json", "budget.json", "configuration.json", "axes/x.json", "buses/line0.json"}
    assert described <= set(documents)
    assert RigConfig.model_validate(documents["configuration.json"]).bus[0].axis[0].name == "x"
    assert documents["axes/x.json"]["unit"] == "mm"
    assert not path.with_name("run.mcap.part").exists()


async def test_events_are_log_messages_that_viewers_know_and_nothing_of_them_is_lost(tmp_path):
    path = tmp_path / "run.mcap"

    await record_a_move(path, 2.0)

    with path.open("rb") as stream:
        found = list(make_reader(stream).iter_messages(topics=["/ldcn/sim/tele/x/event"]))
    logs = [json.loads(message.data) for _, _, message in found]
    assert {schema.name for schema, _, _ in found} == {"foxglove.Log"}
    # the fields of foxglove.Log, as documented
    assert {"timestamp", "level", "message", "name", "file", "line"} < set(logs[0])
    assert [log["event"]["seq"] for log in logs] == list(range(len(logs)))
    ended = logs[-1]
    event = CommandEvent.model_validate(ended["event"])
    assert (event.verb, event.status, ended["level"]) == (Verb.MOVE_ABSOLUTE, CommandStatus.DONE, 2)
    assert ended["timestamp"] == {"sec": event.t // 10**9, "nsec": event.t % 10**9}
    assert ended["message"].startswith("x: move_absolute done by ")


async def test_a_rig_that_says_little_is_on_the_disk_all_the_same(tmp_path):
    path, whole = tmp_path / "run.mcap", tmp_path / "whole.mcap"
    recorder = Recorder(path, {}, lambda: EPOCH_NS, LARGE)
    async with asyncio.TaskGroup() as group:
        with recorder:
            group.create_task(recorder.run(lambda: 0), name="recorder")
            recorder.take(health(0))

            await asyncio.sleep(1.1 * FLUSH_PERIOD_S)

            saved = recover(path.with_name("run.mcap.part"), whole)
            recorder.end()
    assert saved.messages == 1


@pytest.mark.real_time
@pytest.mark.timeout(900)
@pytest.mark.parametrize(("seconds", "axes"), [(20.4, 4), pytest.param(300.4, 31, marks=pytest.mark.soak)])
@pytest.mark.long
async def test_all_but_the_last_chunk_of_a_killed_recorder_is_recovered(tmp_path, seconds, axes):
    path, whole = tmp_path / "run.mcap", tmp_path / "whole.mcap"
    arguments = ("-m", "tests.support.killed_recorder", str(path), str(seconds), str(axes))
    killed = await asyncio.create_subprocess_exec(sys.executable, *arguments, stdout=PIPE, cwd=ROOT)
    async with asyncio.timeout(10 + seconds * 2):
        told, _ = await killed.communicate()

    saved = recover(path.with_name("run.mcap.part"), whole)

    flushed, recorded = map(int, told.splitlines()[-1].split())
    assert killed.returncode == -signal.SIGKILL
    assert 0 < flushed < recorded
    assert saved.messages == flushed == checked_topics(whole).total()
    assert recorded - flushed < 2 * recorded / seconds  # no more than about a second of it
    assert facts(whole)["missing"] == "0"
    assert "configuration.json" in attached(whole)


@pytest.mark.long
async def test_a_recording_that_was_cut_tells_where_and_is_recovered_up_to_there(tmp_path):
    path, cut, whole = tmp_path / "run.mcap", tmp_path / "cut.mcap.part", tmp_path / "whole.mcap"
    await record_a_move(path, 10.0)
    data = path.read_bytes()
    cut.write_bytes(data[: len(data) // 2])

    saved = recover(cut, whole)

    before = messages(path)
    (damage,) = saved.damages
    assert len(before) / 4 < saved.messages < len(before)
    assert messages(whole) == before[: saved.messages]
    assert len(data) // 4 < damage.at_bytes <= len(data) // 2
    assert "cut short" in damage.reason
    assert facts(whole)["damage 1"] == str(damage)


@pytest.mark.long
async def test_a_chunk_that_was_damaged_costs_no_other_chunk(tmp_path):
    path, damaged, whole = tmp_path / "run.mcap", tmp_path / "damaged.mcap", tmp_path / "whole.mcap"
    await record_a_move(path, 10.0)
    with path.open("rb") as stream:
        chunks = make_reader(stream).get_summary().chunk_indexes
    data = bytearray(path.read_bytes())
    data[chunks[4].chunk_start_offset + chunks[4].chunk_length - 20] ^= 0xFF
    damaged.write_bytes(data)

    saved = recover(damaged, whole)

    (damage,) = saved.damages
    assert damage.at_bytes == chunks[4].chunk_start_offset
    assert saved.messages > 0.7 * len(messages(path))
    assert saved.losses.missing.total() > 0
    assert saved.messages + saved.losses.missing.total() == len(messages(path))


def test_what_is_no_recording_is_refused_and_leaves_nothing_behind(tmp_path):
    text = tmp_path / "text.mcap"
    text.write_text("no recording")

    with pytest.raises(ConfigError, match="not an MCAP file"):
        recover(text, tmp_path / "whole.mcap")

    assert list(tmp_path.iterdir()) == [text]


@pytest.mark.long
async def test_a_full_file_is_followed_by_the_next_without_a_gap(tmp_path):
    published = await record_a_move(tmp_path / "run.mcap", 20.0, rotate_bytes=50_000)

    files = sorted(tmp_path.iterdir())
    assert len(files) > 1
    assert sum((checked_topics(file) for file in files), start=published - published) == published
    assert all("configuration.json" in attached(file) for file in files)


async def test_a_recording_whose_next_file_exists_ends_with_one_error_and_is_whole(tmp_path):
    path, taken = tmp_path / "run.mcap", tmp_path / "run-2.mcap"
    taken.write_bytes(b"precious")

    refused = pytest.RaisesExc(ConfigError, match=r"run-2\.mcap exists already")
    with pytest.RaisesGroup(refused, flatten_subgroups=True):
        await record_a_move(path, 60.0, rotate_bytes=50_000)

    assert taken.read_bytes() == b"precious"
    assert checked_topics(path).total() > 100
    assert sorted(tmp_path.iterdir()) == [taken, path]


@pytest.mark.long
async def test_a_full_disk_ends_the_recording_and_what_was_written_is_recovered(tmp_path):
    path, whole = tmp_path / "run.mcap", tmp_path / "whole.mcap"
    before = resource.getrlimit(resource.RLIMIT_FSIZE)

    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, before[1]))
    try:
        with pytest.raises(OSError, match="File too large"):
            await record_a_move(path, 60.0)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)

    assert recover(path.with_name("run.mcap.part"), whole).messages > 100


def health(seq, key=HEALTH):
    report = DaemonHealth(t=EPOCH_NS + seq, seq=seq, loop_lag_s=0.0, published=0, missed_reports=0)
    return Publication(key, *encode(report, Encoding.JSON), SampleKind.PUT, report.t)


async def test_what_is_missing_is_counted_in_the_file(tmp_path):
    path = tmp_path / "run.mcap"
    with Recorder(path, {}, lambda: EPOCH_NS, LARGE) as recorder:
        for seq in (7, 8, 11, 12, 0, 1):  # two lost, then a restart
            recorder.take(health(seq))
        recorder.take(Publication("ldcn/sim/tele/x/position", b"{}", "application/json", SampleKind.PUT, None))

    found = facts(path)
    assert {name: found[name] for name in ("messages", "missing", "restarts", "not_understood")} == {
        "messages": "6",
        "missing": "2",
        "restarts": "1",
        "not_understood": "1",
    }
    assert found[f"missing /{HEALTH}"] == "2"
    assert "2 missing" in recorder.summary


@pytest.mark.parametrize(
    ("changed", "recorded"),
    [
        ({}, {}),
        ({"unit": "m\x1b[2Jm"}, {"unit": "m\\x1b[2Jm"}),
        ({"made_by_a_newer_daemon": 1}, {"made_by_a_newer_daemon": None}),
        ({"seq": "3"}, None),
        ({"t": None}, None),
    ],
)
async def test_a_sample_is_recorded_as_its_schema_has_it_or_not_at_all(tmp_path, changed, recorded):
    sample = {"t": EPOCH_NS, "t_error_ns": 9, "seq": 3, "quality": "good", "value": 1.5, "unit": "mm", "turns": None}
    sample |= {"counts": 1500, "following_error": 0.25}
    with Recorder(tmp_path / "run.mcap", {}, lambda: EPOCH_NS, LARGE) as recorder:
        payload = msgpack.packb(sample | changed)
        recorder.take(Publication("ldcn/sim/tele/x/position", payload, "application/msgpack", SampleKind.PUT, None))

    with (tmp_path / "run.mcap").open("rb") as stream:
        found = [json.loads(message.data) for _, _, message in make_reader(stream).iter_messages()]
    wanted = [] if recorded is None else [{k: v for k, v in (sample | recorded).items() if k in sample}]
    assert found == wanted
    assert recorder.not_understood == (recorded is None)


async def test_what_the_recorder_was_too_slow_for_is_counted(tmp_path):
    path = tmp_path / "run.mcap"
    async with recorded_rig(path, kept=8) as recorded:
        await asyncio.sleep(1.0)
        for seq in range(1000, 1100):  # at once: nobody can take them in between
            sample = health(seq)
            recorded.rig.session.publish(HEALTH, sample.payload, encoding=sample.encoding, qos="telemetry")
        await asyncio.sleep(0.01)

    assert int(facts(path)["too_slow"]) >= 92
    assert "too slow" in recorded.recorder.summary


def test_a_recording_never_overwrites_another(tmp_path):
    path = tmp_path / "run.mcap"
    path.write_bytes(b"precious")

    with pytest.raises(ConfigError, match="exists already"):
        Recorder(path, {}, lambda: EPOCH_NS, LARGE)

    assert path.read_bytes() == b"precious"


def test_a_recording_never_overwrites_what_a_cut_left_of_another(tmp_path):
    left = tmp_path / "run.mcap.part"
    left.write_bytes(b"precious")

    with pytest.raises(ConfigError, match="cut short") as refused:
        Recorder(tmp_path / "run.mcap", {}, lambda: EPOCH_NS, LARGE)

    assert "ldcnd record recover" in str(refused.value.remedy)
    assert left.read_bytes() == b"precious"


async def test_a_daemon_that_is_configured_anew_is_said_to_go_on_in_the_next_file(tmp_path):
    path, said = tmp_path / "run.mcap", []
    described = [{"configuration": b"one"}, {"configuration": b"two"}]

    async def describe():
        return described[-1]

    with Recorder(path, described[0], lambda: 1, LARGE, describe, said.append) as recorder:
        value = PositionSample(
            t=1, t_error_ns=0, seq=0, quality=Quality.GOOD, value=1.5, unit="mm", counts=1500, following_error=None
        )
        recorder.take(
            Publication("ldcn/sim/tele/x/position", *encode(value, Encoding.JSON), SampleKind.PUT, 1, source="other")
        )
        async with asyncio.TaskGroup() as group:
            group.create_task(recorder.run(lambda: 0), name="recorder")
            while not recorder.messages:
                await asyncio.sleep(0.1)
            recorder.end()

    assert said == [tmp_path / "run-2.mcap"]
    assert recorder.summary.endswith(f"2 files, the last of which is {tmp_path / 'run-2.mcap'}")


async def test_what_is_asked_of_a_later_instant_names_the_file_in_which_the_recording_goes_on(tmp_path):
    path = tmp_path / "run.mcap"
    async with recorded_rig(path) as recorded:
        await recorded.rig.until("x", lambda state: state.link is LinkState.UP)
        await asyncio.sleep(2.0)
    args = ["axis", "at", "x", str(EPOCH_NS + 10**12), "--recording", str(path)]
    alone = CliRunner().invoke(cli, args)
    shutil.copy(path, tmp_path / "run-2.mcap")
    followed = CliRunner().invoke(cli, args)

    assert "run-2.mcap" not in alone.stderr
    assert f"goes on in {tmp_path / 'run-2.mcap'}" in followed.stderr
