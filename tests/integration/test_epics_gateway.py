"""Motor records on a whole daemon: what puts do, what is refused, and that nothing moves without permission."""

import asyncio
import math
import random
from contextlib import AsyncExitStack, asynccontextmanager, suppress

import pytest
from caproto import AccessRights, AlarmSeverity, Forbidden

from ldcnd.client.rig import Rig
from ldcnd.client.rig_client import RigClient
from ldcnd.config.plan import plan_rig
from ldcnd.config.rig import RigConfig, load_config
from ldcnd.contract.commands import MoveAbsolute, Reset
from ldcnd.contract.errors import (
    CommandAborted,
    DriveFault,
    LdcndError,
    LeaseHeld,
    LeaseRequired,
    PositionLimit,
    StopLatched,
    ValueOutOfRange,
    WrongState,
)
from ldcnd.contract.events import ReadEvents
from ldcnd.contract.leases import Acquire, ListHolders
from ldcnd.contract.meta import AxisLimits
from ldcnd.contract.samples import AxisState, LinkState, Moving
from ldcnd.daemon.assembly import build_daemon
from ldcnd.lab.epics.gateway import gateway
from ldcnd.testing.memory_session import MemoryBroker
from tests.support.dialect_rig import LS_182AP, dialect_rig
from tests.support.epics_records import SCREENS, VALUES, put, records, shows
from tests.support.lost_answers import losing
from tests.support.rig import EPOCH_NS, SIMULATED, running_rig, two_axes

AT_REST = 0.05
"""Millimetres by which a shaft still settles once it stands, from where a halt or a stop has ended."""


@pytest.mark.record(
    "VAL", "a put moves the motor there; one with completion returns when the motion is over, and fails with it"
)
async def test_a_put_returns_when_the_axis_stands_at_its_target():
    async with records() as (running, made):
        moving = asyncio.create_task(put(made, "T:x", 3.0))
        await shows(made, "T:x.DMOV", 0)
        await shows(made, "T:x.VAL", 3.0)
        assert not moving.done()
        await shows(made, "T:x.TDIR", 1)
        await moving
        state = await running.client.state("x")

        assert made.variables["T:x.DMOV"].value == 1
        assert (made.variables["T:x.VAL"].value, made.variables["T:x.DVAL"].value) == (3.0, 3.0)
        assert state.moving is Moving.NO
        assert made.variables["T:x.RBV"].value == pytest.approx(3, abs=0.02)
        assert made.variables["T:x.RBV"].timestamp == pytest.approx(state.t * 1e-9, abs=1)


async def test_the_record_has_the_fields_that_clients_use():
    async with records(moves=False) as (_, made):
        has = {name.rpartition(".")[2] for name in made.variables if name.startswith("T:x.")}
        assert {screen: set(fields.split()) - has for screen, fields in SCREENS.items()} == {
            screen: set() for screen in SCREENS
        }
        shown = {field: made.variables[f"T:x.{field}"].value for field in ("EGU", "PREC", "MRES", "HLM", "LLM", "RTYP")}
        beside = {name.partition(":x:")[2] for name in made.variables if ":x:" in name}

    assert shown == {"EGU": "mm", "PREC": 3, "MRES": 0.001, "HLM": 100, "LLM": -100, "RTYP": "motor"}
    assert beside == {
        *("adc", "condition", "control", "faults", "first_fault", "inputs", "message", "reset", "state", "velocity"),
    }


@pytest.mark.record("JOGF", "1 jogs at JVEL and with JAR, 0 ends that")
@pytest.mark.long
async def test_a_jog_runs_until_it_is_released():
    async with records() as (running, made):
        await put(made, "T:x.JVEL", 5.0)
        await put(made, "T:x.JOGR", 1)
        await shows(made, "T:x.DMOV", 0)
        await asyncio.sleep(3.0)
        assert made.variables["T:x.RBV"].value < -10
        await put(made, "T:x.JOGR", 0)

        assert made.variables["T:x.DMOV"].value == 1
        assert made.variables["T:x.RBV"].value > -20
        assert (await running.client.state("x")).moving is Moving.NO
        with pytest.raises(ValueOutOfRange):
            await put(made, "T:x.JVEL", 51.0)


@pytest.mark.parametrize("ending", ["client gone", "STOP", "SPMG", "JOGR", "stop from elsewhere"])
@pytest.mark.sweep(2)
async def test_a_jog_ends_with_whatever_may_have_held_it(ending: str):
    async with records() as (running, made):
        connected = {"screen", "archiver"}
        made.circuits = connected
        await put(made, "T:x.JVEL", 2.0)
        await put(made, "T:x.JOGF", 1)
        await running.until("x", lambda state: state.moving is Moving.YES)
        connected.add("another")
        match ending:
            case "client gone":
                connected.discard("archiver")  # which one holds it, Channel Access does not say
            case "STOP":
                await put(made, "T:x.STOP", 1)
            case "SPMG":
                await put(made, "T:x.SPMG", "Pause")
            case "JOGR":
                await put(made, "T:x.JOGR", 0)
            case _:
                await running.client.stop("x")
        await shows(made, "T:x.DMOV", 1)

        assert made.variables["T:x.JOGF"].value == 0
        assert made.variables["T:x.RBV"].value < 5
        assert (await running.client.state("x")).moving is Moving.NO


