"""What fingers do on the page of an axis: no browser makes a click of a second one."""

import pytest

from ldcnd.contract.commands import SetPosition
from tests.browser.marks import IN_THE_HOUSE

windows = pytest.importorskip("tests.browser.windows", reason="the browser tests need playwright")
until = windows.until

pytestmark = [pytest.mark.system, *IN_THE_HOUSE]

PLACE = """(text) => {
  const found = [...document.querySelectorAll("button")].find((each) => each.textContent.trim().startsWith(text));
  if (!found || found.getAttribute("aria-disabled")) return null;
  const { x, y, width, height } = found.getBoundingClientRect();
  return [x + width / 2, y + height / 2];
}"""
TITLE = """() => {
  const { x, y, height } = document.querySelector("h1").getBoundingClientRect();
  return [x + 2, y + height / 2];
}"""
TO_JOG = """() => {
  const found = [...document.querySelectorAll("button.hold")][0];
  found?.scrollIntoView({ block: "center" });
  return Boolean(found);
}"""


async def ready(window, house):
    await house.sim.quiet("x")
    await house.sim.rig.command("x", SetPosition(position=0.0))
    await window.open(f"{house.url}/#/axis/sim/x")
    await window.reload()
    await until(window, windows.TAKE)
    await until(window, windows.PRESS, "Enable")
    await house.sim.until("x", lambda state: state.enabled)
    await until(window, windows.PRESSABLE, "Hold to run + ▶")
    await until(window, TO_JOG)


@pytest.mark.parametrize("button", ["Stop all axes", "Stop x", "Quick stop"])
async def test_a_second_finger_ends_the_jog_that_the_first_one_holds(house, window, button):
    await ready(window, house)
    hold = await until(window, PLACE, "Hold to run +")
    try:
        await window.touch(hold)
        await house.sim.until("x", lambda state: state.moving == "yes")
        await window.touch(hold, await until(window, PLACE, button))
        await window.touch(hold)
        state = await house.sim.until("x", lambda state: state.moving == "no")
    finally:
        await window.touch()

    assert state.stop_latched
    assert await house.sim.position("x") < 60


async def test_a_second_finger_halts_a_motion_while_the_first_one_rests_on_the_page(house, window):
    await ready(window, house)
    beside = await until(window, TITLE)
    try:
        await until(window, windows.PRESS, "+10 mm")
        await house.sim.until("x", lambda state: state.moving == "yes")
        await window.touch(beside)
        await window.touch(beside, await until(window, PLACE, "Halt"))
        await window.touch(beside)
        await house.sim.until("x", lambda state: state.moving == "no")
        assert await house.sim.position("x") < 9.5
    finally:
        await window.touch()


async def test_a_finger_that_comes_down_on_a_stop_has_stopped_though_it_slides_off(house, window):
    await ready(window, house)
    await window.touch(await until(window, PLACE, "Stop x"))
    await house.sim.until("x", lambda state: state.stop_latched)
    await window.touch()
