"""Distances that are put to a motor record, as RLV, TWF and TWR are: each is gone whole, from where it counts."""

import asyncio
import math
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from itertools import pairwise

import pytest

from ldcnd.client.rig import Rig
from ldcnd.contract.commands import Halt
from ldcnd.contract.errors import CommandAborted, LdcndError
from ldcnd.contract.samples import Moving
from ldcnd.lab.epics.gateway import Gateway, gateway
from tests.integration.test_rotary_axes import ENDLESS
from tests.support.dialect_rig import LS_182AP, SC, Dialect, DialectRig, dialect_rig
from tests.support.epics_records import put, shows

MODULO, STEP = 10.0, 2.5
AT_REST = 0.05
TWEAK = ("TWF", 1)
BACK = ("TWR", 1)


@asynccontextmanager
async def record_of(dialect: Dialect, **axis: object) -> AsyncIterator[tuple[DialectRig, Gateway]]:
    """Run a daemon and a gateway on one drive, which is enabled; nothing is in the way of its shaft."""
    async with dialect_rig(dialect, ENDLESS, **axis) as drive:
        rig = Rig(drive.rig.client, await drive.rig.client.daemon())
        async with gateway(rig, prefix="T:", moves=("x",)) as made:
            await shows(made, "T:x.SEVR", "NO_ALARM")
            await put(made, "T:x.CNEN", "Enable")
            await shows(made, "T:x.CNEN", "Enable")
            await put(made, "T:x.TWV", STEP)
            yield drive, made


async def begin(made: Gateway, *puts: tuple[str, float]) -> list["asyncio.Task[None]"]:
    """Put one right behind the other, without waiting for what they do."""
    begun: list[asyncio.Task[None]] = []
    for field, value in puts:
        begun.append(asyncio.create_task(put(made, f"T:x.{field}", value), name=f"{value} to {field}"))
        await asyncio.sleep(0)
    return begun


async def passes(drive: DialectRig, place: float) -> None:
    async with asyncio.timeout(30):
        while drive.position_mm < place:
            await asyncio.sleep(0.01)


def within_a_turn(way: float) -> float:
    return math.remainder(way, MODULO)


@pytest.mark.parametrize("dialect", [LS_182AP, SC], ids=lambda dialect: dialect.name)
@pytest.mark.parametrize(
    ("puts", "ends_at"),
    [
        ([("RLV", 6.0)], 6.0),
        ([("RLV", 10.0)], 10.0),
        ([("RLV", -23.0)], -23.0),
        ([TWEAK] * 3, 3 * STEP),
        ([TWEAK, TWEAK, BACK, ("RLV", 7.0)], STEP + 7.0),
        ([("VAL", 4.0), ("RLV", 9.0)], 13.0),
    ],
)
@pytest.mark.sweep(2)
async def test_a_distance_is_turned_whole_on_an_axis_with_a_modulo(dialect, puts, ends_at):
    async with record_of(dialect, modulo=MODULO) as (drive, made):
        await asyncio.gather(*await begin(made, *puts))

        assert drive.position_mm == pytest.approx(ends_at, abs=AT_REST)
        assert within_a_turn(made.variables["T:x.VAL"].value - ends_at) == pytest.approx(0.0, abs=0.002)
        assert made.variables["T:x.DMOV"].value == 1


@pytest.mark.parametrize("dialect", [LS_182AP, SC], ids=lambda dialect: dialect.name)
@pytest.mark.parametrize(
    ("then", "ends_at"),
    [
        ([TWEAK, TWEAK, TWEAK], 9.0 + 3 * STEP),
        ([BACK, ("RLV", 20.0)], 29.0 - STEP),
        ([TWEAK, BACK], 9.0),
        ([TWEAK, ("VAL", 3.0)], 3.0),
        ([("VAL", 3.0), TWEAK], 3.0 + STEP),
    ],
)
@pytest.mark.sweep(2)
async def test_distances_that_are_put_in_mid_move_count_from_its_end(dialect, then, ends_at):
    async with record_of(dialect, modulo=MODULO) as (drive, made):
        first = await begin(made, ("RLV", 9.0))
        await drive.until(lambda state: state.moving is Moving.YES)
        await asyncio.gather(*first, *await begin(made, *then))
        await drive.until(lambda state: state.moving is Moving.NO and state.command is None)

        off = drive.position_mm - ends_at
        assert (within_a_turn(off) if ("VAL", 3.0) in then else off) == pytest.approx(0.0, abs=AT_REST)
        assert within_a_turn(made.variables["T:x.VAL"].value - ends_at) == pytest.approx(0.0, abs=0.002)
        assert made.variables["T:x.DMOV"].value == 1


