"""Sequences and positions on the rig page of the centrifuge, by keys and pointer, judged by its simulated machine."""

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import pytest

from ldcnd.client.lease import control
from ldcnd.client.rig_client import RigClient
from ldcnd.contract.errors import InterlockViolated
from ldcnd.contract.rig_commands import SetIo
from ldcnd.testing import ServedRig, served_rig
from tests.browser.house import LOOKED_EACH_S, Desk, console, open_browser
from tests.support.process import ROOT, client

playwright = pytest.importorskip("playwright.async_api", reason="the browser tests need playwright")
expect = playwright.expect

pytestmark = [pytest.mark.system, pytest.mark.real_time, pytest.mark.timeout(240)]

FILE = ROOT / "config" / "centrifuge.toml"
PATIENCE_S = 60.0
SPINS = 10.0
"""Revolutions a second, on the way to the 15.8 of 100 g."""
STANDS = 0.05
SHUT, LOCKED = 0.001, 0.999
TITLE = "Sequences and positions"


@dataclass
class Machine:
    """The machine behind a daemon, and a person at a console.

    Attributes:
        served: the rig.
        rig: a client of its own.
        desk: the page.
    """

    served: ServedRig
    rig: RigClient
    desk: Desk

    @property
    def speed(self) -> float:
        """Revolutions a second of the rotor itself."""
        return self.served.ask(lambda rig: abs(rig.truth("rotor").velocity))

    def part(self, name: str) -> float:
        """Return where the door, its lock or the pin is, 0 to 1."""

        def look(rig):
            _drive, module = rig.lines["line0"].modules
            module.catch_up(asyncio.get_running_loop().time())
            return module.around.at(name)

        return self.served.ask(look)

    async def until(self, wanted: Callable[[], bool]) -> None:
        """Wait until something is so."""
        async with asyncio.timeout(PATIENCE_S):
            while not wanted():
                await asyncio.sleep(LOOKED_EACH_S)

    @property
    def panel(self):
        """The panel of the page."""
        return self.desk.panel(TITLE)

    @property
    def progress(self):
        """What the page says of the run."""
        return self.panel.locator(".run [role=status]")

    async def open_door(self) -> None:
        """Have somebody else open the door."""
        async with control(self.rig, "the test", lease_s=60):
            await self.high("unlock")
            await self.until(lambda: self.part("lock") < SHUT)
            await self.high("door")
            await self.until(lambda: self.part("door") > LOCKED)

    async def high(self, line: str) -> None:
        """Drive an output high, as soon as the daemon lets it."""
        request = SetIo(module="cabinet", high=(line,), leases=tuple(self.rig.held))
        async with asyncio.timeout(PATIENCE_S):
            while True:
                with suppress(InterlockViolated):
                    await self.rig.ask(request)
                    return
                await asyncio.sleep(LOOKED_EACH_S)

    async def shuts(self) -> None:
        """Take control, and shut the door by the page."""
        await self.desk.button("Take control of all").click()
        await self.desk.button("Run shut").click()
        await expect(self.progress).to_contain_text("sequence shut: done")

    async def spins(self) -> None:
        """Spin by the page until the rotor is fast."""
        await self.desk.button("Run spin").click()
        await self.until(lambda: self.speed > SPINS)


@asynccontextmanager
async def machine(folder: Path, spin_s: int = 60) -> AsyncIterator[Machine]:
    """Run machine, daemon, console and browser until the context ends; its sequence spins for so long."""
    config = folder / "centrifuge.toml"
    # a module may answer late where a browser has the processor
    text = FILE.read_text(encoding="utf-8").replace("within_ms = 500", "within_ms = 5000")
    config.write_text(text.replace("duration_s = 10 }", f"duration_s = {spin_s} }}"), encoding="utf-8")
    with served_rig(config) as served:
        async with (
            client(served.endpoint) as rig,
            console(served.endpoint) as link,
            open_browser() as browser,
        ):
            context = await browser.new_context(viewport={"width": 1400, "height": 1200})
            page = await context.new_page()
            page.set_default_timeout(PATIENCE_S * 1e3)
            expect.set_options(timeout=PATIENCE_S * 1e3)
            await page.goto(link)
            yield Machine(served, rig, Desk(page, link.split("/?")[0]))


