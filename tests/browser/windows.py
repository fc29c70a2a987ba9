"""One page of either engine, driven alike: by keys, by the mouse, by an input method."""

import asyncio
import itertools
from collections.abc import AsyncIterator, Callable, Iterable, Mapping
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest
from playwright.async_api import CDPSession, Error, Page

from tests.browser.house import PATIENCE_S, House, console
from tests.support.marionette import CONTROL, DELETE, DOWN, ENTER, ESCAPE, SHIFT, TAB, Firefox, firefox, open_firefox

__all__ = ["PRESS", "PRESSABLE", "Chromium", "Window", "console", "gecko_with", "open_chromium", "open_gecko", "until"]
NAMED = {
    CONTROL: "Control",
    DELETE: "Delete",
    DOWN: "ArrowDown",
    ENTER: "Enter",
    TAB: "Tab",
    ESCAPE: "Escape",
    SHIFT: "Shift",
}


CHOOSE = """(label, option) => {
  const found = [...document.querySelectorAll("select")].find((each) => each.labels[0].textContent === label);
  const wanted = [...found?.options ?? []].find((each) => each.textContent === option);
  if (!wanted) return false;
  found.value = wanted.value;
  found.dispatchEvent(new Event("change", { bubbles: true }));
  return true;
}"""
"""Chooses in a list, by its label and by what it offers; tells whether it could."""

PRESSABLE = """(text) => [...document.querySelectorAll("main button")].some(
  (each) => each.textContent.trim() === text && !each.getAttribute("aria-disabled"))"""
"""Tells whether a button of the page can act, as it is drawn; a page is drawn a moment after the daemon has told."""
PRESS = """(text) => {
  const found = [...document.querySelectorAll("main button")].find((each) => each.textContent.trim() === text);
  if (!found || found.getAttribute("aria-disabled")) return false;
  found.click();
  return true;
}"""
"""Presses it; tells whether it could."""
TAKE = """() => {
  const buttons = [...document.querySelectorAll("main button")];
  const named = (text) => buttons.find((each) => each.textContent.trim() === text);
  const take = named("Take control");
  if (take && !take.getAttribute("aria-disabled") && !take.getAttribute("aria-busy")) take.click();
  return Boolean(named("Release control"));
}"""
"""Takes control, again where a page that has just come was refused it; tells whether it has it."""


