"""A newcomer on a bare Debian follows the README, every tutorial and INSTALL.md; prints the times.

Run as root: `python -m tests.newcomer` (or `make newcomer`). For each Debian it makes a root with nothing but what the
README asks for, copies the committed files of this checkout into it, and works there from the checkout and the wheel;
then a root with nothing but systemd and Python, builds the package for it, boots it, and does what INSTALL.md says,
without a network. It needs mmdebstrap, systemd-container and a network; what a network asks for (a certificate, pip's
configuration) is copied with `--copy PATH`.
"""

import argparse
import asyncio
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

ROOT = Path(__file__).parents[1]
SUITES = {"12": "bookworm", "13": "trixie"}
PACKAGES = "git,make,python3-venv,ca-certificates"
SERVED = "python3,systemd,udev,kmod,iproute2,ca-certificates"
"""What a server has anyway."""
INSTALL = ROOT / "deploy" / "INSTALL.md"
SECTIONS = re.compile(r"(?ms)^## ([^\n]+)\n(.*?)(?=^## |\Z)")
COMMANDS = re.compile(r"(?ms)^```sh\n(.*?)^```$")
RUNNING = "Console, recording, metrics"
"""Once this section is done, everything runs as a service."""
CHECKOUT = "ldcnd"
UP = "Ctrl-C here ends it"
README = ("list", "power on x", "move x 10 --wait", "watch x --count 5", "power on z")
README += ("home z --wait", "stop", "reset x")
TUTORIALS = ("first-rig", "move-from-python", "take-a-trace", "record-and-export")


def main() -> None:
    """Work through everything; ends with the exit code of what failed first."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--copy", action="append", default=[], type=Path, help="also copy this path into the root")
    parser.add_argument("--debian", action="append", choices=SUITES, help="only this release [12 and 13]")
    parser.add_argument("--part", action="append", choices=PARTS, help="only this part [all]")
    parser.add_argument("--inside", choices=("tutorials",), help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.inside:
        asyncio.run(_follow_tutorials())
        return
    for release in given.debian or SUITES:
        for part in given.part or PARTS:
            packages, work = PARTS[part]
            with tempfile.TemporaryDirectory(prefix="newcomer-", ignore_cleanup_errors=True) as folder:
                root = Path(folder, "root")
                _timed(
                    f"a bare Debian {release} (no work of the newcomer's)",
                    lambda root=root, release=release, packages=packages: _debian(root, release, packages, given.copy),
                )
                work(root)


@contextmanager
def _with_checkout(root: Path) -> Iterator[None]:
    """Have the committed files of this checkout in a root, and the kernel's."""
    home = root / "root" / CHECKOUT
    home.mkdir(parents=True)
    archive = subprocess.run(["git", "archive", "HEAD"], cwd=ROOT, check=True, capture_output=True).stdout  # noqa: S607
    subprocess.run(["tar", "x"], cwd=home, input=archive, check=True)  # noqa: S607
    for place in ("proc", "dev"):
        subprocess.run(["mount", "--rbind", f"/{place}", root / place], check=True)  # noqa: S603, S607
    try:
        yield
    finally:
        for place in ("proc", "dev"):
            subprocess.run(["umount", "-l", root / place], check=False)  # noqa: S603, S607


def _debian(root: Path, release: str, packages: str, copied: list[Path]) -> None:
    command = ["mmdebstrap", "--quiet", "--variant=minbase", f"--include={packages}", SUITES[release], str(root)]
    subprocess.run(command, check=True)  # noqa: S603
    shutil.copy("/etc/resolv.conf", root / "etc" / "resolv.conf")
    shutil.copy("/etc/hosts", root / "etc" / "hosts")
    for path in copied:
        place = root / path.relative_to("/")
        place.parent.mkdir(parents=True, exist_ok=True)
        if path.is_dir():
            shutil.copytree(path, place, dirs_exist_ok=True)
        else:
            shutil.copy(path, place)


def _install_package(root: Path) -> None:
    """Build the package for a root, boot it, and do what INSTALL.md says, in its order."""
    from tests.support.booted_machine import booted_machine  # noqa: PLC0415 - not where the tutorials are followed

    uv = shutil.which("uv", path=f"{ROOT}/.venv/bin:{os.environ['PATH']}")
    if not uv:
        sys.exit("no uv")
    with _with_checkout(root):
        shutil.copy(uv, root / "root" / "uv")
        build = "UV=/root/uv COMPRESSION=none deploy/build_deb.sh /root/built"
        _timed("build the packages (no work of the newcomer's)", lambda: _run(root, build))
    for package in (root / "root" / "built").glob("*.deb"):
        package.rename(root / "root" / package.name)
    for place in (root / "root" / CHECKOUT, root / "root" / ".cache", root / "root" / "built"):
        shutil.rmtree(place, ignore_errors=True)
    with booted_machine(root) as machine:
        machine.must("ip", "link", "set", "lo", "up")
        began_s = time.monotonic()
        for section, text in SECTIONS.findall(INSTALL.read_text(encoding="utf-8")):
            step_s = time.monotonic()
            for command in COMMANDS.findall(text):
                machine.must("sh", "-euxc", f"cd /root\n{command}", timeout_s=120)
            print(f"{time.monotonic() - step_s:7.1f} s  {INSTALL.name}: {section}", flush=True)
            if section == RUNNING:
                print(f"{time.monotonic() - began_s:7.1f} s  until rig, console, recording and metrics run", flush=True)


