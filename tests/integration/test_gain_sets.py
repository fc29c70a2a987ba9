"""Sets of gains by name and by kind of motion: switched at standstill, and back after faults and restarts."""

import asyncio

import pytest
from pydantic import ValidationError

from ldcnd.bench.tuning.plan import plan
from ldcnd.client.lease import control
from ldcnd.contract.commands import (
    BufferMode,
    Halt,
    Home,
    MoveAbsolute,
    MoveRelative,
    MoveVelocity,
    Power,
    Reset,
    SetGains,
    SetPosition,
    Stop,
)
from ldcnd.contract.errors import ValueOutOfRange, VelocityLimit, WrongState
from ldcnd.contract.questions import Preview
from ldcnd.contract.samples import AxisState, LinkState
from ldcnd.drives.ldcn.packet import CommandCode
from ldcnd.line.flight_recorder import WireEvent
from ldcnd.sim.ldcn.drive import SimulatedDrive
from tests.support.machine_rig import GAINS, Machine, machine, running_machine

SETS = {
    "gentle": GAINS | {"kp": 40, "ol": 90, "el": 2000},
    "spin": GAINS | {"kp": 30, "el": 12_000},
}
AXIS = {"gain_sets": SETS, "gains_for": {"home": "gentle", "velocity": "spin"}}


def held(rig: Machine) -> tuple[int, int, int]:
    """Return kp, ol and el that the drive of the rotor holds."""
    drive = rig.chain.modules[0]
    assert isinstance(drive, SimulatedDrive)
    gains = drive.loop.gains
    return gains.kp, gains.ol, gains.el


POSITION, GENTLE, SPIN = (60, 250, 8000), (40, 90, 2000), (30, 250, 12_000)


async def stands(rig: Machine) -> None:
    await rig.until(
        "rotor", lambda state: state.state in (AxisState.STANDSTILL, AxisState.DISABLED) and not state.command
    )


async def test_each_kind_of_motion_has_its_gains_from_standstill_on():
    async with running_machine(machine(axis=AXIS)) as rig:
        await rig.client.command("rotor", Power(on=True))
        assert held(rig) == POSITION
        await rig.client.command("rotor", MoveVelocity(velocity=2.0))
        assert held(rig) == SPIN
        await rig.client.command("rotor", Halt())
        await stands(rig)
        assert held(rig) == SPIN  # until another motion begins
        await rig.client.command("rotor", MoveRelative(distance=0.5))
        assert held(rig) == POSITION
        await stands(rig)
        await rig.client.command("rotor", Home(method="index", velocity=0.5))
        assert held(rig) == GENTLE
        info = {each.name: each.value for each in (await rig.client.axes())[0].registers}
        assert (info["kp"], info["ol"], info["el"]) == GENTLE


async def test_a_motion_with_other_gains_does_not_go_on_from_one_under_way():
    async with running_machine(machine(axis=AXIS)) as rig:
        await rig.client.command("rotor", Power(on=True))
        await rig.client.command("rotor", SetPosition(position=0.0))
        await rig.client.command("rotor", MoveVelocity(velocity=5.0))
        await asyncio.sleep(1.0)
        slowest = [rig.speed()]
        move = asyncio.create_task(
            rig.client.command("rotor", MoveAbsolute(position=30.0, buffer_mode=BufferMode.ABORTING))
        )
        while not move.done():
            await asyncio.sleep(0.005)
            slowest.append(rig.speed())
            assert held(rig) == SPIN or min(slowest) < 0.3  # it stands, and settles
        await move
        assert held(rig) == POSITION


