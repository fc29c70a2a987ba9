"""Whether everybody can use the pages: by screen reader, by keyboard, on a narrow screen, in the dark, in the light."""

import re

import pytest

axe = pytest.importorskip("axe_playwright_python.async_playwright", reason="needs axe-playwright-python")
playwright = pytest.importorskip("playwright.async_api", reason="the browser tests need playwright")
expect = playwright.expect

pytestmark = [pytest.mark.real_time, pytest.mark.asyncio(loop_scope="package"), pytest.mark.timeout(240)]

PAGES = {
    "rig": "Needs attention",
    "axis/sim/x": "Can it move?",
    "axis/mixed/feed": "Limits",
    "scope": "Live",
    "trace/sim/x": "Record x",
    "tuning/sim/x": "Test move",
    "tuning/mixed/feed": "Record",
    "parameters/mixed/feed": "Alarms and assumptions",
    "network": "sim · line0",
    "events": "Commands and how they ended",
}
"""Each page with a heading that tells that it is there."""


NARROW_INPUTS = """
[...document.querySelectorAll("input[type=number], select")].filter((field) => field.clientWidth < 60).map(
  (field) => field.getAttribute("aria-label") ?? field.id)
"""
EVERYTHING = {"resultTypes": ["violations"]}
COLOURS = EVERYTHING | {"runOnly": {"type": "rule", "values": ["color-contrast", "link-in-text-block"]}}
"""Only colours depend on the scheme."""


async def go(desk, place):
    """Go to a page without loading the console anew."""
    await desk.page.evaluate("(place) => { location.hash = `#/${place}`; }", place)
    await expect(desk.page.get_by_role("heading", name=PAGES[place], exact=True)).to_be_visible()


async def something_stands_out(house):
    """Latch a stop, so that the pages have warnings to show."""
    await house.sim.rig.stop("c")


async def test_axe_finds_nothing_on_any_page_in_the_dark_and_in_the_light(house):
    await something_stands_out(house)
    reports = []
    async with house.desk() as desk:
        await desk.open("rig")
        for place in PAGES:
            await go(desk, place)
            for scheme, rules in (("dark", EVERYTHING), ("light", COLOURS)):
                await desk.page.emulate_media(color_scheme=scheme)
                found = await axe.Axe().run(desk.page, options=rules)
                if found.response["violations"]:
                    reports.append(f"{place}, {scheme}: {found.generate_report()}")
    assert not reports, "\n".join(reports)


@pytest.mark.parametrize("width", [390, 1280, 1920])
async def test_no_page_is_wider_than_the_screen(house, width):
    await something_stands_out(house)
    async with house.desk(width=width) as desk:
        await desk.open("rig")
        for place in PAGES:
            await go(desk, place)
            assert await desk.page.evaluate("document.documentElement.scrollWidth") <= width, place
            narrow = await desk.page.evaluate(NARROW_INPUTS)
            assert not narrow, place
            stop = desk.page.get_by_role("button", name="Stop all axes")
            await expect(stop).to_be_in_viewport(ratio=1)
            for link in await desk.page.get_by_role("navigation").get_by_role("link").all():
                box = await link.bounding_box()
                assert box["x"] >= 0
                assert box["x"] + box["width"] <= width, place


async def test_the_keyboard_reaches_the_page_and_an_axis(house):
    async with house.desk() as desk:
        await desk.open("rig")
        await expect(desk.panel("Rig sim").get_by_role("link", name="x", exact=True)).to_be_visible()
        await desk.page.keyboard.press("Tab")
        await expect(desk.page.get_by_role("link", name="Skip to the page")).to_be_focused()
        await desk.page.keyboard.press("Enter")
        await expect(desk.page.get_by_role("main")).to_be_focused()

        await desk.panel("Rig sim").get_by_role("link", name="x", exact=True).focus()
        await desk.page.keyboard.press("Enter")
        await expect(desk.page).to_have_title(re.compile("^Axis x "))
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