def _work(root: Path) -> None:
    """Follow README and tutorials, from the checkout and from the wheel."""
    with _with_checkout(root):
        _follow_readme(root)


PARTS: Mapping[str, tuple[str, Callable[[Path], None]]] = {
    "source": (PACKAGES, _work),
    "package": (SERVED, _install_package),
}


def _follow_readme(root: Path) -> None:
    began_s = time.monotonic()
    running = _start(root, "make run")
    try:
        assert running.stdout
        while line := running.stdout.readline():
            print(f"  | {line}", end="")
            if UP in line:
                break
        else:
            sys.exit("make run has ended")
        print(f"{time.monotonic() - began_s:7.1f} s  make run, until it says what to type next")
        size = _run(root, "du -sm .venv | cut -f1").strip()
        print(f"{size:>7} MB of .venv")
        for words in README:
            _timed(f"ldcnd {words}", lambda words=words: _run(root, f".venv/bin/ldcnd {words}"))
        _timed("the first program of the README", lambda: _run(root, FIRST))
        _timed("examples/move_and_watch.py", lambda: _run(root, ".venv/bin/python examples/move_and_watch.py"))
    finally:
        os.killpg(running.pid, signal.SIGINT)
        running.wait(30)
    for name, what in (("checkout", "."), ("wheel", "$(echo dist/*.whl)")):
        if name == "wheel":
            _timed(
                "build a wheel", lambda: _run(root, "build-env/bin/python -m hatchling build -t wheel -d dist", BUILD)
            )
        made = f'python3 -m venv /root/{name} && /root/{name}/bin/pip install -q -c constraints.txt "{what}[lab,plot]"'
        _timed(f"install from the {name}", lambda made=made: _run(root, made))
        inside = f"PATH=/root/{name}/bin:$PATH /root/{name}/bin/python -m tests.newcomer --inside tutorials"
        _timed(f"all tutorials, from the {name}", lambda inside=inside: print(_run(root, inside), end=""))


FIRST = r"sed -n '/^# first.py/,/^```/p' README.md | grep -v '^```' > first.py && .venv/bin/python first.py"
BUILD = "python3 -m venv build-env && build-env/bin/pip install -q -c constraints.txt hatchling"


def _timed(what: str, work: Callable[[], object]) -> None:
    began_s = time.monotonic()
    work()
    print(f"{time.monotonic() - began_s:7.1f} s  {what}", flush=True)


def _run(root: Path, script: str, before: str = "true") -> str:
    done = _start(root, f"{before} && {script}")
    printed, _ = done.communicate()
    if done.returncode:
        sys.exit(f"{script}: exit code {done.returncode}\n{printed}")
    return printed


def _start(root: Path, script: str) -> "subprocess.Popen[str]":
    kept = {name: text for name, text in os.environ.items() if name.startswith(("PIP_", "UV_", "SSL_", "http", "HTTP"))}
    environment = {"PATH": "/usr/bin:/usr/sbin:/bin", "HOME": "/root", "LANG": "C.UTF-8", **kept}
    return subprocess.Popen(  # noqa: S603 - our own commands
        ["chroot", str(root), "/bin/bash", "-c", f"cd /root/{CHECKOUT} && {script}"],  # noqa: S607
        env=environment,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )


async def _follow_tutorials() -> None:
    """Do what the tutorials say, but for the installation, which has been done."""
    from tests.support.page_reader import PageReader  # noqa: PLC0415 - only where ldcnd is installed

    with tempfile.TemporaryDirectory() as folder:
        left_out = {("docs/tutorials/first-rig.md", "python3 -m venv ldcnd-env")}
        pages = [ROOT / "docs" / "tutorials" / f"{name}.md" for name in TUTORIALS]
        async with PageReader(Path(folder)) as reader:
            began_s = time.monotonic()
            await reader.follow(pages[0], left_out)
            print(f"{time.monotonic() - began_s:9.1f} s    {TUTORIALS[0]}", flush=True)
        async with PageReader(Path(folder)) as reader:
            await reader.start_daemon("rig.toml")
            for page in pages[1:]:
                began_s = time.monotonic()
                await reader.follow(page, left_out)
                print(f"{time.monotonic() - began_s:9.1f} s    {page.stem}", flush=True)


if __name__ == "__main__":
    main()
