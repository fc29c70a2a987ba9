"""The check list of a release, from top to bottom: `python -m tools.release`, or `make release`.

Each step says how long it took; the first that fails ends it, and `--from STEP` goes on there. Nothing is tagged or
published: what is left for people stands at the end.
"""

import argparse
import hashlib
import re
import shutil
import subprocess
import sys
import time
import tomllib
import venv
from collections.abc import Callable, Mapping
from pathlib import Path
from tempfile import TemporaryDirectory

ROOT = Path(__file__).parents[1]
DIST = ROOT / "dist"
PACKAGES = ("ldcnd", "ldcnd-tuning", "ldcnd-bridges")
LEFT = """What is left, by hand:
  git tag v{version}      and hand out what is in dist, the file SHA256SUMS with it
  CHANGELOG.md            begin the next version as `(not yet released)`; `make fix` then keeps a contract of its own
"""


class NotReady(Exception):
    """A step of the list has failed."""


def main() -> None:
    """Work through the list."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--from", dest="first", choices=STEPS, default=next(iter(STEPS)), help="begin with this step")
    parser.add_argument("--only", choices=STEPS, help="take this step alone")
    given = parser.parse_args()
    names = list(STEPS)
    began_s = time.monotonic()
    for name in [given.only] if given.only else names[names.index(given.first) :]:
        step_s = time.monotonic()
        try:
            STEPS[name]()
        except NotReady as error:
            sys.exit(f"{name}: {error}")
        say(f"{time.monotonic() - step_s:8.1f} s  {name}")
    say(f"{time.monotonic() - began_s:8.1f} s  together\n\n{LEFT.format(version=version_of(ROOT))}")


def say(text: str) -> None:
    """Write a line at once, among those of the steps."""
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


def version_of(root: Path) -> str:
    """Return the version that the project has in a tree."""
    project = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    return str(project["version"])


def named(root: Path = ROOT) -> None:
    """The changelog begins with this version and its date, its contract and files are kept, and it has no tag yet."""
    version = version_of(root)
    heading = re.search(r"(?m)^## (.+)$", (root / "CHANGELOG.md").read_text(encoding="utf-8"))
    if not heading or not re.fullmatch(rf"{re.escape(version)} \(\d{{4}}-\d\d-\d\d\)", heading[1]):
        raise NotReady(f"CHANGELOG.md has to begin with `## {version} (YEAR-MONTH-DAY)`")
    kept = root / "tests" / "kept" / version
    if not (kept / "contract.txt").exists():
        raise NotReady(f"{kept} has no contract: `make fix` writes it while the version is not yet released")
    if not (kept / "run.mcap").exists():
        raise NotReady(f"{kept} has no files for later versions to read: `python -m tests.kept_files` writes them")
    if _told("git", "tag", "--list", f"v{version}", root=root):
        raise NotReady(f"v{version} is tagged already")


def committed(root: Path = ROOT) -> None:
    """What is checked is what is tagged."""
    if changed := _told("git", "status", "--porcelain", root=root):
        raise NotReady(f"commit or drop these first:\n{changed}")


def complete(dist: Path = DIST, root: Path = ROOT) -> None:
    """Everything that is handed out is there, and is what the checksums say."""
    version = version_of(root)
    expected = [f"ldcnd-{version}-py3-none-any.whl", f"ldcnd-{version}.tar.gz"]
    expected += [f"{name}_{version}_*{suffix}" for name in PACKAGES for suffix in (".deb", ".cdx.json")]
    if missing := [name for name in expected if len(list(dist.glob(name))) != 1]:
        raise NotReady(f"{dist} has not one each of {', '.join(missing)}")
    lines = (dist / "SHA256SUMS").read_text(encoding="ascii").splitlines()
    sums = {name: digest for digest, name in (line.split(maxsplit=1) for line in lines)}
    files = {each.name: hashlib.sha256(each.read_bytes()).hexdigest() for each in dist.iterdir()}
    del files["SHA256SUMS"]
    if wrong := {name for name in sums.keys() | files.keys() if sums.get(name) != files.get(name)}:
        raise NotReady(f"SHA256SUMS does not say what {', '.join(sorted(wrong))} is")


def installed(dist: Path = DIST, root: Path = ROOT) -> None:
    """The wheel can be installed by itself, and runs."""
    [wheel] = dist.glob("*.whl")
    with TemporaryDirectory() as folder:
        venv.create(folder, with_pip=True)
        _run(f"{folder}/bin/pip", "install", "--quiet", "-c", str(root / "constraints.txt"), str(wheel))
        said = _told(f"{folder}/bin/ldcnd", "--version", root=root)
        if version_of(root) not in said:
            raise NotReady(f"the wheel says {said!r}")


def linted(dist: Path = DIST) -> None:
    """Debian's checker finds nothing in the packages but what deploy/lintian-overrides argues."""
    if not shutil.which("lintian"):
        raise NotReady("apt-get install lintian")
    _run("lintian", "--allow-root", "--fail-on", "error,warning", *map(str, sorted(dist.glob("*.deb"))))


def make(target: str, *variables: str) -> Callable[[], None]:
    """Return the step that is a target of the Makefile."""
    return lambda: _run("make", "--no-print-directory", target, *variables)


STEPS: Mapping[str, Callable[[], None]] = {
    "committed": committed,
    "named": named,
    "test": make("test"),
    "test-system": make("test-system"),
    "test-edges": make("test-edges"),
    "test-pythons": make("test-pythons"),
    "soak": make("soak", "SHARE=0.01"),
    "newcomer": make("newcomer"),
    "dist-check": make("dist-check"),
    "complete": complete,
    "installed": installed,
    "linted": linted,
    "still committed": committed,
}
"""By name, in their order."""


def _run(*command: str) -> None:
    if code := subprocess.run(command, cwd=ROOT, check=False).returncode:  # noqa: S603 - our own commands
        raise NotReady(f"`{' '.join(command)}` ended with {code}")


def _told(*command: str, root: Path) -> str:
    done = subprocess.run(command, cwd=root, check=False, capture_output=True, text=True)  # noqa: S603 - our own commands
    if done.returncode:
        raise NotReady(f"`{' '.join(command)}` ended with {done.returncode}: {done.stderr.strip()}")
    return done.stdout.strip()


if __name__ == "__main__":
    main()
