"""A place that is not known is never shown as one: daemons that end in mid-move, drives that lost power, dead lines."""

import asyncio
import json
from pathlib import Path

import pytest

from ldcnd.config.rig import load_config
from ldcnd.contract.commands import MoveAbsolute, Power, Reset
from ldcnd.contract.samples import LinkState
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain
from tests.support.command_line import virtual_rig

CONFIGS = Path(__file__).parents[2] / "config"


def four_drives():
    return build_chain(ChainSpec(tuple(map(ModuleSpec, ("ls182ap", "ls182ap", "picservo-v4", "picservo-v4")))))


def line_of(printed: str, axis: str) -> str:
    (line,) = [line for line in printed.splitlines() if line.split()[:1] == [axis]]
    return line


def up(virtual, axis: str) -> None:
    virtual.wait(virtual.rig.until(axis, lambda state: state.link is LinkState.UP))


def rows(virtual) -> dict[str, dict[str, object]]:
    printed = virtual.run("list --json").printed
    return {row["axis"]: row for row in map(json.loads, printed.splitlines())}


@pytest.mark.long
def test_a_daemon_that_ended_in_mid_move_leaves_an_axis_that_says_it_is_not_homed(monkeypatch):
    chain = four_drives()
    with virtual_rig(monkeypatch, chains={"line0": chain}) as first:
        up(first, "x")
        assert "(" not in line_of(first.run("list").printed, "x")  # at rest where it was powered on
        first.wait(first.rig.client.command("x", Power(on=True)))
        first.wait(first.rig.client.command("x", MoveAbsolute(position=60.0, velocity=10.0)))
        first.wait(asyncio.sleep(3.0))

    with virtual_rig(monkeypatch, chains={"line0": chain}) as second:
        up(second, "x")
        listed, topped = second.run("list").printed, second.run("top").printed
        watched = second.run("watch x --item position --count 1")
        fleet, why, now = second.run("fleet").printed, second.run("why x").printed, rows(second)["x"]
        second.run("power on x")
        switched_on = second.run("why x")

    assert abs(chain.modules[0].shaft.position_counts) > 20_000  # the shaft is far from where it reads 0
    assert "(0.000) mm not homed" in line_of(listed, "x")
    assert (now["place"], now["referenced"], now["position"]) == ("not_homed", False, 0.0)
    assert "(0.0000) mm not homed" in watched.printed
    assert "(0.000) mm not homed" in topped
    assert "nothing is wrong" not in topped
    assert "needs attention" in fleet
    assert "not homed" in line_of(fleet, "x")
    assert "disabled" in why
    assert "x: cannot move to a position now, only by a distance or at a velocity" in switched_on.printed
    assert switched_on.code == 1


@pytest.mark.long
def test_a_drive_that_lost_power_has_lost_its_reference_and_a_reset_does_not_bring_it_back(monkeypatch):
    chain = four_drives()
    with virtual_rig(monkeypatch, chains={"line0": chain}) as virtual:
        up(virtual, "z")
        for on in (False, True):
            virtual.wait(_switch(chain, 2, on=on))
            virtual.wait(virtual.rig.until("z", lambda state, on=on: (state.link is LinkState.UP) is on))
        virtual.wait(virtual.rig.client.command("z", Reset()))
        virtual.wait(asyncio.sleep(60.0))
        listed, topped = virtual.run("list").printed, virtual.run("top").printed
        virtual.run("axis set-position z 0")
        virtual.wait(asyncio.sleep(1.0))
        after = virtual.run("list").printed

    assert "reference lost" in line_of(listed, "z")
    assert "(" in line_of(listed, "z")
    assert "(" not in line_of(listed, "y")
    assert "has lost its reference" in topped
    assert "(" not in line_of(after, "z")


def test_a_dead_line_shows_no_bare_number_and_watch_says_at_once_what_is_wrong(monkeypatch):
    chain = four_drives()
    with virtual_rig(monkeypatch, chains={"line0": chain}) as virtual:
        up(virtual, "c")
        for module in range(4):
            virtual.wait(_switch(chain, module, on=False))
        virtual.wait(virtual.rig.until("x", lambda state: state.link is LinkState.DOWN))
        virtual.wait(asyncio.sleep(30.0))
        listed, topped, now = virtual.run("list").printed, virtual.run("top").printed, rows(virtual)["x"]
        virtual.wait(_later(chain))
        watched = virtual.run("watch x --item position --count 2")

    for axis in ("x", "y", "z", "c"):
        assert "(" in line_of(listed, axis)
        assert "s old" in line_of(listed, axis)
        assert "unknown, was disabled" in line_of(listed, axis)
        assert "moving unknown" in line_of(listed, axis)
    assert (now["place"], now["moving"], now["link"]) == ("not_answering", "unknown", "down")
    assert now["age_s"] > 20.0
    assert topped.count("(0.000)") == 4
    assert "unknown, was disabled" in watched.errors.splitlines()[0]
    assert "no sample for 3 s" in watched.errors


def test_a_place_that_gets_lost_while_it_is_watched_alone_is_shown_as_none_from_then_on(monkeypatch):
    async def lose_power():
        await asyncio.sleep(1.0)
        await _switch(chain, 2, on=False)
        await virtual.rig.until("z", lambda state: state.link is LinkState.DOWN)
        await _switch(chain, 2, on=True)
        await virtual.rig.until("z", lambda state: state.link is LinkState.UP)
        await virtual.rig.client.command("z", Reset())

    chain = four_drives()
    with virtual_rig(monkeypatch, chains={"line0": chain}) as virtual:
        up(virtual, "z")
        losing = virtual.begin(lose_power())
        printed = virtual.run("watch z --item position --count 80").printed
        virtual.wait(losing)

    watched = [line for line in printed.splitlines() if line.startswith("z ")]
    assert {line.split()[1] for line in watched} == {"position"}
    lost = next(number for number, line in enumerate(watched) if "(" in line)
    assert lost > 0
    assert [line for line in watched[lost:] if "(" not in line] == []
    assert any("no answer" in line for line in watched)
    assert "mm reference lost" in watched[-1]


def test_what_is_said_of_a_drive_without_motions_names_no_command_that_it_does_not_take(monkeypatch):
    config = load_config(CONFIGS / "mixed.toml").model_copy(update={"state_dir": None})
    with virtual_rig(monkeypatch, config) as virtual:
        up(virtual, "feed")
        told = virtual.run("why feed")
        listed = virtual.run("list").printed

    for verb in ("home", "halt", "set-position", "power", "enable"):
        assert verb not in told.printed
    assert "takes no motion" in told.printed
    assert "(" not in line_of(listed, "feed")  # it has no reference that it could lack


async def _switch(chain, module: int, *, on: bool) -> None:
    chain.modules[module].power(on=on, at_s=asyncio.get_running_loop().time())


async def _later(chain) -> None:
    """Switch the drives on again ten seconds from now, while a command waits."""
    loop = asyncio.get_running_loop()
    for module in chain.modules:
        loop.call_later(10.0, lambda module=module: module.power(on=True, at_s=loop.time()))
