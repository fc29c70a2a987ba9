"""Schedules of clients that freeze, die, release and are displaced, on lines of any quality: who may move, moves."""

import asyncio
import contextlib
import random

import pytest
from structlog.testing import capture_logs

from ldcnd.client.rig_client import RigClient
from ldcnd.config.rig import RigConfig
from ldcnd.daemon.process.assembly import build_daemon
from ldcnd.drivers.ldcn.packet import Command
from ldcnd.drivers.ldcn.received import PlainCommand
from ldcnd.errors import LdcndError
from ldcnd.messaging.memory_session import MemoryBroker
from ldcnd.model.commands import BufferMode, MoveRelative, MoveVelocity, Power
from ldcnd.model.rig_commands import Acquire, Release, Renew
from ldcnd.sim.chain import Chain
from ldcnd.sim.faults import Fault, FaultKind, FaultPlan
from ldcnd.sim.jumping_loop import JumpingLoop
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain

CONFIG = {
    "rig": "sim",
    "authority": "leased",
    "bus": [
        {
            "name": "a",
            "port": "sim:a",
            "axis": [
                {
                    "name": "x",
                    "address": 1,
                    "model": "ls-182ap",
                    "unit": "mm",
                    "counts_per_unit": 1000.0,
                    "velocity": 20.0,
                    "acceleration": 500.0,
                    "gains": {"kp": 350, "kd": 3000, "ki": 400, "il": 400, "ol": 250, "el": 4000},
                    "rates": {"position": 20, "velocity": 20, "adc": 1, "state": 20},
                }
            ],
        }
    ],
    "sim": [{"name": "a", "module": [{"model": "ls182ap"}]}],
}
LEASE_S = 0.5
LINE_S = 1.5
"""From the end of a lease until the axis stands: stops are sent again on a bad line, then it decelerates."""
STANDING_COUNTS = 50


async def live(chain: Chain, dice: random.Random) -> tuple[int, list[str]]:
    """Live through one schedule; return how many motions began, and what went wrong."""
    loop, wrong, starts = asyncio.get_running_loop(), [], []
    drive = chain.modules[0]
    execute = drive.execute

    def noted(packet: object) -> None:
        if packet == PlainCommand(Command.START_MOTION):
            starts.append(loop.time())
        execute(packet)

    drive.execute = noted
    config = RigConfig.model_validate(CONFIG)
    broker = MemoryBroker()
    async with broker.session() as session, broker.session() as clients, asyncio.TaskGroup() as group:
        daemon = build_daemon(config, session, lambda: round(loop.time() * 1e9), "life", {"a": chain})
        running = group.create_task(daemon.run(), name="daemon")
        rig = RigClient(clients, "sim")
        await daemon.wait_up()
        while not (state := await rig.state("x")) or state.link != "up":
            await asyncio.sleep(0.05)
        lease = (await rig.ask(Acquire(client="ann", axes=("x",), lease_s=LEASE_S))).lease

        async def renew() -> None:
            while True:
                await asyncio.sleep(LEASE_S / 4)
                try:
                    await rig.ask(Renew(lease=lease), timeout_s=LEASE_S)
                except LdcndError:
                    return

        async def move() -> None:
            for number in range(100):
                distance, mode = dice.uniform(-5, 5), dice.choice(list(BufferMode))
                command = dice.choice(
                    (
                        MoveRelative(distance=distance, lease=lease, command_id=f"c{number}", buffer_mode=mode),
                        MoveVelocity(velocity=distance or 1.0, lease=lease, buffer_mode=mode),
                        Power(on=True, lease=lease),
                    )
                )
                for _ in range(dice.randint(1, 2)):  # some are sent again
                    with contextlib.suppress(LdcndError):
                        await rig.command("x", command, timeout_s=dice.choice((0.05, 0.5, 2.0)))
                await asyncio.sleep(dice.uniform(0, 0.2))

        keeper = group.create_task(renew(), name="renewals")
        mover = group.create_task(move(), name="moves")
        await asyncio.sleep(dice.uniform(0.2, 2.0))
        lost_s = loop.time()
        match dice.choice(("freeze", "die", "release", "force")):
            case "freeze":  # its commands go on, its renewals do not
                keeper.cancel()
                lost_s += LEASE_S
            case "die":
                keeper.cancel()
                mover.cancel()
                lost_s += LEASE_S
            case "release":
                keeper.cancel()
                await rig.ask(Release(lease=lease), timeout_s=5.0)
            case "force":
                keeper.cancel()
                await rig.ask(Acquire(client="bob", axes=("x",), lease_s=60.0, force=True), timeout_s=5.0)
        lost_s = max(lost_s, loop.time())
        await asyncio.sleep(max(0.0, lost_s - loop.time()) + LINE_S)
        late = [at_s for at_s in starts if at_s > lost_s + 0.05]
        if late:
            wrong.append(f"motions began {[round(at_s - lost_s, 3) for at_s in late]} s after control was lost")
        drive.catch_up(loop.time())
        before = drive.shaft.position_counts
        await asyncio.sleep(0.3)
        drive.catch_up(loop.time())
        if abs(drive.shaft.position_counts - before) > STANDING_COUNTS:
            wrong.append("the axis moves with nobody in charge")
        mover.cancel()
        keeper.cancel()
        daemon.end()
        await running
    return len(starts), wrong


def schedule(seed: int) -> tuple[int, list[str]]:
    dice = random.Random(seed)
    share = dice.choice((0.0, 0.02, 0.1))
    kinds = [kind for kind in FaultKind if kind not in (FaultKind.UNPLUGGED, FaultKind.ECHO)]
    faults = tuple(Fault(kind, share / len(kinds), 1.0, longest_s=0.02) for kind in kinds)
    chain = build_chain(ChainSpec((ModuleSpec("ls182ap"),), faults=FaultPlan(faults, seed), seed=seed))
    with capture_logs(), asyncio.Runner(loop_factory=JumpingLoop) as runner:
        return runner.run(live(chain, dice))


def campaign(seeds: range) -> None:
    moved = 0
    for seed in seeds:
        motions, wrong = schedule(seed)
        assert not wrong, f"seed {seed}: {'; '.join(wrong)}"
        moved += motions
    print(f"{len(seeds)} schedules, {moved} motions")
    assert moved > len(seeds) / 2


def test_nothing_moves_for_those_who_have_lost_control():
    campaign(range(60))


@pytest.mark.soak
@pytest.mark.timeout(3600 * 6)
@pytest.mark.parametrize("batch", range(100))
def test_nothing_ever_moves_for_those_who_have_lost_control(batch):
    campaign(range(1000 * batch, 1000 * (batch + 1)))