@pytest.mark.parametrize("what", ["stop", "power lost"])
@pytest.mark.sweep(2)
async def test_the_gains_of_the_position_are_back_after_a_fault_and_a_restart(what):
    async with running_machine(machine(axis=AXIS)) as rig:
        await rig.client.command("rotor", Power(on=True))
        await rig.client.command("rotor", MoveVelocity(velocity=2.0))
        if what == "stop":
            await rig.client.command("rotor", Stop())
            await asyncio.sleep(1.0)
        else:
            drive = rig.chain.modules[0]
            drive.power(on=False, at_s=asyncio.get_running_loop().time())
            await asyncio.sleep(1.0)
            drive.power(on=True, at_s=asyncio.get_running_loop().time())
            await rig.until("rotor", lambda state: state.link is LinkState.UP)
            await asyncio.sleep(1.0)
        await rig.client.command("rotor", Reset())
        await rig.client.command("rotor", Power(on=True))
        assert held(rig) == (SPIN if what == "stop" else POSITION)  # a closed loop gets no other gains: it would turn
        await rig.client.command("rotor", MoveRelative(distance=0.1))
        await rig.until("rotor", lambda state: state.command is None)
        assert held(rig) == POSITION
        await rig.client.command("rotor", MoveVelocity(velocity=2.0))
        assert held(rig) == SPIN


async def spins(rig: Machine) -> None:
    await rig.client.command("rotor", MoveVelocity(velocity=2.0))


async def goes_and_stands(rig: Machine) -> None:
    await rig.client.command("rotor", Halt())
    await stands(rig)
    await rig.client.command("rotor", MoveRelative(distance=0.1))


async def test_what_is_set_in_a_spin_stays_in_the_set_of_the_spin():
    async with running_machine(machine(axis=AXIS)) as rig:
        await rig.client.command("rotor", Power(on=True))
        await spins(rig)
        await rig.client.command("rotor", SetGains(kp=50))
        assert held(rig) == (50, *SPIN[1:])
        await goes_and_stands(rig)
        assert held(rig) == POSITION
        await stands(rig)
        await rig.client.command("rotor", Power(on=False))
        await rig.client.command("rotor", Power(on=True))
        assert held(rig) == POSITION
        await spins(rig)
        assert held(rig) == (50, *SPIN[1:])


async def test_what_is_set_at_rest_stays_in_the_set_that_is_in_force():
    async with running_machine(machine(axis=AXIS)) as rig:
        await rig.client.command("rotor", Power(on=True))
        await rig.client.command("rotor", SetGains(kp=70))
        await spins(rig)
        assert held(rig) == SPIN
        await goes_and_stands(rig)
        assert held(rig) == (70, *POSITION[1:])


async def test_a_set_that_is_loaded_by_its_name_is_that_of_its_kind_alone():
    async with running_machine(machine(axis=AXIS)) as rig:
        await rig.client.command("rotor", Power(on=True))
        await rig.client.command("rotor", SetGains(gain_set="spin", ol=100))
        assert held(rig) == (30, 100, 12_000)
        await rig.client.command("rotor", MoveRelative(distance=0.5))
        assert held(rig) == POSITION
        with pytest.raises(WrongState):
            await rig.client.command("rotor", SetGains(gain_set="spin"))
        await stands(rig)
        with pytest.raises(ValueOutOfRange, match="no set of gains 'fast'; it has gentle, spin"):
            await rig.client.command("rotor", SetGains(gain_set="fast"))
        await spins(rig)
        assert held(rig) == (30, 100, 12_000)


async def test_where_no_kind_names_a_set_one_that_is_loaded_serves_all():
    async with running_machine(machine(axis=AXIS | {"gains_for": {}})) as rig:
        await rig.client.command("rotor", Power(on=True))
        await rig.client.command("rotor", SetGains(gain_set="gentle"))
        await rig.client.command("rotor", MoveRelative(distance=0.5))
        assert held(rig) == GENTLE
        await stands(rig)
        await spins(rig)
        assert held(rig) == GENTLE


async def test_an_axis_whose_kinds_of_motion_have_gains_of_their_own_is_not_tuned():
    """The set that is tried, stored and written would be another one than its moves load."""
    async with running_machine(machine(axis=AXIS)) as rig:
        await stands(rig)
        with pytest.raises(WrongState, match="home gentle, velocity spin") as refused:
            await plan(rig.client, "rotor", None)

    assert "take gains_for out of the configuration" in refused.value.remedy


async def test_a_motion_that_is_refused_leaves_the_set_that_is_in_force():
    async with running_machine(machine(axis=AXIS | {"limits": {"velocity": 20.0}})) as rig:
        await rig.client.command("rotor", Power(on=True))
        with pytest.raises(VelocityLimit):
            await rig.client.command("rotor", MoveVelocity(velocity=21.0))
        await rig.client.command("rotor", SetGains(kp=70))
        assert held(rig) == (70, *POSITION[1:])
        await spins(rig)
        assert held(rig) == SPIN


