"""Two real daemons on simulated lines, a real console, a real browser: for tests, pictures and measurements."""

import asyncio
import json
import os
import signal
from asyncio.subprocess import Process
from collections.abc import AsyncIterator, Callable
from contextlib import AsyncExitStack, asynccontextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from playwright.async_api import Browser, ConsoleMessage, Locator, Page, async_playwright, expect

from ldcnd.client.lease import Control, control
from ldcnd.client.rig_client import RigClient
from ldcnd.contract.commands import Halt, Power, Reset
from ldcnd.contract.errors import CommandAborted, StopLatched
from ldcnd.contract.samples import PositionSample, StateSample, TelemetryItem
from tests.support.process import ROOT, answering, client, free_port, process

CHROMIUM = Path(os.environ.get("LDCND_CHROMIUM", "/usr/bin/chromium"))
FLAGS = (
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--disable-dev-shm-usage",
)
PATIENCE_S = 45.0
"""Pages are waited for, never slept for; a busy machine may take its time."""
LOOKED_EACH_S = 0.05
GROUP = """
[[bus.group]]
name = "gantry"
axes = ["x", "y"]

[[bus.group]]
name = "table"
axes = ["z", "c"]

[[bus.module]]
name = "cabinet"
address = 5
model = "pic-io"
inputs = { door = { line = 3 } }
outputs = { lamp = { line = 4 } }
"""


class DaemonUnderTest:
    """A daemon that can be ended and started again on the same endpoint.

    Attributes:
        config: its configuration, read at each start.
        endpoint: where it listens.
        rig: a client of it, of a session of its own.
    """

    def __init__(self, config: Path) -> None:
        self.config = config
        self.endpoint = f"tcp/127.0.0.1:{free_port()}"
        self.rig: RigClient
        self._running = AsyncExitStack()
        self._process: Process

    async def start(self) -> None:
        """Return when every axis answers."""
        run = process("run", "--config", str(self.config), "--listen", self.endpoint)
        daemon = self._process = await self._running.enter_async_context(run)
        await answering(daemon, self.endpoint)
        self.rig = await self._running.enter_async_context(client(self.endpoint))

    def pause(self, *, on: bool) -> None:
        """Stop the process where it is, so that it falls silent, or let it go on."""
        self._process.send_signal(signal.SIGSTOP if on else signal.SIGCONT)

    async def kill(self) -> None:
        """Let it end without a word."""
        self._process.kill()
        await self.end()

    async def end(self) -> None:
        """Return when it has ended."""
        await self._running.aclose()

    async def until(self, axis: str, wanted: Callable[[StateSample], bool]) -> StateSample:
        """Wait for a state of an axis, as the daemon tells it."""
        state = None
        try:
            async with asyncio.timeout(PATIENCE_S):
                while not (state := await self.rig.state(axis)) or not wanted(state):
                    await asyncio.sleep(LOOKED_EACH_S)
        except TimeoutError:
            raise TimeoutError(f"{axis} has stayed at {state!r}") from None
        return state

    async def reaches(self, axis: str, position: float, within: float) -> None:
        """Wait until an axis stands at a position, as the daemon tells it."""
        async with asyncio.timeout(PATIENCE_S):
            while abs(await self.position(axis) - position) > within:
                await asyncio.sleep(LOOKED_EACH_S)
        await self.until(axis, lambda state: state.moving == "no")

    async def position(self, axis: str) -> float:
        """Return where an axis is."""
        sample = await self.rig.last(axis, TelemetryItem.POSITION)
        assert isinstance(sample, PositionSample)
        return sample.value

    async def registers(self, axis: str) -> dict[str, int | None]:
        """Return what the daemon knows of a drive's registers."""
        info = next(each for each in await self.rig.axes() if each.axis == axis)
        return {each.name: each.value for each in info.registers}

    async def quiet(self, *axes: str) -> None:
        """Leave axes at rest and disabled, without a latch, a fault or a holder, whatever was done to them before."""
        async with control(self.rig, "the test", *axes, lease_s=60, force=True) as held:
            for axis in axes:
                await held.command(axis, Halt())
                # behind a fault that hides motion none is seen to stand before a reset, and that wants its motor off
                await self.until(axis, lambda state: state.moving == "no" or state.motion_hidden_by)
                await held.command(axis, Power(on=False))
                while not await is_reset(held, axis):
                    await asyncio.sleep(LOOKED_EACH_S)
            for axis in axes:
                await self.until(axis, lambda state: state.moving == "no" and not state.motion_hidden_by)


