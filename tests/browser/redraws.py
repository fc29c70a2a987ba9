"""`python -m tests.browser.redraws`: how often a browser redraws a full scope in front of a large rig.

31 axes at 10 Hz on one line, and 8 axes at 60 Hz on four more, all eight on the scope. Everything shares this machine:
the simulated lines, the daemons, the console and the browser, which draws without a graphics processor.
"""

import argparse
import asyncio
import re
import statistics
import tempfile
from contextlib import AsyncExitStack
from pathlib import Path

from playwright.async_api import CDPSession, expect

from tests.bench.console import large_rig
from tests.browser.house import PATIENCE_S, DaemonUnderTest, console, open_browser

LINES, AXES_OF_A_LINE, RATE_HZ = 4, 2, 60
TARGET_HZ = 55


def fast_rig() -> str:
    """Return the configuration of eight axes that are read at `RATE_HZ`."""
    parts = ['rig = "fast"']
    for line in range(LINES):
        parts.append(f'[[bus]]\nname = "fast{line}"\nport = "sim:fast{line}"\nbaud = 115200\nmargin_ms = 50')
        parts += [
            f'[[bus.axis]]\nname = "f{line}{number}"\naddress = {number}\nmodel = "ls-182ap"\nvelocity = 1\n'
            f"acceleration = 1\nrates = {{ position = {RATE_HZ}, velocity = 5, adc = 1, state = 5 }}"
            for number in range(1, AXES_OF_A_LINE + 1)
        ]
    modules = ", ".join(['{ model = "ls182ap" }'] * AXES_OF_A_LINE)
    parts += [f'[[sim]]\nname = "fast{line}"\nmodule = [{modules}]' for line in range(LINES)]
    return "\n".join(parts)


async def measure(folder: Path, seconds: int) -> tuple[list[int], float]:
    """Return the redraws of each second, as the page counts them, and the share of its time that the page was busy."""
    configs = {"large.toml": large_rig(), "fast.toml": fast_rig()}
    async with AsyncExitStack() as stack:
        daemons = []
        for name, text in configs.items():
            (folder / name).write_text(text, encoding="utf-8")
            daemons.append(DaemonUnderTest(folder / name))
            stack.push_async_callback(daemons[-1].end)
            await daemons[-1].start()
        link = await stack.enter_async_context(console(*(daemon.endpoint for daemon in daemons)))
        browser = await stack.enter_async_context(open_browser())
        page = await browser.new_page(viewport={"width": 1400, "height": 900})
        expect.set_options(timeout=PATIENCE_S * 1e3)
        await page.goto(link)
        await expect(page.get_by_role("row", name=re.compile("^(a|f)"))).to_have_count(31 + LINES * AXES_OF_A_LINE)
        await page.goto(link.split("?")[0] + "#/scope")
        for box in await page.get_by_role("group", name=re.compile("fast")).get_by_label("position", exact=True).all():
            if not await box.is_checked():
                await box.check()
        counter = page.locator("[data-redraws]")
        await expect(counter).to_be_visible()
        tools = await page.context.new_cdp_session(page)
        await tools.send("Performance.enable", {"timeDomain": "threadTicks"})  # not what others take from it
        before, counts = await busy_s(tools), []
        for _ in range(seconds):
            await asyncio.sleep(1)
            counts.append(int(await counter.get_attribute("data-redraws") or 0))
        after = await busy_s(tools)
        return counts[1:], (after["TaskDuration"] - before["TaskDuration"]) / (after["Timestamp"] - before["Timestamp"])


async def busy_s(tools: CDPSession) -> dict[str, float]:
    """Return the clocks of a page."""
    told = await tools.send("Performance.getMetrics")
    return {each["name"]: each["value"] for each in told["metrics"]}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=int, default=20)
    with tempfile.TemporaryDirectory() as folder:
        counts, busy = asyncio.run(measure(Path(folder), parser.parse_args().seconds))
    median = statistics.median(counts)
    verdict = "met" if median >= TARGET_HZ else "MISSED"
    print(f"redraws a second: median {median:g}, least {min(counts)}; target {TARGET_HZ}: {verdict}")
    print(f"main thread of the page: busy for {busy:.0%} of the time, {busy * 1e3 / median:.1f} ms a redraw")


if __name__ == "__main__":
    main()