async def test_a_move_that_follows_a_jog_is_not_halted_by_its_end():
    async with records() as (_, made):
        await put(made, "T:x.JVEL", 2.0)
        await put(made, "T:x.JOGF", 1)
        await put(made, "T:x", 7.0)

        assert made.variables["T:x.RBV"].value == pytest.approx(7, abs=0.2)
        assert (made.variables["T:x.JOGF"].value, made.variables["T:x.DMOV"].value) == (0, 1)


@pytest.mark.promise("energy-out-always-sent")
async def test_an_axis_that_another_program_controls_is_switched_off_by_a_put():
    async with records() as (running, made):
        await running.client.ask(Acquire(client="ann", axes=("x",), force=True, lease_s=60))
        while made.variables["T:x:control"].value == "epics gateway":
            await asyncio.sleep(0.01)
        await put(made, "T:x.CNEN", "Disable")

        await running.until("x", lambda state: not state.enabled)


@pytest.mark.parametrize(
    ("name", "value"), [("T:x.STOP", 1), ("T:allstop", 1), ("T:x.SPMG", "Stop"), ("T:x.CNEN", "Disable")]
)
@pytest.mark.sweep(2)
@pytest.mark.promise("energy-out-always-sent")
async def test_what_another_program_moves_is_brought_to_rest_by_a_put_although_nothing_can_be_read(name, value):
    loop = asyncio.get_running_loop()
    async with records() as (running, made):
        taken = await running.client.ask(Acquire(client="ann", axes=("x",), force=True, lease_s=60))
        while made.variables["T:x:control"].value == "epics gateway":
            await asyncio.sleep(0.01)
        await running.client.command("x", MoveAbsolute(position=90.0, velocity=5.0, lease=taken.lease))
        await running.until("x", lambda state: state.moving is Moving.YES)
        with losing(running.session, commands={"state", "position"}):
            asked_s = loop.time()
            await put(made, name, value)
            took_s = loop.time() - asked_s
        state = await running.until("x", lambda state: state.moving is Moving.NO)

        assert took_s < 1.0
        assert made.variables["T:x.RBV"].value < 20.0
        assert (state.enabled, state.stop_latched) == ((False, False) if value == "Disable" else (True, True))


@pytest.mark.record("HLS", "it and LLS are those of the user's directions, and bits 3 and 14 of MSTA")
@pytest.mark.parametrize("direction", ["forward", "reverse"])
@pytest.mark.sweep(2)
async def test_a_limit_switch_shows_at_the_end_of_the_axis_where_it_is(direction: str):
    async with dialect_rig(LS_182AP, limit_switches="stop", direction=direction) as drive:
        rig = Rig(drive.rig.client, await drive.rig.client.daemon())
        async with gateway(rig, prefix="T:", moves=("x",)) as made:
            await shows(made, "T:x.LLS", AlarmSeverity.INVALID_ALARM, "severity")  # the power driver is off
            assert made.variables["T:x.LLS"].value == 0
            await shows(made, "T:x.SEVR", "NO_ALARM")
            await put(made, "T:x.CNEN", "Enable")
            with pytest.raises(DriveFault, match="limit switch"):
                await put(made, "T:x", 30.0)
            await shows(made, "T:x.HLS", 1)
            await shows(made, "T:x.LLS", 0)

            await shows(made, "T:x.HLS", AlarmSeverity.NO_ALARM, "severity")
            assert made.variables["T:x:inputs"].value == f"{direction}_limit, amplifier_enable"
            assert made.variables["T:x.RBV"].value < 22
            with pytest.raises(DriveFault, match="limit switch"):
                await put(made, "T:x", -30.0)
            await shows(made, "T:x.LLS", 1)
            await shows(made, "T:x.HLS", 0)
            await shows(made, "T:x.MSTA", made.variables["T:x.MSTA"].value & ~0x4 | 0x2000)


@pytest.mark.record("ACCL", "it is the time to VELO, of the next move")
async def test_velocity_and_acceleration_are_those_of_the_next_move():
    async with records() as (_, made):
        assert made.variables["T:x.VELO"].value == pytest.approx(20, rel=0.01)
        assert made.variables["T:x.ACCL"].value == pytest.approx(0.1, rel=0.01)
        await put(made, "T:x.VELO", 2.0)
        began_s = asyncio.get_running_loop().time()
        await put(made, "T:x", 1.0)
        took_s = asyncio.get_running_loop().time() - began_s
        with pytest.raises(ValueOutOfRange):
            await put(made, "T:x.VELO", 51.0)

    assert 0.5 < took_s < 1.5  # 1 mm at 2 mm/s


