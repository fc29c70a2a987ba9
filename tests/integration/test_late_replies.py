"""A reply that comes late is to the packet that it answers: it confirms no stop that was sent meanwhile and lost."""

import asyncio
import random
from contextlib import suppress

import pytest

from ldcnd.contract.commands import (
    CommandReply,
    Halt,
    Home,
    MoveAbsolute,
    MoveRelative,
    MoveVelocity,
    Power,
    QuickStop,
    Reset,
    SetGains,
    SetPosition,
    SetPwm,
    Stop,
)
from ldcnd.contract.errors import LdcndError, WrongState
from ldcnd.contract.events import CommandStatus, ReadOutcome
from ldcnd.contract.rig_commands import SetIo, SetSpeedOverride
from ldcnd.contract.samples import AxisState, LinkState, Moving
from ldcnd.drives.ldcn.pic_io import LINES, SetDirection, SetOutput
from ldcnd.drives.ldcn.received import SetGain
from ldcnd.sim.faults import FaultKind, FaultPlan, LineFault
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain
from ldcnd.sim.ldcn.drive import SimulatedDrive
from ldcnd.sim.ldcn.io import SimulatedIo
from tests.support.dialect_rig import LS_182AP, SC, V4, dialect_rig
from tests.support.machine_rig import ENDLESS, LOCK, MODEL, Machine, machine, running_machine

FROM_S = 5.0
MARGIN_MS = 10
LATEST_S = (0.022, 0.06, 0.2)
"""The first lies within the time in which a line gets back in step. A reply that comes after that, in the time of the
one to another packet, cannot be told from it: what the shaft does then tells that the drive has not heard."""


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


@pytest.mark.parametrize("seed", [120, *range(3), *SOAK])
@pytest.mark.sweep(4)
async def test_what_is_confirmed_has_been_heard(seed: int):
    """Judged by the simulated shaft: it comes to rest within the time that it needs."""
    dice, confirmed = random.Random(seed), 0
    faults = (
        LineFault(FaultKind.REPLY_DELAYED, 0.06, from_s=FROM_S, longest_s=dice.choice(LATEST_S)),
        LineFault(FaultKind.REQUEST_LOST, 0.06, from_s=FROM_S),
    )
    plan = FaultPlan(faults, seed)
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


NO_DOOR = {"name": "no_door", "of": "rotor", "requires": [{"input": "door_closed"}]}


@pytest.mark.promise("inputs-of-their-module")
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.sweep(3)
async def test_a_late_reply_of_another_module_shows_no_input_that_permits_motion(seed: int):
    """The door is open all the time; the low bytes of the table's position, and the inputs of the store, look shut."""
    late = FaultPlan((LineFault(FaultKind.REPLY_DELAYED, 0.03, from_s=FROM_S, longest_s=0.1),), seed)
    modules = (ModuleSpec(MODEL, plant=ENDLESS), ModuleSpec(MODEL), ModuleSpec("pic-io"), ModuleSpec("pic-io"))
    chain = build_chain(ChainSpec(modules, faults=late))
    cabinet, store = chain.modules[2:]
    for line in range(1, LINES + 1):
        cabinet.drive_line(line, high=False, at_s=0.0)
        store.drive_line(line, high=True, at_s=0.0)
    others = [{"name": "store", "address": 4, "model": "pic-io", "rate": 50}]
    async with running_machine(machine(NO_DOOR, more=others), chain) as rig:
        await rig.client.command("rotor", Power(on=True))
        await rig.client.command("table", Power(on=True))
        await rig.client.command("table", MoveRelative(distance=0.006))
        stood_at = chain.modules[0].shaft.position_counts
        await asyncio.sleep(FROM_S)
        refused = 0
        for _ in range(1000):
            try:
                await rig.client.command("rotor", MoveRelative(distance=2.0))
            except LdcndError:
                refused += 1
            await asyncio.sleep(0.01)

        assert refused == 1000
        assert chain.modules[0].shaft.position_counts == pytest.approx(stood_at, abs=5)


CREEPING = MoveVelocity(velocity=0.1)
DEAF = (
    pytest.param(MoveVelocity(velocity=10.0), Stop(), id="stop"),
    pytest.param(MoveVelocity(velocity=10.0), QuickStop(), id="quick stop"),
    pytest.param(MoveVelocity(velocity=10.0), Power(on=False), id="power off"),
    pytest.param(CREEPING, Halt(), id="halt of a creeping shaft"),
    pytest.param(MoveAbsolute(position=15.0, velocity=2.0), Halt(), id="halt of a trapezoid"),
    pytest.param(SetPwm(duty=0.05, duration_s=3.0), Power(on=False), id="power off with an open loop"),
    pytest.param(SetPwm(duty=0.05, duration_s=3.0), Stop(), id="stop with an open loop"),
)


