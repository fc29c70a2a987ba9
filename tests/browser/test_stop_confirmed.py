"""No page calls an axis stopped before its drive has shown it: a latch is the daemon's, and says nothing of a shaft."""

import re
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import pytest

from ldcnd.client.rig_client import RigClient
from ldcnd.contract.commands import MoveVelocity, Power
from ldcnd.net.zenoh_session import open_zenoh_session
from ldcnd.net.zenoh_settings import ZenohSettings
from ldcnd.testing import ServedRig, served_rig
from tests.browser.marks import IN_THE_HOUSE
from tests.support.process import ROOT

playwright = pytest.importorskip("playwright.async_api", reason="the browser tests need playwright")
house_of = pytest.importorskip("tests.browser.house", reason="the browser tests need playwright")
expect = playwright.expect

pytestmark = [pytest.mark.system, *IN_THE_HOUSE]

LISTEN = """() => {
  window.said = [];
  const look = () => {
    const text = document.querySelector(".stops")?.textContent ?? "";
    if (text !== window.said.at(-1)) window.said.push(text);
    requestAnimationFrame(look);
  };
  look();
}"""
"""Gather everything that the strip says of stops."""


@asynccontextmanager
async def looking_at_x(house) -> AsyncIterator[tuple[ServedRig, RigClient, object]]:
    """Show x on a page; yields its rig, whose drives can fail, a client of it, and the page."""
    with served_rig(ROOT / "config" / "simulated.toml") as rig:
        settings = ZenohSettings(mode="client", connect=(rig.endpoint,))
        async with (
            open_zenoh_session(settings) as session,
            house_of.console_process(rig.endpoint) as (_, link),
            await house.browser.new_context(reduced_motion="reduce") as context,
        ):
            page = await context.new_page()
            await page.goto(link)
            await page.goto(f"{link.partition('/?')[0]}/#/axis/sim/x")
            await expect(page.locator(".now-state")).to_contain_text("good")
            yield rig, RigClient(session, "sim"), page


async def called_stopped(page) -> list[str]:
    """Return what the strip has said while it called x stopped."""
    said = await page.evaluate("() => window.said")
    return [each for each in said if re.search(r"stopped and latched: [^.]*\bx\b", each)]


@pytest.mark.parametrize("press", ["Escape", "Stop x", "Quick stop"])
@pytest.mark.parametrize("moves", ["x", "z"])
async def test_a_drive_that_does_not_answer_is_at_no_instant_called_stopped(house, press, moves):
    async with looking_at_x(house) as (rig, client, page):
        await client.command(moves, Power(on=True))
        await client.command(moves, MoveVelocity(velocity=2))
        rig.until(lambda each: abs(each.truth(moves).velocity) > 1)
        await page.evaluate(LISTEN)

        rig.ask(lambda each: each.faults.mute("x"))
        if press == "Escape":
            await page.keyboard.press(press)
        else:
            await page.get_by_role("button", name=press).click()
        await expect(page.locator(".stops")).to_contain_text("stop NOT confirmed by x")
        if press == "Escape":
            await expect(page.locator(".stops")).to_contain_text(re.compile(r"stopped and latched: [^.]*\bz\b"))
        assert not await called_stopped(page)


async def test_a_second_press_is_not_answered_by_what_was_read_before_it(house):
    async with looking_at_x(house) as (rig, _, page):
        stops = page.locator(".stops")
        await page.keyboard.press("Escape")
        await expect(stops).to_contain_text("stopped and latched: x, y, z, c")
        rig.ask(lambda each: each.faults.mute("x"))
        await page.keyboard.press("Escape")
        await expect(stops).to_contain_text("not seen to stand: x")
        await page.evaluate(LISTEN)
        await expect(stops).to_contain_text("stop NOT confirmed by x")
        assert not await called_stopped(page)