@pytest.mark.record("LVIO", "it is 1 after a target beyond HLM or LLM, which does not move the motor")
async def test_a_target_beyond_the_limit_is_refused_and_moves_nothing():
    async with records() as (running, made):
        with pytest.raises(PositionLimit):
            await put(made, "T:x", 1000.0)

        assert made.variables["T:x.LVIO"].value == 1
        assert made.variables["T:x.DMOV"].value == 1
        assert "100" in made.variables["T:x:message"].value
        assert (await running.client.state("x")).moving is Moving.NO
        await put(made, "T:x", 0.5)
        assert made.variables["T:x.LVIO"].value == 0


@pytest.mark.parametrize(("asked", "said"), [(math.nan, "nan"), (math.inf, "inf"), ("10 furlong", "furlong")])
@pytest.mark.sweep(2)
async def test_what_is_no_target_is_refused_in_words_and_moves_nothing(asked, said):
    async with records() as (running, made):
        with pytest.raises(ValueError, match=said):
            await put(made, "T:x", asked)

        assert said in made.variables["T:x:message"].value
        assert (await running.client.state("x")).moving is Moving.NO
        await put(made, "T:x", 0.5)
        assert made.variables["T:x:message"].value == ""


@pytest.mark.record("BDST", "the last part of a move goes in its direction, and is part of the same motion")
@pytest.mark.parametrize(("direction", "distance"), [("positive", 0.5), ("negative", -0.5)])
async def test_backlash_is_the_approach_of_the_daemon_and_one_put(direction: str, distance: float):
    async with dialect_rig(LS_182AP, approach={"direction": direction, "distance": 0.5}) as drive:
        rig = Rig(drive.rig.client, await drive.rig.client.daemon())
        async with gateway(rig, prefix="T:", moves=("x",)) as made:
            await shows(made, "T:x.SEVR", "NO_ALARM")
            await put(made, "T:x.CNEN", "Enable")
            seen, target = [], -2.0 * distance  # from the wrong side
            async with rig.samples("x", "position") as positions:
                moving = asyncio.create_task(put(made, "T:x", target))
                while not moving.done():
                    seen.append((await anext(positions))[1].value)
            await moving

            assert made.variables["T:x.BDST"].value == distance
            assert made.variables["T:x.BDST"].check_access("host", "user") == AccessRights.READ
            assert made.variables["T:x.RBV"].value == pytest.approx(target, abs=0.02)
            assert max(seen, key=abs) == pytest.approx(target - distance, abs=0.1)


async def test_a_stop_halts_without_the_latch_and_the_put_is_complete():
    async with records() as (running, made):
        moving = asyncio.create_task(put(made, "T:x", 50.0))
        await running.until("x", lambda state: state.moving is Moving.YES)
        await put(made, "T:x.STOP", 1)
        await moving
        state = await running.client.state("x")

    assert (state.stop_latched, state.moving) == (False, Moving.NO)


@pytest.mark.parametrize("how", ["standing", "disabled", "latched"])
async def test_a_stop_of_an_axis_that_stands_is_no_error_and_changes_nothing(how: str):
    def told(state):
        return state.state, state.enabled, state.referenced, state.stop_latched, state.target, state.last_error

    async with records() as (running, made):
        await put(made, "T:x", 3.0)
        if how == "disabled":
            await put(made, "T:x.CNEN", "Disable")
        elif how == "latched":
            await running.client.stop("x")
        before = await running.until(
            "x", lambda state: state.moving is Moving.NO and state.state is not AxisState.STOPPING
        )
        for name in ("T:x.STOP", "T:allstop"):
            await put(made, name, 1)
        await asyncio.sleep(1)
        after = await running.client.state("x")

        assert told(after) == told(before)
        assert made.variables["T:x:message"].value == ""
        assert made.variables["T:x.RBV"].value == pytest.approx(3, abs=AT_REST)


async def test_a_stop_of_a_drive_that_takes_no_halt_is_no_error_while_it_stands(tmp_path):
    config = load_config(SIMULATED.with_name("mixed.toml")).model_copy(update={"state_dir": tmp_path})
    async with running_rig(config) as running:
        rig = Rig(running.client, await running.client.daemon())
        async with gateway(rig, prefix="T:", axes=("spool",), moves=("spool",)) as made:
            await running.until("spool", lambda state: state.link is LinkState.UP and state.moving is Moving.NO)
            await shows(made, "T:spool.DMOV", 1)
            for name in ("T:spool.STOP", "T:allstop"):
                await put(made, name, 1)

            assert made.variables["T:spool:message"].value == ""


async def test_a_stop_from_elsewhere_fails_the_put_and_raises_the_severity():
    async with records() as (running, made):
        moving = asyncio.create_task(put(made, "T:x", 50.0))
        await running.until("x", lambda state: state.moving is Moving.YES)
        await running.client.stop()
        with pytest.raises(CommandAborted):
            await moving
        await shows(made, "T:x.SEVR", "MINOR")
        await running.until("x", lambda state: state.moving is Moving.NO)


