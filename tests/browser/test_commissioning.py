"""A person who has never seen the rig gets from a search of its port to four tuned axes by the page alone.

The first axis goes through all steps of its checklist, the three others through those that the page says are needed for
tuning. Controls are found by what can be read on the page. What a busy machine lets fail is done again, as a person
does it: the page says so, and offers it.
"""

import asyncio
import re
import shlex
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import pytest

from ldcnd.bench.commissioning.first_settings import SOFT_GAINS
from ldcnd.config.rig import load_config
from tests.browser.house import CHROMIUM, Desk, console, is_trouble, open_browser
from tests.support.process import START_TIME_S, answering, free_port, process

access = pytest.importorskip("tests.browser.access", reason="needs axe-playwright-python and playwright")
playwright = pytest.importorskip("playwright.async_api", reason="the browser tests need playwright")
expect = playwright.expect

pytestmark = [
    pytest.mark.system,
    pytest.mark.alone,
    pytest.mark.real_time,
    pytest.mark.asyncio(loop_scope="module"),
    pytest.mark.timeout(1800),
]

AXES = ("axis1", "axis2", "axis3", "axis4")
MODULE = '[[module]]\nmodel = "ls-182ap"\nplant = { inertia_kg_m2 = 2e-4, friction_nm = 0.02 }\n'
SLOW_MS = 240_000
"""Time for a tuning, and for a scan, on a machine that has very much else to do."""
SOON_MS = 5_000
"""Time for a button that can be seen to be pressed."""
AGAIN = 10
"""So often a person tries what the machine's load has let fail."""
SCALE = 500.0
"""Encoder counts of one mm of the simulated machine, by this person's decision."""


@dataclass
class Bench:
    """A line of four drives on a port, a console for it, and one person with a browser.

    Attributes:
        config: what the console writes; not there at first.
        port: of the line.
    """

    config: Path
    port: Path
    desk: Desk
    running: AsyncExitStack = field(default_factory=AsyncExitStack)

    async def start_daemon(self, command: str) -> None:
        """Type the command that the page shows, and wait until every axis answers."""
        words = shlex.split(command)
        assert words[0] == "ldcnd"
        daemon = await self.running.enter_async_context(process(*words[1:]))
        await answering(daemon, words[words.index("--listen") + 1])

    async def restart_daemon(self, command: str) -> None:
        """End the daemon, and start it again."""
        await self.running.aclose()
        await self.start_daemon(command)


@asynccontextmanager
async def bench(folder: Path) -> AsyncIterator[Bench]:
    """Run line, console and browser until the context ends."""
    endpoint, port, line = f"tcp/127.0.0.1:{free_port()}", folder / "port", folder / "line.toml"
    line.write_text("\n".join(MODULE for _ in AXES), encoding="utf-8")
    config = folder / "rig.toml"
    async with AsyncExitStack() as stack:
        browser = await stack.enter_async_context(open_browser())
        served = process("sim", "--baud-check", "--pty", str(port), "--file", str(line))
        simulated = await stack.enter_async_context(served)
        assert simulated.stdout
        async with asyncio.timeout(START_TIME_S):
            await simulated.stdout.readline()
        link = await stack.enter_async_context(console(endpoint, commission=config))
        context = await browser.new_context(reduced_motion="reduce", permissions=["clipboard-read", "clipboard-write"])
        page = await context.new_page()
        desk = Desk(page, link.split("/?")[0])
        page.on("pageerror", lambda error: desk.troubles.append(str(error)))
        page.on("console", lambda told: desk.troubles.append(told.text) if is_trouble(told) else None)
        page.on("dialog", lambda dialog: dialog.accept())
        expect.set_options(timeout=45_000)
        context.set_default_timeout(45_000)
        await page.goto(link)
        opened = Bench(config, port, desk)
        stack.push_async_callback(opened.running.aclose)
        try:
            yield opened
        except BaseException:
            print(*desk.troubles, await page.locator("main").inner_text(), sep="\n")
            raise
        assert not desk.troubles


