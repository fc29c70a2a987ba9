"""A daemon that is gone, or silent: the page says so wherever one looks, and none of its values passes for new."""

from contextlib import asynccontextmanager

import pytest

from tests.browser.marks import IN_THE_HOUSE
from tests.support.marionette import ESCAPE

windows = pytest.importorskip("tests.browser.windows", reason="the browser tests need playwright")
until = windows.until

pytestmark = [pytest.mark.system, *IN_THE_HOUSE]

SIZES = ((320, 568), (640, 400), (1400, 900))
PAGES = {
    "rig": 'section[aria-label="Rig alpha"]',
    "axis/alpha/x": "main",
    "axis/alpha/feed": "main",
    "network": "section:has(> header > h2)",
    "trace/alpha/x": "main",
    "tuning/alpha/x": "main",
    "parameters/alpha/feed": "main",
    "events": "main",
    "scope": "main",
    "commissioning": "main",
}
"""Pages, and the part of each that is about the rig."""
SEEN = """() => {
  scrollTo(0, document.body.scrollHeight);
  const notice = [...document.querySelectorAll(".notices .notice")].find((each) => each.textContent.includes("alpha"));
  if (!notice) return "there is no notice";
  const range = document.createRange();
  range.selectNodeContents(notice);
  for (const box of range.getClientRects()) {
    const [x, y] = [box.left + 4, box.top + box.height / 2];
    if (box.top < 0 || box.bottom > innerHeight || x < 0 || box.right > innerWidth + 1) return "it is off the screen";
    const over = document.elementFromPoint(x, y);
    if (!notice.contains(over)) return `${over?.className || over?.tagName} is over it`;
  }
  const room = innerHeight - document.querySelector("header.frame").getBoundingClientRect().bottom;
  return room < innerHeight / 3 ? "it leaves no room for the page" : "";
}"""
UNMARKED = """(within) => {
  const parts = [...document.querySelectorAll(within)].filter(
    (each) => within !== "section:has(> header > h2)" || each.querySelector("h2").textContent.startsWith("alpha"));
  const values = "td.number, td.main, .facts dd, .lamps li b, .counters b, .meter b, .big";
  return parts.flatMap((part) => [...part.querySelectorAll(values)])
    .filter((each) => /\\d|yes|no|up|open|closed|low|high/.test(each.textContent))
    .filter((each) => each.checkVisibility() && getComputedStyle(each).fontStyle !== "italic")
    .map((each) => `${each.closest("tr, div, li")?.textContent.trim().slice(0, 60)}`);
}"""
CALM = """() => {
  const text = document.body.innerText, strip = document.querySelector(".strip")?.textContent ?? "";
  return ["Nothing needs attention", "Ready to move"].filter((each) => text.includes(each))
    .concat(["Nothing moves"].filter((each) => strip.includes(each)));
}"""
UNMARKED_LAST = """() => [...document.querySelectorAll("td [data-known=no] b")]
  .filter((each) => !each.textContent.startsWith("(") || getComputedStyle(each).fontStyle !== "italic").length"""
MODULE = """() => [...document.querySelectorAll("section")]
  .filter((each) => each.querySelector("h2, h3")?.textContent === "Module cabinet")
  .filter((each) => each.parentElement.closest("section")?.textContent.startsWith("alpha"))
  .map((each) => each.textContent).join()"""
ON_THE_RIG = (
    "() => document.querySelector('[aria-label=\"Rig alpha\"] [aria-label=\"Module cabinet\"] dd')?.innerText ?? ''"
)
"""What the rig page says of its door."""
ATTENTION = """() => document.querySelector(".attention, main").textContent"""
EVENTS = """() => [...document.querySelectorAll("tr")].map((each) => each.textContent)
  .filter((each) => each.includes("cabinet")).join()"""