async def test_a_second_put_sends_a_moving_axis_elsewhere():
    async with records() as (running, made):
        first = asyncio.create_task(put(made, "T:x", 50.0))
        await running.until("x", lambda state: state.moving is Moving.YES)
        await put(made, "T:x", 1.0)
        await first

        assert made.variables["T:x.RBV"].value == pytest.approx(1, abs=0.02)


@pytest.mark.record("VAL", "the motion goes on when its client is gone")
async def test_a_motion_goes_on_when_its_client_is_gone():
    async with records() as (running, made):
        client = asyncio.create_task(put(made, "T:x", 2.0))
        await running.until("x", lambda state: state.moving is Moving.YES)
        client.cancel()
        await shows(made, "T:x.DMOV", 1)

        assert made.variables["T:x.RBV"].value == pytest.approx(2, abs=0.02)


@pytest.mark.record("SPMG", "in Stop and Pause the motor decelerates to a stop, and does not move")
async def test_spmg_halts_and_refuses_and_go_starts_nothing():
    async with records() as (running, made):
        moving = asyncio.create_task(put(made, "T:x", 50.0))
        await running.until("x", lambda state: state.moving is Moving.YES)
        await put(made, "T:x.SPMG", "Pause")
        await moving
        with pytest.raises(WrongState, match="SPMG"):
            await put(made, "T:x", 1.0)
        await put(made, "T:x.SPMG", 3)
        await asyncio.sleep(2)

        assert (await running.client.state("x")).moving is Moving.NO


@pytest.mark.parametrize(("field", "value"), [("STOP", 1), ("SPMG", "Pause"), ("SPMG", "Stop")])
@pytest.mark.sweep(2)
async def test_a_move_that_waits_for_the_end_of_a_jog_does_not_begin_after_a_stop(field: str, value: float | str):
    async with records() as (running, made):
        await put(made, "T:x.JVEL", 2.0)
        await put(made, "T:x.JOGF", 1)
        await running.until("x", lambda state: state.moving is Moving.YES)
        moving = asyncio.create_task(put(made, "T:x", 40.0))
        await asyncio.sleep(0)
        await put(made, f"T:x.{field}", value)
        with suppress(WrongState):
            await moving
        await shows(made, "T:x.DMOV", 1)
        await asyncio.sleep(3)

        assert made.variables["T:x.RBV"].value < 5
        assert (await running.client.state("x")).moving is Moving.NO


@pytest.mark.long
async def test_a_stop_right_after_a_put_leaves_the_axis_at_rest():
    async with records() as (running, made):
        for turns in range(1, 13):
            began = made.variables["T:x.RBV"].value
            moving = asyncio.create_task(put(made, "T:x", 50.0 if began < 0 else -50.0))
            for _ in range(turns):
                await asyncio.sleep(0)
            await put(made, "T:x.STOP", 1)
            await moving
            await asyncio.sleep(1)

            assert made.variables["T:x.RBV"].value == pytest.approx(began, abs=3), turns
            assert (await running.client.state("x")).moving is Moving.NO


@pytest.mark.long
async def test_tweaks_homing_and_set_mode():
    async with records() as (running, made):
        await put(made, "T:x.TWV", 0.5)
        await put(made, "T:x.TWF", 1)
        await put(made, "T:x.TWR", 1)
        await put(made, "T:x.TWR", 1)
        assert made.variables["T:x.RBV"].value == pytest.approx(-0.5, abs=0.02)
        assert made.variables["T:x.HVEL"].value == 1  # as it is configured
        await put(made, "T:x.HOMF", 1)
        await put(made, "T:x.SET", "Set")
        await put(made, "T:x", 7.0)
        await put(made, "T:x.SET", "Use")
        await asyncio.sleep(0.5)

        assert made.variables["T:x.RBV"].value == pytest.approx(7, abs=0.02)
        assert (await running.client.state("x")).moving is Moving.NO


async def test_a_put_that_says_where_the_motor_is_returns_when_the_record_shows_it():
    shown = []
    async with records() as (_, made):
        await put(made, "T:x.SET", "Set")
        for target in (1.0, 3.0) * 5:
            await put(made, "T:x", target)
            shown.append(tuple(made.variables[f"T:x{name}"].value for name in ("", ".RBV", ".DIFF")))

    assert [target for target, _, _ in shown] == [1.0, 3.0] * 5
    assert [place for _, place, _ in shown] == pytest.approx([1.0, 3.0] * 5, abs=0.02)
    assert [left for _, _, left in shown] == pytest.approx([0.0] * 10, abs=0.02)