@pytest.mark.parametrize("ending", ["STOP", "SPMG", "stop from elsewhere"])
async def test_a_distance_that_waits_for_a_motion_does_not_begin_once_that_was_stopped(ending):
    async with record_of(LS_182AP, modulo=MODULO) as (drive, made):
        first = await begin(made, ("RLV", 9.0))
        await drive.until(lambda state: state.moving is Moving.YES)
        waiting = await begin(made, TWEAK)
        match ending:
            case "STOP":
                await put(made, "T:x.STOP", 1)
            case "SPMG":
                await put(made, "T:x.SPMG", "Stop")
            case _:
                await drive.rig.client.stop("x")
        ended = await asyncio.gather(*first, *waiting, return_exceptions=True)
        await drive.until(lambda state: state.moving is Moving.NO and state.command is None)

        assert [type(each) for each in ended] == [CommandAborted if ending == "stop from elsewhere" else type(None)] * 2
        assert drive.position_mm < 9.0 - AT_REST
        await shows(made, "T:x.DMOV", 1)
        assert made.variables["T:x.VAL"].value == pytest.approx(drive.position_mm, abs=AT_REST)


@pytest.mark.parametrize(
    ("speed", "refused"), [("HVEL", ("HOMF", 1)), ("JVEL", ("JOGF", 1)), ("VELO", ("VAL", 3.0))], ids=str
)
async def test_a_distance_that_waits_for_a_motion_is_gone_though_what_was_to_replace_it_is_refused(speed, refused):
    async with record_of(LS_182AP, modulo=MODULO) as (drive, made):
        first = await begin(made, ("RLV", 9.0))
        await drive.until(lambda state: state.moving is Moving.YES)
        waiting = await begin(made, TWEAK)
        usual = made.variables[f"T:x.{speed}"].value
        await made.variables[f"T:x.{speed}"].show(0.0)
        with pytest.raises(LdcndError):
            await put(made, f"T:x.{refused[0]}", refused[1])
        await made.variables[f"T:x.{speed}"].show(usual)
        await asyncio.gather(*first, *waiting)

        assert drive.position_mm == pytest.approx(9.0 + STEP, abs=AT_REST)
        assert made.variables["T:x.VAL"].value == pytest.approx((9.0 + STEP) % MODULO, abs=0.002)


async def refuse_a_jog(made: Gateway) -> None:
    await made.variables["T:x.JVEL"].show(0.0)
    with pytest.raises(LdcndError):
        await put(made, "T:x.JOGF", 1)


@pytest.mark.parametrize("then", [("VAL", 12.0), ("RLV", -28.0)], ids=["VAL", "RLV"])
async def test_a_jog_that_is_refused_in_mid_move_holds_nothing_up(then):
    async with record_of(LS_182AP, reference="at_reset", velocity=4.0) as (drive, made):
        first = await begin(made, ("VAL", 40.0))
        await passes(drive, 5.0)
        await refuse_a_jog(made)
        going = asyncio.gather(*first, *await begin(made, then))
        seen = [drive.position_mm]
        async with asyncio.timeout(30):
            while not going.done():
                await asyncio.sleep(0.02)
                seen.append(drive.position_mm)
        await going

        assert drive.position_mm == pytest.approx(12.0, abs=AT_REST)
        assert max(seen) < 15.0


