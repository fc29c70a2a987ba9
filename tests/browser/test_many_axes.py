"""The rig page with a few axes, with many, and with very many: one line an axis, in sight, found, and told apart."""

from contextlib import AsyncExitStack, asynccontextmanager

import pytest
import pytest_asyncio

from ldcnd.contract.commands import MoveAbsolute, Power
from tests.browser.house import PATIENCE_S, DaemonUnderTest, Desk, console, open_browser

access = pytest.importorskip("tests.browser.access", reason="needs axe-playwright-python and playwright")
windows = pytest.importorskip("tests.browser.windows", reason="the browser tests need playwright")
playwright = pytest.importorskip("playwright.async_api", reason="the browser tests need playwright")
expect = playwright.expect

pytestmark = [
    pytest.mark.system,
    pytest.mark.real_time,
    pytest.mark.asyncio(loop_scope="module"),
    pytest.mark.timeout(240),
]

MOST_ON_A_LINE = 22
COUNTS = (4, 31, 66)
SCREENS = {"laptop": (1280, 800), "large": (1920, 1080), "phone": (390, 844)}
HIGHEST_ROW = 44
HIGHEST_PAGE = {"laptop": 3400, "large": 3400, "phone": 3400}
ROWS = """() => [...document.querySelectorAll("table.axes tbody tr[data-axis]")].map((row) => {
  const buttons = [...row.querySelectorAll("td.commands button")].map((each) => each.getBoundingClientRect().top);
  const [place, cell] = [row.querySelector(".place"), row.querySelector("td.main")];
  const height = Math.round(row.getBoundingClientRect().height);
  return [row.dataset.axis, height, new Set(buttons).size, place.scrollWidth > cell.clientWidth];
})"""
"""Name, height and rows of buttons of each axis, and whether its position is cut."""
HEIGHT = "() => document.documentElement.scrollHeight"
ONE_ROW = """() => new Set([...document.querySelectorAll(".rig-commands button")].map((each) => {
  const box = each.getBoundingClientRect();
  return Math.round((box.top + box.bottom) / 20);
})).size"""


def plant(axes: int, most_on_a_line: int = MOST_ON_A_LINE) -> str:
    """Return the configuration of a rig of so many axes, every third of which is not homed."""
    parts = [f'rig = "plant{axes}"\n[zenoh]\nlisten = []']
    names = [f"a{number}" for number in range(1, axes + 1)]
    lines = [names[first : first + most_on_a_line] for first in range(0, axes, most_on_a_line)]
    for line, here in enumerate(lines):
        parts.append(f'[[bus]]\nname = "line{line}"\nport = "sim:line{line}"\nbaud = 115200\nmargin_ms = 250')
        for address, name in enumerate(here, 1):
            homed = "" if int(name[1:]) % 3 == 0 else 'reference = "at_reset"\n'
            parts.append(
                f'[[bus.axis]]\nname = "{name}"\naddress = {address}\nmodel = "ls-182ap"\nunit = "mm"\n'
                f"counts_per_unit = 1000\nvelocity = 2\nacceleration = 200\n{homed}"
                "gains = { kp = 350, kd = 3000, ki = 400, il = 400, ol = 250, el = 4000 }\n"
                "rates = { position = 2, velocity = 2, adc = 1, state = 1 }"
            )
    for line, here in enumerate(lines):
        modules = ", ".join(['{ model = "ls-182ap" }'] * len(here))
        parts.append(f'[[sim]]\nname = "line{line}"\nmodule = [{modules}]')
    return "\n".join(parts)


@asynccontextmanager
async def rig_of(folder, browser, axes):
    """Yield a daemon of so many axes, of which one moves, and a desk that has let itself in."""
    config = folder / f"plant{axes}.toml"
    config.write_text(plant(axes), encoding="utf-8")
    daemon = DaemonUnderTest(config)
    async with AsyncExitStack() as stack:
        stack.push_async_callback(daemon.end)
        await daemon.start()
        link = await stack.enter_async_context(console(daemon.endpoint))
        context = await browser.new_context(viewport={"width": 1280, "height": 800}, reduced_motion="reduce")
        stack.push_async_callback(context.close)
        context.set_default_timeout(PATIENCE_S * 1e3)
        page = await context.new_page()
        await page.goto(link)
        await expect(page.locator("tr[data-axis]")).to_have_count(axes, timeout=PATIENCE_S * 1e3)
        yield daemon, Desk(page, link.split("/?")[0])


@pytest_asyncio.fixture(scope="module", loop_scope="module", params=COUNTS)
async def many(request, tmp_path_factory):
    """A rig of so many axes on the screen."""
    async with open_browser() as browser, rig_of(tmp_path_factory.mktemp("plant"), browser, request.param) as there:
        yield request.param, *there


async def test_each_axis_is_one_line_and_the_page_is_not_long(many):
    count, _, desk = many
    wrong = []
    for screen, (width, height) in SCREENS.items():
        await desk.page.set_viewport_size({"width": width, "height": height})
        await desk.page.reload()
        await expect(desk.page.locator(".bus-line").first).to_be_visible()
        if screen != "phone":
            await expect(desk.page.locator("tr[data-axis]")).to_have_count(count)
            rows = await desk.page.evaluate(ROWS)
            wrong += [(screen, *row) for row in rows if row[1] > HIGHEST_ROW or row[2] > 1 or row[3]]
        length = await desk.page.evaluate(HEIGHT)
        if length > HIGHEST_PAGE[screen]:
            wrong.append((screen, "the page is", length, "high"))
        if screen == "large" and await desk.page.evaluate(ONE_ROW) > 1:
            wrong.append((screen, "commands in several rows"))
    await desk.page.set_viewport_size({"width": 1280, "height": 800})
    assert not wrong


