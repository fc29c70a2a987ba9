"""The Debian package of this checkout, built once for a whole test run."""

import fcntl
import os
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PARTS = ("ldcnd", "schemas", "tools", "deploy", "config", "docs", "examples", "pyproject.toml", "constraints.txt")
PAGES = ("README.md", "LICENSE", "CHANGELOG.md")
BUILD_TIME_S = 180.0
"""For a build by itself; the first one on a machine fetches packages."""


def why_no_package() -> str | None:
    """Return why the package cannot be built on this machine; None if it can be."""
    for tool in ("dpkg-deb", "systemctl"):
        if not shutil.which(tool):
            return f"no {tool}"
    if not _uv():
        return "no uv"
    if not Path("/usr/bin/python3").exists():
        return "no Python of the distribution in /usr/bin/python3"
    return None


def package(factory: pytest.TempPathFactory) -> Path:
    """Return the main package; the others are beside it. The first caller of a run builds them, in any worker."""
    place = factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        place = place.parent
    with (place / "package.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        built = sorted(place.glob("package/ldcnd_*.deb"))
        return built[0] if built else build(snapshot(place), place / "package")


def snapshot(place: Path) -> Path:
    """Return a copy of what the package is made of, which nobody changes meanwhile."""
    copy = place / "source"
    if not copy.exists():
        for part in (*PARTS, *PAGES):
            if (ROOT / part).is_dir():
                shutil.copytree(ROOT / part, copy / part, ignore=shutil.ignore_patterns("__pycache__"))
            else:
                copy.mkdir(exist_ok=True)
                shutil.copy(ROOT / part, copy / part)
    return copy


def build(source: Path, out: Path) -> Path:
    """Build the packages of a source tree, the main one first; skips the test when their parts cannot be fetched."""
    environment = os.environ | {"UV": _uv(), "COMPRESSION": "none"}
    done = subprocess.run(  # noqa: S603 - our own script
        [str(source / "deploy" / "build_deb.sh"), str(out)],
        env=environment,
        capture_output=True,
        text=True,
        timeout=BUILD_TIME_S,
        check=False,
    )
    if done.returncode and any(word in done.stderr for word in ("Failed to fetch", "error sending request", "dns")):
        pytest.skip(f"the package's parts cannot be fetched: {done.stderr.splitlines()[-1]}")
    assert done.returncode == 0, done.stderr
    return Path(done.stdout.split()[0])


def _uv() -> str:
    return shutil.which("uv", path=f"{ROOT}/.venv/bin:{os.environ.get('PATH', '')}") or ""
