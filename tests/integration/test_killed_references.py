"""Daemon processes that are killed at random instants: no reference of a later one is wrong.

The drives are simulated in a process of their own that outlives them, so their positions are the truth. x is told where
it is once, and from then on every daemon that believes a reference must say for each count what the first one would.
"""

import asyncio
import contextlib
import random
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest

from ldcnd.client.rig_client import RigClient
from ldcnd.contract.commands import Halt, MoveRelative, Power, Reset, SetPosition
from ldcnd.contract.errors import LdcndError, RequestRefused
from ldcnd.contract.samples import LinkState, PositionSample, TelemetryItem
from tests.support.process import ROOT, START_TIME_S, answering, client, free_port, process, simulated_terminal

pytestmark = pytest.mark.real_time

COUNTS_PER_MM = 1000.0
LONGEST_RUN_S = 5.0
"""A daemon lives for up to so long after its line is up."""


class Truth:
    """What a client has told x, against which later daemons are judged.

    Attributes:
        origins: positions 0 on the drive's counter, in mm, that x may have by now: the last one that was confirmed, and
            one that was asked for when the daemon was killed.
        kept: how often a later daemon believed a reference.
        refused: how often it did not.
    """

    def __init__(self) -> None:
        self.origins: list[float] = []
        self.kept = self.refused = 0

    def judge(self, sample: PositionSample) -> None:
        """Hold a position of a referenced axis against what was told."""
        origin = sample.counts / COUNTS_PER_MM - sample.value
        near = [known for known in self.origins if abs(known - origin) <= 0.1]
        assert near, f"0 is believed at {origin:.3f} mm of the drive; it was told to be at {self.origins}"
        self.origins = near


async def _position(rig: RigClient) -> PositionSample:
    async with rig.samples("x", TelemetryItem.POSITION) as positions, asyncio.timeout(START_TIME_S):
        _, sample = await anext(positions)
    assert isinstance(sample, PositionSample)
    return sample


async def _use(rig: RigClient, dice: random.Random, truth: Truth) -> None:
    """Move x to and fro, and tell it anew where it is now and then, until the daemon is killed."""
    while True:
        with contextlib.suppress(LdcndError, TimeoutError):
            await _step(rig, dice, truth)


async def _step(rig: RigClient, dice: random.Random, truth: Truth) -> None:
    state = await rig.state("x")
    if state is None:
        return
    if state.state == "error_stop":
        await rig.command("x", Reset())
    if not state.enabled:
        await rig.command("x", Power(on=True))
    if not state.referenced or dice.random() < 0.2:
        told = dice.uniform(-50.0, 50.0)
        here = (await _position(rig)).counts / COUNTS_PER_MM
        before = truth.origins
        truth.origins = [*before, here - told]
        try:
            await rig.command("x", SetPosition(position=told))
        except RequestRefused:
            truth.origins = before
            raise
        truth.origins = [here - told]
    reply = await rig.command("x", MoveRelative(distance=dice.uniform(-4.0, 6.0)))
    if dice.random() < 0.2:
        await rig.command("x", Halt())
    else:
        await rig.wait_for_end("x", reply.command_id)
    await asyncio.sleep(dice.uniform(0.0, 2.0))


@asynccontextmanager
async def _killed_after(config: Path, dice: random.Random) -> AsyncIterator[RigClient]:
    """Run a daemon that is killed at the end of the context."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    async with process("run", "--config", str(config), "--listen", endpoint) as running:
        await answering(running, endpoint)
        async with client(endpoint) as rig:
            yield rig
            with contextlib.suppress(ProcessLookupError):
                running.kill()
            await running.wait()


async def _lives(config: Path, lives: int, dice: random.Random) -> Truth:
    truth = Truth()
    for life in range(lives):
        async with _killed_after(config, dice) as rig:
            state = await rig.state("x")
            assert state is not None
            assert state.link is LinkState.UP
            if state.referenced:
                truth.kept += 1
                truth.judge(await _position(rig))
            elif life:
                truth.refused += 1
            using = asyncio.create_task(_use(rig, dice, truth))
            await asyncio.sleep(dice.uniform(0.0, LONGEST_RUN_S))
            using.cancel()
            await asyncio.wait([using])
    return truth


@pytest.mark.timeout(3600)  # two processes start in turn, on however busy a machine
@pytest.mark.soak
@pytest.mark.parametrize(("lives", "seed"), [(2, 1), (250, None)])
async def test_no_reference_that_a_killed_daemon_has_left_is_wrong(tmp_path, lives, seed):
    seed = seed if seed is not None else random.randrange(1_000_000)
    print(f"seed {seed}")
    link, config = tmp_path / "line0", tmp_path / "adopt.toml"
    text = (ROOT / "config" / "simulated.toml").read_text()
    text = text[: text.index("[[sim]]")].replace('"sim:line0"', f'"{link}"').replace('"at_reset"', '"required"')
    text = text.replace("baud = 115200", 'baud = 115200\nstart = "adopt"\nadopt_fallback = "reset"')
    config.write_text(text.replace('rig = "sim"', f'rig = "sim"\nstate_dir = "{tmp_path / "state"}"'))

    async with simulated_terminal(link, "ls182ap", "ls182ap", "picservo-v4", "picservo-v4"):
        truth = await _lives(config, lives, random.Random(seed))

    print(f"{lives} lives: reference kept {truth.kept} times, refused {truth.refused} times, wrong never")
    assert truth.kept + truth.refused == lives - 1
