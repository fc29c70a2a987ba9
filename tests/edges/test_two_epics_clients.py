"""Two Channel Access clients put into one motor record while others stop the rig and reload it; the shaft decides."""

import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from random import Random
from typing import IO

import pytest

from ldcnd.config.plan import plan_rig
from ldcnd.testing import ServedRig, Truth, served_rig
from ldcnd.testing.rig import SimulatedRig
from tests.support.process import LDCND, ROOT, free_port, piped

pytestmark = [pytest.mark.edges, pytest.mark.real_time, pytest.mark.timeout(600)]

LONGEST_S = 60.0
SETTLES_MM = 0.05
STANDS_MM_PER_S = 0.05
QUIET_S = 0.5
"""Time in which a motion that was not put would have begun."""
STEPS = 40
MOTIONS = {"move_absolute", "home", "jog"}
STARTS = (
    *(("VAL", place) for place in (-8.0, -2.5, 0.0, 4.0, 15.0)),
    *(("TWF", 1), ("TWR", 1), ("RLV", 1.5), ("JOGF", 1), ("JOGR", 1), ("HOMF", 1)),
)
OTHERS = (("JOGF", 0), ("JOGR", 0), ("STOP", 1), ("SPMG", "Stop"), ("SPMG", "Move"), ("SPMG", "Go"), ("TWV", 0.7))
CLIENT = """
import sys
import epics
channels = {}
for line in sys.stdin:
    name, _, value = line.strip().partition(" ")
    channel = channels.setdefault(name, epics.PV(name))
    assert channel.wait_for_connection(60), name
    if not value:
        print(channel.get(use_monitor=False, timeout=60), flush=True)
        continue
    try:
        channel.put(value if value[0].isalpha() else float(value), wait=False)
    except epics.ca.CASeverityException:
        pass
    print("put", flush=True)
"""


class Putting:
    """A client in a process of its own, with a connection of its own."""

    def __init__(self, running: "subprocess.Popen[str]") -> None:
        assert running.stdin
        assert running.stdout
        self._to: IO[str] = running.stdin
        self._from: IO[str] = running.stdout

    def put(self, name: str, value: float | str) -> None:
        """Put without waiting for the end of what that begins."""
        assert self._say(f"{name} {value}") == "put"

    def get(self, name: str) -> float:
        return float(self._say(name))

    def _say(self, line: str) -> str:
        self._to.write(line + "\n")
        self._to.flush()
        return self._from.readline().strip()


@dataclass
class Day:
    """What two clients, a person at the command line and an administrator do with x, in an order that is drawn."""

    rig: ServedRig
    clients: tuple[Putting, Putting]
    dice: Random
    started: int = 0
    """Puts that may begin a motion."""
    compared: int = 0
    stopped: int = 0
    done: list[str] = field(default_factory=list)

    def shaft(self) -> Truth:
        return self.rig.ask(lambda inside: inside.truth("x"))

    def put(self, name: str, value: float | str) -> None:
        self.done.append(f"{name} {value}")
        self.dice.choice(self.clients).put(f"T:x{name}", value)

    def until(self, holds: Callable[[], bool]) -> None:
        until_s = time.monotonic() + LONGEST_S
        while not holds():
            assert time.monotonic() < until_s, self.done[-12:]
            time.sleep(0.02)

    def stop(self) -> None:
        """Stop the rig from a terminal, right behind a put; let clients reset it, and see that nothing went on."""
        self.start()
        self.done.append("ldcnd stop")
        subprocess.run([*LDCND, "stop", "-e", self.rig.endpoint], check=True, capture_output=True, timeout=60)  # noqa: S603
        self.until(lambda: abs(self.shaft().velocity) < STANDS_MM_PER_S)
        stands = self.shaft().position
        self.until(self.cleared)
        time.sleep(QUIET_S)
        assert abs(self.shaft().position - stands) < SETTLES_MM, self.done[-12:]
        self.stopped += 1
        self.equal()

    def cleared(self) -> bool:
        """Reset the latch and enable x, as a screen does; tell whether it is."""
        reader = self.clients[0]
        reader.put("T:x-ErrRst", 1)
        reader.put("T:x.CNEN", 1)
        return self.rig.ask(enabled)

    def start(self) -> None:
        name, value = self.dice.choice(STARTS)
        self.started += 1
        self.put(f".{name}", value)

    def compare(self) -> None:
        """Let what was put end, in one of the ways in which things end, and compare."""
        if self.dice.random() < 0.5:
            self.put(".STOP", 1)
        for jog in (".JOGF", ".JOGR"):
            self.put(jog, 0)
        self.until(lambda: self.rig.ask(idle))
        self.equal()

    def equal(self) -> None:
        """VAL is where x was sent, which is where its shaft stands, and both clients read the same."""
        time.sleep(QUIET_S)
        for client in self.clients:
            self.until(lambda client=client: client.get("T:x.DMOV") == 1)
            target, stands = client.get("T:x.VAL"), self.shaft().position
            assert abs(target - stands) < SETTLES_MM, (target, stands, self.done[-12:])
        self.compared += 1

    def reload(self) -> None:
        velocity = self.dice.choice([5.0, 10.0, 20.0])
        self.done.append(f"reload with velocity = {velocity}")
        self.rig.ask(lambda inside: reloaded(inside, velocity))

    def step(self) -> None:
        match self.dice.choice(["start"] * 6 + ["other"] * 3 + ["wait"] * 3 + ["stop", "reload", "compare"]):
            case "start":
                self.start()
            case "other":
                name, value = self.dice.choice(OTHERS)
                self.put(f".{name}", value)
            case "wait":
                time.sleep(self.dice.uniform(0, 0.4))
            case "stop":
                self.stop()
            case "reload":
                self.reload()
            case _:
                self.compare()
        self.put(".SPMG", "Go")


