"""A hand on a keyboard: an axis moves by a key that is pressed now, never by one that was, on the jumping clock."""

import asyncio

import pytest

from ldcnd.config.rig import load_config
from ldcnd.contract.commands import Halt
from ldcnd.contract.samples import AxisState
from tests.support.command_line import virtual_rig
from tests.support.rig import SIMULATED

SEQUENCE = """
[[position]]
name = "far"
axes = { x = 20 }

[[position]]
name = "near"
axes = { x = 5 }

[[sequence]]
name = "there"
step = [{ go = "far" }, { go = "near" }]
"""
REPEAT_S = 0.05
RAMP_MM = 0.5
"""As far as an axis goes at most that is being halted from 5 mm/s."""


@pytest.fixture
def here(monkeypatch):
    with virtual_rig(monkeypatch) as found:
        found.power_on("x")
        yield found


def place(here):
    return here.rig.lives.truth("x").position


async def hold(press, for_s):
    """Hold the space bar, as a keyboard repeats it."""
    for _ in range(round(for_s / REPEAT_S)):
        press(" ")
        await asyncio.sleep(REPEAT_S)


def worked(here, *hands, line="jog x 5", before=""):
    """Run a command line with these at work besides it, and return what it said; a key may have been hit before."""
    with here.keyboard() as press:
        press(before)
        besides = [here.begin(hand(press)) for hand in hands]
        ran = here.run(line)
        for each in besides:
            here.wait(each)

    assert ran.code == 0
    return ran


@pytest.mark.promise("jog-while-renewed")
def test_a_bar_that_stays_down_begins_no_jog_behind_the_halt_of_another_client(here):
    places = []

    async def hand(press):
        await asyncio.sleep(0.5)
        await hold(press, 3.0)
        places.append(place(here))
        await asyncio.sleep(1.0)
        await hold(press, 1.0)
        await asyncio.sleep(1.0)
        places.append(place(here))
        press("q")

    async def other(_):
        await asyncio.sleep(1.5)
        await here.rig.client.command("x", Halt())

    worked(here, hand, other)

    assert places[0] == pytest.approx(5.0, abs=1.0)
    assert places[1] - places[0] == pytest.approx(6.0, abs=1.5)


@pytest.mark.promise("jog-while-renewed")
def test_a_bar_that_is_hit_while_the_axis_is_being_halted_begins_no_jog(here):
    places = []

    async def hand(press):
        await asyncio.sleep(0.5)
        await hold(press, 1.0)
        await here.rig.until("x", lambda state: state.state is AxisState.STOPPING)
        press(" ")
        places.append(place(here))
        await asyncio.sleep(3.0)
        places.append(place(here))
        press("q")

    worked(here, hand)

    assert places[0] > 3.0
    assert places[1] - places[0] < RAMP_MM


def test_a_key_to_leave_wins_over_the_bar_that_came_with_it(here):
    async def hand(press):
        await asyncio.sleep(0.5)
        press(" q ")
        await asyncio.sleep(3.0)
        press("q")

    ran = worked(here, hand)

    assert place(here) == pytest.approx(0.0, abs=0.05)
    assert "halted" not in ran.errors


def test_another_key_in_mid_jog_ends_the_command(here):
    places = []

    async def hand(press):
        await asyncio.sleep(0.5)
        await hold(press, 1.0)
        press("q")
        await asyncio.sleep(1.0)
        places.append(place(here))
        await hold(press, 1.0)
        press("q")

    worked(here, hand)

    assert places[0] > 3.0
    assert place(here) - places[0] < RAMP_MM


def test_a_bar_that_is_down_before_anything_is_asked_begins_no_jog(here):
    async def hand(press):
        await hold(press, 1.0)
        await asyncio.sleep(1.0)
        press("q")

    worked(here, hand, before=" ")

    assert place(here) == pytest.approx(0.0, abs=0.05)


@pytest.mark.parametrize("repetitions", [7, 8])
@pytest.mark.sweep(2)
def test_a_bar_that_is_held_pauses_a_sequence_once_however_often_it_repeats_itself(monkeypatch, tmp_path, repetitions):
    config = tmp_path / "rig.toml"
    config.write_text(SIMULATED.read_text(encoding="utf-8") + SEQUENCE, encoding="utf-8")
    places = []

    async def hand(press):
        await asyncio.sleep(0.2)
        press(" ")
        await asyncio.sleep(0.6)
        await hold(press, repetitions * REPEAT_S)
        await asyncio.sleep(5.0)
        places.append(place(here))
        press("   ")
        await asyncio.sleep(1.0)
        places.append(place(here))
        press("x")
        await asyncio.sleep(0.1)
        press(" ")

    with virtual_rig(monkeypatch, load_config(config)) as here:
        here.power_on("x")
        ran = worked(here, hand, line=f"sequence run {config} there")
        places.append(place(here))

    assert places == pytest.approx([20.0, 20.0, 5.0], abs=0.05)
    assert ran.errors.splitlines() == ["pauses before the next step; space goes on", "goes on"]
