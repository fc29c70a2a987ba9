"""One guest for all tests of this folder, and the report at the end."""

import time
from collections.abc import Callable, Generator, Iterator
from contextlib import ExitStack, suppress
from pathlib import Path

import pytest

from ldcnd.drives.smartstep.profiles import Framing
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain
from ldcnd.sim.smartstep.cable import smartstep_chain
from ldcnd.sim.smartstep.simulation import SimulatedUnitConfig, simulated_units
from tests.guest.machine import Adapter, Bench, booted_guest, far_end, why_no_guest
from tests.guest.rigs import COST_PORTS, FAST, STEPS, USB
from tests.support.package import package, why_no_package
from tests.support.plugged_rig import ENDLESS

FOUND: list[str] = []
"""What the tests have measured, for the report."""
JOURNAL_LINES = 60


@pytest.fixture(scope="session")
def found() -> Callable[[str], None]:
    """Take a line for the report."""
    return FOUND.append


@pytest.fixture(scope="session")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    """Boot the guest with all adapters plugged in and the package installed; nothing runs yet."""
    if reason := why_no_guest() or why_no_package():
        pytest.skip(reason)
    began_s = time.monotonic()
    deb = package(tmp_path_factory)
    FOUND.append(f"package built in {time.monotonic() - began_s:.0f} s")
    usb, uart, fast = (
        build_chain(ChainSpec(tuple(ModuleSpec(model, ENDLESS) for model in models), baud_check=True))
        for models in (("ls182ap", "ls182ap", "picservo-v4"), ("ls182ap", "picservo-v4"), ("picservo-sc",))
    )
    units = simulated_units([SimulatedUnitConfig(number=1), SimulatedUnitConfig(number=2)], 0.0)
    steps = smartstep_chain(units, framing=Framing.SEVEN_EVEN)
    with ExitStack() as stack:
        ends = [stack.enter_context(far_end(chain)) for chain in (usb, fast, uart)]
        steps_end = stack.enter_context(far_end(steps, baud_check=False))
        adapters = (Adapter(USB, ends[0]), Adapter(FAST, ends[1]), Adapter(STEPS, steps_end))
        began_s = time.monotonic()
        guest = stack.enter_context(booted_guest(deb, adapters, ends[2].path, (7447, 7448, *COST_PORTS)))
        FOUND.append(
            f"image made ready and guest booted in {time.monotonic() - began_s:.0f} s, boot {guest.boot_s:.0f} s"
        )
        FOUND.append(f"kernel {guest.must('uname -r')}, systemd {guest.must('systemctl --version').split()[1]}")
        guest.must(f"head -c {deb.stat().st_size} /dev/vdb > /tmp/ldcnd.deb && dpkg -i /tmp/ldcnd.deb", timeout_s=240)
        yield Bench(guest, usb, uart)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Show what the services have said before a test failed."""
    report = yield
    bench = getattr(item, "funcargs", {}).get("bench")
    if call.when == "call" and report.failed and bench:
        said = "the guest does not answer"
        with suppress(OSError):
            said = bench.guest.run(f"journalctl -q --no-pager -o short-monotonic -n {JOURNAL_LINES}").stdout
        report.sections.append(("journal of the guest", said))
    return report


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Print what was found, and keep it."""
    if not FOUND:
        return
    terminalreporter.section("kernel drivers")
    for line in FOUND:
        terminalreporter.line(line)
    folder = Path(__file__).parents[2] / "build"
    folder.mkdir(exist_ok=True)
    (folder / "drivers-report.txt").write_text("\n".join(FOUND) + "\n", encoding="utf-8")
