"""How a command line ends is said of what it has sent, whatever axes do by then; on the jumping clock."""

import asyncio
import json
import re

import pytest

from ldcnd.config.rig import load_config
from ldcnd.contract.commands import BufferMode, MoveAbsolute
from ldcnd.contract.leases import ListHolders
from ldcnd.contract.samples import LinkState
from tests.integration.test_path import plane, sc_chain
from tests.support.chain_rig import simulated_config
from tests.support.command_line import virtual_rig
from tests.support.process import ROOT
from tests.support.rig import SIMULATED

CENTRIFUGE = load_config(ROOT / "config" / "centrifuge.toml")
GANTRY = simulated_config(group=[{"name": "gantry", "axes": ["x", "y"]}])


async def take_over(here, axis, position):
    """Move an axis elsewhere as another client, while it is on its way."""
    await asyncio.sleep(2.0)
    await here.rig.client.command(axis, MoveAbsolute(position=position, buffer_mode=BufferMode.ABORTING, client="bob"))


async def fall_silent(here, axis):
    """Let a drive answer no more while its axis is on its way."""
    await asyncio.sleep(2.0)
    here.rig.lives.faults.mute(axis)


def stands(here, axis):
    """Wait until an axis stands, and return where."""
    here.wait(here.rig.until(axis, lambda state: state.command is None and state.moving == "no"))
    return here.rig.lives.truth(axis).position


def last_line(ran):
    return ran.printed.splitlines()[-1]


def test_where_a_move_will_end_says_as_little_of_an_axis_that_is_not_homed_as_its_place(monkeypatch):
    with virtual_rig(monkeypatch, CENTRIFUGE) as here:
        here.wait(asyncio.sleep(1))
        assert here.run("power on rotor").code == 0
        moved = here.run("move rotor 0.1 --relative --velocity 3 --wait")
        set_there = here.run("axis set-position rotor 0.25")
        known = here.run("move rotor 0.1 --relative --velocity 3 --wait")

        assert (moved.code, set_there.code, known.code) == (0, 0, 0)
        assert re.search(r"accepted: to \(0\.10\d*\) rev not homed, at ", moved.printed)
        assert re.search(r"accepted: to 0\.25\d* rev$", set_there.printed, re.MULTILINE)
        assert re.search(r"accepted: to 0\.35\d* rev, at ", known.printed)


def test_a_move_that_another_client_has_taken_over_is_not_done(monkeypatch):
    with virtual_rig(monkeypatch, CENTRIFUGE) as here:
        here.wait(asyncio.sleep(1))
        for line in ("power on rotor", "home rotor --wait"):
            assert here.run(line).code == 0

        taking = here.begin(take_over(here, "rotor", 0.3))
        ran = here.run("move rotor 0.4 --velocity 3 --wait")
        here.wait(taking)
        place = stands(here, "rotor")
        taking = here.begin(take_over(here, "rotor", 0.1))
        in_json = here.run("move rotor 0.0 --velocity 3 --wait --json")
        here.wait(taking)
        stands(here, "rotor")
        done = here.run("move rotor 0.2 --wait --json")

    assert (ran.code, in_json.code, done.code) == (1, 1, 0)
    assert "aborted by move_absolute of bob" in last_line(ran)
    assert ": done" not in last_line(ran)
    assert place % 1 == pytest.approx(0.3, abs=0.005)
    aborted, ended = json.loads(last_line(in_json)), json.loads(last_line(done))
    assert (aborted["status"], aborted["reason"]) == ("aborted", "aborted by move_absolute of bob")
    assert aborted["link"] == "up"  # beside the fields of the state
    assert (ended["status"], ended["reason"]) == ("done", None)


@pytest.mark.long
def test_a_member_of_a_group_that_another_client_has_taken_over_is_not_done(monkeypatch):
    with virtual_rig(monkeypatch, GANTRY) as here:
        here.power_on("x", "y")

        taking = here.begin(take_over(here, "y", -5.0))
        ran = here.run("group move x=40 y=40 --velocity 5 --wait")
        here.wait(taking)
        place = stands(here, "y")

    assert ran.code == 1
    (of_y,) = [line for line in ran.printed.splitlines() if line.startswith("y: ") and "accepted" not in line]
    assert "aborted by" in of_y
    assert place == pytest.approx(-5.0, abs=0.05)


