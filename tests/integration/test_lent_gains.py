"""Gains that a client lends an axis for a trial end with its control, however that ends; on the jumping clock."""

import asyncio

import pytest

from ldcnd.client.lease import control
from ldcnd.contract.commands import Jog, MoveAbsolute, MoveRelative, MoveVelocity, Power, SetGains
from ldcnd.contract.errors import LeaseRequired
from ldcnd.contract.leases import Acquire, Release
from ldcnd.contract.rig_commands import SetIo
from ldcnd.contract.samples import AxisState
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain
from tests.support.chain_rig import drive, rig_on, simulated_config
from tests.support.dialect_rig import AXIS, LS_182AP, SC, V4, dialect_rig
from tests.support.machine_rig import machine, running_machine

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


@pytest.mark.parametrize("dialect", [V4, SC, LS_182AP], ids=lambda dialect: dialect.name)
async def test_an_axis_that_still_moves_with_lent_gains_is_at_rest_before_its_loop_is_opened(dialect):
    async with dialect_rig(dialect, velocity=1.0) as rig:
        client = rig.rig.client
        await rig.power_on()
        lease = (await client.ask(Acquire(client="tuner", axes=(AXIS,), lease_s=60.0))).lease
        await rig.send(SOFT.model_copy(update={"lease": lease}))
        await rig.send(MoveAbsolute(position=18.0, lease=lease))
        await client.ask(Release(lease=lease, leave_running=True))
        await asyncio.sleep(9.5)
        assert rig.drive.shaft.velocity_counts > 0.4

        while rig.drive.loop.servo_on:
            speed = abs(rig.drive.shaft.velocity_counts)
            await asyncio.sleep(0.002)
            rig.drive.catch_up(asyncio.get_running_loop().time())
            assert asyncio.get_running_loop().time() < 60.0

        assert speed < 0.05
        assert rig.position_mm < 12.0


@pytest.mark.parametrize("acceleration", [0.1, 20.0])
@pytest.mark.parametrize("dialect", [V4, SC, LS_182AP], ids=lambda dialect: dialect.name)
async def test_a_daemon_that_ends_before_lent_gains_are_back_opens_the_loop_and_is_over(dialect, acceleration):
    """At the lower acceleration its drive shows no velocity yet; an SC is halted for one that has its own gains."""
    async with dialect_rig(dialect, acceleration=acceleration) as rig:
        client, loop = rig.rig.client, asyncio.get_running_loop()
        await rig.power_on()
        own = rig.drive.loop.gains
        lease = (await client.ask(Acquire(client="tuner", axes=(AXIS,), lease_s=60.0))).lease
        await rig.send(SOFT.model_copy(update={"lease": lease}))
        await rig.send(MoveVelocity(velocity=1.0, lease=lease))
        await asyncio.sleep(1.0)
        await client.ask(Release(lease=lease, leave_running=True))
        await rig.send(MoveVelocity(velocity=0.8))
        assert rig.drive.loop.servo_on

        began_s = loop.time()
        async with asyncio.timeout(30.0):
            await rig.rig.lives.close()

        assert loop.time() - began_s < 5.0
        assert not rig.drive.loop.servo_on or rig.drive.loop.gains == own


async def test_a_motion_of_another_client_has_its_own_gains_also_behind_one_that_it_takes_over():
    async with dialect_rig(SC, loss={"client": "run_to_target"}) as rig:
        client = rig.rig.client
        await rig.power_on()
        before = rig.drive.loop.gains
        lease = (await client.ask(Acquire(client="tuner", axes=(AXIS,), lease_s=60.0))).lease
        await rig.send(SOFT.model_copy(update={"lease": lease}))
        await rig.send(MoveAbsolute(position=15.0, velocity=2.0, lease=lease))
        lent = rig.drive.loop.gains
        other = (await client.ask(Acquire(client="other", axes=(AXIS,), lease_s=60.0, force=True))).lease
        await asyncio.sleep(0.5)

        await rig.send(MoveAbsolute(position=-18.0, velocity=1.0, buffer_mode="aborting", lease=other))
        await asyncio.sleep(14.0)
        rig.drive.catch_up(asyncio.get_running_loop().time())

        assert lent.kp == 120
        assert rig.drive.loop.gains == before
        assert rig.drive.loop.servo_on
        assert (await client.state(AXIS)).state is AxisState.DISCRETE_MOTION


async def test_lent_gains_do_not_open_a_loop_that_an_interlock_keeps_closed():
    hanging = {"name": "brake", "of": "table", "kind": ["power_off"], "requires": [{"output": "lock"}]}
    async with running_machine(machine(hanging)) as rig:
        await rig.client.command("table", Power(on=True))
        lease = (await rig.client.ask(Acquire(client="tuner", axes=("table",), lease_s=60.0))).lease
        await rig.client.command("table", SOFT.model_copy(update={"lease": lease}))
        await rig.client.ask(Release(lease=lease))
        await asyncio.sleep(15.0)
        held = await rig.client.state("table")
        await rig.client.ask(SetIo(module="cabinet", high=("lock",)))
        await rig.until("table", lambda state: state.state is AxisState.DISABLED)

        assert (held.state, held.enabled) == (AxisState.STANDSTILL, True)
