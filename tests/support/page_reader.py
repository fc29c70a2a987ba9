"""Somebody who does what a page says: writes its files, runs its commands, presses Ctrl-C where it tells him to."""

import asyncio
import os
import re
import shlex
import signal
import sys
from asyncio.subprocess import DEVNULL, PIPE, STDOUT, Process
from collections.abc import Awaitable, Callable, Container
from contextlib import suppress
from pathlib import Path
from typing import Self

from ldcnd.client.traces import trace_header
from ldcnd.contract.traces import TracePhase
from tests.support.pages import Block, blocks_of
from tests.support.process import END_TIME_S, START_TIME_S, answering, client, free_port

COMMAND_TIME_S = 120.0
FILE_NAME = re.compile(r"# (\S+\.(?:py|toml))\n")
PORT_OF_THE_PAGES = "7447"


class PageReader:
    """Works through pages in one folder, with terminals of his own, and a port that nobody else uses.

    Attributes:
        printed: what the commands have said, for the message of a test that fails.
        port: at which the daemon listens instead of that of the pages.
    """

    def __init__(self, folder: Path) -> None:
        self.printed = ""
        self.folder = folder
        self.port = str(free_port())
        self._endpoint = f"tcp/127.0.0.1:{self.port}"
        path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
        self._environment = {**os.environ, "PATH": path, "LDCND_CONNECT": self._endpoint, "PYTHONUNBUFFERED": "1"}
        self._running: list[Process] = []
        self._waiting: list[Process] = []

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        """Close all terminals."""
        for process in [*self._waiting, *reversed(self._running)]:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGTERM)
        for process in [*self._waiting, *self._running]:
            await self._end_of(process)

    async def follow(self, page: Path, left_out: Container[tuple[str, str]] = ()) -> None:
        """Do what a page says, but for some blocks, named by page and first line."""
        for block in blocks_of(page):
            if (block.page, block.first_line) in left_out:
                continue  # what is said of Ctrl-C there is said of what is left out
            if "Ctrl-C" in block.prose and self._running:
                await self._interrupt()
            await self._do(block)
            assert all(process.returncode is None for process in self._running), f"{block}: what should serve has ended"

    async def start_daemon(self, config: str) -> None:
        """Start a daemon on a file that an earlier page has had written."""
        path = self.folder / config
        text = re.sub(r"tcp/127\.0\.0\.1:\d+", self._endpoint, path.read_text(encoding="utf-8"))
        path.write_text(text, encoding="utf-8")
        await self._leave_running(f"ldcnd run --config {config}", self._answers, f"the daemon on {config}")

    async def _do(self, block: Block) -> None:
        text = block.text.replace(PORT_OF_THE_PAGES, self.port)
        if name := FILE_NAME.match(text):
            (self.folder / name[1]).write_text(text, encoding="utf-8")
        if block.language != "sh":
            return
        *at_once, last = text.strip().splitlines()
        ready = self._serves(shlex.split(last, comments=True))
        if ready is None:
            at_once.append(last)
        if last.startswith("ldcnd sim") and self._running:
            await self._interrupt()  # its link is wanted again
        if at_once:
            await self._run("\n".join(at_once), block)
        if ready is not None:
            await self._leave_running(last, ready, block)

    def _serves(self, words: list[str]) -> Callable[[Process], Awaitable[bool]] | None:
        """Return what tells that a command is at work which does not come back by itself; None for all others."""
        match words:
            case ["ldcnd", "run", *_]:
                return self._answers
            case ["ldcnd", "sim", *options]:
                return self._appears(self.folder / options[options.index("--pty") + 1])
            case ["ldcnd", "record", "--out", name]:
                return self._appears(self.folder / f"{name}.part")
            case ["ldcnd", "trace", "take", axis, *options] if "--trigger" in options:
                return self._is_armed(axis)
        return None

    async def _run(self, text: str, block: Block) -> None:
        done = await self._start(f"set -euo pipefail\n{text}", PIPE)
        async with asyncio.timeout(COMMAND_TIME_S):
            printed, _ = await done.communicate()
        self.printed += printed.decode()
        assert done.returncode == 0, f"{block}: exit code {done.returncode}\n{self.printed}"
        for process in self._waiting:
            await self._end_of(process)
            assert process.returncode == 0, f"{block}: what had been waiting ended with {process.returncode}"
        self._waiting.clear()

    async def _leave_running(self, text: str, ready: Callable[[Process], Awaitable[bool]], what: object) -> None:
        process = await self._start(f"exec {text}", DEVNULL)
        (self._waiting if "--trigger" in text else self._running).append(process)
        async with asyncio.timeout(START_TIME_S):
            while not await ready(process):
                assert process.returncode is None, f"{what}: ended with {process.returncode}"
                await asyncio.sleep(0.1)  # another process: nothing tells when

    async def _start(self, script: str, output: int) -> Process:
        return await asyncio.create_subprocess_exec(
            "bash",
            "-c",
            script,
            stdin=DEVNULL,
            stdout=output,
            stderr=STDOUT if output == PIPE else None,
            cwd=self.folder,
            env=self._environment,
            start_new_session=True,
        )

    async def _interrupt(self) -> None:
        """Press Ctrl-C in the terminal that was opened last."""
        process = self._running.pop()
        os.killpg(process.pid, signal.SIGINT)
        await self._end_of(process)
        assert process.returncode == 0, f"Ctrl-C: exit code {process.returncode}"

    @staticmethod
    async def _end_of(process: Process) -> None:
        try:
            async with asyncio.timeout(END_TIME_S):
                await process.wait()
        except TimeoutError:
            os.killpg(process.pid, signal.SIGKILL)
            await process.wait()
            raise

    async def _answers(self, process: Process) -> bool:
        await answering(process, self._endpoint)
        return True

    @staticmethod
    def _appears(path: Path) -> Callable[[Process], Awaitable[bool]]:
        async def appeared(_process: Process) -> bool:
            return path.exists()

        return appeared

    def _is_armed(self, axis: str) -> Callable[[Process], Awaitable[bool]]:
        async def armed(_process: Process) -> bool:
            async with client(self._endpoint) as rig:
                header = await trace_header(rig, axis)
            return header is not None and header.phase is TracePhase.WAITING

        return armed
