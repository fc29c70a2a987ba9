"""Gains that a client lends an axis for a trial end with its control, however that ends; on the jumping clock."""

import asyncio

import pytest

from ldcnd.client.lease import control
from ldcnd.contract.commands import Jog, MoveRelative, Power, SetGains
from ldcnd.contract.errors import LeaseRequired
from ldcnd.contract.leases import Acquire, Release
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain
from tests.support.chain_rig import drive, rig_on, simulated_config

MODELS = ("ls182ap", "ls182ap", "picservo-v4", "picservo-v4")
SOFT = SetGains(kp=120, kd=1000, lent=True)


def gains(chain, address):
    return drive(chain, address).loop.gains


@pytest.mark.parametrize("end", ["force", "killed", "released", "daemon ends"])
@pytest.mark.parametrize(("name", "address"), [("x", 1), ("z", 3)])
@pytest.mark.parametrize("moving", [False, True], ids=["at rest", "moving"])
@pytest.mark.sweep(7)
async def test_a_trial_that_is_cut_short_leaves_the_loop_open_and_the_next_motion_has_the_gains_of_before(
    end, name, address, moving
):
    chain = build_chain(ChainSpec(tuple(ModuleSpec(model) for model in MODELS)))
    async with rig_on(chain, simulated_config()) as rig:
        await rig.until(name, lambda state: state.link == "up")
        lease = (await rig.client.ask(Acquire(client="tuner", axes=(name,), lease_s=1.0))).lease
        await rig.client.command(name, Power(on=True, lease=lease))
        before = gains(chain, address)
        await rig.client.command(name, SOFT.model_copy(update={"lease": lease}))
        assert gains(chain, address).kp == 120
        if moving:
            await rig.client.command(name, Jog(velocity=1.0, hold_s=1.0, lease=lease))

        match end:
            case "force":
                await rig.client.ask(Acquire(client="other", axes=(name,), lease_s=30.0, force=True))
            case "released":
                await rig.client.ask(Release(lease=lease))
            case "daemon ends":
                rig.daemon.end()
                await asyncio.wait([rig.running])
            case "killed":
                pass  # it is never renewed
        await asyncio.sleep(13.0)

        assert not drive(chain, address).loop.servo_on
        if end == "daemon ends":
            return
        async with control(rig.client, "next", name, lease_s=30.0, force=True) as held:
            await held.command(name, Power(on=True))
            reply = await held.command(name, MoveRelative(distance=1.0))
            await rig.client.wait_for_end(name, reply.command_id)
            assert gains(chain, address) == before


async def test_gains_are_lent_under_a_lease_only():
    chain = build_chain(ChainSpec(tuple(ModuleSpec(model) for model in MODELS)))
    async with rig_on(chain, simulated_config()) as rig:
        await rig.until("x", lambda state: state.link == "up")
        before = gains(chain, 1)
        with pytest.raises(LeaseRequired):
            await rig.client.command("x", SOFT)
        assert gains(chain, 1) == before


async def test_gains_that_are_set_to_stay_outlive_control():
    chain = build_chain(ChainSpec(tuple(ModuleSpec(model) for model in MODELS)))
    async with rig_on(chain, simulated_config()) as rig:
        await rig.until("x", lambda state: state.link == "up")
        async with control(rig.client, "tuner", "x", lease_s=30.0) as held:
            await held.command("x", Power(on=True))
            await held.command("x", SOFT)
            await held.command("x", SetGains(kp=200))
        await asyncio.sleep(3.0)
        assert drive(chain, 1).loop.servo_on
        assert gains(chain, 1).kp == 200
