"""The daemon keeps captures of its own accord; what they hold can be played back."""

import asyncio
import os
import signal

import pytest

from ldcnd.config.rig import CapturesConfig, load_config
from ldcnd.contract.samples import LinkState
from ldcnd.daemon.capture import config_of
from ldcnd.line.capture import parse_capture
from ldcnd.testing.jumping_loop import JumpingLoop
from tests.integration.test_kept_references import chain_of, keeping
from tests.support.captures import FOLDER, replayed
from tests.support.chain_rig import rig_on
from tests.support.process import LDCND, answering, free_port
from tests.support.rig import running_rig, two_lines


def config_with(name, directory, **bounds):
    rig = load_config(FOLDER / f"{name}.toml")
    return rig.model_copy(update={"captures": CapturesConfig(directory=directory, **bounds)})


async def until(count, directory):
    async with asyncio.timeout(60):
        while len(list(directory.glob("*.capture"))) < count:
            await asyncio.sleep(0.1)
    return sorted(directory.glob("*.capture"))


async def test_a_drive_that_loses_power_leaves_a_capture_that_shows_it(tmp_path):
    async with running_rig(config_with("power_loss", tmp_path)):
        (file, *_) = await until(1, tmp_path)

    capture = parse_capture(file.read_text(encoding="utf-8"))
    assert "link_lost" in capture.header.cause
    assert capture.header.first_record == 0
    assert capture.header.config["bus"][0]["name"] == "line0"


async def test_a_capture_of_a_line_carries_its_configuration_beside_rules_of_another_line(tmp_path):
    async with running_rig(two_lines(tmp_path)) as rig:
        captured = {line.name: rig.daemon.capture(line.name, "asked for") for line in rig.daemon.config.bus}
        lines = rig.daemon.config.bus

    assert [config_of(captured[line.name].header).bus for line in lines] == [(line,) for line in lines]


@pytest.mark.long
async def test_what_an_earlier_run_has_left_behind_is_not_captured_at_each_start(tmp_path):
    """Captures of an incident would make room for those of every start after it."""
    chain, config = chain_of(), keeping(tmp_path)
    async with rig_on(chain, config) as rig:
        await rig.until("x", lambda state: state.link is LinkState.UP)
        await rig.client.stop()
        await asyncio.sleep(2.0)
        await rig.kill()
    before = set((tmp_path / "captures").glob("*"))
    for _ in range(3):
        async with rig_on(chain, config) as rig:
            await rig.until("x", lambda state: state.link is LinkState.UP and not state.stop_pending)
            await asyncio.sleep(15.0)
            await rig.kill()

    assert set((tmp_path / "captures").glob("*")) == before


async def test_a_line_that_goes_down_leaves_a_capture(tmp_path):
    async with running_rig(config_with("clean_start", tmp_path)) as rig:
        await asyncio.sleep(1.0)
        line = rig.daemon.rig.buses[0]
        line.bus._line.transport_lost("the adapter is gone")
        (file, *_) = await until(1, tmp_path)

    capture = parse_capture(file.read_text(encoding="utf-8"))
    assert "line down" in capture.header.cause
    assert any(record.note == "the adapter is gone" for record in capture.records)


async def test_a_loose_contact_fills_no_disk(tmp_path):
    async with running_rig(config_with("clean_start", tmp_path)) as rig:
        bus, loop = rig.daemon.rig.buses[0].bus, asyncio.get_running_loop()
        began_s = loop.time()
        for _ in range(25):
            await bus.wait_opened()
            bus._line.transport_lost("a loose contact")
            await asyncio.sleep(1.0)
        most = (loop.time() - began_s) / 10.0 + 1  # one every 10 s

    assert 1 < len(list(tmp_path.iterdir())) <= most


@pytest.mark.long
async def test_nothing_is_written_without_a_place_or_a_cause(tmp_path):
    async with running_rig(config_with("clean_start", tmp_path)) as rig, running_rig() as other:
        await asyncio.sleep(20.0)

        assert rig.daemon.captures is not None
        assert other.daemon.captures is None
    assert not list(tmp_path.iterdir())


def test_the_capture_of_a_power_loss_plays_back(tmp_path):
    async def lose_power():
        async with running_rig(config_with("power_loss", tmp_path)):
            return (await until(1, tmp_path))[0]

    with asyncio.Runner(loop_factory=JumpingLoop) as runner:
        file = runner.run(lose_power())
    published = replayed(parse_capture(file.read_text(encoding="utf-8")))

    assert any('"link_lost"' in line for line in published)


@pytest.mark.real_time
@pytest.mark.long
async def test_a_daemon_that_is_aborted_writes_what_was_on_its_lines(tmp_path):
    text = (FOLDER / "clean_start.toml").read_text(encoding="utf-8")
    config = tmp_path / "rig.toml"
    config.write_text(text.replace("[[bus]]", f'[captures]\ndirectory = "{tmp_path}/kept"\n\n[[bus]]', 1))
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    running = await asyncio.create_subprocess_exec(*LDCND, "run", "--config", str(config), "--listen", endpoint)
    try:
        await answering(running, endpoint)
        os.kill(running.pid, signal.SIGABRT)
        async with asyncio.timeout(30):
            code = await running.wait()
    finally:
        if running.returncode is None:
            running.kill()
            await running.wait()

    assert code == -signal.SIGABRT
    (file,) = (tmp_path / "kept").glob("*-aborted-as-by-a-watchdog.capture")
    assert len(parse_capture(file.read_text(encoding="utf-8")).records) > 10