async def is_reset(held: Control, axis: str) -> bool:
    """Reset an axis; return whether it was: the stop or halt of a page that has gone may be on its way."""
    try:
        await held.command(axis, Reset())
    except (StopLatched, CommandAborted):
        return False
    return True


@dataclass
class Desk:
    """One operator, whose browser was let in.

    Attributes:
        page: what he sees.
        url: of the console, without a path.
        asked: every address that the browser asked for.
        troubles: what the page complained about.
    """

    page: Page
    url: str
    asked: list[str] = field(default_factory=list)
    troubles: list[str] = field(default_factory=list)

    async def open(self, place: str) -> None:
        """Open a page of the console, named by its address behind the hash."""
        await self.page.mouse.move(0, 0)  # a hand that goes to another page does not rest where it pressed before
        await self.page.goto(f"{self.url}/#/{place}")

    def button(self, name: str) -> Locator:
        """Return the button that is called exactly so."""
        return self.page.get_by_role("button", name=name, exact=True)

    def panel(self, title: str) -> Locator:
        """Return the part of the page under this heading."""
        return self.page.get_by_role("region", name=title, exact=True)

    def strangers(self) -> list[str]:
        """Return the addresses asked for that are on another machine."""
        here = {"127.0.0.1", "localhost"}
        return [
            url
            for url in self.asked
            if urlsplit(url).scheme not in {"blob", "data"} and urlsplit(url).hostname not in here
        ]


@dataclass
class House:
    """What the browser tests share.

    Attributes:
        browser: without any context.
        sim: the daemon of the simulated rig.
        mixed: the daemon of the rig of two families.
        alpha: a daemon that is not running, of the same rig under a name that comes before the others.
        link: the console's one-time link.
        url: of the console, without a path.
    """

    browser: Browser
    sim: DaemonUnderTest
    mixed: DaemonUnderTest
    alpha: DaemonUnderTest
    link: str
    _cookies: list[dict[str, object]] = field(default_factory=list)

    @asynccontextmanager
    async def that_expects_alpha(self) -> AsyncIterator["House"]:
        """Run one more console, which looks for alpha too: the shared one would go on telling that alpha is gone."""
        endpoints = [daemon.endpoint for daemon in (self.sim, self.mixed, self.alpha)]
        async with console(*endpoints, commission=self.sim.config) as link:
            yield House(self.browser, self.sim, self.mixed, self.alpha, link)

    @asynccontextmanager
    async def beside_alpha(self) -> AsyncIterator["House"]:
        """Run such a console, and alpha until the context ends."""
        await self.alpha.start()
        try:
            async with self.that_expects_alpha() as own:
                yield own
        finally:
            with suppress(ProcessLookupError):  # it has ended already
                self.alpha.pause(on=False)
            await self.alpha.end()

    @property
    def url(self) -> str:
        """Of the console, without a path."""
        at = urlsplit(self.link)
        return f"{at.scheme}://{at.netloc}"

    @asynccontextmanager
    async def desk(
        self, scheme: str = "dark", width: int = 1400, height: int = 900, *, phone: bool = False
    ) -> AsyncIterator[Desk]:
        """Let one more browser in, the first by the link; nothing that it asks for may lie elsewhere.

        The browser of a phone makes a page as wide as the widest of its content, and what is fixed to an edge with it.
        """
        context = await self.browser.new_context(
            color_scheme=scheme,
            viewport={"width": width, "height": height},
            reduced_motion="reduce",
            is_mobile=phone,
            has_touch=phone,
        )
        context.set_default_timeout(PATIENCE_S * 1e3)
        try:
            page = await context.new_page()
            desk = Desk(page, self.url)
            context.on("request", lambda request: desk.asked.append(request.url))
            page.on("websocket", lambda socket: desk.asked.append(socket.url))
            page.on("pageerror", lambda error: desk.troubles.append(str(error)))
            page.on("console", lambda told: desk.troubles.append(told.text) if is_trouble(told) else None)
            if not self._cookies:
                await page.goto(self.link)
                self._cookies = await context.cookies()
            await context.add_cookies(self._cookies)
            yield desk
            assert not desk.strangers()
            assert not desk.troubles, desk.troubles
        finally:
            await context.close()


