"""Rules of the motor record's documentation, each with its test; `docs/reference/motor-record.md` is made of them."""

import asyncio
from contextlib import suppress
from itertools import pairwise

import pytest
from caproto import AccessRights, AlarmSeverity, ChannelType, SubscriptionType

from ldcnd.client.axis import Axis
from ldcnd.config.plan import plan_rig
from ldcnd.contract.errors import CommandAborted, LdcndError, PositionLimit, StopLatched, WrongState
from ldcnd.contract.samples import Moving
from ldcnd.lab.epics.record import MotorRecord
from ldcnd.testing.rig import lines_of
from tests.support.epics_records import monitored, put, records, shows
from tests.support.rig import two_axes

DONE, CLOSED, ENCODER, MOVING, SUPPORT, HOMED, PLUS = 0x2, 0x20, 0x100, 0x400, 0x800, 0x4000, 0x1
ALWAYS = ENCODER | SUPPORT | HOMED
NO_COMMUNICATION = 0x1000
AT_INDEX = 0x80
"""Comes and goes as the motor turns."""


def values(made, *fields):
    return tuple(made.variables[f"T:x.{field}"].value for field in fields)


@pytest.mark.record(
    "MSTA",
    "bit 1 is the last direction, 2 done, 6 closed loop enabled, 9 encoder, 11 moving, 12 gain support, 15 homed",
)
async def test_the_status_word_has_the_bits_of_its_documentation():
    async with records(power=False) as (_, made):

        async def becomes(*bits, hides=0):
            async with asyncio.timeout(30):
                while made.variables["T:x.MSTA"].value & ~(AT_INDEX | hides) != sum(bits) | ALWAYS:
                    await asyncio.sleep(0.05)

        await becomes(DONE)
        await put(made, "T:x.CNEN", "Enable")
        await becomes(DONE, CLOSED, hides=PLUS)
        for target, direction in ((20.0, PLUS), (0.0, 0)):
            moving = asyncio.create_task(put(made, "T:x", target))
            await becomes(MOVING, CLOSED, direction)
            await moving
            await becomes(DONE, CLOSED, hides=PLUS)  # a loop that settles goes to and fro


@pytest.mark.record("SPMG", "with Move it falls back to Pause when a motion completes, and nothing moves in Pause")
async def test_move_is_for_one_motion():
    async with records() as (_, made):
        await put(made, "T:x.SPMG", "Move")
        await put(made, "T:x", 2.0)
        assert values(made, "SPMG", "DMOV") == ("Pause", 1)
        with pytest.raises(WrongState, match="SPMG"):
            await put(made, "T:x", 3.0)

        assert made.variables["T:x.RBV"].value == pytest.approx(2, abs=0.02)


@pytest.mark.record("RLV", "its value is added to VAL and it is reset to 0")
async def test_a_relative_value_is_added_to_the_target():
    async with records() as (_, made):
        first = asyncio.create_task(put(made, "T:x.RLV", 2.0))
        await asyncio.sleep(0)
        await asyncio.gather(first, put(made, "T:x.RLV", 0.5), put(made, "T:x.RLV", -1.0))

        assert values(made, "VAL", "RLV") == (1.5, 0.0)
        assert made.variables["T:x.RBV"].value == pytest.approx(1.5, abs=0.02)


@pytest.mark.record("DMOV", "it posts 1, 0, 1 when the motor is commanded to move, even to where it is")
async def test_a_move_to_the_present_position_is_a_pulse_of_done():
    async with records() as (_, made):
        await put(made, "T:x", 1.0)
        sent = await monitored(made, "T:x.DMOV")
        await put(made, "T:x", 1.0)

        assert [sent.get_nowait().values[0] for _ in range(sent.qsize())] == [1, 0, 1]


