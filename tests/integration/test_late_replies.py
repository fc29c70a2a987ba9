"""A reply that comes late is to the packet that it answers: it confirms no stop that was sent meanwhile and lost."""

import asyncio
import random
from contextlib import suppress

import pytest

from ldcnd.contract.commands import CommandReply, Halt, MoveVelocity, Power, Reset, Stop
from ldcnd.contract.errors import LdcndError
from ldcnd.contract.samples import LinkState
from ldcnd.sim.faults import FaultKind, FaultPlan, LineFault
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain
from tests.support.machine_rig import ENDLESS, MODEL, Machine, machine, running_machine

FROM_S = 5.0
MARGIN_MS = 10
LATEST_S = 0.022
"""Later than the deadline of a reply, and within the time in which the line gets back in step: a reply that comes after
that, in the time of another one's own, cannot be told from it."""
FAULTS = (
    LineFault(FaultKind.REPLY_DELAYED, 0.06, from_s=FROM_S, longest_s=LATEST_S),
    LineFault(FaultKind.REQUEST_LOST, 0.06, from_s=FROM_S),
)


async def ready(rig: Machine) -> bool:
    """Reset the axis and switch it on, as far as the line lets it."""
    with suppress(LdcndError, TimeoutError):
        await rig.until("rotor", lambda state: state.link is LinkState.UP)
        for command in (Reset(), Power(on=True)):
            await rig.client.ask(command, "rotor")
        return True
    return False


async def moving(rig: Machine) -> None:
    """Begin a motion, as far as the line lets it."""
    with suppress(LdcndError):
        await rig.client.ask(MoveVelocity(velocity=5.0), "rotor")


async def ended(rig: Machine, command: Stop | Halt | Power) -> bool:
    """End the motion; return whether the daemon says that the drive has heard it."""
    try:
        reply = await rig.client.ask(command, "rotor")
    except LdcndError:
        return False
    return isinstance(reply, CommandReply) or "rotor" in reply.confirmed


SOAK = tuple(pytest.param(seed, marks=pytest.mark.soak) for seed in range(100, 200) if seed != 120)


@pytest.mark.parametrize("seed", [120, *range(3), *SOAK])  # 120 has failed
async def test_what_is_confirmed_has_been_heard(seed: int):
    """Judged by the simulated shaft: it comes to rest within the time that it needs."""
    dice, confirmed = random.Random(seed), 0
    plan = FaultPlan(FAULTS, seed)
    modules = (ModuleSpec(MODEL, plant=ENDLESS), ModuleSpec(MODEL), ModuleSpec("pic-io"))
    async with running_machine(machine(margin_ms=MARGIN_MS), build_chain(ChainSpec(modules, faults=plan))) as rig:
        await asyncio.sleep(FROM_S)
        for _ in range(25):
            if not await ready(rig):
                await asyncio.sleep(0.5)
                continue
            begin = asyncio.create_task(moving(rig))
            await asyncio.sleep(dice.choice((0.0, 0.01, 0.02, 0.03, 0.05, 0.3)))
            command = dice.choice((Stop(), Halt(), Power(on=False)))
            if isinstance(command, Halt):
                await begin  # a halt does not keep from beginning what comes after it
            heard = await ended(rig, command)
            await begin
            if heard:
                confirmed += 1
                await asyncio.sleep(1.0)  # from 5 rev/s at 20 rev/s2, and what coasts
                assert rig.speed() < 0.05, seed
        await ended(rig, Power(on=False))
    assert confirmed > 5
