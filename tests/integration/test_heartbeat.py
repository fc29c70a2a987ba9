"""The level that changes while the daemon works: when it does, when it stops, and how soon."""

import asyncio
import os
import signal
import statistics
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager, contextmanager
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import pytest

from ldcnd.config.rig import HeartbeatConfig, RigConfig
from ldcnd.contract.codec import decode
from ldcnd.contract.errors import ConfigError
from ldcnd.contract.health import DaemonHealth, HeartbeatHealth
from ldcnd.daemon.heartbeat import Heartbeat
from ldcnd.daemon.rig import OwnedRig
from ldcnd.line.level import LevelFile, Output
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain
from tests.support.chain_rig import rig_on, simulated_config
from tests.support.process import ROOT, answering, free_port

HALF_S, SILENCE_S = 0.05, 0.5
ALMOST_S = 0.001


def configured(path, **bus) -> RigConfig:
    return simulated_config(**bus).model_copy(update={"heartbeat": HeartbeatConfig(file=path)})


def new_chain():
    return build_chain(ChainSpec(tuple(ModuleSpec(n) for n in ("ls182ap", "ls182ap", "picservo-v4", "picservo-v4"))))


@pytest.fixture
def changes_s(monkeypatch):
    """The instants of all changes, in loop time; the level itself is checked to change each time."""
    at_s, levels = [], [False]

    def note(_output, level):
        assert level is not levels[-1]
        levels.append(level)
        at_s.append(asyncio.get_running_loop().time())

    monkeypatch.setattr(LevelFile, "set", note)
    return at_s


@asynccontextmanager
async def beating_rig(tmp_path, changes_s):
    chain = new_chain()
    async with rig_on(chain, configured(tmp_path / "level")) as rig:
        await asyncio.sleep(1.0)
        assert changes_s[-1] >= asyncio.get_running_loop().time() - HALF_S
        yield rig, chain


async def health(rig) -> HeartbeatHealth:
    await asyncio.sleep(1.1)
    (answer,) = await rig.session.query("ldcn/sim/meta/health")
    heartbeat = decode(DaemonHealth, answer.payload, answer.encoding).heartbeat
    assert heartbeat is not None
    return heartbeat


def longest_gap_s(at_s):
    return max(later - earlier for earlier, later in pairwise(at_s))


async def test_the_level_changes_every_half_period_while_all_is_well(tmp_path, changes_s):
    async with beating_rig(tmp_path, changes_s) as (rig, _):
        seen = len(changes_s)
        await asyncio.sleep(5.0)
        found = await health(rig)

    assert longest_gap_s(changes_s[seen:]) == pytest.approx(HALF_S, abs=ALMOST_S)
    assert (found.beating, found.why) == (True, "")
    assert found.changes > 100


async def test_it_does_not_begin_before_every_line_is_up(tmp_path, changes_s):
    chain = new_chain()
    for module in chain.modules:
        module.power(on=False, at_s=0.0)
    async with rig_on(chain, configured(tmp_path / "level"), up=False) as rig:
        await asyncio.sleep(5.0)
        found = await health(rig)

    assert changes_s == []
    assert found.why == "line0: the line is not up"


@pytest.mark.promise("heartbeat-ends")
async def test_it_does_not_begin_where_it_watches_no_line(tmp_path, changes_s):
    elsewhere = HeartbeatConfig(file=tmp_path / "level", lines=("other",))
    async with rig_on(new_chain(), simulated_config().model_copy(update={"heartbeat": elsewhere})) as rig:
        await asyncio.sleep(5.0)
        found = await health(rig)

    assert changes_s == []
    assert (found.beating, found.why) == (False, "no line is watched")


@pytest.mark.promise("heartbeat-ends")
async def test_it_stops_when_a_line_no_longer_answers_and_goes_on_when_it_does(tmp_path, changes_s):
    async with beating_rig(tmp_path, changes_s) as (rig, chain):
        loop = asyncio.get_running_loop()
        dark_s = loop.time()
        for module in chain.modules:
            module.power(on=False, at_s=dark_s)
        await asyncio.sleep(5.0)
        last_s, found = changes_s[-1], await health(rig)
        for module in chain.modules:
            module.power(on=True, at_s=loop.time())
        for axis in rig.daemon.rig.axes:
            await rig.until(axis, lambda state: state.link == "up")
        await asyncio.sleep(1.0)
        went_on = changes_s[-1] > last_s

    assert last_s - dark_s <= SILENCE_S + HALF_S + ALMOST_S
    assert not found.beating
    assert went_on