@pytest.mark.record("DIFF", "it is DVAL less DRBV; RDIF is the same in steps, and RVAL less RRBV")
async def test_the_difference_is_that_of_the_target():
    async with records() as (_, made):
        moving = asyncio.create_task(put(made, "T:x", 20.0))
        for _ in range(20):
            await asyncio.sleep(0.05)
            target, here, difference, steps, raw, counts = values(made, "DVAL", "DRBV", "DIFF", "RDIF", "RVAL", "RRBV")
            assert difference == pytest.approx(target - here)
            assert (steps, raw - counts) == (round(difference * 1000), steps)
        await moving

        assert abs(made.variables["T:x.DIFF"].value) < 0.02


@pytest.mark.record("HOMF", "it is 1 until the homing is over, which a put with completion waits for; VAL is RBV then")
@pytest.mark.record("HVEL", "it is the velocity of the search that is configured, until another one is put")
async def test_a_homing_shows_and_ends():
    async with records() as (running, made):
        assert made.variables["T:x.HVEL"].value == 1
        homing = asyncio.create_task(put(made, "T:x.HOMF", 1))
        await shows(made, "T:x.HOMF", 1)
        await shows(made, "T:x.DMOV", 0)
        await homing
        state = await running.client.state("x")

        assert values(made, "HOMF", "DMOV") == (0, 1)
        assert state.referenced
        assert made.variables["T:x.VAL"].value == pytest.approx(made.variables["T:x.RBV"].value, abs=0.02)


@pytest.mark.record("MISS", "it is 1 after a move that did not settle, until one does")
async def test_a_move_that_does_not_settle_is_a_miss():
    config = two_axes()
    (bus,) = config.bus
    never = bus.axis[0].settle.model_copy(update={"window": 1e-9, "time_s": 0.01, "timeout_s": 0.05})
    axes = (bus.axis[0].model_copy(update={"settle": never}), *bus.axis[1:])
    missing = config.model_copy(update={"bus": (bus.model_copy(update={"axis": axes}),)})
    async with records(config=missing) as (running, made):
        await put(made, "T:x", 1.0)
        assert values(made, "MISS", "DMOV") == (1, 1)
        running.daemon.reconfigure(config, plan_rig(config))
        await put(made, "T:x", 2.0)

        assert values(made, "MISS", "DMOV") == (0, 1)


@pytest.mark.record("ATHM", "it is 1 at the index of the encoder, as bit 8 of MSTA is")
async def test_the_index_of_the_encoder_is_at_home():
    async with records() as (running, made):
        await put(made, "T:x", 0.69)
        await put(made, "T:x.VELO", 0.02)
        sent = await monitored(made, "T:x.ATHM")
        moving = asyncio.create_task(put(made, "T:x", 0.72))
        at_index = []
        while not moving.done():
            at, mask = values(made, "ATHM", "MSTA")
            if at and mask & AT_INDEX:
                at_index.append((await running.client.position("x")).counts)
            await asyncio.sleep(0.01)
        await moving

        assert at_index
        assert 698 <= min(at_index) <= max(at_index) <= 706  # the pulse is four counts wide, from 700 on
        assert [sent.get_nowait().values[0] for _ in range(sent.qsize())][-1] == 0
        assert not values(made, "MSTA")[0] & AT_INDEX


@pytest.mark.record("NAME", "it is the record's, DTYP is family and model of the drive, RRBV its count")
async def test_a_record_says_whose_it_is():
    async with records(moves=False) as (running, made):
        position, (info, _) = await running.client.position("x"), await running.client.axes()

        assert values(made, "NAME", "DTYP") == ("T:x", f"{info.family} {info.model}")
        assert abs(values(made, "RRBV")[0] - position.counts) <= 1


@pytest.mark.record("SSET", "a put sets SET to Set, one to SUSE to Use")
async def test_set_and_use_have_a_field_each():
    async with records() as (_, made):
        await put(made, "T:x.SSET", 1)
        was = made.variables["T:x.SET"].value
        await put(made, "T:x.SUSE", 1)

        assert (was, made.variables["T:x.SET"].value) == ("Set", "Use")