class Chromium:
    """A page of Chromium, driven as `Firefox` is."""

    def __init__(self, page: Page) -> None:
        self._page = page
        self._touching: CDPSession | None = None
        self._fingers = 0

    async def open(self, url: str) -> None:
        """Open a page."""
        await self._page.goto(url)

    async def reload(self) -> None:
        """Load the page again."""
        await self._page.reload()

    async def back(self) -> None:
        """Go back to the page before."""
        await self._page.go_back()

    # Any: what JSON holds
    async def evaluate(self, script: str, *arguments: object) -> Any:
        """Return what a function of JavaScript returns; of a page that goes meanwhile the next one is asked."""
        while True:
            try:
                return await self._page.evaluate(f"(given) => ({script})(...given)", list(arguments))
            except Error as error:
                if "context was destroyed" not in error.message:
                    raise

    async def keys(self, *strokes: str, pause_ms: int = 0) -> None:
        """Press keys one after another; several characters in one stroke are held together."""
        for special, group in itertools.groupby(strokes, lambda each: len(each) > 1 or each in NAMED):
            if not special:
                await self._page.keyboard.type("".join(group), delay=pause_ms)
                continue
            for stroke in group:
                await self._page.keyboard.press("+".join(NAMED.get(key, key) for key in stroke))

    async def hold(self, key: str, times: int, pause_ms: int) -> None:
        """Keep a key down while it repeats so many times."""
        for _ in range(times):
            await self._page.keyboard.down(NAMED[key])
            await asyncio.sleep(pause_ms / 1e3)
        await self._page.keyboard.up(NAMED[key])

    async def click(self, x: float, y: float, count: int = 1) -> None:
        """Click at a point of the window, as often as a hand does in one go."""
        await self._page.mouse.click(x, y, click_count=count)

    async def drag(self, start: tuple[float, float], end: tuple[float, float]) -> None:
        """Press the button at one point and let it go at another."""
        await self._page.mouse.move(*start)
        await self._page.mouse.down()
        for step in range(1, 11):
            await self._page.mouse.move(*(a + (b - a) * step / 10 for a, b in zip(start, end, strict=True)))
        await self._page.mouse.up()

    async def touch(self, *fingers: tuple[float, float]) -> None:
        """Have fingers at these points and nowhere else: new ones come down, missing ones are lifted."""
        tools = self._touching = self._touching or await self._page.context.new_cdp_session(self._page)
        points = [{"x": x, "y": y, "id": number} for number, (x, y) in enumerate(fingers)]
        for count in range(self._fingers + 1, len(fingers) + 1):
            await tools.send("Input.dispatchTouchEvent", {"type": "touchStart", "touchPoints": points[:count]})
        if len(fingers) < self._fingers:
            await tools.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": points})
        self._fingers = len(fingers)

    async def wheel(self, x: float, y: float, by: int) -> None:
        """Turn the wheel over a point."""
        await self._page.mouse.move(x, y)
        await self._page.mouse.wheel(0, by)

    async def compose(self, *texts: str) -> None:
        """Let an input method show each of these texts in the focused field, and take over the last."""
        tools = await self._page.context.new_cdp_session(self._page)
        enter = {"key": "Enter", "code": "Enter", "windowsVirtualKeyCode": 229}  # so an input method hides its keys
        for text in texts:
            await tools.send(
                "Input.imeSetComposition", {"text": text, "selectionStart": len(text), "selectionEnd": len(text)}
            )
        await tools.send("Input.dispatchKeyEvent", {"type": "rawKeyDown", **enter})
        await tools.send("Input.insertText", {"text": texts[-1]})
        await tools.send("Input.dispatchKeyEvent", {"type": "keyUp", **enter})
        await tools.detach()

    async def resize(self, width: int, height: int) -> None:
        """Give the page a size, in its own pixels."""
        await self._page.set_viewport_size({"width": width, "height": height})


Window = Chromium | Firefox


@asynccontextmanager
async def open_chromium(house: House, _folder: Path) -> AsyncIterator[Window]:
    """Open a page of Chromium that the console has let in."""
    async with house.desk() as desk:
        yield Chromium(desk.page)


@asynccontextmanager
async def open_gecko(house: House, folder: Path) -> AsyncIterator[Window]:
    """Open a page of Firefox with the cookies of a page that the console has let in."""
    async with house.desk() as desk:
        await desk.open("rig")
        cookies = await desk.page.context.cookies()
    async with gecko_with(cookies, house.url, folder) as window:
        yield window


@asynccontextmanager
async def gecko_with(cookies: Iterable[Mapping[str, Any]], url: str, folder: Path) -> AsyncIterator[Firefox]:
    """Open a page of Firefox with cookies that a console has given."""
    program = firefox()
    if program is None:
        pytest.skip("no firefox-esr: install it, or say where one is in LDCND_FIREFOX")
    async with open_firefox(program, folder) as window:
        await window.open(f"{url}/")
        for cookie in cookies:
            given = {"path": "/"} | {name: cookie[name] for name in ("name", "value", "httpOnly", "sameSite")}
            await window.command("WebDriver:AddCookie", cookie=given)
        yield window


# Any: what JSON holds
async def until(window: Window, script: str, *arguments: object, wanted: Callable[[Any], Any] = bool) -> Any:
    """Wait until a function of JavaScript returns what is wanted, and return that."""
    found = None
    try:
        async with asyncio.timeout(PATIENCE_S):
            while not wanted(found := await window.evaluate(script, *arguments)):
                await asyncio.sleep(0.05)
    except TimeoutError:
        shown = await window.evaluate("() => document.querySelector('main')?.innerText")
        raise AssertionError(f"{script} gave {found!r} to the end; the page shows {shown!r}") from None
    return found
