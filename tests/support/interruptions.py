"""A scenario that is interrupted at each step of its loop, each time in a copy of the process: the original goes on.

A step is a callback of the event loop: between two of them every task of the daemon is suspended at some await. The
copy is made by fork, so each interruption costs only what comes after it.
"""

import asyncio
import contextlib
import json
import os
import shutil
import signal
import tempfile
from collections import deque
from collections.abc import Awaitable, Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NoReturn, TypeVar

from pydantic import BaseModel
from typing_extensions import override

from ldcnd.testing.jumping_loop import JumpingLoop

ResultT = TypeVar("ResultT")
LONGEST_LIFE_S = 600
"""A copy that takes longer has gone astray; a busy machine is slow."""
Chosen = Callable[[int], bool]
"""Tells whether to interrupt before a step, by its number."""


@dataclass
class Interruptions:
    """What came of the copies of one run.

    Attributes:
        steps: callbacks of the loop.
        visited: how many of them were interrupted.
        counted: what the copies have counted, all together.
        wrong: what each copy complained about, with the number of its step.
    """

    steps: int = 0
    visited: int = 0
    counted: int = 0
    wrong: list[str] = field(default_factory=list)


class _Steps(deque[Any]):
    """The callbacks that are ready; tells of each one before it runs."""

    def __init__(self, before: Callable[[], None]) -> None:
        super().__init__()
        self._before = before

    @override
    def popleft(self) -> Any:
        self._before()
        return super().popleft()


class CopiedLoop(JumpingLoop):
    """A loop in virtual time whose process can be copied, before chosen steps or when a scenario asks for it.

    Attributes:
        came: what came of the copies.
        interrupt: what is done to a copy before a chosen step, with the number of the step: it returns what is wrong
            afterwards, or, to let the loop of the copy go on, None; then `leave` ends the copy. None before the first.
    """

    def __init__(self, chosen: Chosen = lambda _: False) -> None:
        super().__init__()
        self.came = Interruptions()
        self.interrupt: Callable[[int], list[str] | None] | None = None
        self._chosen = chosen
        self._report: int | None = None  # of a copy: where it writes
        self._ready = _Steps(self._before_step)

    def copy(self, name: str) -> bool:
        """Go on as two processes; true in the copy, false in the original once the copy has left."""
        reading, writing = os.pipe()
        if pid := os.fork():
            os.close(writing)
            wrong, counted = _heard(reading, pid)
            self.came.visited += 1
            self.came.counted += counted
            self.came.wrong += [f"{name}: {each}" for each in wrong]
            return False
        asyncio._set_running_loop(self)  # asyncio forgets it in a copy
        signal.alarm(LONGEST_LIFE_S)
        self._report = writing
        return True

    def leave(self, wrong: list[str], counted: int = 0) -> NoReturn:
        """End a copy, and tell what was wrong and what it has counted."""
        assert self._report is not None
        os.write(self._report, json.dumps((wrong, counted)).encode())
        os._exit(0)

    @property
    def is_copy(self) -> bool:
        """Whether this process is a copy."""
        return self._report is not None

    def _before_step(self) -> None:
        interrupt = self.interrupt
        if interrupt is None or self._report is not None:
            return
        self.came.steps += 1
        step = self.came.steps
        if self._chosen(step) and self.copy(f"step {step}"):
            try:
                wrong = interrupt(step)
            except BaseException as error:  # noqa: BLE001 - whatever went wrong, this process must not go on as a test
                self.leave([f"{type(error).__name__}: {error}"])
            if wrong is not None:
                self.leave(wrong)


@contextlib.contextmanager
def own_folder() -> Iterator[None]:
    """Work in a folder of its own: what daemons keep is kept below it."""
    before, folder = Path.cwd(), tempfile.mkdtemp()
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(before)
        shutil.rmtree(folder, ignore_errors=True)


ROOMS = tuple(f"/ldcnd/{room}/" for room in ("line", "axis", "drives", "daemon", "net"))
"""Where an await may come between a decision and what it was about."""


class EveryAwait:
    """Chooses a step before which a task goes on from an await in the rooms of the daemon, for each await once.

    Attributes:
        reached: the awaits at which a task was suspended: file and line.
    """

    def __init__(self) -> None:
        self.reached: set[tuple[str, int]] = set()

    def __call__(self, step: int) -> bool:
        """Tell whether the task whose turn it is waits at an await that was not met before."""
        loop = asyncio.get_running_loop()
        assert isinstance(loop, CopiedLoop)
        task = getattr(loop._ready[0]._callback, "__self__", None)
        met = set(_awaits_of(task.get_coro())) if isinstance(task, asyncio.Task) else set()
        is_new = not met <= self.reached
        self.reached |= met
        return is_new


def _awaits_of(coroutine: Any) -> Iterator[tuple[str, int]]:
    """Yield where a suspended coroutine waits, and where those wait that wait for it inside."""
    while coroutine is not None:
        frame = getattr(coroutine, "cr_frame", None) or getattr(coroutine, "ag_frame", None)
        if frame is not None and any(room in frame.f_code.co_filename for room in ROOMS):
            yield frame.f_code.co_filename, frame.f_lineno
        coroutine = getattr(coroutine, "cr_await", None) or getattr(coroutine, "ag_await", None)


def _heard(reading: int, pid: int) -> tuple[list[str], int]:
    told = b""
    while more := os.read(reading, 65_536):
        told += more
    os.close(reading)
    _, status = os.waitpid(pid, 0)
    if status or not told:
        return [f"the copy ended with {status} and said {told!r}"], 0
    wrong, counted = json.loads(told)
    return wrong, counted


def in_new_loop(scenario: Callable[[], Awaitable[ResultT]], now_s: float) -> ResultT:
    """Leave the loop that runs here for good, as a killed process does, and run a scenario in a new one.

    Nothing of the old loop runs any more: no task is cancelled and nothing is closed.
    """
    asyncio._set_running_loop(None)

    async def run() -> ResultT:
        return await scenario()

    with asyncio.Runner(loop_factory=lambda: JumpingLoop(now_s)) as runner:
        return runner.run(run())


def _build_models(base: type[BaseModel]) -> None:
    """Build the validators that pydantic defers, lest each copy build them for itself."""
    for model in base.__subclasses__():
        model.model_rebuild()
        _build_models(model)


def run_with_copies(scenario: Callable[[], Awaitable[None]], chosen: Chosen = lambda _: False) -> Interruptions:
    """Run a scenario on a loop that is copied; return what came of the copies."""
    origin = os.getpid()
    _build_models(BaseModel)
    loop = CopiedLoop(chosen)

    async def run() -> None:
        await scenario()

    try:
        with asyncio.Runner(loop_factory=lambda: loop) as runner:
            runner.run(run())
    finally:
        if os.getpid() != origin:
            loop.leave(["the scenario of the copy ended before its judgement"])
    return loop.came