async def test_it_stops_when_one_drive_is_lost(tmp_path, changes_s):
    async with beating_rig(tmp_path, changes_s) as (rig, chain):
        chain.modules[1].power(on=False, at_s=asyncio.get_running_loop().time())
        await rig.until("y", lambda state: state.link == "down")
        down_s = asyncio.get_running_loop().time()
        await asyncio.sleep(1.0)
        found = await health(rig)

    assert changes_s[-1] <= down_s + HALF_S + ALMOST_S
    assert found.why == "y: the drive does not answer"


@pytest.mark.promise("heartbeat-ends")
async def test_it_stops_while_a_stop_is_not_confirmed(tmp_path, changes_s):
    async with beating_rig(tmp_path, changes_s) as (rig, chain):
        chain.modules[3].power(on=False, at_s=asyncio.get_running_loop().time())
        asked_s = asyncio.get_running_loop().time()
        reply = await rig.client.stop("c")
        await asyncio.sleep(2.0)

    assert reply.confirmed == ()
    assert changes_s[-1] <= asked_s + HALF_S + ALMOST_S


async def test_a_loop_that_is_held_up_misses_changes_and_does_not_make_up_for_them(tmp_path, changes_s):
    async with beating_rig(tmp_path, changes_s) as (_, _):
        loop = asyncio.get_running_loop()
        held_s, before = loop.time(), len(changes_s)
        loop.hold_up(0.4)
        await asyncio.sleep(1.0)

    missed = changes_s[before:]
    assert [at_s for at_s in missed if held_s < at_s < held_s + 0.4 - ALMOST_S] == []
    assert min(later - earlier for earlier, later in pairwise(missed)) > HALF_S - ALMOST_S


async def test_an_output_that_is_gone_is_opened_again(tmp_path, changes_s, monkeypatch):
    async with beating_rig(tmp_path, changes_s) as (rig, _):
        working = LevelFile.set

        def gone(_output, _level):
            raise OSError(5, "Input/output error")

        monkeypatch.setattr(LevelFile, "set", gone)
        seen = len(changes_s)
        found = await health(rig)
        monkeypatch.setattr(LevelFile, "set", working)
        await asyncio.sleep(1.2)

    assert found.why == "the output is gone: [Errno 5] Input/output error"
    assert len(changes_s) > seen


@pytest.mark.real_time
async def test_work_that_fills_the_threads_of_the_loop_does_not_hold_it():
    loop, changed, over = asyncio.get_running_loop(), asyncio.Event(), threading.Event()
    pool = ThreadPoolExecutor(max_workers=1)
    loop.set_default_executor(pool)
    pool.submit(over.wait)

    class Wire(Output):
        def set(self, level):
            loop.call_soon_threadsafe(changed.set)

        def close(self):
            pass

    bus = SimpleNamespace(
        settings=SimpleNamespace(name="line0"), statistics=SimpleNamespace(replies=0), on_time=lambda _now_s: True
    )
    rig = OwnedRig("sim", (SimpleNamespace(bus=bus, report="up", axes=()),), {})
    heartbeat = Heartbeat(HeartbeatConfig(file=Path("level")), rig, lambda _config: Wire())
    beating = asyncio.create_task(heartbeat.run(), name="heartbeat")
    try:
        async with asyncio.timeout(10.0):
            await changed.wait()
    finally:
        over.set()
        beating.cancel()
        await asyncio.gather(beating, return_exceptions=True)


async def test_the_line_goes_on_when_the_output_cannot_be_opened(tmp_path):
    async with rig_on(new_chain(), configured(tmp_path / "missing" / "level")) as rig:
        found = await health(rig)
        state = await rig.client.state("x")

    assert "missing/level" in found.why
    assert state is not None
    assert state.link == "up"