@pytest.mark.record("MDEL", "monitors of RBV are sent only what differs by more from before, archivers by ADEL")
@pytest.mark.parametrize(("values_mm", "archive_mm"), [(2.0, 0.25), (0.25, 2.0)])
async def test_a_deadband_thins_what_monitors_get_and_not_what_is_read(values_mm: float, archive_mm: float):
    async with records() as (_, made):
        await put(made, "T:x.MDEL", values_mm)
        await put(made, "T:x.ADEL", archive_mm)
        masks = {values_mm: SubscriptionType.DBE_VALUE, archive_mm: SubscriptionType.DBE_LOG}
        sent = {each: await monitored(made, "T:x.RBV", ChannelType.DOUBLE, mask) for each, mask in masks.items()}
        await put(made, "T:x", 5.0)
        got = {each: [queue.get_nowait().values[0] for _ in range(queue.qsize())] for each, queue in sent.items()}

        for deadband, of in got.items():
            assert all(abs(after - before) > deadband for before, after in pairwise(of[1:]))
        assert 2 <= len(got[2.0]) <= 4 < len(got[0.25])
        assert made.variables["T:x.RBV"].value == pytest.approx(5, abs=0.02)


@pytest.mark.record("VELO", "S, BVEL and SBAK follow it, BACC follows ACCL")
async def test_speeds_in_steps_follow_those_in_units():
    async with records() as (_, made):
        await put(made, "T:x.VELO", 5.0)
        await put(made, "T:x.ACCL", 0.5)

        assert values(made, "VELO", "S", "BVEL", "SBAK", "BACC") == (5.0, pytest.approx(5000), 5.0, 5000.0, 0.5)


@pytest.mark.record(
    "DISP", "while it is 1, and the record beside it says Disable, puts are refused; those that stop are not"
)
async def test_puts_are_disabled_and_a_stop_is_not():
    async with records() as (running, made):
        moving = asyncio.create_task(put(made, "T:x", 50.0))
        await running.until("x", lambda state: state.moving is Moving.YES)
        await put(made, "T:x_able", "Disable")
        for field, value in (("VAL", 1.0), ("TWF", 1), ("JOGF", 1), ("HOMF", 1), ("RLV", 1.0), ("VELO", 1.0)):
            with pytest.raises(WrongState, match="disabled"):
                await put(made, f"T:x.{field}", value)
        assert made.variables["T:x.DISP"].value == 1
        await put(made, "T:x.STOP", 1)
        await moving
        await put(made, "T:x.DISP", 0)
        await put(made, "T:x", 1.0)

        assert made.variables["T:x_able"].value == "Enable"
        assert made.variables["T:x.RBV"].value == pytest.approx(1, abs=0.02)


@pytest.mark.parametrize("refusal", ["disabled", "paused", "beyond"])
@pytest.mark.sweep(2)
async def test_a_motion_that_is_refused_ends_with_an_alarm_until_a_put_is_taken(refusal):
    """A client that waits for DMOV alone looks at the alarm of RBV then, and would say that it has arrived."""
    async with records() as (_, made):
        if refusal == "disabled":
            await put(made, "T:x.CNEN", "Disable")
            await shows(made, "T:x.CNEN", "Disable")
        elif refusal == "paused":
            await put(made, "T:x.SPMG", "Pause")
        await asyncio.sleep(1.0)
        sent = await monitored(made, "T:x.DMOV")
        with pytest.raises(LdcndError):
            await put(made, "T:x", 3.0 if refusal != "beyond" else 1000.0)

        assert [sent.get_nowait().values[0] for _ in range(sent.qsize())][-2:] == [0, 1]
        assert made.variables["T:x.RBV"].alarm.severity == AlarmSeverity.MINOR_ALARM
        await put(made, "T:x.TWV", 2.0)
        assert made.variables["T:x.RBV"].alarm.severity == AlarmSeverity.NO_ALARM