@pytest.mark.record(
    "STOP", "when the motor has stopped, VAL is RBV, as after Stop in SPMG, a jog, and what another program did"
)
@pytest.mark.parametrize("ending", ["STOP", "SPMG", "jog", "stop from elsewhere", "another program", "power"])
@pytest.mark.sweep(2)
async def test_a_relative_move_begins_where_the_axis_is_whatever_has_moved_or_stopped_it(ending: str):
    async with records() as (running, made):
        moving = asyncio.create_task(put(made, "T:x", 50.0))
        await running.until("x", lambda state: state.moving is Moving.YES)
        await asyncio.sleep(0.5)
        match ending:
            case "STOP":
                await put(made, "T:x.STOP", 1)
            case "SPMG":
                await put(made, "T:x.SPMG", "Stop")
                await put(made, "T:x.SPMG", "Go")
            case "jog":
                await put(made, "T:x.JVEL", 2.0)
                await put(made, "T:x.JOGR", 1)
                await asyncio.sleep(0.5)
                await put(made, "T:x.JOGR", 0)
            case "stop from elsewhere":
                await running.client.stop("x")
                await running.until("x", lambda state: state.moving is Moving.NO)
                lease = await running.client.ask(Acquire(client="ann", axes=("x",), force=True, lease_s=60))
                await running.client.command("x", Reset(lease=lease.lease))
            case "another program":
                lease = await running.client.ask(Acquire(client="ann", axes=("x",), force=True, lease_s=60))
                await running.until("x", lambda state: state.moving is Moving.NO)
                await running.client.command("x", MoveAbsolute(position=4.0, lease=lease.lease))
            case _:
                await put(made, "T:x.CNEN", "Disable")
        with suppress(LdcndError):
            await moving
        state = await running.until("x", lambda state: state.moving is Moving.NO and state.command is None)
        await asyncio.sleep(0.5)

        shaft = made.variables["T:x.RBV"].value
        assert 0 < shaft < 30
        assert made.variables["T:x.VAL"].value == pytest.approx(shaft, abs=AT_REST)
        assert state.target is None or state.target == pytest.approx(shaft, abs=AT_REST)
        assert (state.target is None) == (ending == "power")


@pytest.mark.record("TWF", "it moves on by TWV from VAL, none is lost, and it is reset to 0")
@pytest.mark.parametrize(
    ("step", "count", "pause_s"), [(0.1, 50, 0.0), (0.1, 20, 0.02), (1.0, 6, 0.03), (0.002, 20, 0.001)]
)
@pytest.mark.sweep(2)
async def test_no_tweak_is_lost_however_quick_they_are(step: float, count: int, pause_s: float):
    async with records() as (running, made):
        await put(made, "T:x.TWV", step)
        tweaks = []
        for _ in range(count):
            tweaks.append(asyncio.create_task(put(made, "T:x.TWF", 1)))
            await asyncio.sleep(pause_s)
        await asyncio.gather(*tweaks)
        await running.until("x", lambda state: state.moving is Moving.NO and state.command is None)

        assert made.variables["T:x.VAL"].value == pytest.approx(step * count)
        assert (await running.client.position("x")).value == pytest.approx(step * count, abs=0.02)


@pytest.mark.long
async def test_a_tweak_beyond_the_limit_leaves_the_target_of_those_before_it():
    async with records() as (running, made):
        await put(made, "T:x", 99.0)
        await put(made, "T:x.TWV", 0.4)
        results = await asyncio.gather(*(put(made, "T:x.TWF", 1) for _ in range(4)), return_exceptions=True)
        await running.until("x", lambda state: state.moving is Moving.NO and state.command is None)

        assert [type(result) for result in results] == [type(None), type(None), PositionLimit, PositionLimit]
        assert made.variables["T:x.VAL"].value == pytest.approx(99.8)
        assert (await running.client.position("x")).value == pytest.approx(99.8, abs=0.02)


async def test_control_that_another_program_takes_ends_puts_until_it_is_free():
    async with records() as (running, made):
        taken = await running.client.ask(Acquire(client="ann", axes=("x",), force=True, lease_s=60))
        async with asyncio.timeout(20):
            while made.variables["T:x:control"].value == "epics gateway":
                await asyncio.sleep(0.1)
        with pytest.raises(LeaseRequired):
            await put(made, "T:x", 1.0)
        await put(made, "T:x.STOP", 1)

        assert (await running.client.state("x")).stop_latched
        assert taken.client == "ann"


async def test_a_daemon_that_says_nothing_leaves_no_axis_that_has_arrived():
    async with records(moves=False) as (running, made):
        running.daemon.end()
        await shows(made, "T:x.SEVR", "INVALID")

        assert made.variables["T:x.DMOV"].value == 0
        measured = {"T:x:velocity", "T:x:adc", "T:x:condition"}
        shown = {name: field.severity for name, field in made.variables.items() if name.startswith("T:x.")}
        shown |= {name: made.variables[name].severity for name in measured}
        assert {name for name, severity in shown.items() if severity != AlarmSeverity.INVALID_ALARM} == set()


