"""`limit_switches = "stop"`: the drive stops a motion at the switch ahead, with or without a daemon."""

import asyncio
from contextlib import suppress

import pytest
from pydantic import ValidationError

from ldcnd.contract.commands import Halt, Home, Jog, MoveAbsolute, MoveRelative, MoveVelocity, SetPwm
from ldcnd.contract.errors import LeaseExpired, OutcomeUnknown, WrongState
from ldcnd.contract.rig_commands import SetSpeedOverride
from ldcnd.contract.samples import AxisState, Moving
from ldcnd.drives.ldcn.received import LoadTrajectory, SetHomingMode
from tests.integration.test_unconfirmed_start import lose_next
from tests.support.dialect_rig import AXIS, GAINS, LS_173AP, LS_182AP, LS_182AP_22, PLANT, SC, V2, V3, V4, dialect_rig

GUARDED = {"limit_switches": "stop"}
dialects = pytest.mark.parametrize("dialect", [V3, V4, SC, LS_182AP, LS_182AP_22], ids=lambda dialect: dialect.name)


@dialects
@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.sweep(2)
async def test_a_move_past_the_switch_stops_there_and_says_so(dialect, side):
    async with dialect_rig(dialect, **GUARDED) as rig:
        await rig.power_on()

        state = await rig.done(MoveAbsolute(position=30.0 * side, velocity=10.0))

        switch = "forward limit switch" if side > 0 else "reverse limit switch"
        assert (state.state, state.last_error) == (
            AxisState.STANDSTILL,
            f"move_absolute: the drive stopped at the {switch}",
        )
        assert state.referenced
        assert abs(rig.position_mm) == pytest.approx(20.0 + 10.0**2 / 200 / 2, abs=0.05)


@dialects
@pytest.mark.sweep(2)
async def test_leaving_the_switch_is_possible_and_going_on_is_refused(dialect):
    async with dialect_rig(dialect, **GUARDED) as rig:
        await rig.power_on()
        await rig.done(MoveAbsolute(position=30.0, velocity=10.0))

        with pytest.raises(WrongState, match="stands on its forward limit switch") as refusal:
            await rig.send(MoveRelative(distance=1.0))
        back = await rig.done(MoveAbsolute(position=5.0))

        assert refusal.value.remedy == "move the other way"
        assert (back.state, back.last_error) == (AxisState.STANDSTILL, None)
        assert rig.position_mm == pytest.approx(5.0, abs=0.05)
        assert (await rig.done(MoveVelocity(velocity=10.0))).last_error.endswith("the forward limit switch")


@pytest.mark.parametrize("dialect", [LS_182AP, V4], ids=lambda dialect: dialect.name)
async def test_a_distance_counts_from_where_the_drive_has_stopped_an_axis(dialect):
    async with dialect_rig(dialect, **GUARDED) as rig:
        await rig.power_on()
        await rig.done(MoveAbsolute(position=30.0, velocity=10.0))
        stopped = rig.position_mm

        state = await rig.done(MoveRelative(distance=-15.0))

        assert (state.state, state.last_error) == (AxisState.STANDSTILL, None)
        assert rig.position_mm == pytest.approx(stopped - 15.0, abs=0.1)


async def test_a_move_between_the_switches_ends_at_its_target():
    async with dialect_rig(LS_182AP, **GUARDED) as rig:
        await rig.power_on()

        for position in (15.0, -15.0, 0.0):
            state = await rig.done(MoveAbsolute(position=position))
            assert (state.state, state.last_error) == (AxisState.STANDSTILL, None)
            assert rig.position_mm == pytest.approx(position, abs=0.05)


@pytest.mark.promise("limit-switches")
@dialects
@pytest.mark.sweep(2)
async def test_the_drive_stops_at_the_switch_when_the_host_is_dead(dialect):
    async with dialect_rig(dialect, **GUARDED) as rig:
        await rig.power_on()
        await rig.send(MoveVelocity(velocity=10.0))
        await asyncio.sleep(0.5)

        rig.chain.unplug(asyncio.get_running_loop().time())
        await asyncio.sleep(10.0)

        rig.drive.catch_up(asyncio.get_running_loop().time())
        assert rig.position_mm == pytest.approx(20.25, abs=0.05)


