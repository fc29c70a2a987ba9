"""What a poll of five items costs on the kernel's own drivers; `tests.bench.bus_efficiency` measures it on terminals.

Far ends are the paced lines of the bench, on the host, as is a subscriber of everything. Each program has a port of its
own and is frozen between its turns: turns are short and close together, so that what else this machine does acts alike
on all. Where QEMU emulates the processor, polls cost many times what they cost on a real one: ratios are reported, and
nothing is asserted of them.
"""

import statistics
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, fields
from pathlib import Path
from subprocess import Popen

import pytest

from tests.bench.bus_efficiency import ITEMS, MINIMAL, MODULES, STATUS_ITEMS
from tests.bench.processes import (
    PIC_SERVO,
    SUBJECT_CPU,
    PacedLines,
    config_text,
    heard,
    paced_lines,
    process,
    settle,
    told,
)
from tests.bench.sources import NoCompiler, build
from tests.guest.machine import Adapter, Card, FarEnd, Guest, accelerated, image
from tests.guest.rigs import COST_PORTS

pytestmark = [pytest.mark.real_time, pytest.mark.guest, pytest.mark.timeout(900)]

ROUNDS = 7
SETTLE_S, TURN_S = 1.0, 2.0
"""Zenoh gives up a peer that is frozen for ten seconds: two turns of others are shorter."""
START_S = 300.0
LEAST_RATE, MOST_COST = 0.9, 1.05
PLACE = "/var/lib/ldcnd-costs"
FIRST_SLOT = 0x10
MASTER = Path(__file__).parents[1] / "bench" / "minimal_master.py"


@dataclass(frozen=True, slots=True)
class Turn:
    """What a program did in one turn; processor time is that of all its threads."""

    cpu_us: float
    exchanges_per_s: float
    share: float
    turnaround_us: float
    samples: float


@dataclass(frozen=True, slots=True)
class Subject:
    """A program in the guest, its line and its subscriber."""

    guest: Guest
    pid: str
    line: PacedLines
    listener: "Popen[str]"

    def turn(self) -> Turn:
        """Let it run for a while and measure it."""
        self.guest.must(f"kill -CONT {self.pid}")
        settle(SETTLE_S)
        cpu_ns = self._cpu_ns()
        self.line.figures()
        received = int(told(self.listener))
        settle(TURN_S)
        cpu_ns = self._cpu_ns() - cpu_ns
        (line,) = self.line.figures()
        received = int(told(self.listener)) - received
        self.guest.must(f"kill -STOP {self.pid}")
        return Turn(
            cpu_us=cpu_ns / 1e3 / line.exchanges,
            exchanges_per_s=line.exchanges / line.elapsed_s,
            share=cpu_ns / 1e9 / line.elapsed_s,
            turnaround_us=line.turnaround_p50_us,
            samples=received / line.exchanges,
        )

    def _cpu_ns(self) -> int:
        threads = self.guest.must(f"cat /proc/{self.pid}/task/*/schedstat").splitlines()
        return sum(int(thread.split()[0]) for thread in threads)


