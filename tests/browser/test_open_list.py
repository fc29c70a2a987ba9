"""A list that is open keeps no press from stopping, and is used by mouse and keys as any other."""

import pytest

from ldcnd.contract.commands import MoveVelocity, Power
from tests.browser.marks import IN_THE_HOUSE
from tests.support.marionette import DOWN, ENTER, ESCAPE, TAB

windows = pytest.importorskip("tests.browser.windows", reason="the browser tests need playwright")
until = windows.until

pytestmark = [pytest.mark.system, *IN_THE_HOUSE]

LIST = """[...document.querySelectorAll("select")].find((each) => each.labels[0].textContent === "Move")"""
AT = f"""() => {{
  const list = {LIST};
  if (!list) return null;
  list.scrollIntoView({{ block: "center" }});
  const {{ x, y, width, height }} = list.getBoundingClientRect();
  return [x + width / 2, y + height / 2];
}}"""
OPTION = f"""(text) => {{
  const {{ x, y, width, height }} = [...{LIST}.options].find((each) => each.text === text).getBoundingClientRect();
  return [x + width / 2, y + height / 2];
}}"""
CHOSEN = f"() => {LIST}.selectedOptions[0].text"
FIELD = """() => [...document.querySelectorAll(".panel")].find((each) => each.innerText.startsWith("Move"))
  .querySelector("input").labels[0].textContent"""
FOCUS = f"() => {LIST}.focus()"
BELOW = f"() => {LIST}.closest('.panel').querySelector('button.main').getBoundingClientRect().top"


async def at_x(house, window):
    await window.open("about:blank")
    await window.open(f"{house.url}/#/axis/sim/x")
    return await until(window, AT)


@pytest.mark.parametrize("key", [None, " ", ENTER, DOWN])
async def test_escape_stops_while_a_list_is_open(house, window, key):
    await house.sim.quiet("x", "y", "z", "c")
    at = await at_x(house, window)
    await house.sim.rig.command("x", Power(on=True))
    away = 2.0 if await house.sim.position("x") < 0 else -2.0
    await house.sim.rig.command("x", MoveVelocity(velocity=away))
    if key is None:
        await window.click(*at)
    else:
        await window.evaluate(FOCUS)
        await window.keys(key)
    await window.keys(ESCAPE)
    await house.sim.until("x", lambda state: state.stop_latched and state.moving == "no")
    assert await window.evaluate(CHOSEN) == "to a position"
    await house.sim.quiet("x", "y", "z", "c")
    await house.mixed.quiet("x")


async def test_a_list_is_used_by_the_mouse_and_moves_nothing_on_the_page(house, window):
    at = await at_x(house, window)
    below = await window.evaluate(BELOW)
    await window.click(*at)
    assert await window.evaluate(BELOW) == below
    await window.click(*(await window.evaluate(OPTION, "at a velocity")))
    await until(window, CHOSEN, wanted=lambda text: text == "at a velocity")
    await until(window, FIELD, wanted=lambda text: text.startswith("Velocity"))


async def test_a_list_is_used_by_keys_and_what_is_not_taken_is_not_chosen(house, window):
    await at_x(house, window)
    await window.evaluate(FOCUS)
    await window.keys(DOWN, DOWN)
    assert (await window.evaluate(FIELD)).startswith("Position")  # nothing is taken yet
    await window.keys(ENTER)
    await until(window, FIELD, wanted=lambda text: text.startswith("Distance"))
    await window.keys(DOWN, DOWN, TAB)
    await until(window, FIELD, wanted=lambda text: text.startswith("Velocity"))
    await window.evaluate(FOCUS)
    await window.keys(DOWN, DOWN, DOWN)
    await window.evaluate("() => document.activeElement.blur()")
    assert await window.evaluate(CHOSEN) == "at a velocity"
