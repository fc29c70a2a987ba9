"""`python -m tests.browser.many_cost`: what the rig page of 66 axes costs browser and console, and how memory grows.

Six lines of 11 axes, each read 20 times a second, one moving to and fro. Everything shares this machine, so that
only shares of processor time are told, which others take nothing from.
"""

import argparse
import asyncio
import os
import statistics
import tempfile
from collections.abc import Iterator
from contextlib import AsyncExitStack, suppress
from pathlib import Path

from playwright.async_api import CDPSession, expect

from ldcnd.contract.commands import MoveAbsolute, Power
from tests.browser.house import PATIENCE_S, DaemonUnderTest, console, open_browser
from tests.browser.test_many_axes import plant

AXES, ON_A_LINE, RATE_HZ = 66, 11, 20
SLOW = "rates = { position = 2, velocity = 2, adc = 1, state = 1 }"
FAST = f"rates = {{ position = {RATE_HZ}, velocity = {RATE_HZ}, adc = 1, state = {RATE_HZ} }}"
PAGE_SHARE, CONSOLE_SHARE = 0.5, 0.2
GROWTH = 1.1
"""Of the last third over the second, after collection, as far as a heap is flat."""


def descendants(pid: int) -> Iterator[int]:
    """Yield a process and all below it."""
    yield pid
    for task in Path(f"/proc/{pid}/task").iterdir():
        for child in (task / "children").read_text().split():
            yield from descendants(int(child))


def used_s(words: str) -> float:
    """Return the processor time of what was started from here with these words in its command line, and of all below.

    A process that has ended counts no more; neither browser nor console ends one while a span lasts.
    """
    found: set[int] = set()
    for pid in descendants(os.getpid()):
        with suppress(OSError):
            line = Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
            found |= set(descendants(pid)) if words in line else set()
    total_ns = 0
    for pid in found:
        with suppress(OSError):
            tasks = list(Path(f"/proc/{pid}/task").iterdir())
            total_ns += sum(int((task / "schedstat").read_text().split()[0]) for task in tasks)
    return total_ns / 1e9


async def heap_mb(tools: CDPSession) -> float:
    """Return what JavaScript holds after a collection."""
    await tools.send("HeapProfiler.collectGarbage")
    return float((await tools.send("Runtime.getHeapUsage"))["usedSize"]) / 1e6


async def measure(folder: Path, seconds: float, every_s: float) -> list[tuple[float, float, float, float]]:
    """Return shares of page, whole browser and console, and the heap in MB, of each span of time."""
    config = folder / "many.toml"
    config.write_text(plant(AXES, ON_A_LINE).replace(SLOW, FAST), encoding="utf-8")
    daemon, seen = DaemonUnderTest(config), []
    async with AsyncExitStack() as stack:
        stack.push_async_callback(daemon.end)
        await daemon.start()
        link = await stack.enter_async_context(console(daemon.endpoint))
        browser = await stack.enter_async_context(open_browser())
        page = await browser.new_page(viewport={"width": 1280, "height": 800})
        await page.goto(link)
        await expect(page.locator("tr[data-axis]")).to_have_count(AXES, timeout=PATIENCE_S * 1e3)
        tools = await page.context.new_cdp_session(page)
        await tools.send("Performance.enable", {"timeDomain": "threadTicks"})
        await tools.send("HeapProfiler.enable")
        await daemon.rig.command("a2", Power(on=True))
        at = daemon.endpoint
        loop = asyncio.get_running_loop()
        for span in range(round(seconds / every_s)):
            await daemon.rig.command("a2", MoveAbsolute(position=0.0 if span % 2 else every_s))
            before, began_s = await _clocks(tools, at), loop.time()
            await asyncio.sleep(every_s)
            after, took_s = await _clocks(tools, at), loop.time() - began_s
            shares = [(late - early) / took_s for early, late in zip(before, after, strict=True)]
            seen.append((*shares, await heap_mb(tools)))
            print(" ".join(f"{each:.3f}" for each in seen[-1]), flush=True)
    return seen


async def _clocks(tools: CDPSession, endpoint: str) -> tuple[float, float, float]:
    told = await tools.send("Performance.getMetrics")
    page_s = next(each["value"] for each in told["metrics"] if each["name"] == "TaskDuration")
    return page_s, used_s("chromium"), used_s(f"ldcnd console -e {endpoint}")


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=600.0)
    parser.add_argument("--every", type=float, default=30.0, help="seconds of each span")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        seen = asyncio.run(measure(Path(folder), given.seconds, given.every))
    page, browser, served, heap = (list(column) for column in zip(*seen, strict=True))
    third = max(1, len(heap) // 3)
    growth = statistics.median(heap[-third:]) / statistics.median(heap[third : 2 * third])
    for what, value, most in (
        ("main thread of the page", statistics.median(page), PAGE_SHARE),
        ("console", statistics.median(served), CONSOLE_SHARE),
        ("heap of the last third over the second", growth, GROWTH),
    ):
        print(f"{what}: {value:.3f}, at most {most:g}: {'met' if value <= most else 'MISSED'}")
    print(f"whole browser, drawing without a graphics processor: {statistics.median(browser):.3f} of a core")


if __name__ == "__main__":
    main()