async def test_an_end_from_elsewhere_behind_a_jog_that_was_refused_fails_the_put_of_the_motion():
    async with record_of(LS_182AP, reference="at_reset", velocity=4.0) as (drive, made):
        first = await begin(made, ("VAL", 40.0))
        await passes(drive, 5.0)
        await refuse_a_jog(made)
        await drive.send(Halt())
        (ended,) = await asyncio.gather(*first, return_exceptions=True)

        assert isinstance(ended, CommandAborted)
        assert drive.position_mm < 20.0


@pytest.mark.parametrize("modulo", [None, MODULO])
async def test_a_step_behind_a_jog_goes_on_from_where_that_comes_to_rest(modulo):
    async with record_of(LS_182AP, modulo=modulo, velocity=20.0, acceleration=50.0) as (drive, made):
        await put(made, "T:x.TWV", 0.2)
        await put(made, "T:x.JVEL", 20.0)
        await put(made, "T:x.JAR", 50.0)
        async with drive.rig.client.samples("x", "position") as positions:
            await put(made, "T:x.JOGF", 1)
            while (await anext(positions))[1].value < 5.0:
                pass
            stepping = asyncio.create_task(put(made, "T:x.TWF", 1))
            seen = [drive.position_mm]
            while not stepping.done():
                await anext(positions)
                seen.append(drive.position_mm)
            await stepping

        assert min(after - before for before, after in pairwise(seen)) > -0.2, "it has turned round"
        assert made.variables["T:x.VAL"].value == pytest.approx(made.variables["T:x.RBV"].value, abs=AT_REST)
        assert made.variables["T:x.JOGF"].value == 0


@pytest.mark.parametrize(
    "puts",
    [[("VAL", 3.0)], [("RLV", 3.0)], [TWEAK, ("RLV", 0.5)], [TWEAK, TWEAK, TWEAK, BACK, ("RLV", -2.0)]],
    ids=lambda puts: " ".join(field for field, _ in puts),
)
@pytest.mark.record("SET", "with Set puts to VAL, RLV, TWF, TWR say where the motor is; nothing moves")
async def test_with_set_every_target_says_where_the_motor_is(puts):
    async with record_of(LS_182AP) as (drive, made):
        await put(made, "T:x.SSET", 1)
        stands = drive.position_mm
        await asyncio.gather(*await begin(made, *puts))

        assert made.variables["T:x.RBV"].value == pytest.approx(3.0, abs=0.02)
        assert made.variables["T:x.VAL"].value == pytest.approx(3.0, abs=0.02)
        assert made.variables["T:x.DMOV"].value == 1
        assert drive.position_mm == pytest.approx(stands, abs=0.005)


@pytest.mark.parametrize("modulo", [None, 100.0])
@pytest.mark.parametrize("stop", [("STOP", 1), ("SPMG", "Stop")], ids=["STOP", "SPMG"])
@pytest.mark.parametrize("step", [("RLV", 1.0), TWEAK], ids=["RLV", "TWF"])
async def test_a_distance_right_behind_a_stop_counts_from_where_the_axis_comes_to_rest(stop, step, modulo):
    """A client that does not wait for its put: the halt is on its way, and VAL is the target of before it."""
    ramp = {"velocity": 20.0, "acceleration": 20.0}
    async with record_of(LS_182AP, modulo=modulo, reference="at_reset", **ramp) as (drive, made):
        first = await begin(made, ("VAL", 40.0))
        await passes(drive, 10.0)
        behind = asyncio.gather(*first, *await begin(made, stop, *[("SPMG", "Go")] * (stop[0] == "SPMG"), step))
        seen = [drive.position_mm]
        async with asyncio.timeout(30):
            while not behind.done():
                await asyncio.sleep(0.02)
                seen.append(drive.position_mm)
        await behind
        await drive.until(lambda state: state.moving is Moving.NO and state.command is None)

        assert min(after - before for before, after in pairwise(seen)) > -0.2, "it has turned round"
        assert drive.position_mm < seen[0] + 15.0
        assert made.variables["T:x.VAL"].value == pytest.approx(drive.position_mm, abs=AT_REST)


