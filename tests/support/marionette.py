"""Firefox, driven over Marionette: JSON messages on a local port, each with its length in front."""

import asyncio
import contextlib
import itertools
import json
import os
import shutil
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

from tests.support.process import free_port

START_TIME_S = 60.0
COMMAND_TIME_S = 60.0
CONTROL = "\ue009"
DELETE = "\ue017"
ENTER = "\ue007"
ESCAPE = "\ue00c"
DOWN = "\ue015"
SHIFT = "\ue008"
TAB = "\ue004"
NARROWEST = 640
"""Width of the narrowest window, in pixels of the screen."""
COMPOSE = """
const method = Cc["@mozilla.org/text-input-processor;1"].createInstance(Ci.nsITextInputProcessor);
if (!method.beginInputTransactionForTests(window)) throw new Error("no input method");
for (const text of arguments[0]) {
  method.setPendingCompositionString(text);
  method.appendClauseToPendingComposition(text.length, method.ATTR_RAW_CLAUSE);
  method.setCaretInPendingComposition(text.length);
  method.flushPendingComposition();
}
const enter = new KeyboardEvent("keydown", { key: "Enter", code: "Enter", keyCode: KeyboardEvent.DOM_VK_RETURN });
method.commitComposition(enter);
method.keyup(enter);
"""
PREFERENCES = {
    "marionette.port": "{port}",
    "app.update.enabled": "false",
    "datareporting.policy.dataSubmissionEnabled": "false",
    "network.captive-portal-service.enabled": "false",
    "network.connectivity-service.enabled": "false",
    "browser.shell.checkDefaultBrowser": "false",
    "ui.prefersReducedMotion": "1",
}


def firefox() -> str | None:
    """Return the program; None where there is none."""
    return os.environ.get("LDCND_FIREFOX") or shutil.which("firefox-esr") or shutil.which("firefox")