@pytest.mark.record("STOP", "`allstop` is one for all records of the gateway")
async def test_a_stop_of_all_halts_each_axis():
    async with records() as (running, made):
        await put(made, "T:y.CNEN", "Enable")
        await shows(made, "T:y.CNEN", "Enable")
        moving = [asyncio.create_task(put(made, f"T:{axis}", 50.0)) for axis in ("x", "y")]
        for axis in ("x", "y"):
            await running.until(axis, lambda state: state.moving is Moving.YES)
        await put(made, "T:allstop", 1)
        await asyncio.gather(*moving)
        states = [await running.until(axis, lambda state: state.moving is Moving.NO) for axis in ("x", "y")]

        assert not any(state.stop_latched for state in states)
        assert all(abs(made.variables[f"T:{axis}.RBV"].value) < 25 for axis in ("x", "y"))
        assert made.variables["T:y.VAL"].value == pytest.approx(made.variables["T:y.RBV"].value, abs=0.05)


@pytest.mark.record("STAT", "it is COMM or STATE and an enumeration, as SEVR is")
@pytest.mark.record("UDF", "it is 1 before a position is known")
async def test_alarms_are_enumerations():
    async with records() as (running, made):
        status, severity = made.variables["T:x.STAT"], made.variables["T:x.SEVR"]
        info = (await running.client.axes())[0]
        assert {status.data_type, severity.data_type} == {ChannelType.ENUM}
        assert (status.raw_value, severity.raw_value, made.variables["T:x.UDF"].value) == (0, 0, 0)
        await running.client.stop("x")
        await shows(made, "T:x.STAT", "STATE")
        assert not made.variables["T:x.MSTA"].value & NO_COMMUNICATION
        running.daemon.end()
        await shows(made, "T:x.STAT", "COMM")

        assert (status.raw_value, severity.raw_value) == (9, 3)
        assert made.variables["T:x.MSTA"].value & NO_COMMUNICATION
        unknown = MotorRecord(info, None)
        assert (unknown["UDF"].value, unknown["UDF"].severity) == (1, AlarmSeverity.INVALID_ALARM)


async def test_puts_that_do_not_wait_take_effect_in_their_order(monkeypatch):
    power = Axis.power

    async def late(axis, *, on):
        await asyncio.sleep(0.1)  # a query may overtake another one
        return await power(axis, on=on)

    monkeypatch.setattr(Axis, "power", late)
    async with records(power=False) as (running, made):
        await running.client.stop("x")
        await running.until("x", lambda state: state.stop_latched)
        puts = (("T:x-ErrRst", 1), ("T:x.CNEN", "Enable"), ("T:x.HOMF", 1))
        async with asyncio.TaskGroup() as group:
            for name, value in puts:
                group.create_task(put(made, name, value))
                await asyncio.sleep(0)

        assert (await running.client.state("x")).enabled
        assert made.variables["T:x:message"].value == ""


async def test_an_axis_that_moves_has_no_message_but_an_error_as_nicos_takes_one_with_it_for_one_that_has_arrived():
    async with records() as (running, made):
        said, done = made.variables["T:x-MsgTxt"], made.variables["T:x.DMOV"]

        async def look_until_it_rests() -> set[tuple[int, str]]:
            seen = {(done.value, said.value)}
            while (await running.client.state("x")).moving is not Moving.NO:
                await asyncio.sleep(0.01)
                seen.add((done.value, said.value))
            await shows(made, "T:x.DMOV", 1)
            return seen

        homing = asyncio.create_task(put(made, "T:x.HOMF", 1))
        await shows(made, "T:x.DMOV", 0)
        seen = await look_until_it_rests()
        await homing
        moving = asyncio.create_task(put(made, "T:x", 90.0))
        await running.until("x", lambda state: state.moving is Moving.YES)
        await running.client.stop()
        await running.until("x", lambda state: state.stop_latched)
        seen |= await look_until_it_rests()
        with suppress(CommandAborted, StopLatched):
            await moving
        await shows(made, "T:x-MsgTxt", "stop latched")

        assert {message for is_done, message in seen if not is_done} == {""}


