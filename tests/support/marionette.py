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
PREFERENCES = {
    "marionette.port": "{port}",
    "app.update.enabled": "false",
    "datareporting.policy.dataSubmissionEnabled": "false",
    "network.captive-portal-service.enabled": "false",
    "network.connectivity-service.enabled": "false",
    "browser.shell.checkDefaultBrowser": "false",
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
        await self.command("WebDriver:PerformActions", actions=[{"type": "key", "id": "keys", "actions": actions}])


@asynccontextmanager
async def open_firefox(program: str, folder: Path) -> AsyncIterator[Firefox]:
    """Run a Firefox without a screen until the context ends; its profile is kept in a folder."""
    port = free_port()
    lines = [f'user_pref("{name}", {value.format(port=port)});' for name, value in PREFERENCES.items()]
    (folder / "user.js").write_text("\n".join(lines), encoding="utf-8")
    process = await asyncio.create_subprocess_exec(
        program, "--headless", "--marionette", "--no-remote", "--profile", str(folder),
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
        await window.message()
        await window.command("WebDriver:NewSession")
        yield window
        writer.close()
    finally:
        with contextlib.suppress(ProcessLookupError):
            process.terminate()
        await process.wait()