class Firefox:
    """One window of Firefox."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._reader = reader
        self._writer = writer
        self._numbers = itertools.count(1)
        self._fingers = 0

    async def reload(self) -> None:
        """Load the page again."""
        await self.command("WebDriver:Refresh")

    async def back(self) -> None:
        """Go back to the page before."""
        await self.command("WebDriver:Back")

    # Any: what JSON holds
    async def command(self, name: str, **parameters: object) -> Any:
        """Send a command of WebDriver and return its value."""
        text = json.dumps([0, next(self._numbers), name, parameters]).encode()
        self._writer.write(b"%d:%s" % (len(text), text))
        async with asyncio.timeout(COMMAND_TIME_S):
            _, _, error, result = await self.message()
        assert error is None, f"{name}: {error}"
        return result.get("value", result) if isinstance(result, dict) else result

    async def message(self) -> Any:
        """Return the next message of the browser."""
        length = (await self._reader.readuntil(b":"))[:-1]
        return json.loads(await self._reader.readexactly(int(length)))

    async def open(self, url: str) -> None:
        """Open a page."""
        await self.command("WebDriver:Navigate", url=url)

    async def evaluate(self, script: str, *arguments: object) -> Any:
        """Return what a function of JavaScript returns."""
        return await self.command(
            "WebDriver:ExecuteScript", script=f"return ({script})(...arguments)", args=list(arguments)
        )

    async def keys(self, *strokes: str, pause_ms: int = 0) -> None:
        """Press keys one after another; several characters in one stroke are held together."""
        actions: list[dict[str, object]] = []
        for stroke in strokes:
            actions += [{"type": "keyDown", "value": key} for key in stroke]
            actions += [{"type": "keyUp", "value": key} for key in reversed(stroke)]
            actions += [{"type": "pause", "duration": pause_ms}] if pause_ms else []
        await self._perform("key", actions)

    async def hold(self, key: str, times: int, pause_ms: int) -> None:
        """Keep a key down while it repeats so many times: to press one that is down is a repetition."""
        down: list[dict[str, object]] = [{"type": "keyDown", "value": key}, {"type": "pause", "duration": pause_ms}]
        await self._perform("key", [*down * times, {"type": "keyUp", "value": key}])

    async def click(self, x: float, y: float, count: int = 1) -> None:
        """Click at a point of the window, as often as a hand does in one go."""
        press = [{"type": "pointerDown", "button": 0}, {"type": "pointerUp", "button": 0}]
        await self._perform("pointer", [_move(x, y), *press * count])

    async def drag(self, start: tuple[float, float], end: tuple[float, float]) -> None:
        """Press the button at one point and let it go at another."""
        steps = [[a + (b - a) * step / 10 for a, b in zip(start, end, strict=True)] for step in range(1, 11)]
        held = [{**_move(*step), "duration": 20} for step in steps]
        down, up = ({"type": f"pointer{way}", "button": 0} for way in ("Down", "Up"))
        await self._perform("pointer", [_move(*start), down, *held, up])

    async def touch(self, *fingers: tuple[float, float]) -> None:
        """Have fingers at these points and nowhere else: new ones come down, missing ones are lifted."""
        for number in range(self._fingers, len(fingers)):
            await self._finger(number, [_move(*fingers[number]), {"type": "pointerDown", "button": 0}])
        for number in reversed(range(len(fingers), self._fingers)):
            await self._finger(number, [{"type": "pointerUp", "button": 0}])
        self._fingers = len(fingers)

    async def _finger(self, number: int, actions: list[dict[str, object]]) -> None:
        touch = {"type": "pointer", "id": f"finger {number}", "parameters": {"pointerType": "touch"}}
        await self.command("WebDriver:PerformActions", actions=[{**touch, "actions": actions}])

    async def wheel(self, x: float, y: float, by: int) -> None:
        """Turn the wheel over a point."""
        turn = {"type": "scroll", "x": round(x), "y": round(y), "deltaX": 0, "deltaY": by, "origin": "viewport"}
        await self._perform("wheel", [turn])

    async def compose(self, *texts: str) -> None:
        """Let an input method show each of these texts in the focused field, and take over the last."""
        await self.command("Marionette:SetContext", value="chrome")
        try:
            await self.command("WebDriver:ExecuteScript", script=COMPOSE, args=[list(texts)])
        finally:
            await self.command("Marionette:SetContext", value="content")

    async def resize(self, width: int, height: int) -> None:
        """Give the page a size, in its own pixels: a window cannot be narrow, so its page is zoomed instead."""
        await self.command("Marionette:SetContext", value="chrome")
        try:
            zoom = "ZoomManager.setZoomForBrowser(gBrowser.selectedBrowser, arguments[0])"
            factor = NARROWEST / width if width < NARROWEST else 1.0
            await self.command("WebDriver:ExecuteScript", script=zoom, args=[factor])
        finally:
            await self.command("Marionette:SetContext", value="content")
        for _ in range(2):  # what is round the page shows when it has a size
            rect = await self.command("WebDriver:GetWindowRect")
            has = await self.evaluate("() => [innerWidth, innerHeight]")
            around = [rect[side] - have * factor for side, have in zip(("width", "height"), has, strict=True)]
            wanted = [round(size * factor + more) for size, more in zip((width, height), around, strict=True)]
            await self.command("WebDriver:SetWindowRect", width=wanted[0], height=wanted[1])

    async def prefer(self, scheme: str) -> None:
        """Show pages in the "dark" or in the "light"."""
        await self.command("Marionette:SetContext", value="chrome")
        try:
            preference, value = "layout.css.prefers-color-scheme.content-override", int(scheme == "light")
            await self.evaluate("(name, value) => Services.prefs.setIntPref(name, value)", preference, value)
        finally:
            await self.command("Marionette:SetContext", value="content")

    async def _perform(self, kind: str, actions: list[dict[str, object]]) -> None:
        await self.command("WebDriver:PerformActions", actions=[{"type": kind, "id": kind, "actions": actions}])


@asynccontextmanager
async def open_firefox(program: str, folder: Path) -> AsyncIterator[Firefox]:
    """Run a Firefox without a screen until the context ends; its profile is kept in a folder."""
    port = free_port()
    lines = [f'user_pref("{name}", {value.format(port=port)});' for name, value in PREFERENCES.items()]
    (folder / "user.js").write_text("\n".join(lines), encoding="utf-8")
    process = await asyncio.create_subprocess_exec(
        program, "--headless", "--marionette", "--remote-allow-system-access", "--no-remote", "--profile", str(folder),
        stdout=asyncio.subprocess.DEVNULL, stderr=asyncio.subprocess.DEVNULL,
        env={**os.environ, "HOME": str(folder), "MOZ_HEADLESS": "1"},
    )  # fmt: skip
    try:
        async with asyncio.timeout(START_TIME_S):
            while True:
                with contextlib.suppress(OSError):
                    reader, writer = await asyncio.open_connection("127.0.0.1", port)
                    break
                await asyncio.sleep(0.1)  # nothing tells when its port listens
        window = Firefox(reader, writer)
        try:
            await window.message()
            await window.command("WebDriver:NewSession")
            yield window
        finally:
            writer.close()
    finally:
        with contextlib.suppress(ProcessLookupError):
            process.terminate()
        await process.wait()


def _move(x: float, y: float) -> dict[str, object]:
    return {"type": "pointerMove", "x": round(x), "y": round(y), "origin": "viewport"}