@pytest.mark.promise("stop-seen")
@pytest.mark.parametrize(("motion", "ending"), DEAF)
@pytest.mark.parametrize("times", [1, 2, 3])
@pytest.mark.sweep(4)
async def test_a_stop_that_was_confirmed_and_not_carried_out_is_sent_again(motion, ending, times, monkeypatch):
    """The drive answers and does nothing: so does a line whose late replies stand for those of lost stops."""
    deaf = [True] * times

    def stop(self, *args):
        if deaf:
            deaf.pop()
        else:
            stopping(self, *args)

    stopping = SimulatedDrive._stop
    async with dialect_rig(V4, pwm={"duty": 0.5, "duration_s": 5.0}, acceleration=2000) as rig:
        await rig.power_on()
        await rig.send(motion)
        await asyncio.sleep(0.3)
        monkeypatch.setattr(SimulatedDrive, "_stop", stop)
        await (rig.rig.client.stop("x") if isinstance(ending, Stop) else rig.send(ending))
        await asyncio.sleep(times * (6.5 if motion == CREEPING else 1.2))
        stood_at = rig.position_mm
        await asyncio.sleep(0.5)

        assert not deaf
        assert rig.position_mm == pytest.approx(stood_at, abs=0.01)
        state = await rig.rig.client.state("x")
        assert not state.stop_pending
        assert state.enabled is (not isinstance(ending, Power) and not (times > 1 and isinstance(motion, SetPwm)))


@pytest.mark.promise("told-twice")
@pytest.mark.parametrize("command", ["_load", "_arm_homing"])
@pytest.mark.parametrize("dialect", [V4, LS_182AP, SC], ids=lambda each: each.name)
@pytest.mark.sweep(2)
async def test_a_late_reply_does_not_stand_for_that_to_what_a_motion_needs(dialect, command, monkeypatch):
    """The drive answers and takes nothing, once: the motion goes where it was sent, and ends on its mark."""
    deaf, taking = [True], getattr(SimulatedDrive, command)

    def take(self, *args):
        if deaf:
            deaf.pop()
        else:
            taking(self, *args)

    home = {"method": "index", "velocity": 1.4, "distance": 30.0}
    async with dialect_rig(dialect, home=home) as rig:
        await rig.power_on()
        await rig.send(SetPosition(position=0.0))
        await rig.done(MoveAbsolute(position=4.0))
        began_at = rig.position_mm
        monkeypatch.setattr(SimulatedDrive, command, take)
        if command == "_arm_homing":
            state = await rig.done(Home())
            assert (state.referenced, state.last_error) == (True, None)
            assert abs(rig.position_mm - began_at) > 0.05
        else:
            await rig.done(MoveAbsolute(position=-2.0))
            assert rig.position_mm == pytest.approx(began_at - 6.0, abs=0.02)

        assert not deaf


@pytest.mark.promise("on-its-way")
@pytest.mark.parametrize("mid_motion", [False, True])
async def test_a_shaft_that_goes_elsewhere_than_it_was_sent_is_stopped(mid_motion, monkeypatch):
    """The drive has taken neither of both packets: it goes to the target of the motion before."""
    async with dialect_rig(SC) as rig:
        await rig.power_on()
        await rig.send(SetPosition(position=0.0))
        await rig.send(MoveAbsolute(position=18.0, velocity=4.0))
        await asyncio.sleep(0.8)
        if not mid_motion:
            await rig.done(Halt())
        turned_at = rig.position_mm
        monkeypatch.setattr(SimulatedDrive, "_load", lambda *_: None)
        with suppress(LdcndError):
            await rig.done(MoveAbsolute(position=-5.0, velocity=4.0, buffer_mode="aborting"))
        state = await rig.until(lambda state: state.moving is Moving.NO and not state.stop_pending)

        assert rig.position_mm < turned_at + 7
        assert state.state is AxisState.ERROR_STOP
        assert "no way to its target" in state.last_error


