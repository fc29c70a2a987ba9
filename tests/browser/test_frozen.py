"""A console process that stands still: what its pages say of a press and of values that nobody has heard of since."""

import asyncio
import signal
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress

import pytest

from tests.browser.marks import IN_THE_HOUSE

playwright = pytest.importorskip("playwright.async_api", reason="the browser tests need playwright")
house_of = pytest.importorskip("tests.browser.house", reason="the browser tests need playwright")
expect = playwright.expect

pytestmark = [pytest.mark.system, *IN_THE_HOUSE]

WATCH = """(words) => {
  window.seen = { pressed: null, said: null, silent: null, old: null };
  const now = () => performance.now();
  addEventListener("keydown", () => { window.seen.pressed ??= now(); }, true);
  addEventListener("pointerdown", () => { window.seen.pressed ??= now(); }, true);
  const look = () => {
    const { seen } = window, text = document.body.innerText;
    if (text.includes(words)) seen.said ??= now();
    if (document.querySelector(".big").dataset.known === "no") seen.old ??= now();
    requestAnimationFrame(look);
  };
  look();
}"""
"""Note when a press came, when the page said so many words, and when its position was no present one any more."""
ADVICE = "If the machine moves, use the emergency stop."


@asynccontextmanager
async def looking_at_x(house) -> AsyncIterator[tuple[object, object]]:
    """Show x on a page of a console of its own; yields that process and the page."""
    async with (
        house_of.console_process(house.sim.endpoint) as (running, link),
        await house.browser.new_context(reduced_motion="reduce") as context,
    ):
        context.set_default_timeout(house_of.PATIENCE_S * 1e3)
        page = await context.new_page()
        await page.goto(link)
        await page.goto(f"{link.partition('/?')[0]}/#/axis/sim/x")
        await expect(page.locator(".now-state")).to_contain_text("good")
        try:
            yield running, page
        finally:
            with suppress(ProcessLookupError):
                running.send_signal(signal.SIGCONT)


@pytest.mark.parametrize("press", ["Escape", "Stop all axes", "Stop x", "Quick stop"])
async def test_a_press_that_nobody_answers_is_said_to_be_unanswered_within_half_a_second(house, press):
    await house.sim.quiet("x", "y", "z", "c")
    async with looking_at_x(house) as (running, page):
        await page.evaluate(WATCH, ADVICE)
        running.send_signal(signal.SIGSTOP)
        if press == "Escape":
            await page.keyboard.press(press)
        else:
            await page.get_by_role("button", name=press).click()
        await expect(page.get_by_text(ADVICE)).to_be_visible()
        seen = await page.evaluate("() => window.seen")
        assert seen["said"] - seen["pressed"] < 700  # and drawn on a busy machine
        assert not (await house.sim.rig.state("x")).stop_latched

        running.send_signal(signal.SIGCONT)
        await house.sim.until("x", lambda state: state.stop_latched)
        await expect(page.get_by_text(ADVICE)).to_have_count(0)
    await house.sim.quiet("x", "y", "z", "c")


async def test_values_of_a_console_that_sends_nothing_stand_as_present_ones_for_a_second_at_most(house):
    await house.sim.quiet("x")
    async with looking_at_x(house) as (running, page):
        await page.evaluate(WATCH, ADVICE)
        frozen = await page.evaluate("() => performance.now()")
        running.send_signal(signal.SIGSTOP)
        await expect(page.get_by_label("Position", exact=True)).to_contain_text("(")
        assert (await page.evaluate("() => window.seen"))["old"] - frozen < 1_500
        await expect(page.get_by_text("The console process sends nothing").first).to_be_visible()

        running.send_signal(signal.SIGCONT)
        await expect(page.get_by_label("Position", exact=True)).not_to_contain_text("(")


async def test_control_that_ends_while_the_console_stands_still_is_not_laid_to_the_daemon(house):
    await house.sim.quiet("x")
    async with looking_at_x(house) as (running, page):
        await page.get_by_role("button", name="Take control", exact=True).click()
        await expect(page.get_by_text("Held by this page")).to_be_visible()
        running.send_signal(signal.SIGSTOP)
        async with asyncio.timeout(house_of.PATIENCE_S):  # its lease ends
            while (await house.sim.rig.state("x")).holder:
                await asyncio.sleep(0.05)
        running.send_signal(signal.SIGCONT)
        notice = page.locator(".notices").get_by_text("control of x was lost")
        await expect(notice).to_contain_text("the console process stood still for")
        await expect(notice).not_to_contain_text("no daemon serves")
