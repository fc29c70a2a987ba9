"""Which axis a page is about, and which values a selector stands for, while rigs and axes come and go."""

import re
from contextlib import asynccontextmanager
from types import SimpleNamespace

import pytest

from ldcnd.contract.leases import Acquire, Release
from tests.browser.marks import IN_THE_HOUSE
from tests.support.marionette import ENTER, ESCAPE, TAB

windows = pytest.importorskip("tests.browser.windows", reason="the browser tests need playwright")
playwright = pytest.importorskip("playwright.async_api", reason="the browser tests need playwright")
expect = playwright.expect
until, console = windows.until, windows.console

pytestmark = [pytest.mark.system, *IN_THE_HOUSE]

TEXT = "() => document.querySelector('main').innerText"
HASH = "() => location.hash"
SELECTED = """(label) => {
  const select = [...document.querySelectorAll("select")].find((each) => each.labels[0].textContent === label);
  return select?.selectedOptions[0]?.textContent ?? null;
}"""
OPTIONS = """(label) => {
  const select = [...document.querySelectorAll("select")].find((each) => each.labels[0].textContent === label);
  return [...(select?.options ?? [])].map((each) => each.textContent);
}"""
FOCUS = """(label) => {
  const found = [...document.querySelectorAll("select, input")].find((each) => each.labels[0]?.textContent === label);
  found?.focus();
  return Boolean(found);
}"""
TICKS = """() => [...document.querySelectorAll("input[type=checkbox]:checked")].map(
  (each) => `${each.closest("fieldset")?.querySelector("legend").textContent ?? ""} ${each.labels[0].textContent}`)"""
BUTTONS = """() => [...document.querySelectorAll("main button:not([aria-disabled=true])")].map(
  (each) => each.innerText)"""
PRESS = """(text) => {
  const found = [...document.querySelectorAll("main button")].find((each) => each.textContent.trim() === text);
  if (!found || found.getAttribute("aria-disabled")) return false;
  found.focus();
  return true;
}"""


DESCRIBED = """async (name) => {
  const { rigs } = await (await fetch("/api/rigs")).json();
  return rigs.some((each) => each.name === name && each.axes.length);
}"""
READ_ANEW = """() => new Promise((later) => setTimeout(later, 6000))"""
"""Pages read descriptions every five seconds at the latest."""


async def go(window, house, place):
    await window.open("about:blank")
    await window.open(f"{house.url}/#/{place}")


@asynccontextmanager
async def new_console(house, window):
    """Run a console that has never seen the rig alpha."""
    async with console(house.mixed.endpoint, house.alpha.endpoint) as link:
        await window.open(link)
        yield SimpleNamespace(url=link.split("/?", maxsplit=1)[0].rstrip("/"))


@asynccontextmanager
async def alpha_runs(house):
    """Let one more rig join, with axes of the same names, for as long as the context lasts."""
    await house.alpha.start()
    try:
        yield house.alpha
    finally:
        await house.alpha.end()


@asynccontextmanager
async def started_again(house, changed):
    """Start the rig again with another configuration: `changed` makes it of the text of the one before."""
    config = house.alpha.config
    text = config.read_text(encoding="utf-8")
    config.write_text(changed(text), encoding="utf-8")
    try:
        await house.alpha.start()
        yield
    finally:
        await house.alpha.end()
        config.write_text(text, encoding="utf-8")


def without_feed(text):
    blocks = text.split("[[bus.axis]]")
    return "[[bus.axis]]".join(each for each in blocks if 'name = "feed"' not in each)


@pytest.mark.parametrize(
    ("page", "axis"), [("trace", "mixed · x"), ("tuning", "mixed · x"), ("parameters", "mixed · feed")]
)
async def test_a_page_keeps_its_axis_when_another_rig_joins(house, window, page, axis):
    async with new_console(house, window) as new:
        await go(window, new, page)
        first = await until(window, SELECTED, "Axis", wanted=lambda found: found == axis)
        address = await window.evaluate(HASH)
        assert address == f"#/{page}/{first.replace(' · ', '/')}"

        async with alpha_runs(house):
            await until(window, OPTIONS, "Axis", wanted=lambda found: "alpha · feed" in found)
            assert await window.evaluate(SELECTED, "Axis") == first
            assert await window.evaluate(HASH) == address


async def test_the_scope_keeps_its_channels_when_another_rig_joins(house, window):
    async with new_console(house, window) as new:
        await go(window, new, "scope")
        first = await until(window, TICKS)

        async with alpha_runs(house):
            await until(window, TEXT, wanted=lambda text: "alpha · feed" in text)
            assert await window.evaluate(TICKS) == first


