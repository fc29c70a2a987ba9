"""`ldcnd record` against a daemon in its own process over loopback TCP."""

import asyncio
import signal
from asyncio.subprocess import PIPE

import pytest

from tests.support.process import LDCND, ROOT, daemon

pytestmark = pytest.mark.real_time


async def ldcnd(*arguments):
    """Run `ldcnd ARGUMENTS` and return its exit code and what it printed, errors last."""
    running = await asyncio.create_subprocess_exec(*LDCND, *arguments, stdout=PIPE, stderr=PIPE)
    async with asyncio.timeout(45):
        printed, errors = await running.communicate()
    return running.returncode, printed.decode(), errors.decode()


async def test_a_rig_is_recorded_until_the_signal_and_exported(tmp_path):
    path, whole, tables = tmp_path / "run.mcap", tmp_path / "whole.mcap", tmp_path / "tables"
    async with daemon(ROOT / "config" / "simulated.toml") as endpoint:
        recording = await asyncio.create_subprocess_exec(*LDCND, "record", "-o", str(path), "-e", endpoint, stderr=PIPE)
        assert recording.stderr
        async with asyncio.timeout(45):
            await recording.stderr.readline()
            while not path.with_name("run.mcap.part").exists():
                await asyncio.sleep(0.05)
            await asyncio.sleep(1.0)  # of real samples
            recording.send_signal(signal.SIGTERM)
            _, told = await recording.communicate()

    exported = await ldcnd("record", "export", str(path), str(tables))
    recovered = await ldcnd("record", "recover", str(path), str(whole))
    assert recording.returncode == 0
    assert "none missing" in told.decode()
    assert exported[0] == 0, exported[2]
    assert (tables / "ldcn.sim.tele.x.position.csv").read_text().startswith("t_ns,received_ns,")
    assert (recovered[0], recovered[1].split()[0]) == (0, told.decode().split()[0])
