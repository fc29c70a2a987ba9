"""How fast this machine is while the bench runs: two fixed loops, one of Python and one of system calls.

A processor that was idle runs slowly for up to a second, here by 1.8 times, so each look keeps it busy first.

Figures of time are compared within a run only. A machine whose own speed changes during the run, because others use it
or because it throttles, spoils that too: then the bench prints such rows and judges none of them. Ratios of paired
rounds say themselves how well they are known.
"""

import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

from tests.bench.report import Row

TURNS, CALLS = 200_000, 100_000
LOOK_S = 2.0
MOST_VARIATION = 0.15


def _python_loop() -> None:
    total = 0
    for number in range(TURNS):
        total += number & 7


def _syscall_loop() -> None:
    for _ in range(CALLS):
        os.getppid()


def _least_s(loop: Callable[[], None]) -> float:
    """Return the processor time of the quickest run of `LOOK_S`: in others the processor had slept, or was shared."""
    found = []
    end_s = time.monotonic() + LOOK_S
    while time.monotonic() < end_s:
        began_s = time.thread_time()
        loop()
        found.append(time.thread_time() - began_s)
    return min(found)


@dataclass(slots=True)
class MachineSpeed:
    """The two loops, timed whenever `look` is called."""

    python_ms: list[float] = field(default_factory=list)
    syscall_ms: list[float] = field(default_factory=list)

    def look(self) -> None:
        """Time both loops, each for `LOOK_S`."""
        self.python_ms.append(_least_s(_python_loop) * 1e3)
        self.syscall_ms.append(_least_s(_syscall_loop) * 1e3)

    @property
    def variation(self) -> float:
        """Return by which share the slowest look took longer than the quickest."""
        return max(max(each) / min(each) - 1 for each in (self.python_ms, self.syscall_ms))

    def rows(self) -> list[Row]:
        """Say how fast the machine was."""
        return [
            Row(f"machine: {TURNS} turns of a Python loop", min(self.python_ms), "ms"),
            Row(f"machine: {CALLS} system calls", min(self.syscall_ms), "ms"),
            Row("machine: slowest / quickest look, less one", self.variation),
        ]

    def judged(self, rows: Sequence[Row]) -> list[Row]:
        """Return the rows as they may be judged: times only if the machine kept its speed."""
        return [replace(row, doubt=row.doubt or self._doubt(row)) for row in rows]

    def _doubt(self, row: Row) -> str:
        varied = self.variation > MOST_VARIATION and not (row.exact or row.between)
        return f"the machine's speed varied by {self.variation:.0%} during the run" if varied else ""
