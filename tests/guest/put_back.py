"""Puts faults back that a trial on the kernel's drivers once found, and shows that tests notice each of them.

`python -m tests.guest.put_back [--guest] [F1 F2 F3 F4]` changes a copy of this checkout, never the checkout itself, and
runs the tests on terminals, or those in the guest, against it. Ends with 1 if one of them stays green.
"""

import argparse
import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
LONGEST_S = 1800.0


@dataclass(frozen=True)
class PutBack:
    """A fault, and who notices it.

    Attributes:
        what: it did.
        path: the file to change.
        changes: texts that each stand there once, and what they become.
        terminals: tests on terminals and on the jumping clock.
        guest: a part of the names of the tests in the guest.
    """

    what: str
    path: str
    changes: tuple[tuple[str, str], ...]
    terminals: tuple[str, ...]
    guest: str


FAULTS = {
    "F1": PutBack(
        'a stop while the line is down is not sent again under loss.bus = "run_to_target"',
        "ldcnd/daemon/axis/axis.py",
        (
            (
                "        if self._unconfirmed() is None:\n",
                "        if self._unconfirmed() is None or self.config.loss.bus == 'run_to_target':\n",
            ),
        ),
        (
            "tests/drivers/test_terminals.py",
            "tests/drivers/test_adapters.py",
            "tests/drivers/test_unplugged_at_random.py",
        ),
        "stop_while_the_adapter_is_away",
    ),
    "F2": PutBack(
        "slow motion counts as rest, and is not halted after an outage",
        "ldcnd/daemon/axis/state.py",
        (
            ("runs = reading.enabled and not reading.profile_done", "runs = False"),
            ("        if self.commanded and reading.enabled:\n", "        if self._quiet_s:\n"),
        ),
        (
            "tests/drivers/test_terminals.py",
            "tests/drivers/test_adapters.py",
            "tests/drivers/test_unplugged_at_random.py",
        ),
        "halted_when_its_adapter_is_back",
    ),
    "F3": PutBack(
        "the cause of a fault is guessed while it is not known whether the power driver is on",
        "ldcnd/drivers/ldcn/faults.py",
        (
            (
                "        faults = _power_driver_not_known(status, known)\n",
                "        faults = _power_driver_off(status, replace(known, latched=None))\n",
            ),
        ),
        ("tests/drivers/test_adapters.py", "tests/integration/test_fault_causes.py"),
        "killed_daemon",
    ),
    "F4": PutBack(
        "a rate that the UART does not make is accepted",
        "ldcnd/transport/serial_port.py",
        (
            (
                "        if baud and not makes(baud, made := port.tune(baud)):",
                "        if baud and not (made := port.tune(baud)):",
            ),
            ("        if not makes(baud, made):", "        if not made:"),
        ),
        ("tests/drivers/test_port_settings.py",),
        "rates_are_those",
    ),
}


def copy_of_checkout(place: Path) -> Path:
    """Return a copy of what git knows here, with what is not committed yet."""
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


def failures(names: tuple[str, ...], *, guest: bool) -> list[str]:
    """Return the tests that fail once these faults are back."""
    with tempfile.TemporaryDirectory(prefix="ldcnd-put-back-") as place:
        copy = copy_of_checkout(Path(place))
        for name in names:
            put_back(copy, name)
        chosen = ["-m", "guest", "tests/guest", "-k", " or ".join(FAULTS[name].guest for name in names)]
        if not guest:
            chosen = [path for name in names for path in FAULTS[name].terminals]
        done = subprocess.run(  # noqa: S603
            [sys.executable, "-m", "pytest", "-q", "--tb=line", "--show-capture=no", *chosen],
            cwd=copy,
            env=os.environ | {"PYTHONPATH": str(copy), "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"},
            capture_output=True,
            text=True,
            timeout=LONGEST_S,
            check=False,
        )
    assert done.returncode in {0, 1}, done.stdout[-2000:]
    assert " skipped" not in done.stdout.splitlines()[-1], f"nothing can be shown here: {done.stdout[-2000:]}"
    return [*(line for line in done.stdout.splitlines() if line.startswith("FAILED")), done.stdout.splitlines()[-1]]


def put_back(copy: Path, name: str) -> None:
    """Change a copy so that it has a fault again."""
    fault = FAULTS[name]
    changed = copy / fault.path
    text = changed.read_text(encoding="utf-8")
    for before, after in fault.changes:
        assert text.count(before) == 1, f"{name}: {fault.path} has {text.count(before)} times {before!r}"
        text = text.replace(before, after)
    changed.write_text(text, encoding="utf-8")


def main() -> int:
    """Put back what is named: one after another for tests on terminals, all at once in the guest, which boots once."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--guest", action="store_true", help="by the tests in the guest instead of those on terminals")
    parser.add_argument("fault", nargs="*", help="which; all if none is named")
    options = parser.parse_args()
    names = tuple(options.fault or FAULTS)
    silent = []
    for together in [names] if options.guest else [(name,) for name in names]:
        said = failures(together, guest=options.guest)
        for name in together:
            fault = FAULTS[name]
            own = [line for line in said[:-1] if not options.guest or fault.guest in line]
            print(f"{name}: {fault.what}\n  " + "\n  ".join(own or ["nothing noticed it"]), flush=True)
            silent += [] if own else [name]
        print(said[-1], flush=True)
    print(f"not noticed: {', '.join(silent)}" if silent else "each was noticed")
    return 1 if silent else 0


if __name__ == "__main__":
    sys.exit(main())
