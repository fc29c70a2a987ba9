"""Recordings of a whole daemon on the jumping clock, read back with the format's own reader."""

import asyncio
import csv
import json
from collections import Counter

import jsonschema
import pytest
from mcap.reader import make_reader

from ldcnd.config import RigConfig, load_config
from ldcnd.errors import ConfigError
from ldcnd.model.axes import AxisState
from ldcnd.model.requests import MoveAbsoluteRequest, PowerRequest, Verb
from ldcnd.recording.mcap_file import export_csv, recover
from ldcnd.recording.recorder import Recorder
from tests.support.rig import EPOCH_NS, SIMULATED, running_rig

LARGE = 1 << 30


def read(path):
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        attached = {attachment.name: json.loads(attachment.data) for attachment in reader.iter_attachments()}
        return list(reader.iter_messages()), attached


async def record(path, seconds, rotate_bytes=LARGE):
    """Record a rig whose axis x moves, and return how many values were published on each key meanwhile."""
    counts = Counter()
    async with running_rig() as rig:
        await rig.until("x", lambda state: state.state is AxisState.DISABLED)
        recorder = Recorder(path, {"daemon": await rig.client.daemon()}, lambda: EPOCH_NS, rotate_bytes)

        def take(sample):
            counts[sample.key] += 1
            recorder.take(sample)

        with recorder:
            async with rig.client.published(take):
                await rig.client.command("x", Verb.POWER, PowerRequest(on=True))
                await rig.client.command("x", Verb.MOVE_ABSOLUTE, MoveAbsoluteRequest(position=5.0))
                await asyncio.sleep(seconds)
    return counts


async def test_every_published_value_is_in_the_file_and_fits_the_schema_in_the_file(tmp_path):
    path = tmp_path / "run.mcap"

    counts = await record(path, seconds=60.0)

    messages, attached = read(path)
    recorded = Counter(channel.topic.removeprefix("/") for _, channel, _ in messages)
    validators = {}
    for schema, _, message in messages:
        if schema.id not in validators:
            validators[schema.id] = jsonschema.Draft202012Validator(json.loads(schema.data))
        if message.sequence % 20 == 0:
            validators[schema.id].validate(json.loads(message.data))
    assert recorded == counts
    assert {"ldcn/sim/tele/x/event", "ldcn/sim/tele/x/position", "ldcn/sim/meta/health"} <= set(recorded)
    assert len(messages) > 2000
    assert attached["daemon.json"]["rig"] == "sim"
    assert not path.with_name("run.mcap.part").exists()


async def test_a_recording_that_was_cut_is_recovered_up_to_the_cut(tmp_path):
    path, cut, whole = tmp_path / "run.mcap", tmp_path / "cut.mcap.part", tmp_path / "whole.mcap"
    await record(path, seconds=60.0)
    data = path.read_bytes()
    cut.write_bytes(data[: len(data) * 2 // 3])

    count = recover(cut, whole)

    before = [(channel.topic, message.data) for _, channel, message in read(path)[0]]
    messages, attached = read(whole)
    assert len(before) / 4 < count < len(before)
    assert [(channel.topic, message.data) for _, channel, message in messages] == before[:count]
    assert attached["daemon.json"]["rig"] == "sim"


async def test_a_full_file_is_followed_by_the_next_without_a_gap(tmp_path):
    counts = await record(tmp_path / "run.mcap", seconds=60.0, rotate_bytes=20_000)

    files = sorted(tmp_path.iterdir())
    parts = [read(file) for file in files]
    assert len(files) > 1
    assert sum(len(messages) for messages, _ in parts) == counts.total()
    assert all(attached["daemon.json"]["rig"] == "sim" for _, attached in parts)


async def test_a_recording_becomes_a_table(tmp_path):
    path, table = tmp_path / "run.mcap", tmp_path / "run.csv"
    await record(path, seconds=5.0)

    with table.open("w", encoding="utf-8") as stream:
        count = export_csv(path, stream)

    with table.open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    position = [row for row in rows if (row["topic"], row["field"]) == ("/ldcn/sim/tele/x/position", "value")]
    assert len(rows) == count
    assert float(position[-1]["value"]) == pytest.approx(5.0, abs=0.01)
    assert int(position[-1]["t_ns"]) > int(position[0]["t_ns"]) > EPOCH_NS


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


def thirty_one_axes():
    document = load_config(SIMULATED).model_dump()
    (bus,), (line,) = document["bus"], document["sim"]
    x, drive = bus["axis"][0], line["module"][0]
    bus["axis"] = [{**x, "name": f"a{address}", "address": address} for address in range(1, 32)]
    line["module"] = [drive] * 31
    return RigConfig.model_validate(document)


async def test_thirty_one_axes_are_recorded_without_a_gap(tmp_path):
    path = tmp_path / "run.mcap"
    async with running_rig(thirty_one_axes()) as rig:
        recorder = Recorder(path, {}, lambda: EPOCH_NS, LARGE)
        with recorder:
            async with rig.client.published(recorder.take):
                await asyncio.sleep(15.0)

    sequences = {}
    for _, channel, message in read(path)[0]:
        sequences.setdefault(channel.topic, []).append(message.sequence)
    assert sum(topic.endswith("/position") for topic in sequences) == 31
    for sequence in sequences.values():
        assert sequence == list(range(sequence[0], sequence[0] + len(sequence)))