def enabled(inside: SimulatedRig) -> bool:
    status = inside.daemon.rig.axes["x"].tracker.status
    return status.enabled is True and not status.stop_latched


def idle(inside: SimulatedRig) -> bool:
    """Tell whether x does nothing and stands."""
    status = inside.daemon.rig.axes["x"].tracker.status
    return status.command is None and abs(inside.truth("x").velocity) < STANDS_MM_PER_S


def reloaded(inside: SimulatedRig, velocity: float) -> None:
    """Have the daemon take a configuration in which x moves with another velocity."""
    (bus,) = inside.config.bus
    axes = tuple(each.model_copy(update={"velocity": velocity} if each.name == "x" else {}) for each in bus.axis)
    config = inside.config.model_copy(update={"bus": (bus.model_copy(update={"axis": axes}),)})
    inside.daemon.reconfigure(config, plan_rig(config))


@contextmanager
def two_clients(rig: ServedRig) -> Iterator[tuple[Putting, Putting]]:
    port = free_port()
    arguments = ("epics", "x", "-e", rig.endpoint, "--address", f"127.0.0.1:{port}", "--prefix", "T:", "--moves")
    with ExitStack() as stack:
        gateway = stack.enter_context(piped(*LDCND, *arguments))
        assert gateway.stdout
        assert "motor records T:{x}" in gateway.stdout.readline()
        addresses = {
            "EPICS_CA_ADDR_LIST": "127.0.0.1",
            "EPICS_CA_AUTO_ADDR_LIST": "NO",
            "EPICS_CA_SERVER_PORT": str(port),
            "EPICS_CA_REPEATER_PORT": str(free_port()),
        }
        one, two = (Putting(stack.enter_context(piped(sys.executable, "-c", CLIENT, **addresses))) for _ in range(2))
        yield one, two


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_what_two_clients_put_moves_the_axis_there_and_nothing_else_moves_it(seed: int) -> None:
    with served_rig(ROOT / "config" / "simulated.toml", seed=seed) as rig, two_clients(rig) as clients:
        day = Day(rig, clients, Random(seed))
        day.until(day.cleared)
        for _ in range(STEPS):
            day.step()
        day.stop()
        day.compare()
        log = subprocess.run(  # noqa: S603
            [*LDCND, "log", "-e", rig.endpoint, "--json", "--count", "1000", "--axis", "x"],
            check=True, capture_output=True, text=True, timeout=60,
        ).stdout  # fmt: skip
    begun = {row["command_id"] for row in map(json.loads, log.splitlines()) if row["what"] in MOTIONS}
    print(f"seed {seed}: {day.started} puts, {len(begun)} motions, {day.stopped} stops, {day.compared} comparisons")
    assert 0 < len(begun) <= day.started
    assert day.compared > 1