class Walk:
    """What the person does on the checklist of one axis."""

    def __init__(self, bench: Bench, axis: str) -> None:
        self.bench = bench
        self.axis = axis
        self.page = bench.desk.page

    async def open(self) -> None:
        """Go there by the links of the page."""
        await self.page.get_by_role("link", name="Commissioning", exact=True).first.click()
        await self.page.get_by_role("link", name=self.axis, exact=True).click()
        await expect(self.page.get_by_role("heading", name=f"Commissioning / {self.axis}")).to_be_visible()
        await expect(self.page.get_by_role("heading", name="Checklist")).to_be_visible()

    @property
    def question(self):
        return self.page.get_by_role("group", name="Question", exact=True)

    def step(self, title: str):
        called = re.compile(f"^(Begin|Repeat): {re.escape(title)}$")
        return self.page.get_by_role("listitem").filter(has=self.page.get_by_role("button", name=called))

    async def begin(self, title: str) -> None:
        """Begin a step, read what it will do, and agree."""
        await self.until_asked(title, "run it")
        await self.question.get_by_role("button", name="Run it", exact=True).click()

    async def until_asked(self, title: str, words: str) -> None:
        """Begin a step that asks a question first; again if the page has lost the daemon meanwhile."""
        for _ in range(AGAIN):
            await self.step(title).get_by_role("button").click()
            with suppress(AssertionError):
                await expect(self.question).to_contain_text(words)
                return
        pytest.fail(f"{self.axis}: {title} never asked: {words}")

    async def answer(self, words: str, text: str) -> None:
        """Answer a question by the field."""
        asked = self.question.filter(has_text=words)
        await asked.get_by_role("textbox").or_(asked.get_by_role("combobox")).fill(text)
        await asked.get_by_role("button", name="Answer").click()

    async def answer_by_held_key(self, words: str, text: str, behind: str) -> None:
        """Answer a question by Enter, and hold that until the next one could be answered: it is not by that."""
        asked = self.question.filter(has_text=words)
        await asked.get_by_role("textbox").fill(text)
        await expect(asked.get_by_role("button", name="Answer")).to_be_enabled()
        await self.page.keyboard.down("Enter")
        await expect(self.question.filter(has_text=behind).get_by_role("button", name="Answer")).to_be_enabled()
        await self.page.keyboard.down("Enter")  # as a key that repeats
        await self.page.keyboard.up("Enter")

    async def choose(self, words: str, label: str, timeout_ms: float = SLOW_MS) -> None:
        """Answer a question by a button."""
        await (
            self.question.filter(has_text=words).get_by_role("button", name=label, exact=True).click(timeout=timeout_ms)
        )

    async def ends(self, title: str) -> str:
        """Wait until a step is over; return how far it is."""
        await expect(self.page.get_by_role("button", name="End this step")).to_have_count(0, timeout=SLOW_MS)
        return await self.step(title).get_by_role("heading").inner_text()

    async def done(self, title: str) -> None:
        """Expect that a step is done."""
        await expect(self.step(title).get_by_role("heading")).to_contain_text("done", timeout=SLOW_MS)

    async def until_done(self, title: str, *, work) -> None:
        """Do a step, again where the page says that it has failed."""
        for _ in range(AGAIN):
            await work()
            if "done" in await self.ends(title):
                return
            print(self.axis, await self.page.get_by_role("main").get_by_role("region").first.inner_text())
        await self.done(title)

    # -- the steps ---------------------------------------------------------------------------------------------------

    async def load(self) -> None:
        await self.page.get_by_label("Your name, for the report").fill("Ada")
        await self.begin("Brake or hanging load")
        await self.choose("what falls without power", "nothing, and there is no brake")
        await self.answer("a remark for the report", "<b>simulated</b>")
        await self.done("Brake or hanging load")

    async def settings(self, *, look=None) -> None:
        await self.begin("Unit, scale and first gains")
        await self.answer("unit of the axis", "mm")
        await self.answer("encoder counts of one mm", f"{SCALE:g}")
        await self.answer_by_held_key("velocity of its moves", "5", behind="acceleration of its moves")
        await self.answer("acceleration of its moves", "50")
        await self.choose("what marks its reference position", "the index of the encoder")
        await expect(self.question).to_contain_text("+counts_per_unit = 500")
        if look:
            await look()
        await self.choose("write this into", "Write")
        await self.done("Unit, scale and first gains")

    async def motor(self) -> None:
        async def compare() -> None:
            await self.begin("Motor against encoder")
            moved = self.question.filter(has_text="did the axis move")
            which = self.question.filter(has_text=f"was it axis {self.axis} that moved")
            shown = self.ended.or_(moved).or_(which).first
            await expect(shown).to_be_visible(timeout=SLOW_MS)
            while not await self.ended.count():
                answer = which.get_by_role("button", name="Yes", exact=True)
                with suppress(playwright.TimeoutError):  # the question that was seen was answered already
                    await answer.or_(moved.get_by_role("button", name="No", exact=True)).click(timeout=SOON_MS)
                await expect(shown).to_be_visible(timeout=SLOW_MS)

        await self.until_done("Motor against encoder", work=compare)

    async def tune(self) -> None:
        async def tuning() -> None:
            await self.begin("Gains")
            await self.answer("within which distance", "4")
            await self.answer("bandwidth of the loop", "20")
            await self.choose(f"move {self.axis} now", "Yes")
            load = self.question.filter(has_text="load these gains")
            await expect(load.or_(self.ended).first).to_be_visible(timeout=SLOW_MS)
            if not await load.count():
                return
            await expect(self.page.get_by_role("log")).to_contain_text("model: acceleration")
            await load.get_by_role("button", name="Yes", exact=True).click()
            write = self.question.filter(has_text="write this into")
            await expect(write.or_(self.ended).first).to_be_visible(timeout=SLOW_MS)
            if await write.count():
                await expect(write).to_contain_text("+kp = ")
                await write.get_by_role("button", name="Write", exact=True).click()

        await self.until_done("Gains", work=tuning)
        await expect(self.page.get_by_role("row", name="new gains, predicted").first).to_be_visible()

    async def scale(self) -> None:
        async def measure() -> None:
            await self.begin("Encoder direction and counts per unit")
            await self.answer("how far shall it move", "2")
            measured = self.question.filter(has_text="how far did it go")
            await self.hold("moves by 2 mm", measured, by_key=True)
            await self.answer("how far did it go", "2")
            await self.leave_proposal()

        await self.until_done("Encoder direction and counts per unit", work=measure)

    async def friction(self) -> None:
        async def measure() -> None:
            await self.begin("Friction and hanging load, measured")
            await expect(self.ended.first).to_be_visible(timeout=SLOW_MS)

        await self.until_done("Friction and hanging load, measured", work=measure)

    async def limits(self) -> None:
        await self.begin("Limit switches and their polarity")
        await self.choose("has the axis limit switches", "No")
        await expect(self.step("Limit switches and their polarity").get_by_role("heading")).to_contain_text("skipped")

    async def home(self) -> None:
        async def search() -> None:
            await self.begin("Home and its repeatability")
            await self.answer("how many searches", "2")
            await self.hold("searches its reference", self.ended)

        await self.until_done("Home and its repeatability", work=search)

    async def speed(self) -> None:
        async def run() -> None:
            await self.begin("Highest velocity and acceleration")
            await self.answer("how far may it move", "2")
            written = self.question.filter(has_text="write this into")
            await self.hold("and back, again and again", self.ended.or_(written))
            await self.leave_proposal()

        await self.until_done("Highest velocity and acceleration", work=run)

    async def travel(self) -> None:
        await self.begin("Travel")
        await self.answer("reverse end", "-10")
        await self.answer("forward end", "10")
        await expect(self.question).to_contain_text("+position_min = -9.6")
        await self.choose("write this into", "Write")
        await self.done("Travel")

    async def hold(self, words: str, until, *, by_key: bool = False) -> None:
        """Hold the button, by the space bar or by the mouse, until something can be seen."""
        button = self.question.filter(has_text=words).get_by_role("button", name="Hold to move")
        await button.focus()
        if by_key:
            await self.page.keyboard.down("Space")
        else:
            await button.hover()
            await self.page.mouse.down()
        await expect(until.first).to_be_visible(timeout=SLOW_MS)
        await (self.page.keyboard.up("Space") if by_key else self.page.mouse.up())

    @property
    def ended(self):
        """What tells that a step is over, well or not."""
        return self.page.get_by_text("It has ended.")

    async def leave_proposal(self) -> None:
        """Leave what a step proposes, if it does, as it is in the file."""
        written = self.question.filter(has_text="write this into")
        await expect(self.ended.or_(written).first).to_be_visible(timeout=SLOW_MS)
        if await written.count():
            await written.get_by_role("button", name="Leave", exact=True).click()


