"""NICOS's own device classes, unmodified, on `ldcnd secop` and `ldcnd epics`; the simulated shaft decides."""

import subprocess
import sys
import time
from ast import literal_eval
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from importlib.util import find_spec
from pathlib import Path

import pytest

from ldcnd.testing import ServedRig, Truth, served_rig
from tests.support.process import LDCND, ROOT, free_port, piped

pytestmark = [
    pytest.mark.edges,
    pytest.mark.real_time,
    pytest.mark.timeout(300),
    pytest.mark.skipif(find_spec("nicos") is None, reason="no NICOS here: `make .venv-edges/nicos`"),
]

OK, WARN, BUSY, DISABLED, ERROR = 200, 210, 220, 235, 240
"""Numbers of `nicos.core.status`."""
LONGEST_S = 30.0
SYSTEM = """
sysconfig = dict(cache="localhost:{port}", experiment="Exp")
modules = ["nicos.commands.device", "nicos.commands.scan"]
devices = dict(
    Sample=device("nicos.devices.sample.Sample"),
    Exp=device("nicos.devices.experiment.Experiment", sample="Sample", dataroot="{folder}", errorbehavior="abort"),
)
"""
CACHE = """
group = "special"
devices = dict(
    DB=device("nicos.services.cache.database.MemoryCacheDatabase"),
    Server=device("nicos.services.cache.server.CacheServer", db="DB", server="localhost:{port}"),
)
"""


class Refused(Exception):
    """An error of NICOS."""


class Nicos:
    """A session that is told what to do."""

    def __init__(self, running: "subprocess.Popen[str]") -> None:
        self._running = running
        assert self._answer() == "ready"

    def __call__(self, line: str) -> object:
        """Carry out a line of the console, and return its value."""
        assert self._running.stdin
        self._running.stdin.write(line + "\n")
        self._running.stdin.flush()
        said = self._answer()
        if said.startswith("!"):
            raise Refused(said[1:])
        return literal_eval(said)

    def until(self, line: str, holds: Callable[..., bool]) -> object:
        until_s = time.monotonic() + LONGEST_S
        while not holds(value := self(line)):
            assert time.monotonic() < until_s, (line, value)
            time.sleep(0.05)
        return value

    def becomes(self, code: int, axis: str = "x", word: str = "") -> str:
        _, said = self.until(f"{axis}.status(0)", lambda status: status[0] == code and word in status[1])
        return said

    def _answer(self) -> str:
        assert self._running.stdout
        return self._running.stdout.readline().strip()


def setup_on(page: str) -> str:
    """Return the setup file that a page shows."""
    return (ROOT / "docs" / "how-to" / page).read_text().split("```python\n")[1].split("```")[0]


@contextmanager
def nicos(folder: Path, setup: str, **environment: str) -> Iterator[Nicos]:
    port = free_port()
    setups = folder / "setups"
    setups.mkdir()
    for name, text in {"cache": CACHE, "system": SYSTEM, "axes": setup}.items():
        (setups / f"{name}.py").write_text(text.replace("{port}", str(port)).replace("{folder}", str(folder)))
    command = (sys.executable, "-m", "tests.edges.nicos_session", str(folder))
    environment |= {"INSTRUMENT": "nicos_demo.demo"}
    with piped(*command, "cache", **environment) as cache:
        assert cache.stdout
        assert cache.stdout.readline() == "ready\n"
        with piped(*command, "axes", **environment) as running:
            yield Nicos(running)


@contextmanager
def over_secop(rig: ServedRig, folder: Path) -> Iterator[Nicos]:
    port = free_port()
    with piped(*LDCND, "secop", "x", "z", "-e", rig.endpoint, "--address", f"127.0.0.1:{port}", "--moves") as node:
        assert node.stdout
        assert "SECoP modules {x,z}" in node.stdout.readline()
        with nicos(folder, setup_on("use-secop.md").replace("10767", str(port))) as session:
            yield session


@contextmanager
def over_epics(rig: ServedRig, folder: Path) -> Iterator[Nicos]:
    port = free_port()
    arguments = ("epics", "x", "-e", rig.endpoint, "--address", f"127.0.0.1:{port}", "--prefix", "lab:", "--moves")
    addresses = {
        "EPICS_CA_ADDR_LIST": "127.0.0.1",
        "EPICS_CA_AUTO_ADDR_LIST": "NO",
        "EPICS_CA_SERVER_PORT": str(port),
        "EPICS_CA_REPEATER_PORT": str(free_port()),
    }
    with piped(*LDCND, *arguments) as gateway:
        assert gateway.stdout
        assert "motor records lab:{x}" in gateway.stdout.readline()
        with nicos(folder, setup_on("use-epics.md"), **addresses) as session:
            yield session


WORLDS = {"secop": over_secop, "epics": over_epics}
POWER = {"secop": "x.enabled = True", "epics": "enable(x)"}
POWER_OFF = {"secop": "x.enabled = False", "epics": "disable(x)"}
HOME = {"secop": "x.home()", "epics": "x.reference()"}


def shaft(rig: ServedRig) -> Truth:
    return rig.ask(lambda inside: inside.truth("x"))