async def test_firefox_shows_each_axis_in_one_line_too(many, tmp_path):
    count, _, desk = many
    wrong = []
    async with windows.gecko_with(await desk.page.context.cookies(), desk.url, tmp_path) as window:
        await window.open("about:blank")  # another part of the same page would not load it with the cookies
        await window.open(f"{desk.url}/#/rig")
        for screen, (width, height) in SCREENS.items():
            await window.resize(width, height)  # a page that is loaded again would lose the scale that makes it narrow
            await windows.until(window, "() => document.querySelector('.bus-line') !== null")
            if screen != "phone":  # where lines are folded
                await windows.until(window, ROWS, wanted=lambda rows: len(rows) == count)
                rows = await window.evaluate(ROWS)
                wrong += [(screen, *row) for row in rows if row[1] > HIGHEST_ROW or row[2] > 1 or row[3]]
            # a page folds its lines when its next values come
            await windows.until(window, HEIGHT, wanted=lambda length, most=HIGHEST_PAGE[screen]: length <= most)
            wrong += [(screen, each) for each in await window.evaluate(access.FITS, width)]
            if screen == "large" and await window.evaluate(ONE_ROW) > 1:
                wrong.append((screen, "commands in several rows"))
    assert not wrong


async def test_axe_finds_nothing_and_all_of_it_fits(many):
    _, _, desk = many
    await access.examine(desk.page)

    assert not await access.found_wrong(desk.page, access.SCREENS)

    await desk.page.set_viewport_size({"width": 1280, "height": 800})


async def test_what_moves_is_in_sight_wherever_the_page_is_scrolled_and_can_be_looked_for(many):
    count, daemon, desk = many
    strip = desk.page.locator(".strip")
    await desk.page.evaluate("() => scrollTo(0, document.body.scrollHeight)")
    await expect(strip).to_contain_text("Nothing moves")
    await daemon.rig.command("a2", Power(on=True))
    before = await daemon.position("a2")
    await daemon.rig.command("a2", MoveAbsolute(position=before + 100))
    await expect(strip.get_by_role("link", name="a2", exact=True)).to_be_in_viewport()
    await expect(strip).to_contain_text(f"→ {before + 100:.3f}")
    await expect(strip).to_contain_text("Not homed")

    if count > 6:
        await desk.page.get_by_label("Show", exact=True).select_option("what moves")
        await expect(desk.page.locator("tr[data-axis]")).to_have_count(1)
        await desk.page.get_by_label("Show", exact=True).select_option("what is not homed or does not answer")
        await expect(desk.page.locator("tr[data-axis]")).to_have_count(count // 3)
        await desk.page.get_by_label("Show", exact=True).select_option("all axes")
        await desk.page.get_by_label("Find axis").focus()
        await desk.page.keyboard.type("a3")
        wanted = sum(f"a{number}".startswith("a3") for number in range(1, count + 1))
        await expect(desk.page.locator("tr[data-axis]")).to_have_count(wanted)
        await desk.page.keyboard.press("Backspace")
        await desk.page.keyboard.press("Backspace")
    await expect(desk.page.locator("tr[data-axis]")).to_have_count(count)

    fold = desk.page.get_by_role("button", name="line0", exact=True)
    await fold.focus()
    await desk.page.keyboard.press("Enter")
    await expect(fold).to_have_attribute("aria-expanded", "false")
    await expect(desk.page.locator("tr[data-axis=a2]")).to_have_count(0)
    await expect(desk.page.get_by_role("region", name=f"Line line0 of plant{count}")).to_contain_text("1 moving")
    await desk.page.keyboard.press("Enter")
    await expect(desk.page.locator("tr[data-axis=a2]")).to_be_visible()
    await daemon.quiet("a2")


async def test_all_axes_are_taken_slowed_and_given_up_at_once(many):
    count, _, desk = many
    every = desk.page.get_by_role("group", name=f"Commands for all axes of plant{count}")
    banner = desk.page.get_by_role("banner")
    await every.get_by_role("button", name="Take control of all").click()
    await expect(every.get_by_role("button", name="Take control of all")).to_have_count(0)
    await every.get_by_role("button", name="0 %", exact=True).click()
    await expect(banner).to_contain_text("speed override 0 %")
    await every.get_by_role("button", name="100 %", exact=True).click()
    await expect(banner).not_to_contain_text("speed override")
    await every.get_by_role("button", name="Release control").click()
    await expect(every.get_by_role("button", name="Release control")).to_have_count(0)


async def test_the_commands_of_a_row_are_those_that_make_sense_now(many):
    _, daemon, desk = many
    await daemon.quiet("a1")
    row = desk.page.get_by_role("group", name="Commands for a1", exact=True)
    await row.get_by_role("button", name="Take control a1").click()
    await row.get_by_role("button", name="Enable a1").click()
    await expect(row.get_by_role("button", name="Disable a1")).to_be_enabled()
    await expect(row.get_by_role("button", name="Home a1")).to_be_visible()
    await daemon.rig.stop("a1")
    await daemon.until("a1", lambda state: state.stop_latched and state.moving == "no")
    await expect(row.get_by_role("button", name="Reset a1")).to_be_enabled()
    await row.get_by_role("button", name="Reset a1").click()
    await expect(row.get_by_role("button", name="Home a1")).to_be_visible()
    assert len(await row.get_by_role("button").all()) == 3
    await daemon.until("a1", lambda state: not state.stop_latched)
