"""Several commands of `ldcnd` in one process: starting an interpreter for each costs more than what they do."""

import asyncio
import contextlib
import io
import json
import os
import re
import shlex
import signal
import sys
import termios
import tty
from asyncio.subprocess import PIPE
from collections.abc import AsyncIterator, Callable, Coroutine, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, TextIO, TypeVar

import pytest
from typing_extensions import override

from ldcnd.cli import connection
from ldcnd.cli import connection as connecting
from ldcnd.cli.main import main
from ldcnd.config.rig import RigConfig
from ldcnd.contract.samples import LinkState
from ldcnd.net.session import Session
from ldcnd.net.zenoh_settings import ZenohSettings
from ldcnd.sim.chain import Chain
from ldcnd.testing.jumping_loop import JumpingLoop
from tests.support.rig import RunningRig, running_rig

ResultT = TypeVar("ResultT")

PROGRAM = """
import contextlib, io, json, shlex, sys
from ldcnd.cli.main import main

results = []
for line in json.loads(sys.argv[1]):
    line, _, file = line.partition(" > ")
    sys.argv = shlex.split(line)
    printed, errors = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(errors):
        try:
            main()
        except SystemExit as end:
            code = end.code
    if file:
        with open(file, "w", encoding="utf-8") as target:
            target.write(printed.getvalue())
    results.append([code, printed.getvalue(), errors.getvalue()])
print(json.dumps(results))
"""
PATIENCE_S = 50.0


@dataclass(frozen=True, slots=True)
class Ran:
    """How a command went."""

    code: int
    printed: str
    errors: str


async def run_all(folder: Path, *commands: str) -> list[Ran]:
    """Run command lines such as `ldcnd list`, perhaps with ` > FILE` behind them, in a folder."""
    running = await asyncio.create_subprocess_exec(
        sys.executable, "-c", PROGRAM, json.dumps(commands), cwd=folder, stdout=PIPE, stderr=PIPE
    )
    async with asyncio.timeout(PATIENCE_S):
        printed, errors = await running.communicate()
    assert running.returncode == 0, errors.decode()
    return [Ran(*result) for result in json.loads(printed)]


class PipedKeyboard(io.TextIOWrapper):
    """A pipe that says it is a terminal: what is pressed is there at once, which a pseudo-terminal does not promise."""

    @override
    def isatty(self) -> bool:
        return True


class VirtualRig:
    """A daemon on the jumping clock and the command line in front of it, in one process; made by `virtual_rig`.

    Time passes while a command waits for the daemon, and while the test waits for something; otherwise it stands.

    Attributes:
        rig: the daemon, and a client of it.
    """

    def __init__(self, loop: JumpingLoop, rig: RunningRig) -> None:
        self.rig = rig
        self._loop = loop
        self._keyboard: PipedKeyboard | None = None

    def run(self, line: str, typed: str = "", interrupted_after_s: tuple[float, ...] = ()) -> Ran:
        """Run a command line such as `list --json`; it finds on its standard input what is typed, or a keyboard.

        It may be interrupted by Ctrl-C after a time, and after another.
        """
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(asyncio, "run", partial(self._interrupted, interrupted_after_s))
            return run_here(*shlex.split(line), typed=typed, terminal=self._keyboard)

    def _interrupted(self, after_s: tuple[float, ...], work: Coroutine[Any, Any, ResultT]) -> ResultT:
        presses = [self._loop.call_later(each, signal.raise_signal, signal.SIGINT) for each in after_s]
        try:
            return self._loop.run_until_complete(work)
        finally:
            for press in presses:
                press.cancel()

    def power_on(self, *axes: str) -> None:
        """Close the loops of axes once their lines are up."""
        for axis in axes:
            self.wait(self.rig.until(axis, lambda state: state.link is LinkState.UP))
            ran = self.run(f"power on {axis}")
            assert ran.code == 0, ran.errors

    @contextlib.contextmanager
    def keyboard(self) -> Iterator[Callable[[str], object]]:
        """Let commands find a terminal until the context ends; yields what presses its keys, all at once."""
        reading, writing = os.pipe()
        with (
            pytest.MonkeyPatch.context() as patch,
            PipedKeyboard(io.BufferedReader(io.FileIO(reading)), encoding="utf-8") as keyboard,
            io.FileIO(writing, "w") as hand,
        ):
            for module, name in ((termios, "tcgetattr"), (termios, "tcsetattr"), (tty, "setcbreak")):
                patch.setattr(module, name, lambda *_: None)
            self._keyboard = keyboard
            try:
                yield lambda keys: hand.write(keys.encode())
            finally:
                self._keyboard = None

    def begin(self, work: Coroutine[Any, Any, ResultT]) -> "asyncio.Task[ResultT]":
        """Let something go on beside the commands, for as long as their time passes."""
        return self._loop.create_task(work)

    def wait(self, work: "Coroutine[object, object, ResultT] | asyncio.Task[ResultT]") -> ResultT:
        """Let something happen."""
        return self._loop.run_until_complete(work)


@contextlib.contextmanager
def virtual_rig(
    patch: pytest.MonkeyPatch, config: RigConfig | None = None, chains: Mapping[str, Chain] = MappingProxyType({})
) -> Iterator[VirtualRig]:
    """Run a daemon, and let commands find it, until the context ends; only for tests that are no coroutines.

    Args:
        patch: lets commands find the daemon.
        config: the rig.
        chains: simulated lines that exist already, by name.
    """
    loop = JumpingLoop()
    running: asyncio.Future[RunningRig] = loop.create_future()
    over = asyncio.Event()

    async def serve() -> None:
        async with running_rig(config, chains) as rig:
            running.set_result(rig)
            await over.wait()

    @contextlib.asynccontextmanager
    async def open_session(_settings: ZenohSettings) -> AsyncIterator[Session]:
        async with running.result().broker.session() as session:
            yield session

    serving = loop.create_task(serve(), name="rig")
    try:
        either: set[asyncio.Future[Any]] = {running, serving}  # of two types
        loop.run_until_complete(asyncio.wait(either, return_when=asyncio.FIRST_COMPLETED))
        with patch.context() as patched:
            patched.setattr(asyncio, "run", loop.run_until_complete)
            patched.setattr(connection, "open_zenoh_session", open_session)
            patched.setattr(connecting, "open_zenoh_session", open_session)
            yield VirtualRig(loop, running.result())
    finally:
        over.set()
        loop.run_until_complete(serving)
        loop.close()


def run_here(*words: str, typed: str = "", terminal: TextIO | None = None) -> Ran:
    """Run one command line in this process; it finds on its standard input what is typed, or the terminal.

    Raises:
        ModuleNotFoundError: the command is in a wing of ldcnd that is not there.
    """
    printed, errors = io.StringIO(), io.StringIO()
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(printed), contextlib.redirect_stderr(errors):
        patch.setattr(sys, "argv", ["ldcnd", *words])
        patch.setattr(sys, "stdin", io.StringIO(typed) if terminal is None else terminal)
        with pytest.raises(SystemExit) as end:
            main()
    for number, handler in handlers.items():
        signal.signal(number, handler)
    assert isinstance(end.value.code, int)
    if absent := re.search(r"this needs (ldcnd\.\S+), a part of ldcnd that is not installed", errors.getvalue()):
        raise ModuleNotFoundError(absent[0], name=absent[1])
    return Ran(end.value.code, printed.getvalue(), errors.getvalue())
