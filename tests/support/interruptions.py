"""A scenario that is interrupted at each step of its loop, each time in a copy of the process: the original goes on.

A step is a callback of the event loop: between two of them every task of the daemon is suspended at some await. The
copy is made by fork, so each interruption costs only what comes after it.
"""

import asyncio
import json
import os
import select
import signal
from collections import deque
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from typing import Any, NoReturn

from typing_extensions import override

from ldcnd.sim.jumping_loop import JumpingLoop

LONGEST_LIFE_S = 60
"""Processor seconds that a copy may take."""
Chosen = Callable[[int], bool]
"""Tells whether to interrupt before a step, by its number."""


@dataclass
class Interruptions:
    """What came of the interruptions of one run.

    Attributes:
        steps: callbacks of the loop.
        visited: how many of them were interrupted.
        wrong: what each copy complained about, with the number of its step.
    """

    steps: int = 0
    visited: int = 0
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


class InterruptedLoop(JumpingLoop):
    """A loop in virtual time that stops before chosen steps.

    Attributes:
        interruptions: what came of it.
        interrupt: what is done to a copy before a chosen step, with the number of the step: it returns what is wrong
            afterwards, or, to let the loop of the copy go on, None; then `leave` ends the copy. None before the first.
    """

    def __init__(self, chosen: Chosen) -> None:
        super().__init__()
        self.interruptions = Interruptions()
        self.interrupt: Callable[[int], list[str] | None] | None = None
        self._chosen = chosen
        self._report: int | None = None  # of a copy: where it writes
        self._ready = _Steps(self._before_step)

    def _before_step(self) -> None:
        interrupt = self.interrupt
        if interrupt is None or self._report is not None:
            return
        here = self.interruptions
        here.steps += 1
        if not self._chosen(here.steps):
            return
        here.visited += 1
        reading, writing = os.pipe()
        if pid := os.fork():
            os.close(writing)
            here.wrong += [f"step {here.steps}: {each}" for each in _heard(reading, pid)]
            return
        asyncio._set_running_loop(self)
        signal.alarm(LONGEST_LIFE_S * 10)  # a busy machine is slow
        self._report = writing
        try:
            wrong = interrupt(here.steps)
        except BaseException as error:  # noqa: BLE001 - whatever went wrong, this process must not go on as a test
            self.leave([f"{type(error).__name__}: {error}"])
        if wrong is not None:
            self.leave(wrong)

    def leave(self, wrong: list[str]) -> NoReturn:
        """End a copy, and tell what was wrong."""
        assert self._report is not None
        os.write(self._report, json.dumps(wrong).encode())
        os._exit(0)

    @property
    def is_copy(self) -> bool:
        """Whether this process is a copy that goes on after its interruption."""
        return self._report is not None


def _heard(reading: int, pid: int) -> list[str]:
    told = b""
    while select.select([reading], [], [])[0] and (more := os.read(reading, 65_536)):
        told += more
    os.close(reading)
    _, status = os.waitpid(pid, 0)
    if status or not told:
        return [f"the copy ended with {status} and said {told!r}"]
    wrong: list[str] = json.loads(told)
    return wrong


def in_new_loop(scenario: Callable[[], Awaitable[list[str]]], now_s: float) -> list[str]:
    """Leave the loop that runs here for good, as a killed process does, and run a scenario in a new one.

    Nothing of the old loop runs any more: no task is cancelled and nothing is closed.
    """
    asyncio._set_running_loop(None)

    async def run() -> list[str]:
        return await scenario()

    with asyncio.Runner(loop_factory=lambda: JumpingLoop(now_s)) as runner:
        return runner.run(run())


def run_interrupted(scenario: Callable[[], Awaitable[None]], chosen: Chosen) -> Interruptions:
    """Run a scenario on an interrupted loop; return what came of it."""
    origin = os.getpid()
    loop = InterruptedLoop(chosen)

    async def run() -> None:
        await scenario()

    try:
        with asyncio.Runner(loop_factory=lambda: loop) as runner:
            runner.run(run())
    finally:
        if os.getpid() != origin:
            loop.leave(["the scenario of the copy ended before its judgement"])
    return loop.interruptions