@pytest.fixture
def state_home(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))


@pytest.mark.skipif(not CHROMIUM.exists(), reason="needs chromium")
async def test_from_a_port_to_four_tuned_axes_by_the_page_alone(tmp_path, state_home):
    async with bench(tmp_path) as opened:
        page = opened.desk.page
        await page.get_by_role("link", name="Commissioning", exact=True).click()
        walk = Walk(opened, "")
        await page.get_by_role("button", name="Search a port").click()
        await walk.answer("on which port", str(opened.port))
        await walk.choose("which drives", "ldcn drives")
        await walk.choose("no drive has an address", "Yes")
        await walk.choose("write this into", "Write")
        await expect(page.get_by_text("No daemon serves rig rig yet")).to_be_visible()
        await page.get_by_role("button", name="Copy the command").click()
        command = await page.evaluate("navigator.clipboard.readText()")
        await opened.start_daemon(command)
        await expect(page.get_by_text("The daemon of rig rig runs.")).to_be_visible()
        await access.examine(page)
        for axis in AXES:
            walk = Walk(opened, axis)
            await walk.open()
            await walk.settings(look=partial(usable, page) if axis == AXES[0] else None)
        await opened.restart_daemon(command)
        for axis in AXES:
            walk = Walk(opened, axis)
            await walk.open()
            await walk.motor()
            await walk.tune()
        first = Walk(opened, AXES[0])
        await first.open()
        await first.load()
        await first.friction()
        await first.scale()
        await first.limits()
        await first.home()
        await first.speed()
        await first.travel()
        await usable(page)
        async with page.expect_download() as downloading:
            await page.get_by_role("link", name="Report").click()
        report = (await (await downloading.value).path()).read_text(encoding="utf-8")
        await page.get_by_role("link", name="Commissioning", exact=True).first.click()
        for axis in AXES:
            await expect(page.get_by_role("row", name=axis)).not_to_contain_text("not tuned")
        await expect(page.get_by_role("row", name=AXES[0])).to_contain_text("nothing")
        await usable(page)

    configured = {axis.name: axis for bus in load_config(opened.config).bus for axis in bus.axis}
    assert set(configured) == set(AXES)
    for axis in configured.values():
        assert (axis.unit, axis.counts_per_unit) == ("mm", SCALE)
        assert axis.gains.model_dump(include=set(SOFT_GAINS)) != SOFT_GAINS
    assert (configured[AXES[0]].limits.position_min, configured[AXES[0]].limits.position_max) == (-9.6, 9.6)
    assert "tuned: it settles in" in report
    assert "&lt;b&gt;simulated&lt;/b&gt;" in report


async def usable(page) -> None:
    """Expect that axe finds nothing and that the page fits on a phone."""
    wrong = await access.found_wrong(page, {"phone": access.SCREENS["phone"]})
    await page.set_viewport_size({"width": 1280, "height": 900})
    assert not wrong, "\n".join(wrong)
