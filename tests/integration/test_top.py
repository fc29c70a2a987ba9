"""`ldcnd top` against a daemon in its own process."""

import asyncio
from asyncio.subprocess import PIPE

import pytest
from textual.widgets import DataTable, Static

from ldcnd.contract.commands import MoveAbsolute, Power
from ldcnd.lab.top.columns import NARROW
from ldcnd.lab.top.glance import RigGlance
from ldcnd.lab.top.screen import TopScreen
from tests.support.process import LDCND, ROOT, client, daemon

pytestmark = [pytest.mark.system, pytest.mark.real_time]


async def until(pilot, wanted):
    """Wait until a screen shows something."""
    async with asyncio.timeout(20):
        while not wanted():
            await pilot.pause(0.05)


async def test_a_rig_is_watched_and_stopped_with_one_key_and_printed_where_there_is_no_terminal():
    async with daemon(ROOT / "config" / "simulated.toml") as endpoint, client(endpoint) as rig:
        printing = await asyncio.create_subprocess_exec(*LDCND, "top", "-e", endpoint, "--json", stdout=PIPE)
        await rig.command("x", Power(on=True))
        screen = TopScreen(rig)
        async with screen.run_test(size=(140, 24)) as pilot:
            axes, answer = screen.query_one("#axes", DataTable), screen.query_one("#answer", Static)

            def states():
                return {axes.get_row_at(row)[2].plain: axes.get_row_at(row)[3].plain for row in range(axes.row_count)}

            await until(pilot, lambda: states().get("x") == "standstill")
            await rig.command("x", MoveAbsolute(position=90.0, velocity=5.0))
            await until(pilot, lambda: states()["x"] == "moving")
            await pilot.press("escape")
            await until(pilot, lambda: "stop latched, confirmed by x, y, z, c" in str(answer.content))
            await until(pilot, lambda: states()["x"] != "moving")

            await pilot.resize_terminal(80, 24)
            await until(pilot, lambda: len(axes.columns) == len(NARROW))
            titles = [str(column.label) for column in axes.columns.values()]
            left = sum(column.get_render_width(axes) for column in list(axes.columns.values())[:4])
            await until(pilot, lambda: "a stop is latched" in axes.get_row_at(0)[4].plain)
            await pilot.press("r")
            await until(pilot, lambda: ": reset" in str(answer.content))
        screen._redraw()  # as a timer does that expires while the screen closes
        states_after = [await rig.state(axis) for axis in "xyzc"]
        printed, _ = await printing.communicate()

    glance = RigGlance.model_validate_json(printed)
    assert titles == ["", "axis", "state", "position", "trouble", "control"]
    assert left < 60  # of 80 columns; the trouble is seen without scrolling
    assert [each.stop_latched for each in states_after].count(False) == 1
    assert {axis.axis for axis in glance.axes} == set("xyzc")
    assert all(axis.rate_hz for axis in glance.axes)


async def test_a_key_is_meant_for_the_axis_that_was_chosen_though_another_one_has_come_to_its_row():
    async with daemon(ROOT / "config" / "simulated.toml") as endpoint, client(endpoint) as rig:
        screen = TopScreen(rig)
        async with screen.run_test(size=(140, 24)) as pilot:
            axes, answer = screen.query_one("#axes", DataTable), screen.query_one("#answer", Static)

            def row_of(name):
                return next(row for row in range(axes.row_count) if axes.get_row_at(row)[2].plain == name)

            await until(pilot, lambda: axes.row_count == 4)
            await until(pilot, lambda: axes.get_row_at(row_of("c"))[3].plain == "disabled")
            await pilot.press(*["down"] * row_of("z"))
            await rig.stop("c")
            await until(pilot, lambda: row_of("c") == 0)
            await pilot.press("h")
            await until(pilot, lambda: str(answer.content).startswith("z: "))
