"""One command id never makes two motions, whatever the line, the daemon and the client's retries do.

Each schedule drops, delays, doubles and damages packets, kills the daemon at any moment and starts it again, while a
client sends the same command again and again. What counts is what the drive executed.
"""

import asyncio
import random

import pytest
from structlog.testing import capture_logs

from ldcnd.client.rig_client import RigClient
from ldcnd.config.rig import RigConfig
from ldcnd.contract.commands import MoveRelative, Power
from ldcnd.contract.errors import LdcndError, RequestRefused
from ldcnd.daemon.assembly import build_daemon
from ldcnd.drives.ldcn.packet import CommandCode
from ldcnd.drives.ldcn.received import PlainCommand
from ldcnd.sim.chain import Chain
from ldcnd.sim.faults import FaultKind, FaultPlan, LineFault
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain
from ldcnd.sim.line import open_simulated_line
from ldcnd.testing.jumping_loop import JumpingLoop
from ldcnd.testing.memory_session import MemoryBroker

SCHEDULES = 120
"""Of a batch; `make test` lives through the first third of the first one."""
FAULTS_FROM_S = 1.5
ATTEMPTS = 6
CONFIG = {
    "rig": "sim",
    "bus": [
        {
            "name": "a",
            "port": "sim:a",
            "baud": 115200,
            "start": "adopt",
            "adopt_fallback": "reset",
            "axis": [
                {
                    "name": "x",
                    "address": 1,
                    "model": "ls-182ap",
                    "velocity": 20_000,
                    "acceleration": 200_000,
                    "gains": {"kp": 350, "kd": 3000, "ki": 400, "il": 400, "el": 4000},
                    "rates": {"position": 5, "velocity": 0, "adc": 0, "state": 5},
                }
            ],
        }
    ],
    "sim": [{"name": "a", "module": [{"model": "ls182ap"}]}],
}


class Motions:
    """Counts the motions that the simulated drive was made to start."""

    def __init__(self, chain: Chain) -> None:
        self.started = 0
        drive = chain.modules[0]
        execute = drive.execute

        def counted(packet):
            self.started += packet == PlainCommand(CommandCode.START_MOTION)
            execute(packet)

        drive.execute = counted


async def live(chain: Chain, dice: random.Random) -> tuple[int, list[str]]:
    """Live through one schedule; return how many motions there were and what the client was told."""
    loop = asyncio.get_running_loop()
    config = RigConfig.model_validate(CONFIG)
    motions = Motions(chain)
    broker = MemoryBroker()
    told: list[str] = []
    lives = 0

    async def one_life(session) -> None:
        nonlocal lives
        lives += 1
        daemon = build_daemon(config, session, lambda: round(loop.time() * 1e9), f"life{lives}")
        bus = daemon.rig.buses[0].bus
        bus._opener = lambda: open_simulated_line(chain)
        await daemon.run()

    async def client(rig: RigClient) -> None:
        while not (state := await rig.state("x")) or state.link != "up":
            await asyncio.sleep(0.05)
        await rig.command("x", Power(on=True))
        await asyncio.sleep(max(0.0, FAULTS_FROM_S - loop.time()))
        meant = (await rig.daemon()).instance
        step = MoveRelative(distance=500, command_id="step", instance=meant)
        for _ in range(ATTEMPTS):
            try:
                await rig.command("x", step, timeout_s=dice.choice((0.01, 0.05, 0.5)))
                told.append("accepted")
            except RequestRefused as error:
                told.append(error.code.value)
            except LdcndError as error:
                told.append(f"failed: {error.code.value}")
            await asyncio.sleep(dice.uniform(0, 0.2))

    async def lifes() -> None:
        """Run the daemon; kill it at any moment after the faults have begun, and start it again."""
        deaths = sorted(FAULTS_FROM_S + dice.uniform(0, 1.0) for _ in range(dice.randint(0, 2)))
        for death_s in [*deaths, float("inf")]:
            async with broker.session() as session, asyncio.TaskGroup() as group:
                life = group.create_task(one_life(session), name="life")
                if death_s < float("inf"):
                    await asyncio.sleep(max(0.0, death_s - loop.time()))
                    life.cancel()

    async with broker.session() as session, asyncio.TaskGroup() as group:
        daemons = group.create_task(lifes(), name="lifes")
        await client(RigClient(session, "sim"))
        await asyncio.sleep(1.0)
        daemons.cancel()
    return motions.started, told


def schedule(seed: int) -> tuple[int, list[str]]:
    dice = random.Random(seed)
    share = dice.choice((0.0, 0.05, 0.2, 0.4))
    kinds = [kind for kind in FaultKind if kind not in (FaultKind.UNPLUGGED, FaultKind.ECHO)]
    faults = tuple(LineFault(kind, share / len(kinds), FAULTS_FROM_S, longest_s=0.02) for kind in kinds)
    if dice.random() < 0.2:
        faults = (*faults, LineFault(FaultKind.UNPLUGGED, 0.02, FAULTS_FROM_S, longest_s=0.3))
    chain = build_chain(ChainSpec((ModuleSpec("ls182ap"),), faults=FaultPlan(faults, seed), seed=seed))
    # to show the records of so many lives takes a seventh of the time; a seed that fails is lived through again
    with capture_logs(), asyncio.Runner(loop_factory=JumpingLoop) as runner:
        return runner.run(live(chain, dice))


def campaign(seeds: range) -> None:
    accepted = moved = 0
    for seed in seeds:
        motions, told = schedule(seed)
        assert motions <= 1, f"seed {seed}: {motions} motions; the client was told {told}"
        if "accepted" in told:
            assert motions == 1, f"seed {seed}: told accepted, but nothing moved"
        accepted += "accepted" in told
        moved += motions

    assert len(seeds) / 3 < accepted <= moved < len(seeds)


@pytest.mark.promise("one-id-one-motion")
@pytest.mark.timeout(300)
@pytest.mark.long
def test_one_command_id_makes_one_motion_at_most():
    campaign(range(SCHEDULES // 3))


@pytest.mark.soak
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("batch", range(20))
def test_one_command_id_never_makes_two_motions(batch):
    campaign(range(SCHEDULES * batch, SCHEDULES * (batch + 1)))