async def test_errors_are_shown_and_cleared_as_nicos_does():
    async with records() as (running, made):
        moving = asyncio.create_task(put(made, "T:x", 50.0))
        await running.until("x", lambda state: state.moving is Moving.YES)
        assert (made.variables["T:x-Err"].value, made.variables["T:x-MsgTxt"].value) == (0, "")
        await running.client.stop()
        with suppress(CommandAborted, StopLatched):
            await moving
        await shows(made, "T:x-Err", 1)
        assert "latched" in made.variables["T:x-MsgTxt"].value
        await put(made, "T:x-ErrRst", 1)
        await shows(made, "T:x-Err", 0)

        assert (await running.client.state("x")).moving is Moving.NO


@pytest.mark.parametrize("unit", ["degrees", "counts of it", "\u03bcm", "°"])
@pytest.mark.sweep(2)
async def test_a_unit_of_any_length_can_be_read(unit: str):
    config = two_axes()
    (bus,) = config.bus
    axes = tuple(axis.model_copy(update={"unit": unit}) for axis in bus.axis)
    config = config.model_copy(update={"bus": (bus.model_copy(update={"axis": axes}),)})
    async with records(moves=False, config=config) as (_, made):
        for name, field in made.variables.items():
            control = {ChannelType.DOUBLE: ChannelType.CTRL_DOUBLE, ChannelType.CHAR: ChannelType.CTRL_CHAR}
            await field.read(control.get(field.data_type, field.data_type))
            assert field.check_access("host", "user") == AccessRights.READ, name
        metadata, _ = await made.variables["T:x.VELO"].read(ChannelType.CTRL_DOUBLE)

        assert f"{unit}/s".encode().startswith(metadata.units)
        assert len(metadata.units) > 0


async def test_a_refused_target_leaves_the_one_before():
    async with records() as (_, made):
        await put(made, "T:x", 5.0)
        with pytest.raises(PositionLimit):
            await put(made, "T:x.RLV", 1000.0)

        assert values(made, "VAL", "RLV", "LVIO") == (5.0, 0.0, 1)


async def test_a_text_may_carry_a_unit_and_the_velocity_is_in_that_of_people():
    config = two_axes()
    (bus,) = config.bus
    axes = tuple(axis.model_copy(update={"velocity_unit": "m/min"}) for axis in bus.axis)
    config = config.model_copy(update={"bus": (bus.model_copy(update={"axis": axes}),)})
    async with records(config=config) as (_, made):
        await put(made, "T:x", "0.5 cm")
        metadata, _ = await made.variables["T:x:velocity"].read(ChannelType.CTRL_DOUBLE)
        with pytest.raises(ValueError, match="type the value in mm, m, cm, um"):
            await put(made, "T:x", "5 kg")

        assert values(made, "VAL", "RBV") == (5.0, pytest.approx(5.0, abs=0.02))
        assert metadata.units == b"m/min"


@pytest.mark.parametrize("pace_s", [0.0, 0.003, 0.012])
async def test_a_put_that_a_jog_overtakes_leaves_the_motor_done_in_the_end(pace_s: float):
    async with records() as (_, made):
        async with asyncio.TaskGroup() as group:
            group.create_task(put(made, "T:x", -8.0), name="under way")
            await asyncio.sleep(0.3)
            group.create_task(put(made, "T:x", 15.0), name="overtaken")
            await asyncio.sleep(pace_s)
            group.create_task(put(made, "T:x.JOGR", 1), name="jog")
            await asyncio.sleep(1.0)
            await put(made, "T:x.STOP", 1)

        await shows(made, "T:x.DMOV", 1)
        assert values(made, "SEVR", "VAL") == ("NO_ALARM", pytest.approx(made.variables["T:x.RBV"].value, abs=0.05))