@pytest.mark.parametrize(
    ("heartbeat", "said"),
    [
        ({}, "exactly one of port, gpio and file"),
        ({"port": "/dev/ttyS1", "gpio": "gpiochip0:4"}, "exactly one of port, gpio and file"),
        ({"port": "sim:line0"}, "is the port of bus line0"),
        ({"file": "/x", "lines": ["other"]}, "there is no bus 'other'; there are: line0"),
    ],
)
def test_a_heartbeat_that_cannot_be_is_refused(heartbeat, said):
    with pytest.raises(ValueError, match=said):
        RigConfig.model_validate(simulated_config().model_dump() | {"heartbeat": heartbeat})


def test_a_missing_library_is_named(monkeypatch):
    from ldcnd.daemon.heartbeat import open_output  # noqa: PLC0415

    monkeypatch.setitem(sys.modules, "gpiod", None)

    with pytest.raises(ConfigError, match="gpiochip0:17: gpiod is not installed"):
        open_output(HeartbeatConfig(gpio="gpiochip0:17"))


# -- real processes, real signals, a real pipe instead of the wire ---------------------------------------------------

HANGS = """
import signal, time
from ldcnd.cli.main import main
signal.signal(signal.SIGUSR1, lambda *_: time.sleep(1.5))
main()
"""
"""A daemon whose event loop hangs when it is asked to by a signal."""
BOUND_S = HALF_S + 0.05
"""Half a period, and what a busy machine takes to run the thread of a change that was decided before."""


class Wire:
    """The far end of the wire: sees each change, on the machine's clock."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self.changes_s: list[float] = []
        os.set_blocking(descriptor, False)
        asyncio.get_running_loop().add_reader(descriptor, self._see)

    def _see(self) -> None:
        if data := os.read(self._descriptor, 4096):
            self.changes_s += [time.monotonic()] * data.count(b"\n")

    async def beats(self) -> None:
        """Wait for ten more changes."""
        wanted = len(self.changes_s) + 10
        async with asyncio.timeout(10.0):
            while len(self.changes_s) < wanted:
                await asyncio.sleep(HALF_S)

    async def quiet(self, from_s: float) -> float:
        """Return how long after an instant the last change came, once there was none for a second."""
        while time.monotonic() < max([from_s, *self.changes_s]) + 1.0:
            await asyncio.sleep(HALF_S)
        return max([0.0, *(at_s - from_s for at_s in self.changes_s)])


@contextmanager
def pipe(path):
    os.mkfifo(path)
    descriptor = os.open(path, os.O_RDWR | os.O_NONBLOCK)
    try:
        yield Wire(descriptor)
    finally:
        asyncio.get_running_loop().remove_reader(descriptor)
        os.close(descriptor)


@pytest.mark.promise("heartbeat-ends")
@pytest.mark.real_time
@pytest.mark.long
async def test_sigstop_a_hung_loop_and_sigkill_end_the_changes_within_the_bound(tmp_path):
    config, endpoint = tmp_path / "rig.toml", f"tcp/127.0.0.1:{free_port()}"
    with pipe(tmp_path / "level") as wire:
        config.write_text(
            (ROOT / "config" / "simulated.toml")
            .read_text()
            .replace("\n[", f'\n[heartbeat]\nfile = "{tmp_path / "level"}"\n\n[', 1)
        )
        command = (sys.executable, "-c", HANGS, "run", "--config", str(config), "--listen", endpoint)
        running = await asyncio.create_subprocess_exec(*command, cwd=ROOT)
        try:
            await answering(running, endpoint)
            late_s = {}
            for number, back in ((signal.SIGSTOP, signal.SIGCONT), (signal.SIGUSR1, None), (signal.SIGKILL, None)):
                await wire.beats()
                at_s = time.monotonic()
                running.send_signal(number)
                late_s[number.name] = await wire.quiet(at_s)
                if back:
                    running.send_signal(back)
        finally:
            if running.returncode is None:
                running.kill()
            await running.wait()

    steady = statistics.median(later - earlier for earlier, later in pairwise(wire.changes_s))
    print({name: f"{each * 1e3:.1f} ms" for name, each in late_s.items()}, f"between changes {steady * 1e3:.1f} ms")
    assert 0.8 * HALF_S < steady < SILENCE_S  # a host that stands still for moments makes it later, never sooner
    assert max(late_s.values()) <= BOUND_S