# -- motions that are told anew in mid-move ----------------------------------------------------------------------------

MOST_MM = 0.7
"""Between a switch that is met at 10 mm/s and rest: the packets under way, and a ramp of 0.25 mm."""
COASTS_MM = 2.5
"""Likewise behind a duty of 0.11, whose motor is switched off."""
PACKETS = pytest.mark.parametrize("packet", [SetHomingMode, LoadTrajectory], ids=["arming", "loading"])
TOLD_ANEW = [
    pytest.param(SC, MoveAbsolute(position=18.0, velocity=10.0), SetSpeedOverride(percent=90), id="override"),
    pytest.param(
        SC,
        MoveAbsolute(position=18.0, velocity=10.0),
        MoveAbsolute(position=19.0, velocity=10.0, buffer_mode="aborting"),
        id="another goal",
    ),
    pytest.param(V4, MoveVelocity(velocity=10.0), MoveVelocity(velocity=9.0), id="another velocity"),
    pytest.param(V4, SetPwm(duty=0.1, duration_s=2.0), SetPwm(duty=0.11, duration_s=2.0), id="another duty"),
]


def meets_switch(rig, monkeypatch, packet):
    """Have the shaft meet its forward switch as the drive takes the next packet of a type; return where it does."""
    execute, met = rig.drive.execute, []

    def take(command):
        if isinstance(command, packet) and not met:
            met.append(rig.position_mm)
            rig.drive.shaft.forward_stuck = True
        execute(command)

    monkeypatch.setattr(rig.drive, "execute", take)
    return met


async def place(rig):
    """Return where the shaft comes to rest."""
    await rig.until(lambda state: state.command is None)
    await asyncio.sleep(0.5)
    rig.drive.catch_up(asyncio.get_running_loop().time())
    return rig.position_mm


@pytest.mark.promise("limit-switches")
@PACKETS
@pytest.mark.parametrize(("dialect", "first", "anew"), TOLD_ANEW)
@pytest.mark.sweep(2)
async def test_a_switch_that_is_met_while_a_motion_is_told_anew_stops_it(dialect, first, anew, packet, monkeypatch):
    async with dialect_rig(dialect, pwm={"duty": 0.5, "duration_s": 5.0}, **GUARDED) as rig:
        await rig.power_on()
        await rig.send(first)
        await asyncio.sleep(0.4)
        met = meets_switch(rig, monkeypatch, packet)
        await (rig.rig.client.ask(anew) if isinstance(anew, SetSpeedOverride) else rig.send(anew))
        stands = await place(rig)
        state = await rig.rig.client.state(AXIS)

        # a raw duty has no loop closed, and none is closed beside a shaft that turns
        open_loop = isinstance(anew, SetPwm)
        assert met[0] < stands < met[0] + (COASTS_MM if open_loop else MOST_MM)
        assert (state.state, state.enabled) == (
            (AxisState.DISABLED, False) if open_loop else (AxisState.STANDSTILL, True)
        )
        assert state.last_error.endswith(": the drive stopped at the forward limit switch")