@pytest.mark.parametrize("page", ["axis", "trace", "tuning", "parameters", "scope"])
async def test_an_axis_that_goes_is_said_and_not_replaced(house, window, page):
    async with house.that_expects_alpha() as own:
        async with alpha_runs(house):
            await window.open(own.link)
            await go(window, own, f"{page}/alpha/feed")
            await until(window, TEXT, wanted=lambda text: "not known" not in text and re.search("feed|Pn100", text))

        async with started_again(house, without_feed):
            said = "Rig alpha has no axis feed"
            text = await until(window, TEXT, wanted=lambda text: said in text)
            assert await window.evaluate(HASH) == f"#/{page}/alpha/feed"
            for label in ("Record", "Take control", "Read all", "Power"):
                assert label not in await window.evaluate(BUTTONS)
            assert "Record x" not in text


async def test_an_address_of_an_axis_that_is_not_there_shows_no_other(house, window):
    for page in ("trace", "tuning", "parameters", "scope"):
        await go(window, house, f"{page}/sim/nonesuch")
        await until(window, TEXT, wanted=lambda text: "Rig sim has no axis nonesuch" in text)
        assert await window.evaluate(HASH) == f"#/{page}/sim/nonesuch"
        assert not await window.evaluate(TICKS)


async def test_a_list_that_is_open_does_not_change_under_the_hand(house, window):
    async with new_console(house, window) as new:
        await go(window, new, "trace/mixed/x")
        before = await until(window, OPTIONS, "Axis", wanted=lambda found: "mixed · spool" in found)
        await until(window, FOCUS, "Axis")

        async with alpha_runs(house):
            await until(window, DESCRIBED, "alpha")
            await window.evaluate(READ_ANEW)
            assert await window.evaluate(OPTIONS, "Axis") == before
            await window.keys(TAB)
            await until(window, OPTIONS, "Axis", wanted=lambda found: "alpha · x" in found)
            assert await window.evaluate(SELECTED, "Axis") == "mixed · x"


async def test_a_tick_to_take_control_from_one_client_is_none_to_take_it_from_another(house, window):
    await house.sim.quiet("x")
    ada = await house.sim.rig.ask(Acquire(client="ada", axes=("x",), lease_s=60))
    await go(window, house, "axis/sim/x")
    await until(window, FOCUS, "Take it from ada")
    await window.keys(" ")
    await until(window, PRESS, "Take control")

    bob = await house.sim.rig.ask(Acquire(client="bob", axes=("x",), lease_s=60, force=True))
    await until(window, TEXT, wanted=lambda text: "Take it from bob" in text)
    assert "Take control" not in await window.evaluate(BUTTONS)
    assert ada.lease != bob.lease
    await house.sim.rig.ask(Release(lease=bob.lease))


async def test_a_trigger_whose_channel_is_not_recorded_any_more_is_still_shown(house, window):
    await go(window, house, "trace/sim/x")
    await until(window, FOCUS, "Trigger")
    await window.keys("p")  # position
    assert await until(window, SELECTED, "Trigger") == "position"
    await until(window, FOCUS, "position")
    await window.keys(" ")
    await until(window, TICKS, wanted=lambda ticked: " position" not in [each[-9:] for each in ticked])

    assert "position" in await until(window, SELECTED, "Trigger")
    assert "Record" not in await window.evaluate(BUTTONS)
    await window.keys(ESCAPE, ENTER)


def x_in_cm(text):
    """Give an axis another unit; it stands where it stood."""
    return text.replace('unit = "mm"\ncounts_per_unit = 1000', 'unit = "cm"\ncounts_per_unit = 10000', 1)


async def test_what_was_typed_for_one_unit_is_not_there_for_another(house):
    async with house.that_expects_alpha() as own, own.desk() as desk:
        async with alpha_runs(house):
            await desk.open("axis/alpha/x")
            await desk.panel("Move").get_by_label("Position mm").fill("12")
            await desk.panel("Jog").get_by_label("Speed mm/s").fill("3")
            await expect(desk.panel("Move")).to_contain_text("moves x to 12 mm")

        async with started_again(house, x_in_cm):
            await expect(desk.page.get_by_text("x in cm, was in mm. What was typed for it is cleared.")).to_be_visible()
            await expect(desk.panel("Move").get_by_label("Position cm")).to_have_value("")
            await expect(desk.panel("Jog").get_by_label("Speed cm/s")).not_to_have_value("3")
            assert "to 12 cm" not in await desk.page.inner_text("main")


async def test_the_scope_says_values_in_the_unit_that_they_have(house):
    async with house.that_expects_alpha() as own, own.desk() as desk:
        async with alpha_runs(house):
            await desk.open("scope/alpha/x")
            live = desk.panel("Live")
            await expect(live.locator("tr", has_text="alpha · x position")).to_contain_text("mm")

        async with started_again(house, x_in_cm):
            await expect(live.locator("tr", has_text="alpha · x position")).to_contain_text("cm")

        async with alpha_runs(house):
            await expect(live.locator("tr", has_text="alpha · x position")).to_contain_text("mm")