async def test_power_to_a_closed_loop_leaves_the_set_that_is_in_force():
    async with running_machine(machine(axis=AXIS)) as rig:
        await rig.client.command("rotor", Power(on=True))
        await spins(rig)
        await rig.client.command("rotor", Halt())
        await stands(rig)
        await rig.client.command("rotor", Power(on=True))
        await rig.client.command("rotor", SetGains(kp=50))
        assert held(rig) == (50, *SPIN[1:])


async def test_lent_gains_leave_each_set_as_it_is():
    async with running_machine(machine(axis=AXIS)) as rig:
        async with control(rig.client, "tuner", "rotor", lease_s=30.0) as tuner:
            await tuner.command("rotor", Power(on=True))
            await tuner.command("rotor", SetGains(gain_set="spin", kp=77, lent=True))
            await tuner.command("rotor", MoveRelative(distance=0.1))
            assert held(rig) == (77, *SPIN[1:])
        await rig.until("rotor", lambda state: state.state is AxisState.DISABLED)
        await rig.client.command("rotor", Power(on=True))
        assert held(rig) == POSITION
        await spins(rig)
        assert held(rig) == SPIN


def heads(packets) -> list[bytes]:
    """Return of packets who they are for, what they are, and their first byte: the lower one of kp in Set Gain."""
    return [(bytes.fromhex(packet) if isinstance(packet, str) else packet)[:4] for packet in packets]


def changing(rig: Machine) -> list[bytes]:
    """Return what was sent to the rotor and does more than read it."""
    records = rig.daemon.rig.buses[0].bus.wire_log.records()
    sent = [record.data for record in records if record.event is WireEvent.SENT and record.data[1] == 1]
    return [packet for packet in sent if packet[2] & 15 not in (CommandCode.READ_STATUS, CommandCode.NO_OPERATION)]


async def test_a_preview_shows_the_gains_of_its_kind_of_motion_where_they_are_loaded():
    velocity, position = Preview(velocity=2.0), Preview(distance=0.5)
    async with running_machine(machine(axis=AXIS)) as rig:
        disabled = await rig.client.ask(velocity, "rotor")
        await rig.client.command("rotor", Power(on=True))
        planned = []
        for question in (velocity, velocity, position, position, velocity):
            planned.append(heads((await rig.client.ask(question, "rotor")).packets))
            before = len(changing(rig))
            move = MoveVelocity(velocity=2.0) if question is velocity else MoveRelative(distance=0.5)
            await rig.client.command("rotor", move)
            assert planned[-1] == heads(changing(rig)[before:])
            await rig.client.command("rotor", Halt())
            await stands(rig)

    loads = [any(head[2] & 15 == CommandCode.SET_GAIN for head in each) for each in planned]
    assert loads == [True, False, True, False, True]
    assert heads(disabled.packets) == planned[0]


@pytest.mark.parametrize("named", [{}, {"gain_set": "spin"}])
async def test_a_servo_rate_divisor_that_is_lent_serves_each_kind_of_motion(named):
    async with running_machine(machine(axis=AXIS)) as rig:
        await rig.client.command("rotor", Power(on=True))
        async with control(rig.client, "tuner", "rotor", lease_s=30.0) as tuner:
            await tuner.command("rotor", SetGains(sr=2, kp=20, kd=200, lent=True, **named))
            for move in (MoveVelocity(velocity=2.0), Halt(), MoveRelative(distance=0.1)):
                await tuner.command("rotor", move)
                await asyncio.sleep(1.0)
                assert rig.chain.modules[0].loop.gains.sr == 2


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"gains_for": {"home": "soft"}}, "no set 'soft' in gain_sets"),
        ({"gain_sets": {"spin": GAINS | {"sr": 3}}}, "its sr is not that of gains"),
        ({"gain_sets": {"spin": GAINS | {"cl": 2, "ol": 300}}}, "ol"),
    ],
)
def test_impossible_sets_are_refused_in_the_configuration(change, said):
    with pytest.raises(ValidationError, match=said):
        machine(axis=AXIS | change)
