"""Other clocks and further divisors of the baud rate: PIC-SERVO manual, 3.0 and 5.2."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import pytest
from pydantic import ValidationError

from ldcnd.contract.commands import MoveAbsolute, MoveVelocity
from ldcnd.contract.errors import ValueOutOfRange
from ldcnd.drives.ldcn.registers import actual_baud, baud_at_reset, baud_divisor
from ldcnd.sim.ldcn.chain import model
from tests.support.dialect_rig import LS_182AP, SC, V2, V4, Dialect, DialectRig, dialect_rig


@asynccontextmanager
async def clocked(dialect: Dialect, mhz: float, baud: int) -> AsyncIterator[DialectRig]:
    quirks = model(dialect.module)[1].model_copy(update={"version": dialect.version, "clock_hz": round(mhz * 1e6)})
    line = {"clock_mhz": mhz, "baud": baud}
    async with dialect_rig(dialect, settings=quirks, line=line) as rig:
        await rig.power_on()
        yield rig


@pytest.mark.parametrize("dialect", [V4, V2, LS_182AP], ids=lambda dialect: dialect.name)
async def test_125000_baud_works(dialect):
    async with clocked(dialect, 20.0, 125_000) as rig:
        await rig.done(MoveAbsolute(position=3.0))

        assert rig.rig.daemon.rig.buses[0].bus.baud == 125_000
        assert rig.drive.baud == pytest.approx(125_000, rel=0.001)
        assert rig.position_mm == pytest.approx(3.0, abs=0.02)


@pytest.mark.parametrize(("mhz", "baud"), [(10.0, 62_500), (16.0, 100_000)])
@pytest.mark.sweep(2)
async def test_a_drive_with_another_clock_moves_at_the_speed_that_was_asked_for(mhz, baud):
    async with clocked(V4, mhz, baud) as rig:
        await rig.send(MoveVelocity(velocity=5.0))
        await asyncio.sleep(1.0)
        loop = asyncio.get_running_loop()
        rig.chain.advance(loop.time())
        rig.drive.catch_up(loop.time())
        before = rig.position_mm
        await asyncio.sleep(1.0)
        rig.chain.advance(loop.time())
        rig.drive.catch_up(loop.time())
        reading = rig.rig.daemon.rig.axes["x"].tracker.latest()

        assert rig.position_mm - before == pytest.approx(5.0, rel=0.01)
        assert reading.velocity_counts_per_s == pytest.approx(5000, abs=reading.velocity_resolution_counts_per_s)


def test_the_divisor_is_the_one_that_makes_the_rate():
    assert [baud_divisor(baud) for baud in (125_000, 19_200, 50_000)] == [9, 0x3F, 24]
    assert baud_at_reset(10_000_000) == round(actual_baud(0x3F, 10_000_000)) == 9766
    with pytest.raises(ValueOutOfRange, match="no divisor") as refusal:
        baud_divisor(110_000)
    assert refusal.value.nearest == 113_636


@pytest.mark.parametrize(
    ("dialect", "line", "message"),
    [
        (V4, {"baud": 119_000}, "no divisor of a 20 MHz clock makes 119000 baud"),
        (V4, {"baud": 115_200, "clock_mhz": 10.0}, "reaches 62500 at most"),
        (LS_182AP, {"clock_mhz": 16.0, "baud": 19_200}, "has a clock of its own"),
        (SC, {"baud": 125_000}, "only 9600, 19200, 57600, 115200, 230400 are known"),
    ],
)
async def test_what_no_drive_of_the_line_can_do_is_refused_in_the_configuration(dialect, line, message):
    with pytest.raises(ValidationError, match=message):
        async with dialect_rig(dialect, line=line):
            pass