@pytest.mark.record("SEVR", "a client may ask any field for it")
async def test_every_field_of_a_record_carries_its_alarm_from_before_the_first_sample_on():
    async with records() as (running, made):
        severities = {name: [] for name in ("T:x.VAL", "T:x.VELO", "T:x.DMOV", "T:x:condition")}
        for name, seen in severities.items():
            field = made.variables[name]
            field.followers.append(lambda seen=seen, field=field: seen.append(field.severity))
        await running.client.stop()
        await shows(made, "T:x.SEVR", "MINOR")
        while any(AlarmSeverity.MINOR_ALARM not in seen for seen in severities.values()):
            await asyncio.sleep(0.01)
        await running.until("x", lambda state: state.stop_latched and state.state is not AxisState.STOPPING)
        await put(made, "T:x:reset", 1)
        await shows(made, "T:x.SEVR", "NO_ALARM")

        assert {made.variables[name].severity for name in severities} == {AlarmSeverity.NO_ALARM}


@pytest.mark.long
async def test_an_axis_of_a_gateway_that_idles_can_be_reset_by_others():
    async with records() as (running, made):
        await put(made, "T:x", 2.0)
        await running.client.stop()
        held = await running.client.ask(ListHolders())
        with pytest.raises(LeaseHeld):
            await running.client.command("x", Reset())
        await asyncio.sleep(31)
        await running.client.command("x", Reset())
        released = await running.client.ask(ListHolders())
        await put(made, "T:x", 3.0)

        assert [holder.axis for holder in held.holders if holder.client] == ["x"]
        assert not any(holder.client for holder in released.holders)
        assert made.variables["T:x.RBV"].value == pytest.approx(3, abs=0.02)
        assert made.variables["T:x:control"].value == "epics gateway"


async def test_a_latch_is_cleared_by_a_put_and_nothing_moves():
    async with records() as (running, made):
        moving = asyncio.create_task(put(made, "T:x", 50.0))
        await running.until("x", lambda state: state.moving is Moving.YES)
        await running.client.stop()
        with suppress(CommandAborted, StopLatched):
            await moving
        await running.until("x", lambda state: state.moving is Moving.NO)
        stands = (await running.client.position("x")).value
        with pytest.raises(StopLatched):
            await put(made, "T:x", stands + 1)
        await put(made, "T:x:reset", 1)
        state = await running.until("x", lambda state: not state.stop_latched)
        await asyncio.sleep(2)

        assert state.moving is Moving.NO
        assert (await running.client.position("x")).value == pytest.approx(stands, abs=AT_REST)
        assert made.variables["T:x:reset"].value == 0
        await put(made, "T:x.TWF", 1)
        assert made.variables["T:x.RBV"].value == pytest.approx(stands + 1, abs=AT_REST)


@pytest.mark.parametrize("starting", ["VAL", "TWF", "JOGF", "HOMF"])
@pytest.mark.parametrize("ending", ["STOP", "SPMG", "release"])
@pytest.mark.sweep(12)
async def test_what_is_halted_while_control_is_on_its_way_does_not_begin(starting: str, ending: str):
    async with records() as (running, made):
        await put(made, "T:x.HVEL", 1.0)
        await asyncio.sleep(31)  # control was given back
        moving = asyncio.create_task(put(made, f"T:x.{starting}", 5.0 if starting == "VAL" else 1))
        await asyncio.sleep(0)
        if ending == "release":
            await put(made, "T:x.JOGF" if starting == "JOGF" else "T:x.STOP", 0 if starting == "JOGF" else 1)
        else:
            await put(made, f"T:x.{ending}", "Stop" if ending == "SPMG" else 1)
        with suppress(WrongState):
            await moving
        await asyncio.sleep(3)

        assert made.variables["T:x.RBV"].value == pytest.approx(0, abs=AT_REST)
        assert (await running.client.state("x")).moving is Moving.NO


async def test_where_an_axis_was_sent_is_none_of_a_later_run_of_its_daemon_with_an_earlier_clock():
    off_s = [0.0]
    async with running_rig(two_axes(), clock_off_s=lambda: off_s[0]) as running:
        await running.until("x", lambda state: state.link is LinkState.UP)
        rig = Rig(running.client, await running.client.daemon())
        async with gateway(rig, prefix="T:", moves=("x",)) as made:
            await shows(made, "T:x.SEVR", "NO_ALARM")
            await put(made, "T:x.CNEN", "Enable")
            await put(made, "T:x", 60.0)
            off_s[0] = -3600.0
            await running.begin_anew(2.0, killed=True)
            await running.until("x", lambda state: state.link is LinkState.UP)
            async with rig.control("x", client="ann") as x:
                await x.power(on=True)
                await x.set_position(20.0)  # nothing proves to this run where the axis is
                await (await x.move_absolute(15.0)).done()
            place, target = made.variables["T:x.RBV"], made.variables["T:x.VAL"]
            async with asyncio.timeout(30):
                while abs(place.value - 15.0) > AT_REST:
                    await asyncio.sleep(0.01)
            assert target.value == pytest.approx(15.0, abs=AT_REST)
            await put(made, "T:x.RLV", 1.0)

            assert place.value == pytest.approx(16.0, abs=AT_REST)