def test_ctrl_c_before_the_reply_says_how_to_halt_what_goes_on(monkeypatch):
    with virtual_rig(monkeypatch) as here:
        here.power_on("x")
        assert here.run("move x 60 --velocity 20").code == 0
        here.wait(asyncio.sleep(1.0))

        # it is answered once the axis has come to rest from the motion before
        ran = here.run("move x -5 --buffer-mode aborting", interrupted_after_s=(0.03,))
        here.wait(asyncio.sleep(5.0))
        place = here.rig.lives.truth("x").position

    assert ran.code == 130
    assert "accepted" not in ran.printed
    assert "`ldcnd halt x` halts it" in ran.errors
    assert place == pytest.approx(-5.0, abs=0.05)


def test_ctrl_c_before_the_reply_to_a_path_says_how_to_halt_what_goes_on(monkeypatch):
    with virtual_rig(monkeypatch, plane(), {"line0": sc_chain()}) as here:
        here.power_on("z", "c")

        ran = here.run("group path z=20,20,0 c=0,15,0 --speed 15", interrupted_after_s=(0.002,))
        here.wait(asyncio.sleep(2.0))
        place = here.rig.lives.truth("z").position

    assert ran.code == 130
    assert "accepted" not in ran.printed
    assert "`ldcnd halt z` halts it" in ran.errors
    assert "`ldcnd halt c` halts it" in ran.errors
    assert place > 5.0


def test_ctrl_c_of_what_moves_nothing_names_no_axis_that_goes_on(monkeypatch):
    with virtual_rig(monkeypatch) as here:
        here.wait(here.rig.until("x", lambda state: state.link is LinkState.UP))

        ran = here.run("axis gains x --kp 300", interrupted_after_s=(0.0001,))

    assert (ran.code, ran.errors.strip()) == (130, "")


@pytest.mark.promise("ctrl-c-halts")
def test_ctrl_c_once_more_takes_no_halt_away_and_says_what_is_confirmed(monkeypatch):
    with virtual_rig(monkeypatch, GANTRY) as here:
        here.power_on("x", "y")

        ran = here.run("group move x=90 y=90 --velocity 50 --wait", interrupted_after_s=(1.0, 1.02, 1.04))
        rest = [stands(here, axis) for axis in ("x", "y")]

    assert ran.code == 130
    said = ran.errors.strip().splitlines()
    for axis, ended, place in zip(("x", "y"), said[-2:], rest, strict=True):
        waits = f"{axis}: told to halt, and not confirmed at rest yet; it is waited for, 3 s at most"
        assert said.count(waits) == 2  # once for each that came behind the first
        assert ended.startswith(f"{axis}: halted at ")
        assert float(ended.split()[-2]) == pytest.approx(place, abs=0.1)  # the loop still settles
        assert place < 60.0


@pytest.mark.parametrize(
    ("command", "presses", "where"),
    [
        ("jog rotor 0.5 --for 0.5", (), r"\([-\d.]+\) rev not homed"),
        ("home rotor --wait", (0.1,), r"\([-\d.]+\) rev not homed"),
        ("jog x 5 --for 0.5", (), r"[-\d.]+ mm"),
    ],
)
def test_where_an_axis_was_halted_is_said_as_what_the_place_is_worth(monkeypatch, command, presses, where):
    axis = command.split()[1]
    with virtual_rig(monkeypatch, CENTRIFUGE if axis == "rotor" else None) as here:
        here.wait(asyncio.sleep(1))
        here.power_on(axis)

        ran = here.run(command, interrupted_after_s=presses)

    said = (ran.errors if presses else ran.printed).strip().splitlines()[-1]
    assert re.fullmatch(rf"{axis}: halted at {where}", said), said


