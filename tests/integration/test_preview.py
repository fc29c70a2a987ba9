"""What a move would do, asked before it is commanded, on the jumping clock."""

import pytest

from ldcnd.contract.commands import MoveAbsolute, MoveRelative, MoveVelocity, Power, SetPosition, Verb
from ldcnd.contract.errors import MalformedRequest, WrongState
from ldcnd.contract.questions import Preview, Why
from ldcnd.contract.rig_commands import SetSpeedOverride
from ldcnd.line.flight_recorder import WireEvent
from tests.support.command_line import virtual_rig
from tests.support.machine_rig import machine, running_machine
from tests.support.rig import RunningRig, running_rig


def sent(rig: RunningRig) -> list[str]:
    records = rig.daemon.rig.buses[0].bus.wire_log.records()
    return [record.data.hex(" ") for record in records if record.event is WireEvent.SENT]


async def test_a_plan_is_what_the_move_then_is():
    async with running_rig() as rig:
        await rig.power_on("x")

        plan = await rig.client.ask(Preview(position=12.3456, velocity=7.0), "x")
        before = len(sent(rig))
        move = await rig.client.command("x", MoveAbsolute(position=12.3456, velocity=7.0))

        assert plan.refusal is None
        assert plan.obstacles == ()
        assert (plan.position, plan.velocity, plan.acceleration, plan.duration_s) == (
            move.position,
            move.velocity,
            move.acceleration,
            move.duration_s,
        )
        assert plan.position == pytest.approx(12.346)
        assert plan.velocity_error == pytest.approx(plan.velocity - 7.0)
        assert abs(plan.velocity_error) < 0.001
        assert plan.packets == tuple(packet for packet in sent(rig)[before:] if packet in plan.packets)
        assert 0.001 < plan.bus_s < 0.01


async def test_a_speed_override_is_no_rounding():
    async with running_rig() as rig:
        await rig.until("x", lambda state: state.link == "up")
        await rig.client.ask(SetSpeedOverride(percent=25))

        plan = await rig.client.ask(Preview(position=12.0, velocity=8.0), "x")

        assert plan.velocity == pytest.approx(2.0, abs=0.001)
        assert plan.velocity_error == pytest.approx(0, abs=0.001)


async def test_a_plan_sends_nothing():
    async with running_rig() as rig:
        await rig.until("x", lambda state: state.link == "up")

        plan = await rig.client.ask(Preview(distance=1.0), "x")

        assert not set(plan.packets) & set(sent(rig))
        assert plan.obstacles == ("axis x is disabled",)


async def test_a_plan_that_cannot_be_names_the_nearest_that_can():
    async with running_rig() as rig:
        await rig.until("x", lambda state: state.link == "up")

        far = await rig.client.ask(Preview(position=500.0), "x")
        fast = await rig.client.ask(Preview(velocity=-60.0), "x")

        assert (far.refusal.code, far.refusal.nearest) == ("position_limit", 100)
        assert (fast.refusal.code, fast.refusal.nearest) == ("velocity_limit", -50)


async def test_a_plan_says_which_motion_is_meant():
    async with running_rig() as rig:
        await rig.until("x", lambda state: state.link == "up")

        for vague in (Preview(), Preview(position=1.0, distance=1.0)):
            with pytest.raises(MalformedRequest):
                await rig.client.ask(vague, "x")


async def test_at_a_constant_velocity_both_questions_answer_as_the_command_would():
    runs = "axis rotor is moving at a velocity"
    async with running_machine(machine()) as rig:
        await rig.client.command("rotor", Power(on=True))
        await rig.client.command("rotor", SetPosition(position=0.0))
        await rig.client.command("rotor", MoveVelocity(velocity=2.0))

        planned = [
            (await rig.client.ask(each, "rotor")).obstacles
            for each in (Preview(velocity=3.0), Preview(position=3.0), Preview(distance=3.0))
        ]
        why = {
            verb: await rig.client.ask(Why(command=verb), "rotor")
            for verb in (Verb.MOVE_VELOCITY, Verb.MOVE_ABSOLUTE, Verb.MOVE_RELATIVE, Verb.SET_GAINS, Verb.POWER, None)
        }
        await rig.client.command("rotor", MoveVelocity(velocity=3.0))
        for refused in (MoveAbsolute(position=3.0), MoveRelative(distance=3.0)):
            with pytest.raises(WrongState, match=runs):
                await rig.client.command("rotor", refused)

    assert planned == [(), (runs,), (runs,)]
    assert {verb for verb, each in why.items() if each.can_move} == {Verb.MOVE_VELOCITY, Verb.SET_GAINS}
    assert {cause.text for each in why.values() for cause in each.causes} == {runs}


def test_the_command_line_asks_about_one_command(monkeypatch):
    with virtual_rig(monkeypatch) as rig:
        rig.wait(rig.rig.until("x", lambda state: state.link == "up"))
        told = rig.run("why x read_alarms")
        assert told.code == 1
        assert "cannot read_alarms" in told.printed
        rig.run("power on x")
        rig.run("move x 1 --at-velocity")
        assert rig.run("why x").printed.startswith("x: cannot move to a position now, only at a velocity\n")
        assert rig.run("why x move_velocity").printed == "x: ready for move_velocity\n"