@pytest.mark.parametrize("last", [("VAL", 20.0), ("JOGF", 1)], ids=["VAL", "JOGF"])
async def test_a_distance_right_behind_a_stop_does_not_begin_behind_what_was_put_after_it(last):
    async with record_of(LS_182AP, reference="at_reset") as (drive, made):
        first = await begin(made, ("VAL", 40.0))
        await passes(drive, 5.0)
        behind = await begin(made, ("STOP", 1), TWEAK, last)
        ended = await asyncio.gather(*first, *behind, return_exceptions=True)
        await put(made, "T:x.JOGF", 0)
        await drive.until(lambda state: state.moving is Moving.NO and state.command is None)
        ends = drive.position_mm
        await asyncio.sleep(1.0)

        assert drive.position_mm == pytest.approx(ends, abs=AT_REST)
        assert last[0] == "JOGF" or ends == pytest.approx(20.0, abs=AT_REST)
        assert [type(each) for each in ended] == [type(None), type(None), CommandAborted, type(None)]
        assert (made.variables["T:x.SEVR"].value, made.variables["T:x:message"].value) == ("NO_ALARM", "")


@pytest.mark.parametrize("refused", [("VAL", 60.0), ("HOMF", 1), ("JOGF", 1)], ids=lambda refused: refused[0])
async def test_a_distance_right_behind_a_stop_is_gone_though_what_was_put_after_it_is_refused_and_hides_no_refusal(
    refused,
):
    async with record_of(LS_182AP, reference="at_reset", limits={"position_max": 50.0}) as (drive, made):
        for speed in ("HVEL", "JVEL"):
            await made.variables[f"T:x.{speed}"].show(0.0)
        first = await begin(made, ("VAL", 40.0))
        await passes(drive, 5.0)
        halted = await begin(made, ("STOP", 1), TWEAK, refused)
        *ended, refusal = await asyncio.gather(*first, *halted, return_exceptions=True)
        await drive.until(lambda state: state.moving is Moving.NO and state.command is None)

        assert isinstance(refusal, LdcndError)
        assert ended == [None] * 3
        assert 5.0 + STEP < drive.position_mm < 10.0 + STEP
        assert made.variables["T:x.VAL"].value == pytest.approx(drive.position_mm, abs=AT_REST)
        assert made.variables["T:x.SEVR"].value == "MINOR"
        assert made.variables["T:x:message"].value == str(refusal)


async def test_a_distance_right_behind_a_stop_does_not_begin_once_another_program_has_stopped_the_axis():
    """Who resets that stop does not know of what waits."""
    async with record_of(LS_182AP, reference="at_reset", velocity=20.0, acceleration=20.0) as (drive, made):
        first = await begin(made, ("VAL", 40.0))
        await passes(drive, 10.0)
        behind = await begin(made, ("STOP", 1), TWEAK)
        await passes(drive, 13.0)
        await drive.rig.client.stop("x")
        *_, ended = await asyncio.gather(*first, *behind, return_exceptions=True)
        await drive.until(lambda state: state.moving is Moving.NO and state.stop_latched)
        stands = drive.position_mm
        await put(made, "T:x:reset", 1)
        await drive.until(lambda state: not state.stop_latched)
        await asyncio.sleep(0.5)

        assert isinstance(ended, CommandAborted)
        assert drive.position_mm == pytest.approx(stands, abs=AT_REST)
        assert made.variables["T:x.DMOV"].value == 1


async def test_a_distance_right_behind_a_stop_of_a_motion_that_has_just_begun_does_not_go_on_to_its_target():
    async with record_of(LS_182AP, reference="at_reset") as (drive, made):
        await asyncio.gather(*await begin(made, ("VAL", 40.0), ("STOP", 1), TWEAK))
        await drive.until(lambda state: state.moving is Moving.NO and state.command is None)

        assert drive.position_mm < 10.0