async def test_shut_shuts_and_locks_the_door_once_however_often_it_is_pressed(tmp_path):
    async with machine(tmp_path) as bench:
        run = bench.desk.button("Run shut")
        await expect(run).to_have_attribute("aria-disabled", "true")
        await expect(bench.panel).to_contain_text("Take control first")
        await expect(bench.panel).to_contain_text("go to bucket1 (rotor 0.1 rev)")
        await bench.open_door()
        began = []
        bench.desk.page.on("request", lambda asked: began.append(asked) if asked.url.endswith("/run") else None)
        await bench.desk.button("Take control of all").click()

        await run.dblclick()
        await bench.until(lambda: bench.part("lock") > LOCKED)

        await expect(bench.progress).to_contain_text("sequence shut: done")
        assert bench.part("door") < SHUT
        assert len(began) == 1
        await bench.desk.button("Run shut").focus()
        for _ in range(2):
            await bench.desk.page.keyboard.press("Enter")
        await expect(bench.progress).to_contain_text("done")
        assert len(began) == 2


async def test_a_spin_waits_between_its_steps_and_goes_on(tmp_path):
    async with machine(tmp_path, spin_s=10) as bench:
        await bench.shuts()
        await bench.spins()
        await bench.desk.button("Pause").click()
        await expect(bench.progress).to_contain_text("paused since")
        for place in ("scope", "events", "rig"):
            await bench.desk.open(place)
            await expect(bench.desk.page.locator(".summary")).to_contain_text("sequence spin is paused")
        await bench.desk.button("Go on").focus()
        await bench.desk.page.keyboard.press("Enter")
        await expect(bench.progress).to_contain_text("sequence spin: done")
        assert bench.part("door") > LOCKED


async def test_stop_halts_the_rotor_and_the_page_keeps_control(tmp_path):
    async with machine(tmp_path) as bench:
        await bench.shuts()
        await bench.spins()
        await expect(bench.desk.button("Run shut")).to_have_attribute("aria-disabled", "true")
        await expect(bench.panel).to_contain_text("The sequence spin runs: stop it, or wait for its end.")
        await bench.desk.button("Stop spin").click()
        await bench.until(lambda: bench.speed < STANDS)
        await expect(bench.progress).to_contain_text("sequence spin: stopped")
        await expect(bench.desk.page.get_by_text("You control rotor")).to_be_visible()
        assert bench.part("lock") > LOCKED


async def test_closing_the_page_halts_what_its_sequence_moves(tmp_path):
    async with machine(tmp_path) as bench:
        await bench.shuts()
        await bench.spins()
        await bench.desk.page.close()
        await bench.until(lambda: bench.speed < STANDS)
        await asyncio.sleep(3)
        assert bench.speed < STANDS
        assert bench.part("lock") > LOCKED


async def test_who_takes_control_ends_it_and_the_page_can_stop_what_others_run(tmp_path):
    async with machine(tmp_path) as bench:
        await bench.shuts()
        await bench.spins()
        other = await bench.desk.page.context.new_page()
        await other.goto(bench.desk.url)
        watching = Desk(other, bench.desk.url)
        await expect(watching.panel(TITLE).locator(".run [role=status]")).to_contain_text("sequence spin: step 4 of 8")
        await expect(watching.button("Pause")).to_have_attribute("aria-disabled", "true")
        async with control(bench.rig, "another", "rotor", lease_s=60, force=True):
            await bench.until(lambda: bench.speed < STANDS)
            await expect(bench.progress).to_contain_text("sequence spin: failed")
            await expect(bench.desk.page.get_by_text("another took control of rotor")).to_be_visible()
            await expect(bench.panel).to_contain_text("Control is held by another")
        await bench.desk.button("Take control of all").click()
        await bench.spins()
        await watching.button("Stop spin").click()
        await bench.until(lambda: bench.speed < STANDS)
        await expect(bench.progress).to_contain_text("sequence spin: stopped")


async def test_a_position_is_gone_to_and_what_forbids_it_is_said_before(tmp_path):
    async with machine(tmp_path) as bench:
        await bench.shuts()
        go = bench.desk.button("Go bucket2")
        await expect(go).to_have_attribute("aria-disabled", "true")
        await bench.desk.button("Enable all").or_(bench.desk.page.get_by_role("button", name="Enable")).first.click()
        await expect(bench.panel.get_by_label("position bucket2")).to_contain_text("home")
        await bench.desk.page.locator(".rig-commands").get_by_role("button", name="Home").click()
        await expect(go).not_to_have_attribute("aria-disabled", "true")

        await go.click()

        await expect(bench.progress).to_contain_text("position bucket2: done")
        place = bench.served.ask(lambda rig: rig.truth("rotor").position)
        told = (await bench.rig.position("rotor")).value
        assert told == pytest.approx(0.6, abs=0.002)
        assert place is not None
        assert bench.speed < STANDS