EVENT = """
[[sim.event]]
at_s = {}
module = 5
power = "{}"
"""
NAMED = (
    """() => [...document.querySelectorAll(".notices .notice")].some((each) => each.textContent.includes("alpha"))"""
)


@asynccontextmanager
async def lost_alpha(house, window, page, way):
    """Look at a page of a rig, then lose its daemon."""
    async with house.beside_alpha() as own:
        await window.open(own.link)
        await window.open(f"{own.url}/#/rig")
        await until(window, "() => document.querySelector('[aria-label=\"Rig alpha\"]')?.dataset.stale === 'no'")
        await window.evaluate("(page) => { location.hash = `#/${page}`; }", page)
        await until(window, "() => document.querySelector('h1') !== null")
        if way == "gone":
            await house.alpha.end()
        else:
            house.alpha.pause(on=True)
        await until(window, NAMED)
        yield


@pytest.mark.parametrize("way", ["gone", "silent"])
@pytest.mark.parametrize("page", ["axis/alpha/x", "network", "rig"])
async def test_the_notice_is_seen_on_a_scrolled_page_of_any_size(house, window, page, way):
    async with lost_alpha(house, window, page, way):
        wrong = []
        try:
            for size in SIZES:
                await window.resize(*size)
                wrong += [(size, found) for found in [await window.evaluate(SEEN)] if found]
                await window.keys(ESCAPE)  # what a stop reports lies over the page
                await until(window, "() => document.querySelector('.stop-report').dataset.shown === 'yes'")
                wrong += [(size, "stop", found) for found in [await window.evaluate(SEEN)] if found]
        finally:
            await window.resize(1400, 900)
        assert not wrong


async def test_no_value_of_a_daemon_that_is_gone_passes_for_a_present_one(house, window):
    async with lost_alpha(house, window, "rig", "gone"):
        for page, part in PAGES.items():
            await window.evaluate("(page) => { location.hash = `#/${page}`; }", page)
            await until(window, UNMARKED, part, wanted=lambda found: not found)
            await until(window, CALM, wanted=lambda found: not found)


async def test_a_scope_that_was_open_marks_its_last_values(house, window):
    async with lost_alpha(house, window, "scope/alpha/x", "gone"):
        await until(window, "() => document.querySelectorAll('td [data-known=no]').length === 3")
        await until(window, UNMARKED_LAST, wanted=lambda found: not found)


async def test_a_module_without_power_is_named_and_shows_no_value_and_its_loss_and_return_are_events(
    house, window, tmp_path
):
    config, before = tmp_path / "alpha.toml", house.alpha.config
    text = house.sim.config.read_text(encoding="utf-8").partition("[[port]]")[0].replace('rig = "sim"', 'rig = "alpha"')
    config.write_text(text + "".join(EVENT.format(*each) for each in ((20, "off"), (40, "on"))), encoding="utf-8")
    house.alpha.config = config
    try:
        async with house.beside_alpha() as own:
            await window.open(own.link)
            await window.open(f"{own.url}/#/network")
            await until(window, MODULE)
            await until(window, MODULE, wanted=lambda found: "1 low" in found or "1 high" in found)
            await until(window, MODULE, wanted=lambda found: "The module does not answer" in found)
            await until(window, MODULE, wanted=lambda found: "1 low" not in found and "1 high" not in found)
            await window.evaluate("() => { location.hash = '#/rig'; }")
            await until(window, ATTENTION, wanted=lambda found: "alpha · cabinet" in found)
            await until(window, ON_THE_RIG, wanted=lambda found: "unknown" in found)
            await until(window, ATTENTION, wanted=lambda found: "alpha · cabinet" not in found)
            await until(
                window, ON_THE_RIG, wanted=lambda found: "unknown" not in found and ("on" in found or "off" in found)
            )
            await window.evaluate("() => { location.hash = '#/events'; }")
            await until(window, EVENTS, wanted=lambda found: "link lost" in found and "link back" in found)
    finally:
        house.alpha.config = before
