"""Which tests run a line, and what each costs: a plugin of pytest that records it, and the record.

Each test module has its own file below `build/mutants` and is recorded again when it has changed, so that a new test
costs no run of all others.
"""

import difflib
import hashlib
import json
import subprocess
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator
from pathlib import Path

import coverage
import pytest

ROOT = Path(__file__).parents[2]
RECORDS = ROOT / "build" / "mutants"
IMPORTED = ""
"""The context of lines that run when a module is imported."""


class Covering:
    """The recorded tests, and which lines of the changed modules they run.

    Lines that other commits have moved since are followed by their text.
    """

    def __init__(self, paths: Iterable[str], records: Path = RECORDS) -> None:
        self.seconds: dict[str, float] = {}
        """Processor time of each test that passed, while it was recorded: other programs do not change it."""
        self._tests: dict[str, dict[int, list[str]]] = {path: defaultdict(list) for path in paths}
        self._breadth: Counter[str] = Counter()
        self._moved: dict[tuple[str, str], dict[int, int]] = {}
        for file in sorted(records.glob("*.json")):
            record = json.loads(file.read_text(encoding="utf-8"))
            if not (ROOT / record["module"]).exists():
                continue
            tests: list[str] = list(record["seconds"])
            self.seconds.update(record["seconds"])
            for path in self._tests.keys() & record["lines"].keys():
                now = self._line_numbers(path, record["sources"][path], records)
                for line, numbers in record["lines"][path].items():
                    self._breadth.update(tests[number] for number in numbers)
                    self._tests[path][now.get(int(line), 0)] += [tests[number] for number in numbers]

    def of(self, path: str, lines: Iterable[int]) -> list[str]:
        """Return the tests that run one of these lines: first those that are quick and run little else."""
        tests = {test for line in lines for test in self._tests[path].get(line, ())}
        return sorted(tests - {IMPORTED}, key=lambda test: (self.seconds[test] * self._breadth[test], test))

    def of_module(self, path: str) -> list[str]:
        """Return the tests that run anything of a module, in the same order."""
        return self.of(path, self._tests[path])

    def is_imported(self, path: str, lines: Iterable[int]) -> bool:
        """Return whether one of these lines runs while its module is imported."""
        return any(IMPORTED in self._tests[path].get(line, ()) for line in lines)

    def _line_numbers(self, path: str, digest: str, records: Path) -> dict[int, int]:
        """Return recorded line -> line now."""
        if (path, digest) not in self._moved:
            before = (records / "sources" / digest).read_text(encoding="utf-8").splitlines()
            now = (ROOT / path).read_text(encoding="utf-8").splitlines()
            moved: dict[int, int] = {}
            for tag, start, end, start_now, end_now in difflib.SequenceMatcher(
                None, before, now, autojunk=False
            ).get_opcodes():
                for number in range(start, end) if tag in ("equal", "replace") else ():
                    moved[number + 1] = min(start_now + number - start, end_now - 1) + 1
            self._moved[path, digest] = moved
        return self._moved[path, digest]


class _Recorder:
    """Writes a record whenever the tests of a module are over."""

    def __init__(self) -> None:
        # the whole package: a folder left out would look like one whose lines no test runs
        self._coverage = coverage.Coverage(data_file=None, messages=False, include=[f"{ROOT}/ldcnd/*"])
        self._coverage.set_option("run:disable_warnings", ["no-data-collected"])  # a module may test something else
        self._coverage.start()
        self._seconds: dict[str, float] = {IMPORTED: 0.0}
        self._failed: set[str] = set()

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item, nextitem: pytest.Item | None) -> Iterator[None]:
        self._coverage.switch_context(item.nodeid)
        begun_s = time.process_time()
        try:
            return (yield)
        finally:
            self._seconds[item.nodeid] = time.process_time() - begun_s
            self._coverage.switch_context(IMPORTED)
            if nextitem is None or nextitem.path != item.path:
                self._write(item.path)

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.outcome != "passed":
            self._failed.add(report.nodeid)

    def pytest_sessionfinish(self) -> None:
        self._coverage.stop()

    def _write(self, module: Path) -> None:
        self._coverage.stop()
        data = self._coverage.get_data()
        passed = {test: round(took, 4) for test, took in self._seconds.items() if test not in self._failed}
        numbers = {test: number for number, test in enumerate(passed)}
        lines: dict[str, dict[int, list[int]]] = {}
        sources: dict[str, str] = {}
        for file in data.measured_files():
            path = str(Path(file).relative_to(ROOT))
            sources[path] = _kept_source(Path(file))
            lines[path] = {
                line: [numbers[test] for test in tests if test in numbers]
                for line, tests in data.contexts_by_lineno(file).items()
            }
        record = {
            "module": str(module.relative_to(ROOT)), "digest": _state(module), "seconds": passed, "lines": lines,
            "sources": sources,
        }  # fmt: skip
        _record_of(module).write_text(json.dumps(record), encoding="utf-8")
        self._seconds, self._failed = {IMPORTED: 0.0}, set()
        self._coverage.erase()
        self._coverage.start()


def record(tests: Iterable[str]) -> None:
    """Record the test modules, folders or files, that are new or have changed. Those on the wall clock are left out."""
    modules = [
        file
        for test in tests
        for file in ([ROOT / test] if test.endswith(".py") else sorted((ROOT / test).glob("test_*.py")))
    ]
    due = [file for file in modules if not _is_recorded(file)]
    if not due:
        return
    print(f"recording which lines {len(due)} test modules run", flush=True)
    (RECORDS / "sources").mkdir(parents=True, exist_ok=True)
    command = ("-q", "-p", "tests.mutants.covering", "-m", "not soak and not real_time", "--timeout", "600")
    subprocess.run((sys.executable, "-m", "pytest", *command, *map(str, due)), cwd=ROOT, check=False)  # noqa: S603


def _is_recorded(module: Path) -> bool:
    file = _record_of(module)
    return file.exists() and json.loads(file.read_text(encoding="utf-8"))["digest"] == _state(module)


def _state(module: Path) -> str:
    """Return what changes when the tests of a module do, or the way in which they are recorded."""
    return digest(module) + digest(Path(__file__))


def _record_of(module: Path) -> Path:
    return RECORDS / (str(module.relative_to(ROOT)).replace("/", ".") + ".json")


def digest(file: Path) -> str:
    """Return what changes when a file does."""
    return hashlib.sha256(file.read_bytes()).hexdigest()[:16]


def _kept_source(file: Path) -> str:
    """Keep the text of a module under its digest, so that its lines can be followed."""
    kept = RECORDS / "sources" / digest(file)
    if not kept.exists():
        kept.write_bytes(file.read_bytes())
    return kept.name


def pytest_configure(config: pytest.Config) -> None:
    """Record, where pytest was started with this plugin."""
    config.pluginmanager.register(_Recorder(), "covering")