@pytest.mark.promise("limit-switches")
@pytest.mark.parametrize("dialect", [V4, SC, LS_182AP], ids=lambda dialect: dialect.name)
@pytest.mark.parametrize("halted", [False, True], ids=["left alone", "halted"])
@pytest.mark.sweep(2)
async def test_the_loop_of_a_raw_duty_that_has_met_its_switch_stays_open_while_its_shaft_coasts(dialect, halted):
    """What a real drive commands as it closes its loop beside a shaft that turns, no manual says."""
    async with dialect_rig(
        dialect, start_counts=19_000.0, pwm={"duty": 0.5, "duration_s": 5.0}, coast_s=5.0, **GUARDED
    ) as rig:
        await rig.power_on()
        sent = await rig.send(SetPwm(duty=0.3, duration_s=3.0))
        while rig.drive.loop.pwm:
            await asyncio.sleep(0.001)
            rig.drive.catch_up(asyncio.get_running_loop().time())
        if halted:
            await rig.until(lambda state: state.command is None)
            await rig.send(Halt())
        closed = []
        for _ in range(500):
            await asyncio.sleep(0.001)
            rig.drive.catch_up(asyncio.get_running_loop().time())
            closed.append(rig.drive.loop.servo_on)
        state = await rig.rig.client.wait_for_end(AXIS, sent.command_id)

        assert not any(closed)
        assert (state.state, state.enabled) == (AxisState.DISABLED, False)
        assert state.last_error == "set_pwm: the drive stopped at the forward limit switch"
        await rig.until(lambda state: state.moving is Moving.NO)
        await rig.power_on()
        assert (await rig.done(MoveRelative(distance=-15.0))).last_error is None


@pytest.mark.promise("limit-switches")
@PACKETS
async def test_a_switch_that_is_met_while_a_jog_gets_its_next_goal_stops_it(packet, monkeypatch):
    async with dialect_rig(SC, rates={"position": 1, "state": 1}, **GUARDED) as rig:
        await rig.power_on()
        jog = Jog(velocity=10.0, hold_s=0.4)
        held = await rig.send(jog)
        met = meets_switch(rig, monkeypatch, packet)
        with suppress(LeaseExpired):
            for _ in range(100):
                await asyncio.sleep(0.1)
                await rig.send(jog.model_copy(update={"renews": held.command_id}))

        assert met[0] < await place(rig) < met[0] + MOST_MM


@pytest.mark.promise("limit-switches")
@PACKETS
async def test_a_motion_that_goes_on_behind_its_switch_is_stopped_by_the_next_reading(packet, monkeypatch):
    """It was told anew meanwhile, and the reply that would have shown it is lost."""
    async with dialect_rig(SC, **GUARDED) as rig:
        await rig.power_on()
        await rig.send(MoveAbsolute(position=18.0, velocity=10.0))
        await asyncio.sleep(0.4)
        met = meets_switch(rig, monkeypatch, packet)
        lose_next(rig, monkeypatch, heard=True)
        with pytest.raises(OutcomeUnknown):
            await rig.send(MoveAbsolute(position=19.0, velocity=10.0, buffer_mode="aborting"))
        stands = await place(rig)
        state = await rig.rig.client.state(AXIS)

        assert met[0] < stands < met[0] + MOST_MM + 0.05 * 10.0
        assert state.last_error == "move_absolute: the drive stopped at the forward limit switch"


# -- searches for home -------------------------------------------------------------------------------------------------


NO_INDEX = PLANT.model_copy(update={"index_at_counts": -1_000_000, "index_spacing_counts": 10_000_000})
"""The wire of the index is broken."""


@dialects
@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.sweep(2)
async def test_a_search_whose_signal_does_not_come_stops_at_the_switch_ahead(dialect, side):
    async with dialect_rig(dialect, NO_INDEX, start_counts=18_000.0 * side, **GUARDED) as rig:
        await rig.power_on()

        state = await rig.done(Home(method="index", velocity=1.0 * side))

        switch = "forward limit switch" if side > 0 else "reverse limit switch"
        assert (state.state, state.referenced) == (AxisState.STANDSTILL, False)
        assert state.last_error == f"home: the drive stopped at the {switch}"
        assert abs(rig.position_mm) == pytest.approx(20.0, abs=0.05)


async def test_a_search_stops_at_the_switch_ahead_when_the_host_is_dead():
    async with dialect_rig(LS_182AP, NO_INDEX, start_counts=18_000.0, **GUARDED) as rig:
        await rig.power_on()
        await rig.send(Home(method="index", velocity=1.0))
        await asyncio.sleep(0.5)

        rig.chain.unplug(asyncio.get_running_loop().time())
        await asyncio.sleep(10.0)

        rig.drive.catch_up(asyncio.get_running_loop().time())
        assert rig.position_mm == pytest.approx(20.0, abs=0.05)


