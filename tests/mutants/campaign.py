"""Judges mutants in forked processes: a plugin of pytest that takes the place of its loop over the tests.

Pytest imports and collects all tests once. A mutant is then a fork in which the code of one function is replaced and
the tests that run it are run, so that it costs little more than these tests. Changes of what runs at import, in a
module or a class, cannot be made so late: those mutants get a pytest of their own (`applied`).

A test that fails decides only if it fails again by itself, and passes by itself on the code as it is. A kill is
remembered, and holds until the module that is changed or the module of the test changes.
"""

import contextlib
import gc
import json
import os
import re
import resource
import select
import signal
import subprocess
import sys
import time
import traceback
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from types import CodeType, FunctionType

import pytest

from tests.mutants.applied import MUTANT
from tests.mutants.changes import Mutant
from tests.mutants.covering import RECORDS, ROOT, Covering, digest

HANGING_S = 30.0
"""Shortest wall time after which a test is called hanging."""
HANGING_RATIO = 30
"""Wall time after which a test is called hanging, as a multiple of the processor time that it costs."""
LEAST_TESTS = 3
"""Fewest tests for a mutant, where so many run the line: the budget may be less than what one of them costs."""
MEMORY_BYTES = 4 << 30
"""Address space of a fork: a mutant that appends for ever ends here."""
KILLED = RECORDS / "killed.jsonl"
"""What was killed by which test."""


class Verdict(StrEnum):
    """What became of a mutant."""

    KILLED = "killed"
    TIMED_OUT = "killed by time-out"
    SURVIVED = "survived"
    UNCOVERED = "no test runs the line"


@dataclass(frozen=True, slots=True)
class Judgement:
    """What became of one mutant.

    Attributes:
        number: of the mutant in the campaign.
        verdict: what became of it.
        test: the test that killed it, if any.
        seconds: wall time it took.
    """

    number: int
    verdict: Verdict
    test: str
    seconds: float


@dataclass(frozen=True, slots=True)
class _Run:
    """How a row of tests ended: the test that failed, and whether it hung; no test if all passed."""

    failed: str = ""
    hung: bool = False