@pytest.mark.parametrize(("baud", "coalesce_ms"), [(115_200, 5), (19_200, 30)])  # the time of four replies
@pytest.mark.parametrize("driver", ["8250", "ftdi_sio"])
def test_costs_of_a_poll(bench, found, tmp_path, driver, baud, coalesce_ms):
    try:
        program = build("paced_lines", tmp_path)
    except NoCompiler as missing:
        pytest.skip(str(missing))
    guest = bench.guest
    guest.must("systemctl stop ldcnd.service 'ldcnd@*.service'", timeout_s=START_S)
    guest.write(f"{PLACE}/minimal_master.py", MASTER.read_text(encoding="utf-8"))
    together, at_once = (f"ldcnd, coalesce_ms = {wait_ms}" for wait_ms in (coalesce_ms, 0))
    waits_ms = {MINIMAL: None, together: coalesce_ms, at_once: 0}
    with ExitStack() as stack:
        subjects = {
            name: stack.enter_context(subject(guest, number, program, driver, baud, wait_ms))
            for number, (name, wait_ms) in enumerate(waits_ms.items())
        }
        rounds = [{name: each.turn() for name, each in subjects.items()} for _ in range(1 + ROUNDS)][1:]

    def ratios(name: str, base: str, figure: Callable[[Turn], float]) -> list[float]:
        return [figure(turns[name]) / figure(turns[base]) for turns in rounds]

    def cpu_us(turn: Turn) -> float:
        return turn.cpu_us

    medians = {
        name: Turn(*(statistics.median(getattr(turns[name], each.name) for turns in rounds) for each in fields(Turn)))
        for name in subjects
    }
    found(f"{MODULES} drives on {driver} at {baud} baud, five items, medians of {ROUNDS} rounds:")
    for name, turn in medians.items():
        found(
            f"  {name}: {turn.cpu_us:.0f} us of the processor for a poll, {turn.share:.2f} of one; "
            f"{turn.exchanges_per_s:.0f} polls a second, turn-around {turn.turnaround_us:.0f} us, "
            f"{turn.samples:.2f} samples of each received"
        )
    for name, base in ((together, MINIMAL), (at_once, MINIMAL), (together, at_once)):
        costs = ratios(name, base, cpu_us)
        found(f"  {name} / {base}: {statistics.median(costs):.3f} ({min(costs):.3f} to {max(costs):.3f})")
    rates = {name: ratios(name, MINIMAL, lambda turn: turn.exchanges_per_s) for name in (together, at_once)}
    for name, shares in rates.items():
        found(f"  {name}: {statistics.median(shares):.3f} of the rate of the {MINIMAL}")
    assert all(turn.samples > 0 for turn in medians.values())
    if "kvm" not in accelerated(image() / "vmlinuz"):
        return  # an emulated processor is itself the limit, and others on this machine are part of its time
    assert min(statistics.median(shares) for shares in rates.values()) >= LEAST_RATE
    assert statistics.median(ratios(together, at_once, cpu_us)) <= MOST_COST


@contextmanager
def subject(
    guest: Guest, number: int, program: Path, driver: str, baud: int, coalesce_ms: int | None
) -> Iterator[Subject]:
    """Run a program on a port of its own, frozen: a daemon, or the minimal master where nothing is coalesced."""
    unit, listens = f"cost-{number}", COST_PORTS[number]
    endpoint, ready_baud = f"tcp/10.0.2.15:{listens}", baud if coalesce_ms is None else 0
    on_usb = driver == "ftdi_sio"  # where replies arrive in one piece
    with ExitStack() as stack:
        line = stack.enter_context(
            paced_lines(program, modules=MODULES, ready_baud=ready_baud, burst=on_usb, drive=PIC_SERVO)
        )
        end = FarEnd(Path(line.terminals[0]))
        port = Adapter(f"FT4COST{number}", end) if on_usb else Card(FIRST_SLOT + number, end)
        terminal = stack.enter_context(guest.plugged(port))
        if coalesce_ms is None:
            program_of_guest = f"python {PLACE}/minimal_master.py {terminal} {baud} {MODULES} {STATUS_ITEMS} {endpoint}"
        else:
            line_keys = f"margin_ms = 200\ncoalesce_ms = {coalesce_ms}"
            config = config_text(
                terminal,
                modules=MODULES,
                baud=baud,
                uvloop=False,
                hz=2000.0,
                items=ITEMS,
                drive=PIC_SERVO,
                line_keys=line_keys,
            )
            guest.write(f"{PLACE}/{unit}.toml", config)
            program_of_guest = f"ldcnd run --log-level error --config {PLACE}/{unit}.toml --listen {endpoint}"
        guest.must(
            f"systemd-run --quiet --collect --unit={unit} --uid=ldcnd -p SupplementaryGroups=dialout"
            f" /opt/ldcnd/bin/{program_of_guest}"
        )
        stack.callback(guest.run, f"systemctl kill -s CONT {unit}; systemctl stop {unit}", timeout_s=START_S)
        guest.until("ss -ltn", f":{listens}", START_S)
        hearing = (sys.executable, "-m", "tests.bench.subscriber", f"tcp/127.0.0.1:{guest.ports[listens]}")
        listener = stack.enter_context(process(hearing, cpu=SUBJECT_CPU, nice=0, pipe=True))
        assert heard(listener).strip() == "receiving"
        pid = guest.must(f"systemctl show -P MainPID {unit}")
        guest.must(f"kill -STOP {pid}")
        yield Subject(guest, pid, line, listener)