@pytest.mark.promise("as-slow-as-told")
@pytest.mark.parametrize("change", ["override", "move_velocity", "another target"])
async def test_a_shaft_that_goes_on_faster_than_it_was_told_is_stopped(change, monkeypatch):
    """The drive has not taken the start by which its speed was to change in mid-motion."""
    async with dialect_rig(SC) as rig:
        await rig.power_on()
        await rig.send(SetPosition(position=0.0))
        await rig.send(MoveAbsolute(position=18.0, velocity=4.0))
        await asyncio.sleep(0.5)
        monkeypatch.setattr(SimulatedDrive, "_start", lambda *_: None)
        if change == "override":
            await rig.rig.client.ask(SetSpeedOverride(percent=25.0, client="test"))
        elif change == "move_velocity":
            await rig.send(MoveVelocity(velocity=1.0, buffer_mode="aborting"))
        else:
            await rig.send(MoveAbsolute(position=17.0, velocity=1.0, buffer_mode="aborting"))
        await asyncio.sleep(1.2)
        state = await rig.until(lambda state: state.moving is Moving.NO and not state.stop_pending)

        assert rig.position_mm < 10
        assert state.state is AxisState.ERROR_STOP
        assert "faster than 1" in state.last_error


@pytest.mark.promise("stop-seen")
@pytest.mark.parametrize("policy", ["power_off", "halt", "quick_stop"])
async def test_a_daemon_does_not_end_before_the_stop_of_an_axis_is_seen(policy, monkeypatch):
    deaf, stopping = [True], SimulatedDrive._stop

    def stop(self, *args):
        if deaf:
            deaf.pop()
        else:
            stopping(self, *args)

    async with dialect_rig(V4, loss={"daemon": policy}) as rig:
        await rig.power_on()
        await rig.send(MoveVelocity(velocity=3.0))
        await asyncio.sleep(0.3)
        monkeypatch.setattr(SimulatedDrive, "_stop", stop)
    ended_at = rig.position_mm
    rig.chain.advance(asyncio.get_running_loop().time() + 2.0)
    rig.drive.catch_up(asyncio.get_running_loop().time() + 2.0)

    assert not deaf
    assert rig.position_mm == pytest.approx(ended_at, abs=0.5)


@pytest.mark.promise("on-its-way")
@pytest.mark.parametrize("dialect", [V4, LS_182AP, SC], ids=lambda each: each.name)
async def test_a_search_that_was_never_armed_is_not_begun(dialect, monkeypatch):
    """Both packets are acknowledged and not taken: what was captured before would pass for the mark."""
    home = {"method": "index", "velocity": 1.4, "distance": 30.0}
    async with dialect_rig(dialect, home=home) as rig:
        await rig.power_on()
        began_at = rig.position_mm
        monkeypatch.setattr(SimulatedDrive, "_arm_homing", lambda *_: None)
        with pytest.raises(WrongState, match="nothing was started"):
            await rig.done(Home())

        await rig.until(lambda state: state.moving is Moving.NO)
        assert rig.position_mm == pytest.approx(began_at, abs=0.01)


@pytest.mark.promise("on-its-way")
async def test_a_home_whose_last_leg_never_begins_says_so(monkeypatch):
    home = {"method": "index", "velocity": 1.4, "distance": 30.0, "move_to": -4.0}
    starts, starting = [], SimulatedDrive._start

    def start(self, *args):
        starts.append(self)
        if len(starts) != 2:  # the second one begins the leg behind the mark
            starting(self, *args)

    async with dialect_rig(SC, home=home) as rig:
        await rig.power_on()
        monkeypatch.setattr(SimulatedDrive, "_start", start)
        sent = await rig.send(Home())
        await rig.until(lambda state: state.command is None)
        ended = await rig.rig.client.ask(ReadOutcome(command_id=sent.command_id))

        assert len(starts) == 2
        assert ended.status is CommandStatus.FAILED
        assert "no sign of it" in ended.reason


def deaf_once(monkeypatch, simulated, wanted):
    """Have a simulated module answer one command of a type and not carry it out; return what it has not heard yet."""
    deaf, execute = [True], simulated.execute

    def hear(self, command):
        if deaf and isinstance(command, wanted):
            deaf.pop()
        else:
            execute(self, command)

    monkeypatch.setattr(simulated, "execute", hear)
    return deaf


@pytest.mark.promise("told-twice")
async def test_a_late_reply_does_not_stand_for_that_to_gains(monkeypatch):
    async with dialect_rig(SC) as rig:
        await rig.power_on()
        deaf = deaf_once(monkeypatch, SimulatedDrive, SetGain)
        await rig.send(SetGains(kp=77))

        assert not deaf
        assert rig.drive.loop.gains.kp == 77


@pytest.mark.promise("told-twice")
@pytest.mark.parametrize("packet", [SetDirection, SetOutput])
async def test_a_late_reply_does_not_stand_for_that_to_outputs(packet, monkeypatch):
    async with running_machine(machine()) as rig:
        deaf = deaf_once(monkeypatch, SimulatedIo, packet)
        await rig.client.ask(SetIo(module="cabinet", high=["lock"]))

        assert not deaf
        assert rig.io.levels & 1 << LOCK - 1
        assert rig.io.outputs & 1 << LOCK - 1