class Campaign:
    """Forks for each mutant instead of running the tests; `judgements` fills while it runs."""

    def __init__(
        self, mutants: Sequence[Mutant], covering: Covering, seconds: float, workers: int, ends_s: float
    ) -> None:
        self.judgements: list[Judgement] = []
        self._mutants = mutants
        self._covering = covering
        self._seconds = seconds
        self._workers = workers
        self._ends_s = ends_s
        self._items: dict[str, pytest.Item] = {}
        self._functions: Mapping[tuple[str, str], Sequence[FunctionType]] = {}
        self._sound: dict[str, bool] = {}
        self._failed = False
        self._memory = _remembered()

    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        """Judge all mutants, in as many processes as there are workers."""
        self._items = {item.nodeid: item for item in session.items}
        self._functions = _loaded_functions()
        gc.freeze()  # what forks share stays shared
        reading, writing = os.pipe()
        children = []
        for worker in range(self._workers):
            if not (child := os.fork()):
                os.close(reading)
                with _child_ends():
                    self._work(worker, writing)
            children.append(child)
        os.close(writing)
        with os.fdopen(reading, encoding="utf-8") as lines, KILLED.open("a", encoding="utf-8") as memory:
            for line in lines:
                number, verdict, test, seconds = json.loads(line)
                self.judgements.append(judgement := Judgement(number, Verdict(verdict), test, seconds))
                _print(self._mutants[number], judgement)
                if judgement.verdict in (Verdict.KILLED, Verdict.TIMED_OUT):
                    memory.write(json.dumps((_identity(self._mutants[number], test), verdict, test)) + "\n")
                    memory.flush()
        for child in children:
            os.waitpid(child, 0)
        return True

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Remember in a fork that a test failed."""
        self._failed = self._failed or report.failed

    def _work(self, worker: int, writing: int) -> None:
        for number in range(worker, len(self._mutants), self._workers):
            if time.monotonic() > self._ends_s:
                return
            begun_s = time.monotonic()
            verdict, test = self._judged(self._mutants[number])
            line = json.dumps((number, verdict, test, round(time.monotonic() - begun_s, 2)))
            os.write(writing, line.encode() + b"\n")  # one write of less than a page: lines of workers do not mix

    def _judged(self, mutant: Mutant) -> tuple[Verdict, str]:
        for identity, verdict, test in self._memory.get(str(mutant), ()):
            if _identity(mutant, test) == identity:
                return verdict, test
        lines = range(mutant.lines[0], mutant.lines[1] + 1)
        is_early = not mutant.function or self._covering.is_imported(mutant.path, lines)
        covering = self._covering.of(mutant.path, lines)
        if is_early:  # those that run the line first, then those that only import it
            covering = list(dict.fromkeys([*covering, *self._covering.of_module(mutant.path)]))
        elif not covering:  # coverage loses sight of a coroutine behind an `await` in a comprehension
            covering = self._covering.of(mutant.path, self._lines_of_function(mutant))
        tests = [test for test in covering if test in self._items]
        if not tests:
            return Verdict.UNCOVERED, ""
        tests, code = self._affordable(tests), mutant.module(ROOT)
        if is_early or not self._is_replaceable(mutant, code):
            return _judged_freshly(mutant, tests)
        while tests and (run := self._run(tests, mutant, code)).failed:
            alone = run if run.hung or run.failed == tests[0] else self._run([run.failed], mutant, code)
            if alone.failed and self._is_sound(run.failed):
                return Verdict.TIMED_OUT if alone.hung else Verdict.KILLED, run.failed
            tests = [test for test in tests if test != run.failed]
        return Verdict.SURVIVED, ""

    def _affordable(self, tests: Sequence[str]) -> list[str]:
        """Return the first tests, as many as the budget pays for."""
        chosen: list[str] = []
        took_s = 0.0
        for test in tests:
            took_s += self._covering.seconds[test]
            if len(chosen) >= LEAST_TESTS and took_s > self._seconds:
                break
            chosen.append(test)
        return chosen

    def _is_sound(self, test: str) -> bool:
        """Return whether a test passes by itself, in a fork, on the code as it is."""
        if test not in self._sound:
            self._sound[test] = not self._run([test], None, None).failed
        return self._sound[test]

    def _run(self, tests: Sequence[str], mutant: Mutant | None, code: CodeType | None) -> _Run:
        """Run tests in a fork until one fails."""
        reading, writing = os.pipe()
        if not (child := os.fork()):
            os.close(reading)
            with _child_ends():
                _isolate()
                if mutant and code:
                    self._replace(mutant, code)
                self._run_items([self._items[test] for test in tests], writing)
        os.close(writing)
        begun = -1
        try:
            while True:
                cost_s = self._covering.seconds[tests[max(begun, 0)]]
                if not select.select([reading], [], [], max(HANGING_S, HANGING_RATIO * cost_s))[0]:
                    return _Run(tests[max(begun, 0)], hung=True)
                if not (told := os.read(reading, 4096)):
                    break
                begun += len(told)
        finally:
            os.close(reading)
            with contextlib.suppress(ProcessLookupError):
                os.killpg(child, signal.SIGKILL)
            status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        return _Run(tests[max(begun, 0)]) if status else _Run()

    def _lines_of_function(self, mutant: Mutant) -> set[int]:
        codes = (code for each in self._loaded(mutant) for code in _codes(each.__code__))
        return {line for code in codes for _, _, line in code.co_lines() if line}

    def _loaded(self, mutant: Mutant) -> Sequence[FunctionType]:
        return self._functions.get((str(ROOT / mutant.path), mutant.function), ())

    def _is_replaceable(self, mutant: Mutant, module: CodeType) -> bool:
        """Return whether the change can be made in functions that are already loaded."""
        pairs = [(each, _changed_code(mutant, module, each.__code__.co_firstlineno)) for each in self._loaded(mutant)]
        return bool(pairs) and all(code and code.co_freevars == each.__code__.co_freevars for each, code in pairs)

    def _replace(self, mutant: Mutant, module: CodeType) -> None:
        for function in self._loaded(mutant):
            if code := _changed_code(mutant, module, function.__code__.co_firstlineno):
                function.__code__ = code

    def _run_items(self, items: Sequence[pytest.Item], writing: int) -> None:
        """Run items in the fork: one byte at the beginning of each; the exit status is 1 at the first that fails."""
        for item, following in zip(items, [*items[1:], None], strict=True):
            os.write(writing, b".")
            item.ihook.pytest_runtest_protocol(item=item, nextitem=following)
            if self._failed:
                os._exit(1)
        os._exit(0)


@contextlib.contextmanager
def _child_ends() -> Iterator[None]:
    """End a fork where its work ends, whatever happens in it."""
    try:
        yield
    except BaseException:  # noqa: BLE001 - the fork must not go on as a second parent
        traceback.print_exc()
        os._exit(3)
    os._exit(0)


def _isolate() -> None:
    """Let a fork print nothing, use bounded memory, and be ended with all that it starts."""
    os.setpgid(0, 0)
    nothing = os.open(os.devnull, os.O_RDWR)
    for standard in range(3):
        os.dup2(nothing, standard)
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))


def _loaded_functions() -> Mapping[tuple[str, str], Sequence[FunctionType]]:
    """Return all functions by file and qualified name: more than one of a name, where a decorator has made copies."""
    found: dict[tuple[str, str], list[FunctionType]] = defaultdict(list)
    for function in gc.get_objects():
        if type(function) is FunctionType:
            found[function.__code__.co_filename, function.__code__.co_qualname].append(function)
    return found


def _changed_code(mutant: Mutant, module: CodeType, first_line: int) -> CodeType | None:
    """Return the changed code of the outermost function that begins at a line."""
    found = [
        code for code in _codes(module) if (code.co_qualname, code.co_firstlineno) == (mutant.function, first_line)
    ]
    return found[0] if found else None


def _codes(code: CodeType) -> Iterator[CodeType]:
    yield code
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _codes(constant)


def _judged_freshly(mutant: Mutant, tests: Sequence[str]) -> tuple[Verdict, str]:
    """Judge a mutant in a pytest of its own, which imports the changed module."""
    command = ("-q", "-x", "--no-header", "-rfE", "--tb=no", "-p", "tests.mutants.applied", *tests)
    try:
        run = subprocess.run(  # noqa: S603
            (sys.executable, "-m", "pytest", *command), cwd=ROOT, timeout=600, check=False, capture_output=True,
            env=os.environ | {MUTANT: json.dumps((mutant.path, mutant.node, mutant.kind))}, stdin=subprocess.DEVNULL,
            text=True,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return Verdict.TIMED_OUT, "a pytest of its own"
    if run.returncode == 0:
        return Verdict.SURVIVED, ""
    failed = re.search(r"^(?:FAILED|ERROR) (\S+)", run.stdout, re.MULTILINE)
    return Verdict.KILLED, failed[1] if failed else "a pytest of its own"


def _identity(mutant: Mutant, test: str) -> list[str]:
    """Return what a kill depends on: the change, the module that is changed, and the module of the test."""
    files = [ROOT / mutant.path, ROOT / test.partition("::")[0]]
    return [str(mutant), str(mutant.node), *(digest(file) if file.is_file() else "" for file in files)]


def _remembered() -> Mapping[str, Sequence[tuple[list[str], Verdict, str]]]:
    """Return the kills of earlier campaigns by mutant."""
    found: dict[str, list[tuple[list[str], Verdict, str]]] = defaultdict(list)
    for line in KILLED.read_text(encoding="utf-8").splitlines() if KILLED.exists() else ():
        identity, verdict, test = json.loads(line)
        found[identity[0]].append((identity, Verdict(verdict), test))
    return found


def _print(mutant: Mutant, judgement: Judgement) -> None:
    by = f"  [{judgement.test}]" if judgement.test else ""
    sys.__stdout__.write(f"{judgement.verdict}: {mutant}{by} {judgement.seconds:.1f} s\n")  # type: ignore[union-attr]
    sys.__stdout__.flush()  # type: ignore[union-attr]


def run(campaign: Campaign, tests: Sequence[Path]) -> None:
    """Collect the test modules and judge."""
    command = ("-q", "-s", "--no-header", "--no-summary", "-m", "not soak and not real_time", *map(str, tests))
    pytest.main(list(command), plugins=[campaign])
