"""Whether everybody can use the pages: by screen reader, by keyboard, on a narrow screen, in the dark, in the light."""

import re

import pytest
import pytest_asyncio

from tests.browser.marks import IN_THE_HOUSE

access = pytest.importorskip("tests.browser.access", reason="needs axe-playwright-python and playwright")
windows = pytest.importorskip("tests.browser.windows", reason="the browser tests need playwright")
playwright = pytest.importorskip("playwright.async_api", reason="the browser tests need playwright")
expect = playwright.expect

pytestmark = [pytest.mark.system, *IN_THE_HOUSE]

PAGES = {
    "rig": "Needs attention",
    "axis/sim/x": "Can it move?",
    "axis/mixed/feed": "Limits",
    "scope": "Live",
    "trace/sim/x": "Record x",
    "tuning/sim/x": "Test move",
    "tuning/mixed/feed": "Record",
    "parameters/mixed/feed": "Alarms and counters",
    "network": "sim · line0",
    "events": "Commands and how they ended",
    "commissioning": "3. The axes",
    "commissioning/sim/x": "Checklist",
}
"""Each page with a heading that tells that it is there."""


@pytest_asyncio.fixture(scope="module", loop_scope="package")
async def desk(house):
    """One browser for all pages, with warnings to show: a stop is latched."""
    await house.sim.rig.stop("c")
    async with house.desk() as desk:
        await desk.open("rig")
        await access.examine(desk.page)
        yield desk


async def go(desk, place):
    """Go to a page without loading the console anew."""
    await desk.page.evaluate("(place) => { location.hash = `#/${place}`; }", place)
    await expect(desk.page.get_by_role("heading", name=PAGES[place], exact=True)).to_be_visible()


@pytest.mark.parametrize("place", PAGES)
async def test_a_page_fits_on_every_screen_and_axe_finds_nothing(desk, place):
    await go(desk, place)
    wrong = await access.found_wrong(desk.page, access.SCREENS)

    await desk.page.set_viewport_size({"width": 1400, "height": 900})
    assert not wrong, "\n".join(wrong)


HEADED = (
    """(heading) => [...document.querySelectorAll("h1, h2, h3")].some((each) => each.textContent.trim() === heading)"""
)


async def test_each_page_fits_in_firefox_too_and_axe_finds_nothing(desk, house, tmp_path):
    await house.sim.rig.stop("c")  # other tests may have reset it since
    await go(desk, "events")  # one page at a time has the checklist of an axis
    async with windows.gecko_with(await desk.page.context.cookies(), house.url, tmp_path) as window:
        await window.open(f"{house.url}/#/rig")
        await access.examine_in_firefox(window)
        for place, heading in PAGES.items():
            await window.evaluate("(place) => { location.hash = `#/${place}`; }", place)
            await windows.until(window, HEADED, heading)
            assert not (wrong := await access.found_wrong_in_firefox(window, access.SCREENS)), "\n".join(
                [place, *wrong]
            )


async def test_the_keyboard_reaches_the_page_and_an_axis(house):
    async with house.desk() as desk:
        await desk.page.goto("about:blank")  # what is opened from another page of the console has the focus in it
        await desk.open("rig")
        await expect(desk.panel("Rig sim").get_by_role("link", name="x", exact=True)).to_be_visible()
        await desk.page.keyboard.press("Tab")
        await expect(desk.page.get_by_role("link", name="Skip to the page")).to_be_focused()
        await desk.page.keyboard.press("Enter")
        await expect(desk.page.get_by_role("main")).to_be_focused()

        await desk.panel("Rig sim").get_by_role("link", name="x", exact=True).focus()
        await desk.page.keyboard.press("Enter")
        await expect(desk.page).to_have_title(re.compile("^Axis sim . x "))
        await expect(desk.page.get_by_role("main")).to_be_focused()  # a screen reader reads on from there
        await desk.button("Move").focus()
        reason = await desk.button("Move").get_attribute("aria-describedby")
        await expect(desk.page.locator(f"#{reason}")).to_have_text("Take control first.")


async def test_whoever_is_in_can_let_another_browser_in(house):
    async with house.desk() as desk:
        await desk.open("rig")
        await desk.button("Let another browser in").click()
        link = await desk.page.locator("footer code").inner_text()
        other = await house.browser.new_context(reduced_motion="reduce")
        page = await other.new_page()
        await page.goto(link)
        await expect(page.get_by_role("heading", name="sim", exact=True)).to_be_visible()
        await other.close()
