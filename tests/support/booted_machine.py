"""A machine with a real systemd: the files of this one or of another root under an overlay, booted within a second.

The container must not filter system calls itself: with a filter, mlock and bpf are refused, and then systemd silently
leaves out DeviceAllow= and IPAddressDeny=, and a test of them would prove nothing.
"""

import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

SYSTEMD = "/usr/lib/systemd/systemd"
BOOT_TIME_S = 20.0
LOOK_PERIOD_S = 0.05
Done = subprocess.CompletedProcess[str]


def why_no_machine() -> str | None:
    """Return why no machine can be booted here; None if one can be."""
    if os.geteuid() != 0:
        return "booting a container takes root"
    for tool in ("systemd-nspawn", "nsenter", "mount", "umount", "ip"):
        if not shutil.which(tool):
            return f"no {tool}: apt-get install systemd-container iproute2"
    return None if Path(SYSTEMD).exists() else "no systemd"


class Machine:
    """A booted machine."""

    def __init__(self, root: Path, leader: int) -> None:
        self.root = root
        self._leader = leader

    def run(self, *command: str, timeout_s: float = 30.0) -> Done:
        """Run a command in it, whatever its outcome."""
        environment = {"PATH": "/usr/sbin:/usr/bin:/sbin:/bin", "LANG": "C.UTF-8", "SYSTEMD_PAGER": ""}
        return subprocess.run(  # noqa: S603 - commands of the tests
            ["nsenter", "-t", str(self._leader), "-m", "-u", "-i", "-n", "-p", "-C", "--", *command],  # noqa: S607
            env=environment,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=timeout_s,
            check=False,
        )

    def must(self, *command: str, timeout_s: float = 30.0) -> str:
        """Run a command that must succeed; return its output."""
        done = self.run(*command, timeout_s=timeout_s)
        assert done.returncode == 0, f"{' '.join(command)}: {done.returncode}\n{done.stdout}{done.stderr}"
        return done.stdout

    def state(self) -> str:
        """Return `active` once it takes services."""
        return self.run("systemctl", "is-active", "basic.target").stdout.strip()

    def show(self, unit: str, name: str) -> str:
        """Return a property of a unit."""
        return self.must("systemctl", "show", unit, "-P", name).strip()

    def until_shown(self, unit: str, name: str, wanted: Callable[[str], bool], within_s: float = 20.0) -> str:
        """Wait for a property of a unit."""
        return eventually(lambda: self.show(unit, name), wanted, within_s)

    def write(self, path: str, text: str) -> None:
        """Write a file of the machine."""
        place = self.root / path.lstrip("/")
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_text(text, encoding="utf-8")

    def read(self, path: str) -> str:
        """Read a file of the machine."""
        return (self.root / path.lstrip("/")).read_text(encoding="utf-8")


def eventually(look: Callable[[], str], wanted: Callable[[str], bool], within_s: float) -> str:
    """Look again and again at what only tells when asked."""
    until_s = time.monotonic() + within_s
    while not wanted(seen := look()):
        assert time.monotonic() < until_s, f"still {seen!r} after {within_s} s"
        time.sleep(LOOK_PERIOD_S)
    return seen


@contextmanager
def booted_machine(base: Path = Path("/")) -> Iterator[Machine]:
    """Boot a machine; everything done to it is gone when the context ends. Skips the test where that is impossible.

    Args:
        base: the root whose files it has, this machine's own if missing.
    """
    with ExitStack() as stack:
        place = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="ldcnd-machine-")))
        root = _overlay(base, place, stack)
        environment = {
            "PATH": os.environ["PATH"],
            "SYSTEMD_SECCOMP": "0",
            "SYSTEMD_NSPAWN_UNIFIED_HIERARCHY": "1",
        }
        with (place / "console").open("w+", encoding="utf-8") as console:
            container = subprocess.Popen(  # noqa: S603
                [
                    *("systemd-nspawn", "--quiet", "--directory", str(root), "--machine", f"ldcnd-test-{os.getpid()}"),
                    *("--register=no", "--keep-unit", "--private-network", "--capability=all", "--console=pipe"),
                    *(SYSTEMD, "--system", "--unit=basic.target"),
                ],
                env=environment,
                stdin=subprocess.DEVNULL,
                stdout=console,
                stderr=subprocess.STDOUT,
            )
            stack.callback(_end, container)
            machine = Machine(root, _leader(container, console.name))
            stack.callback(machine.run, "systemctl", "poweroff", "-ff")
            eventually(machine.state, lambda state: state == "active", BOOT_TIME_S)
            yield machine


def _overlay(base: Path, place: Path, stack: ExitStack) -> Path:
    """Return a root under an overlay that lives in memory, with no service of its own enabled."""

    def mount(*arguments: str) -> None:
        done = subprocess.run(["mount", *arguments], capture_output=True, text=True, check=False)  # noqa: S603, S607
        if done.returncode:
            pytest.skip(f"mount {' '.join(arguments)}: {done.stderr.strip()}")
        stack.callback(
            subprocess.run, ["umount", "--recursive", "--lazy", arguments[-1]], check=False, capture_output=True
        )

    above = place / "above"
    above.mkdir()
    mount("-t", "tmpfs", "ldcnd-test", str(above))
    for name in ("changed", "work", "root"):
        (above / name).mkdir()
    root = above / "root"
    mount(
        "-t",
        "overlay",
        "-o",
        f"lowerdir={base},upperdir={above / 'changed'},workdir={above / 'work'}",
        "overlay",
        str(root),
    )
    mount("-t", "tmpfs", "ldcnd-test", str(root / "etc/systemd/system"))
    # a package with manuals would have this machine's man-db, if it has one, look through all manuals that it knows
    (root / "var/lib/man-db/auto-update").unlink(missing_ok=True)
    return root


def _leader(container: "subprocess.Popen[bytes]", console: str) -> int:
    """Return the process id of the machine's systemd, as it is seen from here."""

    def look() -> str:
        if container.poll() is not None:
            pytest.skip(f"systemd-nspawn cannot boot here: {Path(console).read_text(encoding='utf-8')[-500:]}")
        children = Path(f"/proc/{container.pid}/task/{container.pid}/children").read_text(encoding="ascii").split()
        systemds = [pid for pid in children if Path(f"/proc/{pid}/comm").read_text(encoding="ascii") == "systemd\n"]
        return systemds[0] if systemds else ""

    return int(eventually(look, bool, BOOT_TIME_S))


def _end(container: "subprocess.Popen[bytes]") -> None:
    try:
        container.wait(10)
    except subprocess.TimeoutExpired:
        container.kill()
        container.wait(10)
