"""Which tests run a line, and how long each takes; a plugin of pytest: `-p tests.mutants.covering`.

The environment says where the map goes (`LDCND_MUTANTS_MAP`).
"""

import json
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import coverage
import pytest

MAP = "LDCND_MUTANTS_MAP"
NO_TEST = "none"


@dataclass(frozen=True, slots=True)
class CoveringTests:
    """The map that a run of the plugin has left.

    Attributes:
        lines: module -> line -> numbers of tests.
        tests: their names.
        seconds: what each took.
    """

    lines: dict[str, dict[str, list[int]]]
    tests: list[str]
    seconds: list[float]

    @classmethod
    def read(cls, file: Path) -> "CoveringTests":
        """Read a map."""
        return cls(**json.loads(file.read_text(encoding="utf-8")))

    def of(self, path: str, line: int, within_s: float) -> Sequence[str]:
        """Return the tests that run a line, quickest first, as many as fit into a time; at least one."""
        covering = sorted(self.lines.get(path, {}).get(str(line), []), key=lambda test: self.seconds[test])
        chosen, took_s = [], 0.0
        for test in covering:
            took_s += self.seconds[test]
            if chosen and took_s > within_s:
                break
            chosen.append(self.tests[test])
        return chosen


class _Recorder:
    """Notes under which test each line runs."""

    def __init__(self, file: Path) -> None:
        self._file = file
        self._coverage = coverage.Coverage(data_file=None, source=["ldcnd"], messages=False)
        self._seconds: dict[str, float] = {}

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Iterator[None]:
        self._coverage.switch_context(item.nodeid)
        try:
            return (yield)
        finally:
            self._coverage.switch_context(NO_TEST)

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        self._seconds[report.nodeid] = self._seconds.get(report.nodeid, 0.0) + report.duration

    def pytest_sessionstart(self) -> None:
        self._coverage.start()

    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        self._coverage.stop()
        data = self._coverage.get_data()
        tests = sorted(self._seconds)
        numbers = {test: number for number, test in enumerate(tests)}
        lines: dict[str, dict[str, list[int]]] = {}
        for file in data.measured_files():
            contexts = data.contexts_by_lineno(file)
            path = str(Path(file).relative_to(session.config.rootpath))
            lines[path] = {
                str(line): [numbers[test] for test in running if test in numbers] for line, running in contexts.items()
            }
        seconds = [self._seconds[test] for test in tests]
        self._file.write_text(json.dumps({"lines": lines, "tests": tests, "seconds": seconds}), encoding="utf-8")


def pytest_configure(config: pytest.Config) -> None:
    """Record, where the environment says so."""
    if file := os.environ.get(MAP):
        config.pluginmanager.register(_Recorder(Path(file)), "covering")
