"""A fix that can be taken back, and the copy of the checkout in which it is."""

import contextlib
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]


@dataclass(frozen=True, slots=True)
class Edit:
    """A change of one file.

    Attributes:
        path: of the file, below the root.
        fixed: what stands there, exactly once.
        broken: what stood there, or what has the same effect.
    """

    path: str
    fixed: str
    broken: str


@dataclass(frozen=True, slots=True)
class Revert:
    """One fix that is taken back.

    Attributes:
        edits: what takes it back, applied in this order.
        noticed_by: tests every one of which fails without the fix.
        finding: its number on the page that lists what was found, or what it was; empty where no page does.
    """

    edits: tuple[Edit, ...]
    noticed_by: tuple[str, ...]
    finding: str = ""

    @property
    def name(self) -> str:
        """A name for reports: what was found, and who notices it first."""
        return f"{self.finding}-{self.noticed_by[0].rpartition('::')[2]}".removeprefix("-")


def revert(path: str, fixed: str, broken: str, noticed_by: tuple[str, ...]) -> Revert:
    """Return a fix that stands in one place."""
    return Revert((Edit(path, fixed, broken),), noticed_by)


def copy_of_checkout(place: Path) -> Path:
    """Return a copy of the files that git tracks and of those that are not committed yet."""
    files = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],  # noqa: S607
        cwd=ROOT,
        capture_output=True,
        check=True,
    ).stdout
    copy = place / "checkout"
    copy.mkdir()
    subprocess.run(["cpio", "--quiet", "-0pdm", str(copy)], cwd=ROOT, input=files, check=True)  # noqa: S603, S607
    return copy


@contextlib.contextmanager
def taken_back(copy: Path, *reverts: Revert) -> Iterator[None]:
    """Have a copy of the checkout without these fixes."""
    edits = [edit for each in reverts for edit in each.edits]
    texts = {edit.path: (copy / edit.path).read_text(encoding="utf-8") for edit in edits}
    try:
        for edit in edits:
            path = copy / edit.path
            path.write_text(path.read_text(encoding="utf-8").replace(edit.fixed, edit.broken), encoding="utf-8")
        yield
    finally:
        for name, text in texts.items():
            (copy / name).write_text(text, encoding="utf-8")


def outcomes(copy: Path, *arguments: str, timeout_s: float = 1800.0) -> dict[str, str]:
    """Run tests of a copy; return how each ended: passed, failed, error."""
    environment = os.environ | {
        "PYTHONPATH": str(copy),
        "PYTHONDONTWRITEBYTECODE": "1",  # a file that changes twice within a second would run as it was
        "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
    }
    command = (sys.executable, "-m", "pytest", "-q", "--no-header", "--tb=no", "--show-capture=no", "-rA", *arguments)
    run = subprocess.run(  # noqa: S603
        command, cwd=copy, env=environment, capture_output=True, text=True, timeout=timeout_s, check=False
    )
    found = re.findall(r"^(PASSED|FAILED|ERROR) (.+?)(?: - .*)?$", run.stdout, re.MULTILINE)
    assert found, f"no test ran: {run.stdout[-2000:]} {run.stderr[-2000:]}"
    return {test: outcome.lower() for outcome, test in found}


def failed(of: dict[str, str], test: str) -> bool:
    """Return whether a test failed, with any of its parameters if none is named."""
    return any(outcome == "failed" and (each == test or each.startswith(f"{test}[")) for each, outcome in of.items())
