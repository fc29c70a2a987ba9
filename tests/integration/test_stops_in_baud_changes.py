"""A stop that comes at any step of the return of a drive, with its changes of rate, brings the others to rest."""

import asyncio
import random

import pytest
from structlog.testing import capture_logs

from ldcnd.client.rig_client import RigClient
from ldcnd.contract.commands import MoveVelocity, Power
from ldcnd.contract.samples import LinkState
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain
from tests.support.chain_rig import rig_on, simulated_config
from tests.support.interruptions import CopiedLoop, Interruptions, run_with_copies
from tests.support.witness import Witness

AXES = {1: ("x",), 2: ("y",), 3: ("z",), 4: ("c",)}
STANDS_WITHIN_S = 0.8
"""A stop may have to wait for a change of rate that is on the wire, and is sent again when it was lost in it."""


async def stopped(loop: CopiedLoop, rig: RigClient, witness: Witness) -> None:
    """Stop x, in a copy, and see whether it stands."""
    try:
        reply = await rig.stop("x")
        if reply.confirmed != ("x",):
            witness.wrong.append("the stop was not confirmed")
        await asyncio.sleep(STANDS_WITHIN_S)
        if not await witness.stands("x"):
            witness.wrong.append("x moves on")
        await asyncio.sleep(3.0)
        if (state := await rig.state("c")) is None or state.link != "up":
            witness.wrong.append("c did not come back")
    except BaseException as error:  # noqa: BLE001 - nothing of a copy may be lost
        witness.wrong.append(f"{type(error).__name__}: {error}")
    loop.leave(witness.wrong)


def stops_while_a_drive_returns(share: float) -> Interruptions:
    dice = random.Random(1)
    chain = build_chain(
        ChainSpec(tuple(ModuleSpec(model) for model in ("ls182ap", "ls182ap", "picservo-v4", "picservo-v4")))
    )
    rates = {"position": 5, "velocity": 0, "adc": 0, "state": 5}
    config = simulated_config({"rates": rates, "jog_horizon_s": 60.0, "limits": {}})

    async def scenario() -> None:
        loop = asyncio.get_running_loop()
        assert isinstance(loop, CopiedLoop)
        async with rig_on(chain, config) as rig, asyncio.TaskGroup() as group:
            witness = Witness(chain, AXES)
            witness.daemon = None
            await rig.until("x", lambda state: state.link is LinkState.UP)
            await rig.client.command("x", Power(on=True))
            await rig.client.command("x", MoveVelocity(velocity=5.0))
            now_s = loop.time()
            chain.modules[3].power(on=False, at_s=now_s)
            await rig.until("c", lambda state: state.link is LinkState.DOWN)
            chain.modules[3].power(on=True, at_s=loop.time())

            def stop(_: int) -> None:
                witness.wrong.clear()
                group.create_task(stopped(loop, rig.client, witness), name="stop")

            loop.interrupt = stop
            await rig.until("c", lambda state: state.link is LinkState.UP)
            loop.interrupt = None
            if loop.is_copy:
                await asyncio.Event().wait()

    with capture_logs():
        came = run_with_copies(scenario, lambda _: dice.random() < share)
    print(f"stopped at {came.visited} of {came.steps} steps")
    assert not came.wrong, "\n".join(came.wrong[:40])
    return came


@pytest.mark.timeout(300)
@pytest.mark.long
def test_a_stop_while_a_drive_returns_brings_another_one_to_rest():
    assert stops_while_a_drive_returns(0.15).visited > 10


@pytest.mark.soak
@pytest.mark.timeout(3600)
def test_a_stop_at_every_step_of_a_return_brings_another_drive_to_rest():
    came = stops_while_a_drive_returns(1.0)

    assert came.visited == came.steps > 80
