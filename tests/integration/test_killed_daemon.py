"""A daemon process that is killed in mid-move, and the one that takes its place."""

import asyncio
import contextlib
from asyncio.subprocess import PIPE
from contextlib import asynccontextmanager

import pytest

from ldcnd.contract.commands import Home, MoveAbsolute, Power, Probe
from ldcnd.contract.samples import AxisState, LinkState, PositionSample, TelemetryItem
from tests.support.process import (
    LDCND,
    ROOT,
    START_TIME_S,
    _all_axes_answer,
    client,
    free_port,
    process,
    simulated_terminal,
)

pytestmark = [pytest.mark.system, pytest.mark.real_time]


@asynccontextmanager
async def killable_daemon(config):
    """Run a daemon; yields its process and its endpoint once every axis answers."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    async with process("run", "--config", str(config), "--listen", endpoint) as running:
        async with asyncio.timeout(START_TIME_S):
            while not await _all_axes_answer(endpoint):
                assert running.returncode is None, "the daemon has ended"
                await asyncio.sleep(0.1)  # nothing tells a client that a port has begun to listen
        yield running, endpoint


async def counts_of(rig, axis):
    async with rig.samples(axis, TelemetryItem.POSITION) as positions, asyncio.timeout(5):
        _, position = await anext(positions)
    assert isinstance(position, PositionSample)
    return position.counts


async def test_sigkill_in_mid_move_loses_neither_position_nor_motion(tmp_path):
    link, config = tmp_path / "line0", tmp_path / "adopt.toml"
    simulated = (ROOT / "config" / "simulated.toml").read_text().replace("margin_ms = 50", "margin_ms = 250")
    simulated = simulated[: simulated.index("[[sim]]")].replace('"sim:line0"', f'"{link}"')
    config.write_text(simulated.replace("baud = 115200", 'baud = 115200\nstart = "adopt"\nadopt_fallback = "reset"'))

    async with simulated_terminal(link, "ls182ap", "ls182ap", "picservo-v4", "picservo-v4"):
        async with killable_daemon(config) as (running, endpoint):
            async with client(endpoint) as rig:
                (first,) = await rig.buses()
                await rig.command("x", Power(on=True))
                await rig.command("x", MoveAbsolute(position=90.0, velocity=5.0))
                await asyncio.sleep(0.5)
                before = await counts_of(rig, "x")
                with contextlib.suppress(ProcessLookupError):
                    running.kill()
                await running.wait()

        async with killable_daemon(config) as (_, endpoint), client(endpoint) as rig:
            (second,) = await rig.buses()
            async with asyncio.timeout(20):
                # a machine that stands still for a moment has it miss replies, or look for lost drives
                state = await rig.state("x")
                while second.baud != 115_200 or state is None or state.link is not LinkState.UP:
                    (second,) = await rig.buses()
                    state = await rig.state("x")
            after = await counts_of(rig, "x")
            still = await counts_of(rig, "y")

    assert (first.started_by, second.started_by, second.baud) == ("reset", "adoption", 115_200)
    assert state is not None
    assert (state.link, state.state, state.referenced) == (LinkState.UP, AxisState.DISCRETE_MOTION, False)
    assert 500 < before < after < 90_000
    assert still == 0


@pytest.mark.promise("motions-without-end")
async def test_what_a_killed_daemon_has_started_ends_within_its_bound(tmp_path):
    link, config = tmp_path / "line0", tmp_path / "adopt.toml"
    simulated = (ROOT / "config" / "simulated.toml").read_text().replace("margin_ms = 50", "margin_ms = 250")
    simulated = simulated[: simulated.index("[[sim]]")].replace('"sim:line0"', f'"{link}"')
    config.write_text(simulated.replace("baud = 115200", 'baud = 115200\nstart = "adopt"\nadopt_fallback = "reset"'))

    async with simulated_terminal(link, "ls182ap", "ls182ap", "picservo-v4", "picservo-v4"):
        async with killable_daemon(config) as (running, endpoint), client(endpoint) as rig:
            for axis in ("x", "y", "z"):
                await rig.command(axis, Power(on=True))
            await rig.command("x", MoveAbsolute(position=4.0, velocity=5.0))
            await rig.command("y", Home(method="index", velocity=-0.1, distance=0.2))
            await rig.command("z", Probe(sources=("forward_limit",), distance=2.0, velocity=5.0))
            await asyncio.sleep(0.2)
            with contextlib.suppress(ProcessLookupError):
                running.kill()
            await running.wait()
        await asyncio.sleep(3.0)  # longer than any of them lasts

        async with killable_daemon(config) as (_, endpoint), client(endpoint) as rig:
            first = [await counts_of(rig, axis) for axis in ("x", "y", "z")]
            await asyncio.sleep(0.5)
            last = [await counts_of(rig, axis) for axis in ("x", "y", "z")]

    assert [abs(b - a) <= 2 for a, b in zip(first, last, strict=True)] == [True] * 3
    assert last[0] == pytest.approx(4000, abs=20)


async def said(looking, what):
    async with asyncio.timeout(START_TIME_S):
        while what not in (line := await looking.stderr.readline()):
            assert line, "the command has ended"


@pytest.mark.parametrize("command", [["watch", "x"], ["log", "--follow"]])
async def test_who_looks_on_is_told_that_the_daemon_is_gone_and_that_one_is_there_again(tmp_path, command):
    config, shown = ROOT / "config" / "simulated.toml", tmp_path / "shown"
    async with killable_daemon(config) as (running, endpoint):
        words = (*LDCND, *command, "--connect", endpoint)
        with shown.open("wb") as output:
            looking = await asyncio.create_subprocess_exec(*words, stdout=output, stderr=PIPE)
        try:
            async with asyncio.timeout(START_TIME_S):
                while not shown.stat().st_size:  # it has found the daemon
                    assert looking.returncode is None, "the command has ended"
                    await asyncio.sleep(0.1)
            running.kill()
            await said(looking, b"no daemon of rig sim is heard")
            async with process("run", "--config", str(config), "--listen", endpoint):
                await said(looking, b"a daemon is heard again")
        finally:
            with contextlib.suppress(ProcessLookupError):
                looking.terminate()
            await looking.wait()