async def test_limits_and_velocities_follow_a_reload():
    async with records() as (running, made):
        await put(made, "T:x.VELO", 30.0)
        config = two_axes()
        (bus,) = config.bus
        limits = AxisLimits(position_min=-5, position_max=6, velocity=10)
        x = bus.axis[0].model_copy(update={"limits": limits, "velocity": 4.0})
        changed = config.model_copy(update={"bus": (bus.model_copy(update={"axis": (x, *bus.axis[1:])}),)})
        running.daemon.reconfigure(changed, plan_rig(changed))
        await shows(made, "T:x.HLM", 6)
        await asyncio.sleep(0.1)
        target = made.variables["T:x.VAL"]

        shown = {name: made.variables[f"T:x.{name}"].value for name in ("LLM", "DHLM", "VMAX", "EGU", "SPMG")}
        assert shown == {"LLM": -5, "DHLM": 6, "VMAX": 10, "EGU": "mm", "SPMG": "Go"}
        assert made.variables["T:x.VELO"].value == pytest.approx(4, rel=0.01)
        assert (target.lower_ctrl_limit, target.upper_ctrl_limit) == (-5, 6)
        with pytest.raises(ValueOutOfRange):
            await put(made, "T:x.VELO", 20.0)


async def test_what_was_put_stays_where_others_follow_new_defaults():
    async with records() as (running, made):
        await put(made, "T:x.TWV", 0.25)
        await put(made, "T:x.VELO", 3.0)
        config = two_axes()
        (bus,) = config.bus
        x = bus.axis[0].model_copy(update={"velocity": 4.0})
        changed = config.model_copy(update={"bus": (bus.model_copy(update={"axis": (x, *bus.axis[1:])}),)})
        running.daemon.reconfigure(changed, plan_rig(changed))
        async with asyncio.timeout(30):
            while made.variables["T:x.JVEL"].value != pytest.approx(4, rel=0.01):
                await asyncio.sleep(0.1)

        shown = [made.variables[f"T:x.{name}"].value for name in ("TWV", "VELO", "BVEL")]
        assert shown == [0.25, 3.0, 3.0]


async def test_a_daemon_with_another_unit_is_not_moved_by_numbers_of_the_former_one():
    broker = MemoryBroker()
    loop = asyncio.get_running_loop()

    @asynccontextmanager
    async def life(instance: str, unit: str):
        config = two_axes()
        (bus,) = config.bus
        axes = tuple(axis.model_copy(update={"unit": unit}) for axis in bus.axis)
        config = config.model_copy(update={"bus": (bus.model_copy(update={"axis": axes}),)})
        async with broker.session() as session, asyncio.TaskGroup() as group:
            daemon = build_daemon(config, session, lambda: EPOCH_NS + round(loop.time() * 1e9), instance)
            running = group.create_task(daemon.run(), name=instance)
            await daemon.wait_up()
            yield
            daemon.end()
            await running

    async with broker.session() as session, AsyncExitStack() as faces:
        client = RigClient(session, "sim")
        async with life("first", "um"):
            rig = Rig(client, await client.daemon())
            made = await faces.enter_async_context(gateway(rig, prefix="T:", moves=rig.axes))
            await shows(made, "T:x.SEVR", "NO_ALARM")
            await put(made, "T:x.CNEN", "Enable")
            await put(made, "T:x", 1.0)
        async with life("second", "mm"):
            await shows(made, "T:x.EGU", "mm")
            await shows(made, "T:x.SEVR", "NO_ALARM")
            await put(made, "T:x.CNEN", "Enable")
            with pytest.raises(WrongState, match="SPMG"):
                await put(made, "T:x", 50.0)
            await put(made, "T:x.TWF", 0)
            stands = (await client.position("x")).value
            await put(made, "T:x.SPMG", "Go")
            await put(made, "T:x", stands + 2)

            assert stands == pytest.approx(0, abs=2)
            assert made.variables["T:x"].units == "mm"
            assert made.variables["T:x.RBV"].units == "mm"
            assert made.variables["T:x.VELO"].units == "mm/s"
            assert (await client.position("x")).value == pytest.approx(stands + 2, abs=0.02)