def is_trouble(told: ConsoleMessage) -> bool:
    """Tell whether a page complains about itself; that a request was refused is no fault of a page."""
    return told.type == "error" and not told.text.startswith(("Failed to load resource", "WebSocket connection to"))


@asynccontextmanager
async def console(*endpoints: str, commission: Path | None = None) -> AsyncIterator[str]:
    """Run `ldcnd console` on a free port, for commissioning with a configuration; yields the link that it prints."""
    async with console_process(*endpoints, commission=commission) as (_running, link):
        yield link


@asynccontextmanager
async def console_process(*endpoints: str, commission: Path | None = None) -> AsyncIterator[tuple[Process, str]]:
    """Run it likewise; yields its process, too."""
    connect = [word for endpoint in endpoints for word in ("-e", endpoint)]
    more = ["--commission", str(commission)] if commission else []
    async with process("console", *connect, *more, "--listen", "127.0.0.1:0", "--json") as running:
        assert running.stdout
        async with asyncio.timeout(PATIENCE_S):
            told = await running.stdout.readline()
        yield running, json.loads(told)["link"]


@asynccontextmanager
async def open_browser() -> AsyncIterator[Browser]:
    """Run a browser until the context ends."""
    if not CHROMIUM.exists():
        pytest.skip(f"no browser at {CHROMIUM}: install chromium, or say where one is in LDCND_CHROMIUM")
    async with async_playwright() as drives:
        browser = await drives.chromium.launch(
            executable_path=str(CHROMIUM), args=list(FLAGS), timeout=PATIENCE_S * 1e3
        )
        yield browser
        await browser.close()


@asynccontextmanager
async def open_house(folder: Path) -> AsyncIterator[House]:
    """Run daemons, console and browser until the context ends.

    Args:
        folder: for what the daemons keep.
    """
    text = (ROOT / "config" / "mixed.toml").read_text(encoding="utf-8")
    mixed_config = folder / "mixed.toml"
    mixed_config.write_text(text.replace('state_dir = "state"', f'state_dir = "{folder}"'), encoding="utf-8")
    text = (ROOT / "config" / "simulated.toml").read_text(encoding="utf-8")
    sim_config = folder / "simulated.toml"
    text = text.replace("\n[[sim]]", f"{GROUP}\n[[sim]]", 1).replace(
        "baud = 115200", "baud = 115200\nsnapshot = true", 1
    )
    text = text.replace('{ model = "pic-servo-v4" },\n]', '{ model = "pic-servo-v4" },\n    { model = "pic-io" },\n]')
    port = f'\n[[port]]\nname = "labview"\nbus = "line0"\nlink = "{folder}/labview"\naccess = "control"\n'
    sim_config.write_text(text + port, encoding="utf-8")
    alpha_config = folder / "alpha.toml"
    text = mixed_config.read_text(encoding="utf-8").replace('rig = "mixed"', 'rig = "alpha"')
    own = text.replace(f'state_dir = "{folder}"', f'state_dir = "{folder}/alpha"')
    alpha_config.write_text(own, encoding="utf-8")
    sim, mixed, alpha = map(DaemonUnderTest, (sim_config, mixed_config, alpha_config))
    async with AsyncExitStack() as stack:
        browser = await stack.enter_async_context(open_browser())
        for daemon in (sim, mixed, alpha):
            stack.push_async_callback(daemon.end)
        async with asyncio.TaskGroup() as group:
            for daemon in (sim, mixed):
                group.create_task(daemon.start(), name=daemon.endpoint)
        link = await stack.enter_async_context(console(sim.endpoint, mixed.endpoint, commission=sim_config))
        expect.set_options(timeout=PATIENCE_S * 1e3)
        yield House(browser, sim, mixed, alpha, link)