@pytest.mark.promise("ctrl-c-halts")
@pytest.mark.parametrize("presses", [(1.0,), (1.0, 1.02), (1.0, 1.005, 1.01, 1.2)])
def test_ctrl_c_of_a_sequence_names_its_axes_and_ends_behind_their_rest(monkeypatch, tmp_path, presses):
    config = tmp_path / "rig.toml"
    far = '[[position]]\nname = "far"\naxes = { x = 90 }\n'
    config.write_text(f"{SIMULATED.read_text(encoding='utf-8')}\n{far}", encoding="utf-8")
    with virtual_rig(monkeypatch, load_config(config)) as here:
        here.power_on("x")

        ran = here.run(f"position go {config} far", interrupted_after_s=presses)
        after = here.rig.lives.truth("x").position
        rest = stands(here, "x")

    assert ran.code == 130
    assert ran.errors.strip().splitlines()[-1].startswith("x: halted at ")
    assert after == pytest.approx(rest, abs=0.1)
    assert rest < 80.0


def test_ctrl_c_while_a_halt_is_waited_for_says_how_far_it_has_come(monkeypatch):
    with virtual_rig(monkeypatch) as here:
        here.power_on("x")
        assert here.run("move x 90 --velocity 50").code == 0
        here.wait(asyncio.sleep(1.0))

        ran = here.run("halt x --wait", interrupted_after_s=(0.1,))
        stands(here, "x")

    assert (ran.code, ran.errors.strip()) == (130, "x: halt accepted, and it is not known to stand yet")


def test_a_member_out_of_sight_has_the_others_of_its_group_halted_and_named(monkeypatch):
    with virtual_rig(monkeypatch, GANTRY) as here:
        here.power_on("x", "y")
        falling = here.begin(fall_silent(here, "y"))
        ran = here.run("group move x=90 y=90 --velocity 5 --wait -e tcp/127.0.0.1:7448")
        here.wait(falling)
        here.wait(asyncio.sleep(1.0))
        x = here.rig.lives.truth("x")

    assert ran.code == 1
    assert "x: halted at " in ran.errors
    assert "y: NOT confirmed at rest" in ran.errors
    assert "the drive does not answer any more" in ran.errors
    assert "`ldcnd stop -e tcp/127.0.0.1:7448` stops every axis" in ran.errors  # of that rig, and of no other one
    assert (x.at_rest, x.position < 40.0) == (True, True)


def test_a_move_whose_drive_falls_silent_is_named_with_what_halts_it(monkeypatch):
    with virtual_rig(monkeypatch) as here:
        here.power_on("x")
        falling = here.begin(fall_silent(here, "x"))
        left = here.run("move x 90 --velocity 5 --wait --leave-running")
        here.wait(falling)

    assert left.code == 1
    assert "x is left running; `ldcnd halt x` halts it" in left.errors
    assert "the drive does not answer any more" in left.errors


@pytest.mark.parametrize("kind", ["client-loss", "bus-loss", "daemon-stop"])
def test_a_drill_that_is_interrupted_halts_the_axis_at_once(monkeypatch, kind):
    with virtual_rig(monkeypatch) as here:
        here.wait(here.rig.until("x", lambda state: state.link is LinkState.UP))

        ran = here.run(f"drill {kind} x --velocity 5 --lease 60 --yes", interrupted_after_s=(0.4,))
        place = here.rig.lives.truth("x").position
        here.wait(asyncio.sleep(5.0))
        later = here.rig.lives.truth("x").position
        holders = here.wait(here.rig.client.ask(ListHolders())).holders

    assert ran.code == 130
    assert "x: halted at " in ran.errors
    assert place > 1.0
    assert later == pytest.approx(place, abs=0.05)
    assert [each.client for each in holders] == [None] * 4


@pytest.mark.long
def test_a_drill_of_a_long_lease_is_watched_to_its_end(monkeypatch):
    with virtual_rig(monkeypatch) as here:
        here.wait(here.rig.until("x", lambda state: state.link is LinkState.UP))

        ran = here.run("drill client-loss x --velocity 1 --lease 40 --yes --json")

    assert (ran.code, ran.errors) == (0, "")
    assert json.loads(last_line(ran))["stands_after_lease_s"] < 1.5
