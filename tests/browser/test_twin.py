"""An operator rehearses in the console, which does not know that the rig behind it is a twin."""

import asyncio
import json
import signal

import pytest

from ldcnd.testing.run_report import RunReport
from tests.browser.house import PATIENCE_S, Desk, console
from tests.browser.marks import IN_THE_HOUSE
from tests.support.process import process

playwright = pytest.importorskip("playwright.async_api", reason="the browser tests need playwright")
expect = playwright.expect

pytestmark = [pytest.mark.system, *IN_THE_HOUSE]


async def test_an_operator_moves_a_twin_and_the_rig_stays_where_it_is(house, tmp_path):
    await house.sim.quiet("x")
    stands_at, night = await house.sim.position("x"), tmp_path / "night.json"
    words = ("twin", str(house.sim.config), "-e", house.sim.endpoint, "--report", str(night))
    async with process(*words) as twin:
        async with asyncio.timeout(PATIENCE_S):
            endpoint = (await twin.stdout.readline()).decode().strip().removeprefix("export LDCND_CONNECT=")
        context = await house.browser.new_context(viewport={"width": 1400, "height": 900}, reduced_motion="reduce")
        try:
            async with console(endpoint) as link:
                desk = Desk(await context.new_page(), link.partition("/?")[0])
                await desk.page.goto(link)
                await desk.panel("Rig sim").get_by_role("link", name="x", exact=True).click()
                await desk.button("Take control").click()
                await desk.button("Enable").click()
                place = desk.panel("Move").get_by_label("Position mm")
                await expect(place).to_be_enabled()
                await place.fill(f"{stands_at + 6:.3f}")
                await desk.button("Move").click()
                shown = desk.page.get_by_label("Position", exact=True)
                await expect(shown).to_have_text(f"{stands_at + 6:.3f}")
        finally:
            await context.close()
        twin.send_signal(signal.SIGINT)
        async with asyncio.timeout(PATIENCE_S):
            await twin.wait()
    report = RunReport.model_validate(json.loads(night.read_text()))
    assert report.axes["x"].motions == 1
    assert report.axes["x"].highest == pytest.approx(stands_at + 6, abs=0.1)
    assert await house.sim.position("x") == pytest.approx(stands_at, abs=0.02)
