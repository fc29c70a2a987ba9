"""Each fault of a rehearsal, by its name, with nothing but the plugin: this file runs wherever ldcnd is installed."""

import asyncio
from dataclasses import dataclass

import pytest

import ldcnd


@dataclass
class Case:
    """A fault that comes in the middle of a motion to 20, and what is then so."""

    begin: object
    goes_on: bool = False
    """The program notices nothing."""
    arrives: bool | None = None
    """Whether the axis does; by itself, as the program says."""
    says: str = ""
    """What an active fault or an event of x says."""
    axis: str = "x"


CASES = {
    "jam": Case(lambda faults: faults.jam("x", at=10), says="not_followed"),
    "slip": Case(lambda faults: faults.slip("x", 0.5, at=10), goes_on=True),
    "friction": Case(lambda faults: faults.friction("x", 5, at=10), goes_on=True),
    "load": Case(lambda faults: faults.load("x", 0.05, at=10), goes_on=True),
    "phase_lost": Case(lambda faults: faults.phase_lost("x", at=10), goes_on=True, says="unsettled"),
    "limit_closed": Case(lambda faults: faults.limit_closed("x", "forward", at=10), goes_on=True),
    "limit_stuck": Case(lambda faults: faults.limit_stuck("x", "forward"), goes_on=True),
    "index_lost": Case(lambda faults: faults.index_lost("x"), goes_on=True),
    "encoder_lost": Case(lambda faults: faults.encoder_lost("x", at=10), says="encoder"),
    "encoder_stuck": Case(lambda faults: faults.encoder_stuck("x", at=10)),
    "overheat": Case(lambda faults: faults.overheat("x", at=10), says="overheat"),
    "overcurrent": Case(lambda faults: faults.overcurrent("x", at=10), says="overcurrent"),
    "motor_short": Case(lambda faults: faults.motor_short("x", at=10), says="short"),
    "overvoltage": Case(lambda faults: faults.overvoltage("x", at=10), says="overvoltage"),
    "motor_supply_lost": Case(lambda faults: faults.motor_supply_lost("z", at=10), axis="z", says="power"),
    "motor_supply_lost_of_a_logosol": Case(
        lambda faults: faults.motor_supply_lost("x", at=10, for_s=1.0), says="reset"
    ),
    "stop_input": Case(lambda faults: faults.stop_input("x", at=10), says="stop_input"),
    "power_loss": Case(lambda faults: faults.power_loss("x", at=10, for_s=1.0), says="reset"),
    "mute": Case(lambda faults: faults.mute("x", at=10, for_s=2.0), says="link_lost"),
    "cable_cut": Case(lambda faults: faults.cable_cut("x", at=10, for_s=1.8), arrives=True, says="link_lost"),
    "noise": Case(lambda faults: faults.noise(0.05, after_s=0.5, for_s=1.0), goes_on=True),
    "late_replies": Case(lambda faults: faults.late_replies(0.004, after_s=0.5, for_s=1.0), goes_on=True),
    "lost_replies": Case(lambda faults: faults.lost_replies(0.05, after_s=0.5, for_s=1.0), goes_on=True),
    "unplug": Case(lambda faults: faults.unplug(after_s=0.5, for_s=1.0), arrives=True, says="lost"),
    "reset_by_another": Case(lambda faults: faults.reset_by_another(after_s=0.5), says="reset"),
    "daemon_killed": Case(lambda faults: faults.daemon_killed(after_s=0.5, for_s=0.3)),
    "client_lost": Case(lambda faults: faults.client_lost(after_s=0.5), says="lease"),
}


@pytest.mark.parametrize("name", CASES)
async def test_every_fault_does_to_the_machine_what_its_name_says(ldcnd_rig, name):
    case = CASES[name]
    fault = case.begin(ldcnd_rig.faults)
    arrived = False
    try:
        async with ldcnd_rig.client.control(case.axis, client="test") as axis, asyncio.timeout(60):
            await axis.power(on=True)
            await (await axis.move_absolute(20, velocity=10)).done()
            arrived = True
    except ldcnd.LdcndError as error:
        ldcnd_rig.timeline.note(f"the program ends: {error}")
    await asyncio.sleep(4)
    told = str(ldcnd_rig.timeline)
    print(told)
    assert fault.begun or name in ("limit_stuck", "index_lost")
    assert arrived == case.goes_on
    truth = ldcnd_rig.truth(case.axis)
    assert (abs(truth.position - 20) < 0.05) == (case.goes_on if case.arrives is None else case.arrives)
    assert case.says in told


@pytest.mark.parametrize(
    "name", ["encoder_lost", "overheat", "overcurrent", "motor_short", "overvoltage", "stop_input"]
)
async def test_a_fault_that_a_drive_does_not_feel_is_refused(ldcnd_rig, name):
    with pytest.raises(ldcnd.LdcndError, match="no effect on a pic-servo-v4"):
        getattr(ldcnd_rig.faults, name)("z")


async def test_the_axis_next_to_a_cut_cable_is_lost_as_the_others_are_and_does_not_go_on(ldcnd_rig):
    """Its drive is also asked for a sign of life after each lost poll of the others: that may not hide its own."""
    ldcnd_rig.faults.cable_cut("x", at=10, for_s=5.0)
    async with ldcnd_rig.client.control("x", client="test") as axis, asyncio.timeout(60):
        await axis.power(on=True)
        motion = await axis.move_absolute(100, velocity=10)

        with pytest.raises(ldcnd.OutcomeUnknown):
            await motion.done()

        assert 10 < ldcnd_rig.truth("x").position < 50, "only a drive that answers again can have told it"
        await asyncio.sleep(8)
    assert ldcnd_rig.truth("x").at_rest
    assert ldcnd_rig.truth("x").position < 80
