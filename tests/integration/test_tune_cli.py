"""`ldcnd tune` as a process against a daemon as a process: what is left when it is interrupted or killed."""

import asyncio
import json
import signal
from asyncio.subprocess import DEVNULL, PIPE

import pytest

from ldcnd.bench.kept_gains import LEASE_S
from ldcnd.contract.leases import ListHolders
from tests.support.process import LDCND, ROOT, client, daemon

pytestmark = [pytest.mark.system, pytest.mark.real_time, pytest.mark.timeout(300)]
CONFIG = ROOT / "config" / "simulated.toml"
CONFIGURED = {"kp": 350, "kd": 3000, "ki": 400, "il": 400, "ol": 250, "el": 4000, "sr": 1, "deadband": 0}
BEGIN_S = 90.0


@pytest.fixture
def state_file(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    return tmp_path / "ldcnd" / "gains" / "sim@x.json"


async def tune(*arguments):
    """Start `ldcnd tune x ARGUMENTS`."""
    return await asyncio.create_subprocess_exec(
        *LDCND, "tune", "x", *arguments, stdin=DEVNULL, stdout=PIPE, stderr=PIPE
    )


async def ended(running):
    """Return exit code, output and errors of a process."""
    printed, errors = await running.communicate()
    return running.returncode, printed.decode(), errors.decode()


async def registers(rig):
    info = next(each for each in await rig.axes() if each.axis == "x")
    return {each.name: each.value for each in info.registers if each.name in CONFIGURED}


async def others_loaded(rig, running):
    """Wait until a tuning has loaded gains of its own."""
    async with asyncio.timeout(BEGIN_S):
        while (await registers(rig))["kd"] in (None, 0, CONFIGURED["kd"]):
            assert running.returncode is None
            await asyncio.sleep(0.05)


async def test_ctrl_c_puts_the_gains_back(state_file):
    async with daemon(CONFIG) as endpoint, client(endpoint) as rig:
        running = await tune("-e", endpoint, "--yes")
        await others_loaded(rig, running)
        running.send_signal(signal.SIGINT)
        code, _, errors = await ended(running)
        loaded, state = await registers(rig), await rig.state("x")

    assert code == 130, errors
    assert "x: off, with its old gains" in errors.splitlines()
    assert loaded == CONFIGURED
    assert not state.enabled
    assert not state_file.exists()


async def test_gains_of_a_tuning_that_was_killed_are_put_back_by_hand(state_file):
    async with daemon(CONFIG) as endpoint, client(endpoint) as rig:
        running = await tune("-e", endpoint, "--yes")
        await others_loaded(rig, running)
        running.kill()
        await ended(running)
        left, kept = await registers(rig), json.loads(state_file.read_text())
        async with asyncio.timeout(LEASE_S + BEGIN_S):
            while any(each.client for each in (await rig.ask(ListHolders())).holders):
                await asyncio.sleep(0.1)
        refused = await ended(await tune("-e", endpoint, "--yes"))
        put_back = await ended(await tune("-e", endpoint, "--put-back"))
        again = await ended(await tune("-e", endpoint, "--put-back"))
        loaded, state = await registers(rig), await rig.state("x")

    assert left != CONFIGURED
    assert kept == {"rig": "sim", "axis": "x", "gains": CONFIGURED, "model": "ls-182ap"}
    assert refused[0] == 1
    assert "ldcnd tune x --put-back" in refused[2]
    assert put_back[0] == 0, put_back[2]
    assert loaded == CONFIGURED
    assert not state.enabled
    assert again[0] == 1
    assert "no gains of an unfinished tuning" in again[2]
