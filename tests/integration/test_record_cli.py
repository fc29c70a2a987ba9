"""`ldcnd record` against a daemon in its own process over loopback TCP."""

import asyncio
import re
import resource
import signal
from asyncio.subprocess import PIPE
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path

import pytest
from click.testing import CliRunner
from mcap.records import Channel

from ldcnd.cli.main import cli
from ldcnd.contract.codec import Encoding, encode
from ldcnd.contract.samples import PositionSample
from ldcnd.lab.cli.record import dated
from ldcnd.lab.recording.reading import Recording
from ldcnd.lab.recording.recorder import Recorder
from ldcnd.net.session import Publication, SampleKind
from tests.support.process import LDCND, ROOT, daemon

VALUE = PositionSample(
    t=1, t_error_ns=0, seq=0, quality="good", value=1.5, unit="mm", counts=1500, following_error=None
)
POSITION = Publication("ldcn/sim/tele/x/position", *encode(VALUE, Encoding.JSON), SampleKind.PUT, VALUE.t)


def is_on_the_disk(part, topic):
    """Tell whether a file that is being written has a message of a topic."""
    written = part.stat().st_size and Recording(part).records()
    return bool(written) and any(isinstance(record, Channel) and record.topic == topic for record in written)


@pytest.mark.system
@pytest.mark.real_time
@pytest.mark.timeout(120)
async def test_a_rig_is_recorded_until_the_signal_and_exported(tmp_path):
    pattern, path, whole, tables = (tmp_path / name for name in ("run%%.mcap", "run%.mcap", "whole.mcap", "tables"))
    async with daemon(ROOT / "config" / "simulated.toml") as endpoint:
        recording = await asyncio.create_subprocess_exec(
            *LDCND, "record", "-o", str(pattern), "-e", endpoint, stderr=PIPE
        )
        assert recording.stderr
        async with asyncio.timeout(45):
            await recording.stderr.readline()
            while not is_on_the_disk(path.with_name("run%.mcap.part"), "/ldcn/sim/tele/x/position"):
                await asyncio.sleep(0.2)  # nothing tells when a file has grown
            recording.send_signal(signal.SIGTERM)
            _, told = await recording.communicate()

    exported = CliRunner().invoke(cli, ["record", "export", str(path), str(tables)])
    recovered = CliRunner().invoke(cli, ["record", "recover", str(path), str(whole)])
    count = told.decode().split()[0]
    assert recording.returncode == 0
    assert int(count) > 0
    assert (exported.exit_code, exported.output.split()[0]) == (0, count)
    assert (tables / "ldcn.sim.tele.x.position.csv").read_text().startswith("t_ns,received_ns,")
    assert (recovered.exit_code, recovered.output.split()[0]) == (0, count)


def test_a_name_tells_when_the_recording_began():
    start = datetime(2031, 2, 3, 4, 5, 6, tzinfo=UTC)

    assert dated(Path("%Y/run-%Y%m%d-%H%M%S.mcap"), start) == Path("2031/run-20310203-040506.mcap")


async def test_a_damaged_recording_is_recovered_and_exported_as_far_as_it_goes_and_says_where_it_ends(tmp_path):
    path, cut, whole, tables = (tmp_path / name for name in ("run.mcap", "cut.mcap", "whole.mcap", "tables"))
    with Recorder(path, {}, lambda: 0, 1 << 30) as recorder:
        recorder.take(POSITION)
    cut.write_bytes(path.read_bytes()[:-30])

    recovered = CliRunner().invoke(cli, ["record", "recover", str(cut), str(whole)])
    exported = CliRunner().invoke(cli, ["record", "export", str(cut), str(tables)])

    assert (recovered.exit_code, exported.exit_code) == (0, 1)
    assert re.search(r"cut\.mcap, byte \d+: the file was cut short here", recovered.stderr)
    assert recovered.stdout.startswith("1 messages recovered, the last of 1970-01-01T00:00:00")
    assert exported.stdout.startswith("1 messages in 1 tables")
    assert "cut short" in exported.stderr


@contextmanager
def full_disk(free_bytes):
    """Let no file of this process become longer: the kernel refuses that as it refuses a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (free_bytes, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.parametrize("free_bytes", [0, 20, 300])
@pytest.mark.parametrize("document", [b"", b"{}" * 100_000])
def test_a_recorder_leaves_nothing_of_a_file_that_it_cannot_begin(tmp_path, free_bytes, document):
    with (
        full_disk(free_bytes),
        pytest.raises(OSError, match="too large"),
        Recorder(tmp_path / "run.mcap", {"configuration": document}, lambda: 0, 1 << 30) as recorder,
    ):
        recorder.take(POSITION)

    assert list(tmp_path.iterdir()) == []


async def test_what_a_recorder_has_on_the_disk_stays_when_that_is_full(tmp_path):
    recorder = Recorder(tmp_path / "run.mcap", {}, lambda: 0, 1 << 30)
    recorder.take(POSITION)
    running = asyncio.create_task(recorder.run(lambda: 0))
    while not is_on_the_disk(tmp_path / "run.mcap.part", "/ldcn/sim/tele/x/position"):
        await asyncio.sleep(0.2)  # nothing tells when a file has grown
    recorder.end()
    await running

    part = tmp_path / "run.mcap.part"
    recorder.take(POSITION)
    with full_disk(part.stat().st_size), pytest.raises(OSError, match="too large"):
        recorder.__exit__(None, None, None)

    saved = CliRunner().invoke(cli, ["record", "recover", str(part), str(tmp_path / "whole.mcap")])
    assert saved.stdout.startswith("1 messages recovered")


@pytest.mark.parametrize(
    ("content", "said"), [(b"", "nothing was recorded\n  delete it"), (b"x" * 99, "not an MCAP file")]
)
@pytest.mark.parametrize("command", ["record recover {} whole.mcap", "record export {} tables", "plot {} x -o x.png"])
def test_what_is_no_recording_is_a_failure_and_no_configuration(tmp_path, monkeypatch, content, said, command):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "run.mcap.part").write_bytes(content)

    done = CliRunner().invoke(cli, command.format("run.mcap.part").split())

    assert f"run.mcap.part: {said}" in done.stderr
    assert done.exit_code == 1