@pytest.mark.record("VAL", "of values that are put right behind each other the newest is where the motor goes")
@pytest.mark.parametrize("pace_s", [0.0, 0.005, 0.02])
async def test_of_puts_right_behind_each_other_the_newest_wins(pace_s: float):
    async with records() as (_, made):
        async with asyncio.TaskGroup() as group:
            for goal in (7.0, 7.5, -3.0, 2.0):
                group.create_task(put(made, "T:x", goal), name=f"to {goal}")
                await asyncio.sleep(pace_s)

        assert values(made, "VAL", "DMOV") == (2.0, 1)
        assert made.variables["T:x.RBV"].value == pytest.approx(2, abs=0.02)


IDLE_S = 35.0
"""After so long the gateway has given control back: a put waits until it has it again."""


async def puts(made, *each):
    """Put right behind each other, as a client does that does not wait, and wait for all of them."""
    return await asyncio.gather(*(put(made, f"T:x{name}", value) for name, value in each), return_exceptions=True)


async def idle(made):
    await asyncio.sleep(IDLE_S)
    await shows(made, "T:x:control", "none")


@pytest.mark.record("SET", "a put says where the motor is as long as SET is Set, which counts when it comes")
async def test_a_place_that_is_said_between_set_and_use_moves_nothing_although_control_is_to_be_had_first():
    lines = lines_of(two_axes())
    async with records(chains=lines) as (_, made):
        await idle(made)
        drive = lines["line0"].modules[0]
        drive.catch_up(asyncio.get_running_loop().time())
        before = drive.shaft.position_counts
        await puts(made, (".SET", "Set"), ("", 7.0), (".SET", "Use"))
        await asyncio.sleep(1)
        drive.catch_up(asyncio.get_running_loop().time())

        assert drive.shaft.position_counts == pytest.approx(before, abs=20)
        assert made.variables["T:x.RBV"].value == pytest.approx(7, abs=0.02)
        assert made.variables["T:x.SET"].value == "Use"


@pytest.mark.parametrize(
    ("field", "slow", "fast", "motion"),
    [("VELO", 1.0, 20.0, ("", 3.0)), ("JVEL", 1.0, 20.0, (".JOGF", 1)), ("HVEL", 0.5, 2.0, (".HOMF", 1))],
)
async def test_a_motion_is_as_fast_as_was_put_before_it(field, slow, fast, motion):
    async with records() as (_, made):
        await put(made, f"T:x.{field}", slow)
        await idle(made)
        waiting = asyncio.create_task(puts(made, motion, (f".{field}", fast)))
        await asyncio.sleep(1)
        way = abs(made.variables["T:x.RBV"].value)
        await put(made, "T:x.STOP", 1)
        await waiting

        assert slow / 2 < way < 1.5 * slow


async def test_a_motion_that_is_put_while_nothing_may_move_does_not_begin_by_the_put_behind_it():
    async with records() as (_, made):
        await put(made, "T:x.SPMG", "Stop")
        await idle(made)
        refused, allowed = await puts(made, ("", 5.0), (".SPMG", "Go"))

        assert isinstance(refused, WrongState)
        assert allowed is None
        assert made.variables["T:x.RBV"].value == pytest.approx(0, abs=0.1)


async def test_a_motor_is_off_behind_a_power_off_that_came_after_a_power_on():
    async with records(power=False) as (running, made):
        on, off = await puts(made, (".CNEN", "Enable"), (".CNEN", "Disable"))

        assert isinstance(on, CommandAborted)
        assert off is None
        assert not (await running.client.state("x")).enabled


async def test_a_latch_stays_that_was_set_behind_the_put_of_a_reset():
    async with records() as (running, made):
        await idle(made)
        await running.client.stop("x")
        await shows(made, "T:x-Err", 1)
        reset, stopped = await puts(made, (":reset", 1), (".STOP", 1))

        assert isinstance(reset, CommandAborted)
        assert stopped is None
        assert (await running.client.state("x")).stop_latched