def rests(rig: ServedRig) -> bool:
    """Tell whether the shaft stands, but for a loop that settles by a hundredth of a millimetre."""
    return abs(shaft(rig).velocity) < 1


@pytest.fixture(params=WORLDS)
def used(request, tmp_path: Path) -> Iterator[tuple[str, ServedRig, Nicos]]:
    """A rig whose x has no reference yet, and a session of NICOS that has it as device x."""
    config = tmp_path / "rig.toml"
    text = (ROOT / "config" / "simulated.toml").read_text()
    config.write_text(text.replace('reference = "at_reset"\n', "", 1))
    with ExitStack() as stack:
        rig = stack.enter_context(served_rig(config))
        yield request.param, rig, stack.enter_context(WORLDS[request.param](rig, tmp_path))


def home(world: str, session: Nicos) -> None:
    session(POWER[world])
    session(HOME[world])
    session.becomes(BUSY)  # a put to HOMF is not waited for
    session("wait(x)")
    session.becomes(OK)


def test_an_axis_is_read_homed_moved_scanned_and_stopped(used):
    world, rig, session = used
    assert session("x.unit") == "mm"
    assert session.becomes(DISABLED if world == "secop" else WARN) == "not homed"
    session(POWER[world])
    assert session.becomes(WARN) == "not homed"
    if world == "secop":  # over Channel Access NICOS notices after a minute
        with pytest.raises(Refused, match="not homed"):
            session("maw(x, 3)")
    home(world, session)
    assert rests(rig)
    session("maw(x, 3)")
    assert abs(shaft(rig).position - 3) < 0.02
    assert abs(session("x.read(0)") - 3) < 0.02
    with pytest.raises(Refused, match=r"100.0000|99.9999"):
        session("move(x, 1000)")
    assert session("x.target") == 3.0
    session("scan(x, 0, 1, 4, t=0)")
    assert abs(shaft(rig).position - 3) < 0.02
    session("x.speed = 10")
    session("x.start(60)")
    session.until("x.read(0)", lambda value: value > 6)
    assert session.becomes(BUSY)
    session("stop(x)")
    session("wait(x)")
    assert rests(rig)
    assert shaft(rig).position < 50
    assert abs(session("x.target") - shaft(rig).position) < 0.05
    assert session.becomes(OK) == ""


def test_a_stop_from_elsewhere_is_busy_until_the_shaft_rests_then_an_error_and_nothing_goes_on_after_reset(used):
    world, rig, session = used
    home(world, session)
    session("x.speed = 50")
    session("x.start(90)")
    rig.until(lambda inside: inside.truth("x").velocity > 45)
    subprocess.run([*LDCND, "stop", "-e", rig.endpoint], check=True, capture_output=True, timeout=60)  # noqa: S603
    while session("x.status(0)")[0] == BUSY:
        pass
    assert rests(rig)
    stood = shaft(rig).position
    assert stood < 85
    session.becomes(ERROR if world == "secop" else WARN, word="stop latched")
    if world == "secop":
        with pytest.raises(Refused, match="latched"):
            session("maw(x, 1)")
    session("reset(x)")
    session(POWER[world])
    session.becomes(OK)
    time.sleep(1)  # for a motion that nobody sent
    assert abs(shaft(rig).position - stood) < 0.05
    assert abs(session("x.target") - stood) < 0.05
    session("maw(x, 80)")
    assert abs(shaft(rig).position - 80) < 0.02


def test_a_fault_ends_the_wait_as_an_error_that_is_reset(used):
    world, rig, session = used
    home(world, session)
    jam = rig.ask(lambda inside: inside.faults.jam("x", at=5.0))
    with pytest.raises(Refused, match="MoveError"):
        session("maw(x, 9)")
    assert abs(shaft(rig).position - 5) < 0.1
    session.becomes(ERROR)
    session(POWER_OFF[world])  # its loop would push what lets go
    rig.ask(lambda _: jam.end())
    rig.until(lambda inside: inside.truth("x").at_rest)
    session("reset(x)")
    # an encoder that has died shows the same as a jam
    session.until("x.status(0)", lambda status: "reference lost" in status[1])
    home(world, session)
    session("maw(x, 9)")
    assert abs(shaft(rig).position - 9) < 0.02


def test_an_axis_whose_line_is_down_is_in_error_and_its_last_values_are_not_good(used):
    world, rig, session = used
    home(world, session)
    session("x.speed = 10")
    session("x.start(60)")
    rig.until(lambda inside: inside.truth("x").velocity > 9)
    cut = rig.ask(lambda inside: inside.faults.cable_cut("x"))
    session.becomes(ERROR)
    if world == "secop":
        for name in ("x", "x_velocity", "x_adc"):
            session.becomes(ERROR, name)
            with pytest.raises(Refused, match="old"):
                session(f"{name}.read(0)")
    rig.ask(lambda _: cut.end())
    rig.until(lambda inside: inside.truth("x").at_rest, 30.0)
    session.until("x.status(0)", lambda status: status[0] == OK or "reference lost" in status[1])
    if world == "secop":
        session.becomes(OK, "x_velocity")
        assert abs(session("x_velocity.read(0)")) < 0.5
    assert abs(session("x.read(0)") - shaft(rig).position) < 0.05
