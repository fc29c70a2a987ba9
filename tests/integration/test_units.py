"""Numbers with units at every face of a rig: the simulated shaft turns as fast as was typed."""

import asyncio
import re

import pytest

from ldcnd.config.rig import load_config
from ldcnd.contract.errors import MalformedRequest
from ldcnd.testing import run, simulated_rig
from tests.support.command_line import virtual_rig
from tests.support.process import ROOT

CENTRIFUGE = load_config(ROOT / "config" / "centrifuge.toml")


async def _ready(rig):
    """Wait until the lock is seen shut, and find the index."""
    async with rig.control("rotor", client="test") as rotor:
        async with rig.samples("cabinet", "io") as samples:
            async for _, sample in samples:
                if sample.named["locked"] and sample.named["unlock"] is False:
                    break
        await rotor.power(on=True)
        await (await rotor.home()).done()


@pytest.mark.long
def test_programs_send_numbers_with_units():
    async def program():
        async with simulated_rig(CENTRIFUGE) as rig:
            await _ready(rig.client)
            async with rig.client.control("rotor", client="test") as rotor:
                await rotor.move_velocity("600 rpm", acceleration="600 rpm/s")
                await rig.until(lambda: abs(rig.truth("rotor").velocity - 10) < 0.1)
                await (await rotor.halt()).done()
                async with rotor.jogging("120 rpm", acceleration="600 rpm/s") as jog:
                    while abs(rig.truth("rotor").velocity - 2) > 0.1:
                        await jog.held()
                await (await rotor.halt()).done()
                await rotor.move_velocity("50 g", acceleration=10)
                await rig.until(lambda: abs(rig.truth("rotor").velocity - 11.14) < 0.1)
                with pytest.raises(MalformedRequest, match="type the value in rpm, rev/s"):
                    await rotor.move_velocity("600 mm/s")
                await (await rotor.halt()).done()
                await (await rotor.move_absolute("90 deg", velocity="30 rpm")).done()
                return rotor.position.value, (await rotor.preview(velocity="-30 rpm")).velocity

    position, velocity = run(program())

    assert position == pytest.approx(0.25, abs=0.002)
    assert velocity == pytest.approx(-0.5, rel=1e-3)


def test_a_unit_can_be_typed_wherever_a_value_is(monkeypatch):
    with virtual_rig(monkeypatch, CENTRIFUGE) as machine:
        lines = [
            'move rotor "600 rpm" --at-velocity --acceleration "10 rev/s²"',
            "move rotor 300 --at-velocity --for 100",
            'axis preview rotor --velocity "-1000 g"',
            'jog rotor "6 deg/s" --for 0.2',
            "watch rotor --item velocity --count 1",
            "halt rotor",
        ]
        machine.wait(asyncio.sleep(1))
        begun = [machine.run(line).code for line in ("power on rotor", "home rotor --wait")]
        ran = [machine.run(line) for line in lines]
        refused = machine.run('move rotor "600 mm/s" --at-velocity')
        machine.wait(machine.rig.until("rotor", lambda state: state.moving == "no"))
        limited = machine.run('move rotor "4000 rpm" --at-velocity')

    said = [each.printed for each in ran]
    assert (begun, [each.code for each in ran]) == ([0, 0], [0, 0, 0, 1, 0, 0]), ran  # one jogs nothing that runs
    assert "at 600 rpm (40.26 g), with 9.997 rev/s²" in said[0]
    assert "at 300 rpm (10.06 g)" in said[1]
    assert "  velocity     -2990.42 rpm (1000 g)" in said[2]
    assert " rpm\n" in said[4]
    assert refused.code == 2
    assert "type the value in rpm, rev/s, deg/s" in refused.errors
    assert limited.code == 1
    assert "velocity 4000 rpm (1789 g) is above the limit 3300 rpm (1218 g)" in limited.errors


@pytest.mark.parametrize(
    ("line", "code", "nearest"),
    [
        ('axis preview rotor --velocity "5000 g"', 0, "1217.76 g"),
        ('axis preview rotor --velocity "-5000 g"', 0, "-1217.76 g"),
        ("axis preview rotor --velocity 5000", 0, "3300 rpm"),
        ('move rotor "5000 g" --at-velocity', 1, "1217.76 g"),
        ('move rotor "100 rev/s" --at-velocity', 1, "55 rev/s"),
        ('move rotor 300 --at-velocity --acceleration "10000 rpm/s"', 1, "600 rpm/s"),
        ("move rotor 300 --at-velocity --for 5000", 1, "3600 s"),
        ('move rotor 0.2 --velocity "30000 deg/s"', 1, "19800 deg/s"),
        ('jog rotor "5000 rpm" --for 1', 1, "3300 rpm"),
        ('home rotor --acceleration "100 rev/s2"', 1, "10 rev/s2"),
    ],
)
@pytest.mark.sweep(2)
def test_a_refusal_names_the_nearest_value_in_the_unit_that_was_typed_and_that_is_accepted(
    monkeypatch, line, code, nearest
):
    with virtual_rig(monkeypatch, CENTRIFUGE) as machine:
        machine.wait(asyncio.sleep(1))
        begun = [machine.run(each).code for each in ("power on rotor", "home rotor --wait")]
        refused = machine.run(line)
        said = (
            (refused.printed + refused.errors)
            .partition("nearest value that would be accepted is ")[2]
            .partition("\n")[0]
        )
        again = machine.run(
            re.sub(r'"[^"]+"$|"[^"]+" |(?<=velocity )5000|(?<=for )5000', f'"{said.removesuffix(" s")}" ', line)
        )

    assert (begun, refused.code) == ([0, 0], code)
    assert said == nearest
    assert again.code == 0, again
    assert "would be refused" not in again.printed
