"""`python -m tests.mutants`: map tests to lines, change code in so many seeded ways, print what no test notices."""

import argparse
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from collections import Counter
from collections.abc import Sequence
from enum import StrEnum
from pathlib import Path

from tests.mutants.changes import Mutant, mutants_of
from tests.mutants.covering import MAP, CoveringTests

ROOT = Path(__file__).parents[2]
SUBJECTS = (
    "ldcnd/daemon/command/*.py", "ldcnd/daemon/axis/*.py", "ldcnd/daemon/axis/procedures/*.py", "ldcnd/bus/*.py",
    "ldcnd/drivers/ldcn/*.py", "ldcnd/drivers/smartstep/*.py", "ldcnd/messaging/hand_over.py",
    "ldcnd/messaging/reads.py",
)  # fmt: skip
"""Admission, authority, ledger, guards, planner, tracker, policies, procedures, bus, status decoding, parameters."""
TESTS = ("tests/unit", "tests/property", "tests/integration")
EQUIVALENTS = Path(__file__).with_name("equivalents.toml")


class Verdict(StrEnum):
    """What became of a mutant."""

    KILLED = "killed"
    SURVIVED = "survived"
    EQUIVALENT = "equivalent"
    UNCOVERED = "no test runs the line"


def main() -> int:
    """Run a campaign; the exit status is 1 when a mutant has survived."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=300, help="how many mutants")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--minutes", type=float, default=240.0, help="no mutant is begun after this time")
    parser.add_argument("--seconds", type=float, default=60.0, help="of tests for one mutant, quickest first")
    parser.add_argument("--map", type=Path, default=ROOT / "build" / "mutants.json", help="made anew if it is missing")
    parser.add_argument("--tests", nargs="+", default=TESTS, help="what the map is made of")
    parser.add_argument("--subjects", nargs="+", default=SUBJECTS, help="what is changed")
    options = parser.parse_args()

    if not options.map.exists():
        make_map(options.map, options.tests)
    covering = CoveringTests.read(options.map)
    equivalents = tomllib.loads(EQUIVALENTS.read_text(encoding="utf-8"))["equivalent"]
    paths = sorted({str(path.relative_to(ROOT)) for glob in options.subjects for path in ROOT.glob(glob)})
    candidates = [mutant for path in paths for mutant in mutants_of(path, ROOT)]
    chosen = random.Random(options.seed).sample(candidates, min(options.count, len(candidates)))
    print(f"seed {options.seed}: {len(chosen)} of {len(candidates)} mutants of {len(paths)} modules", flush=True)
    ends_s = time.monotonic() + 60 * options.minutes
    found: Counter[Verdict] = Counter()
    with tempfile.TemporaryDirectory(prefix="mutants") as name:
        copy = copied(Path(name))
        for mutant in chosen:
            if time.monotonic() > ends_s:
                print(f"{options.minutes:g} minutes are over")
                break
            verdict = judged(mutant, copy, covering, equivalents, options.seconds)
            found[verdict] += 1
            print(f"{verdict}: {mutant.path}:{mutant.line}: {mutant.change}: {mutant.before}", flush=True)
    counted = found[Verdict.KILLED] + found[Verdict.SURVIVED] + found[Verdict.UNCOVERED]
    shares = ", ".join(f"{verdict} {found[verdict]}" for verdict in Verdict)
    print(f"{shares}; killed {found[Verdict.KILLED] / max(1, counted):.0%} of those that are not equivalent")
    return 1 if counted > found[Verdict.KILLED] else 0


def make_map(file: Path, tests: Sequence[str]) -> None:
    """Run the tests once, on the jumping clock, and note which lines each runs."""
    file.parent.mkdir(parents=True, exist_ok=True)
    command = ("-q", "-p", "tests.mutants.covering", "-m", "not soak and not real_time", "--timeout", "600", *tests)
    subprocess.run(  # noqa: S603
        (sys.executable, "-m", "pytest", *command), cwd=ROOT, env=os.environ | {MAP: str(file)}, check=False
    )


def copied(folder: Path) -> Path:
    """Return a copy of the project in which code may be changed."""
    copy = folder / "project"
    shutil.copytree(
        ROOT, copy, ignore=shutil.ignore_patterns(".git", ".venv", "build", "dist", "__pycache__", ".*_cache")
    )
    return copy


def judged(
    mutant: Mutant, copy: Path, covering: CoveringTests, equivalents: list[dict[str, str]], seconds: float
) -> Verdict:
    """Return what the tests that run the changed line say."""
    for known in equivalents:
        if (known["path"], known["change"], known["before"]) == (mutant.path, mutant.change, mutant.before):
            return Verdict.EQUIVALENT
    tests = covering.of(mutant.path, mutant.line, seconds)
    if not tests:
        return Verdict.UNCOVERED
    file = copy / mutant.path
    before = file.read_text(encoding="utf-8")
    file.write_text(mutant.source, encoding="utf-8")
    try:
        run = subprocess.run(  # noqa: S603
            (sys.executable, "-m", "pytest", "-q", "-x", "--timeout", "60", *tests),
            cwd=copy, env=os.environ | {"PYTHONPATH": str(copy), "PYTHONDONTWRITEBYTECODE": "1"},
            capture_output=True, timeout=10 * seconds + 120, check=False,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return Verdict.KILLED
    finally:
        file.write_text(before, encoding="utf-8")
    return Verdict.SURVIVED if run.returncode == 0 else Verdict.KILLED


if __name__ == "__main__":
    sys.exit(main())
