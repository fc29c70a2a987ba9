"""Control belongs to an open page: while it is open it keeps it, and however it goes, what it moved is halted."""

import asyncio
import os
import signal

import pytest

from ldcnd.contract.leases import ListHolders
from tests.browser.house import Desk, console, open_browser
from tests.browser.marks import IN_THE_HOUSE

playwright = pytest.importorskip("playwright.async_api", reason="the browser tests need playwright")
expect = playwright.expect

pytestmark = [pytest.mark.system, *IN_THE_HOUSE]

SOON_S = 12.0
LEASES_LONG = 7.0
"""Longer than a lease of the console, and longer than an unanswered ping."""


async def holder(house, axis):
    told = await house.sim.rig.ask(ListHolders())
    return next(each.client for each in told.holders if each.axis == axis)


async def jogging(house, desk):
    """Let the page move x at a velocity."""
    await house.sim.quiet("x")
    await desk.open("axis/sim/x")
    await desk.button("Take control").click()
    await desk.button("Enable").click()
    await house.sim.until("x", lambda state: state.enabled)
    away = "2" if await house.sim.position("x") < 0 else "-2"
    await desk.panel("Move").get_by_label("Move", exact=True).select_option("move_velocity")
    await desk.panel("Move").get_by_label("Velocity mm/s").fill(away)
    await desk.button("Move").click()
    await house.sim.until("x", lambda state: state.moving == "yes")


async def halted(house):
    """Wait until x stands without a latch and without a holder, long before it would end by itself."""
    async with asyncio.timeout(SOON_S):
        state = await house.sim.until("x", lambda state: state.moving == "no")
        while await holder(house, "x"):
            await asyncio.sleep(0.05)
    assert not state.stop_latched
    assert abs(await house.sim.position("x")) < 90


async def test_closing_the_page_halts_what_it_moved(house):
    async with house.desk() as desk:
        await jogging(house, desk)
        await desk.page.close()
        await halted(house)


async def test_reloading_the_page_halts_what_it_moved(house):
    async with house.desk() as desk:
        await jogging(house, desk)
        await desk.page.reload()
        await halted(house)
        await expect(desk.button("Take control")).to_be_visible()


async def test_leaving_the_console_halts_what_it_moved(house):
    async with house.desk() as desk:
        await jogging(house, desk)
        await desk.page.goto("about:blank")
        await halted(house)


async def test_killing_the_browser_halts_what_it_moved(house):
    async with house.desk() as first:
        cookies = await first.page.context.cookies()
        if not cookies:
            await first.open("rig")
            cookies = await first.page.context.cookies()
    async with open_browser() as browser:
        context = await browser.new_context()
        await context.add_cookies(cookies)
        await jogging(house, Desk(await context.new_page(), house.url))
        tools = await browser.new_browser_cdp_session()
        processes = (await tools.send("SystemInfo.getProcessInfo"))["processInfo"]

        os.kill(next(each["id"] for each in processes if each["type"] == "browser"), signal.SIGKILL)

        await halted(house)


async def test_a_hidden_page_whose_timers_stand_keeps_control(house):
    async with house.desk() as desk:
        await house.sim.quiet("x")
        await desk.open("axis/sim/x")
        await desk.button("Take control").click()
        await expect(desk.panel("Control")).to_contain_text("Held by this page")
        mine = await holder(house, "x")
        tools = await desk.page.context.new_cdp_session(desk.page)
        await tools.send("Page.setWebLifecycleState", {"state": "frozen"})

        end_s = asyncio.get_running_loop().time() + LEASES_LONG
        while asyncio.get_running_loop().time() < end_s:
            assert await holder(house, "x") == mine
            await asyncio.sleep(0.2)

        await tools.send("Page.setWebLifecycleState", {"state": "active"})
        await desk.button("Enable").click()
        await house.sim.until("x", lambda state: state.enabled)


async def test_a_page_whose_axis_moves_asks_before_it_goes(house):
    asked = []

    async def stay(dialog):
        asked.append(dialog.type)
        await dialog.dismiss()

    async with house.desk() as desk:
        await jogging(house, desk)
        await expect(desk.panel("Now")).to_contain_text("moving at a velocity")
        desk.page.on("dialog", stay)
        await desk.page.close(run_before_unload=True)
        async with asyncio.timeout(20):
            while not asked:
                await asyncio.sleep(0.05)
        assert (await house.sim.rig.state("x")).moving == "yes"
        await desk.button("Halt").click()
        await house.sim.until("x", lambda state: state.moving == "no")

    assert asked == ["beforeunload"]


async def test_a_second_console_on_the_host_takes_no_login_from_a_page_that_moves_an_axis(house):
    async with house.desk() as desk, console(house.mixed.endpoint) as link:
        await jogging(house, desk)
        other = await desk.page.context.new_page()
        await other.goto(link)
        await expect(other.get_by_role("heading", name="mixed", exact=True)).to_be_visible()

        await desk.page.keyboard.press("Escape")

        await house.sim.until("x", lambda state: state.stop_latched and state.moving == "no")
        await expect(desk.page.get_by_text("You control sim · x")).to_be_visible()


async def test_a_page_whose_cookies_are_gone_says_so_and_still_ends_motions(house):
    async with house.desk() as desk:
        await jogging(house, desk)
        await desk.page.context.clear_cookies()
        await expect(desk.page.get_by_text("The login of this page is gone")).to_be_visible()

        await desk.button("Halt").click()
        await house.sim.until("x", lambda state: state.moving == "no")
        await desk.page.keyboard.press("Escape")

        await house.sim.until("x", lambda state: state.stop_latched)
