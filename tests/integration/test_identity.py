"""What is commanded to a module that is not known to be what is configured: it is refused, and only a stop goes out."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import pytest

from ldcnd.client.rig import Rig
from ldcnd.config.rig import RigConfig
from ldcnd.contract.commands import Halt, MoveVelocity, Power, Reset, SetGains, SetOutputs, Stop
from ldcnd.contract.condition import assess
from ldcnd.contract.errors import AxisUnreachable, LeaseHeld, NotIdentified, OutcomeUnknown, WrongState
from ldcnd.contract.leases import Acquire
from ldcnd.contract.questions import Why
from ldcnd.contract.rig_commands import SetIo, SetIoTimer
from ldcnd.contract.samples import AxisState, LinkState, Moving
from ldcnd.drives.ldcn.packet import CommandCode
from ldcnd.sim.chain import Chain
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain
from ldcnd.sim.ldcn.drive import SimulatedDrive
from ldcnd.sim.plant import MotorPlant
from tests.support.chain_rig import ChainRig, drive, rig_on
from tests.support.dialect_rig import GAINS, V4, dialect_rig

COASTING = MotorPlant(
    inertia_kg_m2=3e-4,
    friction_nm=0.002,
    viscous_nm_s=1e-6,
    reverse_limit_counts=-10_000_000,
    forward_limit_counts=10_000_000,
)
CHANGING = {
    CommandCode.RESET_POSITION, CommandCode.LOAD_TRAJECTORY, CommandCode.START_MOTION, CommandCode.SET_GAIN,
    CommandCode.IO_CONTROL,
    CommandCode.SET_HOMING_MODE, CommandCode.CLEAR_STICKY_BITS, CommandCode.SAVE_CURRENT_POSITION_AS_HOME,
}  # fmt: skip


def config(start: str = "reset") -> RigConfig:
    axis = {"name": "x", "address": 1, "model": "pic-servo-v4", "velocity": 20_000, "acceleration": 100_000}
    module = {"name": "cabinet", "address": 2, "model": "pic-io", "outputs": [4, 9]}
    bus = {"name": "line", "port": "sim:line", "baud": 115_200, "start": start, "module": [module]}
    return RigConfig.model_validate(
        {
            "rig": "identity",
            "sim": [{"name": "line", "module": [{"model": "pic-servo-v4"}, {"model": "pic-io"}]}],
            "bus": [bus | {"axis": [axis | {"gains": GAINS}]}],
        }
    )


def chain_of(*models: str) -> Chain:
    return build_chain(ChainSpec(tuple(ModuleSpec(model) for model in models)))


def taken(rig: ChainRig) -> set[int]:
    """Return the commands that were sent and change something."""
    return {packet.command for packet in rig.sent} & CHANGING


@asynccontextmanager
async def two_servos() -> AsyncIterator[tuple[ChainRig, Chain]]:
    """Run a daemon whose configured PIC-I/O is a second servo."""
    chain = chain_of("pic-servo-v4", "pic-servo-v4")
    async with rig_on(chain, config(), up=False) as rig:
        await asyncio.sleep(3.0)
        yield rig, chain


async def test_outputs_are_not_set_in_a_servo_that_holds_the_address_of_the_module():
    async with two_servos() as (rig, chain):
        for request in (SetIo(module="cabinet", pwm1=0.565), SetIo(module="cabinet", high=(4,), low=(9,))):
            with pytest.raises(
                NotIdentified, match=r"module cabinet .* address 2 .*expected PIC-I/O, found PIC-SERVO version 4"
            ):
                await rig.client.ask(request)
        with pytest.raises(NotIdentified, match="cabinet"):
            await rig.client.ask(SetIoTimer(module="cabinet", mode="counter"))

        await asyncio.sleep(2.0)
        assert [drive(chain, address).shaft.position_counts for address in (1, 2)] == pytest.approx([0.0, 0.0], abs=2)
        assert not taken(rig)


@pytest.mark.promise("proven-before-changed")
async def test_a_line_that_is_down_takes_no_motion_after_a_stop_and_a_reset():
    async with two_servos() as (rig, chain):
        with pytest.raises(OutcomeUnknown, match="sent again"):
            await rig.client.command("x", Stop())
        await rig.until("x", lambda state: not state.stop_pending)
        for command in (Reset(), Power(on=True), SetGains(kp=10, el=100), SetOutputs(limit1="high")):
            with pytest.raises(NotIdentified, match="axis x is not identified"):
                await rig.client.command("x", command)
        with pytest.raises(NotIdentified):
            await rig.client.command("x", MoveVelocity(velocity=5000.0))
        why = await rig.client.ask(Why(), "x")
        state, told = await rig.client.state("x"), (await rig.client.faults())["x"]

        assert not taken(rig)
        assert drive(chain, 1).shaft.position_counts == pytest.approx(0.0, abs=2)
        assert (state.link, state.moving) == (LinkState.DOWN, Moving.UNKNOWN)
        assert "not_identified" in {fault.code for fault in told.active}
        assert assess(state, told).mark == "not identified"
        assert "not_identified" in {cause.code for cause in why.causes}
        assert any("PIC-SERVO version 4" in cause.text for cause in why.causes)


async def test_a_stop_a_halt_and_power_off_reach_a_line_that_is_not_taken_over():
    async with two_servos() as (rig, _):
        for command in (Stop(), Halt(), Power(on=False)):
            before = len(rig.sent)
            with pytest.raises(OutcomeUnknown, match="sent again"):
                await rig.client.command("x", command)
            await asyncio.sleep(1.0)
            assert CommandCode.STOP_MOTOR in {packet.command for packet in rig.sent[before:]}, command.verb


async def test_the_outputs_of_a_line_that_another_host_left_are_not_touched():
    chain = chain_of("pic-servo-v4", "pic-io")
    io = chain.modules[1]
    for address, module in enumerate(chain.modules, 1):
        module.address, module.address_out, module.items = address, True, type(module.items)(1)
    io.outputs, io.latch = 0x008, 0x008
    async with rig_on(chain, config("adopt"), up=False) as rig:
        await asyncio.sleep(3.0)

        assert (io.outputs, io.latch) == (0x008, 0x008)
        assert not rig.line.problem
        assert not taken(rig)


async def test_a_drive_that_was_out_of_reach_is_identified_before_it_takes_a_command_again():
    chain = chain_of("pic-servo-v4", "pic-io")
    async with rig_on(chain, config()) as rig:
        await rig.until("x", lambda state: state.link is LinkState.UP)
        hear, drive_1 = chain.modules[0].hear_all, chain.modules[0]
        drive_1.hear_all = lambda *_: None  # a loose connector
        await rig.until("x", lambda state: state.link is LinkState.DOWN)
        with pytest.raises(AxisUnreachable):
            await rig.client.command("x", Power(on=True))
        drive_1.hear_all = hear
        before = len(rig.sent)
        await rig.until("x", lambda state: state.link is LinkState.UP)
        read = [packet for packet in rig.sent[before:] if packet.address == 1 and bytes(packet.data) == b"\x20"]

        assert read
        await rig.client.command("x", Reset())
        await rig.client.command("x", Power(on=True))


@pytest.mark.promise("moving-shaft-not-caught")
@pytest.mark.long
async def test_a_loop_is_not_closed_while_the_shaft_coasts():
    """A heavy rotor: the drive would hold it at once, at whatever speed."""
    async with dialect_rig(V4, COASTING, velocity=40, acceleration=400) as rig:
        await rig.power_on()
        await rig.send(MoveVelocity(velocity=40.0))
        await asyncio.sleep(1.0)
        await rig.send(Power(on=False))
        with pytest.raises(WrongState, match="turns with its motor off"):
            await rig.send(Power(on=True))
        assert abs(rig.drive.shaft.velocity_counts) > 5  # in a servo cycle: 10000 counts/s
        assert not (await rig.rig.client.state("x")).enabled
        turns, off, *_ = (await rig.rig.client.ask(Why(), "x")).causes
        assert "turns with its motor off" in turns.text
        assert turns.remedy.startswith("wait until it stands")
        assert (turns.passes, off.passes) == (True, False)

        async with asyncio.timeout(120.0):
            while True:
                try:
                    await rig.send(Power(on=True))
                except WrongState:
                    await asyncio.sleep(0.1)
                else:
                    break
        rig.drive.catch_up(asyncio.get_running_loop().time())
        assert abs(rig.drive.shaft.velocity_counts) < 1.5
        assert (await rig.rig.client.state("x")).state is AxisState.STANDSTILL


async def test_a_motor_that_stands_is_switched_on_right_after_it_was_switched_off():
    async with dialect_rig(V4) as rig:
        await rig.power_on()
        await rig.send(Power(on=False))
        await rig.send(Power(on=True))


async def test_the_client_sends_its_leases_with_outputs_and_with_the_speed_override():
    chain = chain_of("pic-servo-v4", "pic-io")
    async with rig_on(chain, config()) as running:
        await running.until("x", lambda state: state.link is LinkState.UP)
        rig = Rig(running.client, await running.client.daemon())
        async with rig.control("x", client="ann"):
            await rig.set_io("cabinet", high=[4])
            await rig.set_io_timer("cabinet", "counter")
            await rig.set_speed_override(90.0)
            await rig.set_speed_override(100.0)
            assert chain.modules[1].latch == 0x008

        await running.client.ask(Acquire(client="bob", axes=("x",)))
        with pytest.raises(LeaseHeld):
            await rig.set_io("cabinet", low=[4])
        assert isinstance(chain.modules[0], SimulatedDrive)