@pytest.mark.parametrize("stop", ["smooth", "off"])
@pytest.mark.parametrize(
    ("method", "gains"), [("position_error", GAINS | {"el": 800}), ("current", GAINS | {"cl": 101})]
)
async def test_a_search_for_a_hard_stop_ends_at_the_switch_before_it(method, gains, stop):
    async with dialect_rig(V4, start_counts=18_000.0, gains=gains, **GUARDED) as rig:
        await rig.power_on()

        state = await rig.done(Home(method=method, velocity=5.0, acceleration=50.0, stop=stop))

        held = method == "current" and stop == "smooth"
        assert (state.state, state.enabled, state.referenced) == (
            AxisState.STANDSTILL if held else AxisState.DISABLED,
            held,
            False,
        )
        assert state.last_error == "home: the drive stopped at the forward limit switch"
        assert rig.drive.loop.servo_on is held
        assert rig.position_mm < 20.6


@dialects
@pytest.mark.sweep(2)
async def test_a_switch_that_never_releases_does_not_lead_a_search_through_the_other_one(dialect):
    async with dialect_rig(dialect, start_counts=15_000.0, **GUARDED) as rig:
        await rig.power_on()
        rig.drive.shaft.reverse_stuck = True

        state = await rig.done(Home(method="reverse_limit", velocity=-5.0))

        assert (state.state, state.referenced) == (AxisState.STANDSTILL, False)
        assert state.last_error == "home: the drive stopped at the forward limit switch"
        assert rig.position_mm == pytest.approx(20.0 + 5.0**2 / 200 / 2, abs=0.05)


@dialects
@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize("start_counts", [0.0, 20_500.0])
@pytest.mark.sweep(4)
async def test_a_search_for_a_switch_finds_it_and_leaves_it_as_ever(dialect, side, start_counts):
    async with dialect_rig(dialect, start_counts=start_counts * side, **GUARDED) as rig:
        await rig.power_on()
        method = "forward_limit" if side > 0 else "reverse_limit"

        state = await rig.done(Home(method=method, velocity=2.0 * side, find_velocity=10.0, move_to=-5.0 * side))

        assert (state.state, state.referenced, state.last_error) == (AxisState.STANDSTILL, True, None)
        assert rig.position_mm == pytest.approx(15.0 * side, abs=0.05)


@pytest.mark.parametrize("dialect", [V4, LS_182AP], ids=lambda dialect: dialect.name)
async def test_a_search_away_from_a_switch_is_not_stopped_by_leaving_it_and_one_onto_it_is_refused(dialect):
    plant = PLANT.model_copy(update={"index_at_counts": -19_000, "index_spacing_counts": 100_000})
    async with dialect_rig(dialect, plant, start_counts=-20_300.0, **GUARDED) as rig:
        await rig.power_on()

        with pytest.raises(WrongState, match="stands on its reverse limit switch"):
            await rig.send(Home(method="index", velocity=-1.0))
        state = await rig.done(Home(method="index", velocity=1.0))

        assert (state.state, state.referenced, state.last_error) == (AxisState.STANDSTILL, True, None)
        assert rig.position_mm == pytest.approx(-19.0, abs=0.05)


async def test_without_the_setting_the_switches_stop_nothing():
    async with dialect_rig(LS_182AP) as rig:
        await rig.power_on()

        state = await rig.done(MoveAbsolute(position=21.5, velocity=10.0))

        assert state.last_error is None
        assert rig.position_mm == pytest.approx(21.5, abs=0.05)
        assert (await rig.rig.client.state(AXIS)).referenced


@pytest.mark.parametrize("dialect", [V2, LS_173AP], ids=lambda dialect: dialect.name)
async def test_a_drive_that_does_not_stop_on_its_limits_is_refused_in_the_configuration(dialect):
    with pytest.raises(ValidationError, match="does not stop on its limit inputs"):
        async with dialect_rig(dialect, **GUARDED):
            pass
