"""The console in front of a large rig: what pages cost it, and that they cost the rig nothing."""

import asyncio
import json
import signal
import statistics
import subprocess
import sys
import time
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from websockets.asyncio.client import ClientConnection

from ldcnd.client.overview import health_reports
from ldcnd.contract.health import BusHealth
from tests.bench.processes import LINE_CPU, SUBJECT_CPU, free_endpoint, process
from tests.bench.report import Row
from tests.support.browser import Browser, ask_over_tcp, feed, hanging_page
from tests.support.process import client

AXES, RATE_HZ, PAGES, STREAMS = 31, 10.0, 5, 8
START_TIME_S = 60.0
WHAT = f"console, {AXES} axes at {RATE_HZ:g} Hz"


def rows(folder: Path, seconds: float, rounds: int) -> list[Row]:
    """Measure what pages cost and what none cost in turn, for so many seconds each; medians of the rounds."""
    config = folder / "console.toml"
    config.write_text(large_rig())
    endpoint = free_endpoint()
    run = (sys.executable, "-m", "ldcnd", "run", "--log-level", "error", "--config", config, "--listen", endpoint)
    look = (sys.executable, "-m", "ldcnd", "console", "--json", "-e", endpoint, "--listen", "127.0.0.1:0")
    with process(run, cpu=LINE_CPU, nice=-10), process(look, cpu=SUBJECT_CPU, nice=-10, pipe=True) as console:
        assert console.stdout
        link = json.loads(console.stdout.readline())["link"]
        return asyncio.run(_measured(endpoint, link, console, seconds, rounds))


def large_rig() -> str:
    """Return the configuration of a line that is nearly full at `RATE_HZ`."""
    rates = ", ".join(f"{item} = {RATE_HZ}" for item in ("position", "velocity", "adc", "state"))
    axes = "\n".join(
        f'[[bus.axis]]\nname = "a{number}"\naddress = {number}\nmodel = "ls-182ap"\nvelocity = 1\nacceleration = 1\n'
        f"rates = {{ {rates} }}"
        for number in range(1, AXES + 1)
    )
    modules = ", ".join(['{ model = "ls182ap" }'] * AXES)
    return (
        'rig = "bench"\n[[bus]]\nname = "line0"\nport = "sim:line0"\nbaud = 115200\nmargin_ms = 50\n'
        f'adapter_latency_ms = 0\n{axes}\n[[sim]]\nname = "line0"\nmodule = [{modules}]\n'
    )


@dataclass(frozen=True, slots=True)
class Window:
    """What was seen for a while.

    Attributes:
        share: of a core, used by the console.
        rate_hz: positions a second and axis.
        frames_hz: of the slowest page; 0 without pages.
        stop_s: a stop by a page.
    """

    share: float
    rate_hz: float
    frames_hz: float
    stop_s: float


class Bench:
    """A console process, a browser that was let in, and the health of the rig behind it."""

    def __init__(self, console: "subprocess.Popen[str]", browser: Browser, seconds: float) -> None:
        self.reports: list[BusHealth] = []
        self.browser = browser
        self._tasks = Path(f"/proc/{console.pid}/task")
        self._seconds = seconds

    async def window(self, *queries: str) -> Window:
        """Let time pass while pages are open."""
        async with AsyncExitStack() as stack:
            pages = [await stack.enter_async_context(_page(self.browser, query)) for query in queries]
            await asyncio.sleep(1.0)  # the report of the time before
            self.reports.clear()
            counted = [page[0] for page in pages]
            began_s, used_s = time.monotonic(), self._used_s()
            await asyncio.sleep(self._seconds)
            elapsed_s = time.monotonic() - began_s
            share = (self._used_s() - used_s) / elapsed_s
            rate_hz = statistics.mean(axis.rate_hz for report in self.reports for axis in report.axes)
            frames = min((page[0] - count for page, count in zip(pages, counted, strict=True)), default=0)
            return Window(share, rate_hz, frames / elapsed_s, await self._stop_s())

    async def _stop_s(self) -> float:
        began_s = time.monotonic()
        answer = await self.browser.post("/api/stop")
        rigs: Any = answer.document["rigs"]
        assert len(rigs["bench"]["confirmed"]) == AXES
        return time.monotonic() - began_s

    def _used_s(self) -> float:
        return sum(int((task / "schedstat").read_text().split()[0]) for task in self._tasks.iterdir()) / 1e9


async def _measured(
    endpoint: str, link: str, console: "subprocess.Popen[str]", seconds: float, rounds: int
) -> list[Row]:
    at = urlsplit(link)
    assert at.hostname
    assert at.port
    browser = await Browser(partial(ask_over_tcp, at.hostname, at.port), f"http://{at.netloc}").enter(link)
    async with asyncio.timeout(START_TIME_S):
        while not await _is_up(browser):
            await asyncio.sleep(0.5)
    bench = Bench(console, browser, seconds)
    page = f"?rate={RATE_HZ:g}"
    streams = ",".join(f"bench/a{number}/position" for number in range(1, STREAMS + 1))
    empty, full, hung = [], [], []
    async with client(endpoint) as rig:
        take = bench.reports.append
        async with health_reports(rig, lambda report: take(report) if isinstance(report, BusHealth) else None):
            for _ in range(rounds):
                empty.append(await bench.window())
                full.append(await bench.window(*[page] * PAGES))
                with hanging_page(browser):
                    hung.append(await bench.window(*[page] * PAGES, f"{page}&stream={streams}"))
    with hanging_page(browser):
        await asyncio.sleep(seconds)
        end_s = _end_s(console)
    share, rate, stop = (partial(_median, name) for name in ("share", "rate_hz", "stop_s"))
    return [
        Row(f"{WHAT}, no page: share of a core", share(empty)),
        Row(f"{WHAT}, {PAGES} pages: share of a core", share(full), "", 0.10, at_most=True),
        Row(f"{WHAT}, the same, a scope of {STREAMS} and a page that never reads: share of a core", share(hung)),
        Row(f"frames of the slowest of {PAGES} pages / wanted", _median("frames_hz", full) / RATE_HZ, "", 0.95),
        Row("positions a second, with pages / without", rate(full) / rate(empty), "", 0.98),
        Row("positions a second, with a page that never reads / without", rate(hung) / rate(empty), "", 0.98),
        Row("stop by a page, median", stop(empty) * 1e3, "ms"),
        Row("stop by a page while another never reads, median", stop(hung) * 1e3, "ms"),
        Row("console, from SIGTERM to its end while a page never reads", end_s, "s", 3.0, at_most=True),
    ]


def _median(name: str, windows: list[Window]) -> float:
    return statistics.median(getattr(window, name) for window in windows)


async def _is_up(browser: Browser) -> bool:
    rigs: Any = (await browser.get("/api/rigs")).document["rigs"]
    return bool(rigs) and all(bus["up"] for rig in rigs for bus in rig["buses"])


@asynccontextmanager
async def _page(browser: Browser, query: str) -> AsyncIterator[list[int]]:
    """Open a page that reads; yields how many frames it has had."""
    count = [0]

    async def read(socket: ClientConnection) -> None:
        async for _ in socket:
            count[0] += 1

    async with feed(browser, query) as socket, asyncio.TaskGroup() as group:
        reading = group.create_task(read(socket), name="page")
        yield count
        reading.cancel()


def _end_s(console: "subprocess.Popen[str]") -> float:
    began_s = time.monotonic()
    console.send_signal(signal.SIGTERM)
    console.wait(30)
    return time.monotonic() - began_s