@pytest.mark.long
async def test_no_value_of_a_daemon_with_another_unit_is_shown_in_the_unit_of_the_former_one():
    broker = MemoryBroker()
    seen: list[tuple[str, float, str, AlarmSeverity]] = []

    def follow(name: str, field) -> None:
        field.followers.append(lambda: seen.append((name, field.value, field.units, field.severity)))

    def config(unit: str, per: float) -> RigConfig:
        document = two_axes().model_dump(mode="json", exclude_unset=True)
        for axis in document["bus"][0]["axis"]:
            axis |= {"unit": unit, "counts_per_unit": 1000 / per, "velocity": 5 * per, "acceleration": 50 * per}
            axis["limits"] = {"position_min": -100 * per, "position_max": 100 * per, "velocity": 50 * per}
        return RigConfig.model_validate(document)

    async with broker.session() as session, AsyncExitStack() as faces:
        client = RigClient(session, "sim")
        async with running_rig(config("mm", 1), broker=broker) as first:
            await first.until("x", lambda state: state.link is LinkState.UP)
            rig = Rig(client, await client.daemon())
            made = await faces.enter_async_context(gateway(rig, prefix="T:", moves=rig.axes))
            await shows(made, "T:x.SEVR", "NO_ALARM")
            await put(made, "T:x.CNEN", "Enable")
            await put(made, "T:x.MDEL", 0.001)
            await put(made, "T:x", 6.0)
            await put(made, "T:x.CNEN", "Disable")
            for name in ("VAL", "RBV", "HLM", "VELO", "JVEL", "DIFF"):
                follow(name, made.variables[f"T:x.{name}"])
            follow("velocity", made.variables["T:x:velocity"])
        async with running_rig(config("um", 1000), broker=broker) as second:
            await second.until("x", lambda state: state.link is LinkState.UP)
            async with rig.control("x", client="ann") as x:  # before the gateway has described it anew
                await x.power(on=True)
                await (await x.move_absolute(7000)).done()
            await shows(made, "T:x.EGU", "um")
            await shows(made, "T:x.SEVR", "NO_ALARM")
            await asyncio.sleep(2)
            target, speed = made.variables["T:x"], made.variables["T:x.VELO"]
            control = {name: made.variables[f"T:x.{name}"].upper_ctrl_limit for name in ("VAL", "RBV")}
            shown = (target.value, made.variables["T:x.RBV"].value, speed.value, made.variables["T:x.MDEL"].value)

    good = [each for each in seen if each[3] != AlarmSeverity.INVALID_ALARM]
    in_mm, in_um = ([each for each in good if each[2].startswith(unit)] for unit in ("mm", "um"))
    assert [each for each in in_mm if each[1] > 150] == []
    assert [each for each in in_um if each[0] in ("HLM", "VELO", "JVEL") and each[1] < 1000] == []
    assert [each for each in in_um if each[0] in ("VAL", "RBV") and 5.9 < each[1] < 6.1] == []
    assert shown == (7000, pytest.approx(7000, abs=20), pytest.approx(5000, rel=0.01), 0)
    assert speed.severity == AlarmSeverity.NO_ALARM
    assert control == {"VAL": 100_000, "RBV": 100_000}


async def test_an_axis_that_a_restart_brings_is_shown_and_one_that_it_takes_away_is_invalid():
    broker, loop = MemoryBroker(), asyncio.get_running_loop()

    @asynccontextmanager
    async def life(instance: str, *names: str):
        config = two_axes()
        (bus,) = config.bus
        axes = tuple(each.model_copy(update={"name": name}) for each, name in zip(bus.axis, names, strict=True))
        config = config.model_copy(update={"bus": (bus.model_copy(update={"axis": axes}),)})
        async with broker.session() as session, asyncio.TaskGroup() as group:
            daemon = build_daemon(config, session, lambda: EPOCH_NS + round(loop.time() * 1e9), instance)
            running = group.create_task(daemon.run(), name=instance)
            await daemon.wait_up()
            yield
            daemon.end()
            await running

    async with broker.session() as session, AsyncExitStack() as faces:
        client = RigClient(session, "sim")
        async with life("first", "x", "y"):
            rig = Rig(client, await client.daemon())
            made = await faces.enter_async_context(gateway(rig, prefix="T:", moves=("x", "y")))
            await shows(made, "T:y.SEVR", "NO_ALARM")
            await put(made, "T:y.VELO", 3.0)
        async with life("second", "x", "new"):
            async with asyncio.timeout(30):
                while "T:new.VAL" not in made.variables:
                    await asyncio.sleep(0.1)
            await shows(made, "T:new.SEVR", "NO_ALARM")
            await shows(made, "T:y.SEVR", "INVALID")
            with pytest.raises(LdcndError):
                await put(made, "T:y", 1.0)
            await put(made, "T:new.CNEN", "Enable")
            await put(made, "T:new", 2.0)

            assert (await client.position("new")).value == pytest.approx(2, abs=0.02)
            assert made.variables["T:y.VELO"].value == 3.0


@pytest.mark.parametrize("seed", range(1))
async def test_no_puts_move_an_axis_of_a_read_only_gateway(seed: int):
    rng = random.Random(seed)
    async with records(moves=False) as (running, made):
        before = await running.client.ask(ReadEvents(count=1))
        names = sorted(made.variables)
        for name in [*names, *(rng.choice(names) for _ in range(30))]:
            assert made.variables[name].check_access("host", "user") == AccessRights.READ
            with pytest.raises(Forbidden):
                await put(made, name, rng.choice(VALUES))
            with pytest.raises(PermissionError):
                await made.variables[name].write(rng.choice(VALUES))
        after = await running.client.ask(ReadEvents(count=1))

    assert after.end_number == before.end_number  # no command has reached the daemon
