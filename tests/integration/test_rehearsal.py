"""Programs that move machines, tried on a rig in the process of a test."""

import asyncio
import os
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import pytest

import ldcnd
from ldcnd.contract.errors import NotSupported, ValueOutOfRange
from ldcnd.testing import run, simulated_rig
from tests.support.pages import ROOT, blocks_of
from tests.support.rig import SIMULATED


async def scan(rig, places=range(1, 11)):
    found = []
    async with rig.control("x", client="scan") as x:
        await x.power(on=True)
        for place in places:
            move = await x.move_absolute(place)
            await move.done()
            found.append(x.position.value)
    return found


async def test_a_program_moves_a_rig_that_does_not_exist(ldcnd_rig):
    places = await scan(ldcnd_rig.client)
    assert places == pytest.approx(range(1, 11), abs=0.02)
    assert ldcnd_rig.truth("x").position == pytest.approx(10, abs=0.02)
    assert ldcnd_rig.truth("x").at_rest


async def test_a_program_that_connects_by_itself_reaches_the_rig_of_its_test(ldcnd_rig):
    async with ldcnd.connect() as rig:
        assert rig.name == ldcnd_rig.config.rig
        assert await scan(rig, (1, 2)) == pytest.approx([1, 2], abs=0.02)


def slow_scan(places):
    found = []
    with ldcnd.connect_blocking("tcp/127.0.0.1:1") as rig, rig.control("x", client="scan") as x:
        x.power(on=True)
        for place in places:
            x.move_absolute(place).done()
            began_s = time.monotonic()
            time.sleep(30)
            found.append((x.position.value, time.monotonic() - began_s))
    return found


async def test_a_blocking_program_waits_on_the_clock_of_the_rig(ldcnd_rig):
    began_s, real_s = ldcnd_rig.now_s, time.monotonic()
    found = await ldcnd_rig.run_blocking(slow_scan, [1, -1, 2])
    assert [place for place, _ in found] == pytest.approx([1, -1, 2], abs=0.02)
    assert [waited_s for _, waited_s in found] == pytest.approx([30] * 3, abs=0.001)
    assert 90 < ldcnd_rig.now_s - began_s < 100
    assert time.monotonic() - real_s < 60
    assert ldcnd_rig.truth("x").at_rest


async def test_a_blocking_program_fails_where_its_machine_does(ldcnd_rig):
    ldcnd_rig.faults.jam("x", at=0.5)
    with pytest.raises(ldcnd.LdcndError, match="move_absolute"):
        await ldcnd_rig.run_blocking(slow_scan, [1, -1, 2])


async def test_a_jam_ends_the_program_where_it_is(ldcnd_rig):
    ldcnd_rig.faults.jam("x", at=7.5)
    with pytest.raises(ldcnd.LdcndError, match="move_absolute"):
        await scan(ldcnd_rig.client)
    assert ldcnd_rig.truth("x").at_rest
    assert ldcnd_rig.truth("x").position == pytest.approx(7.5, abs=0.02)


@dataclass
class Case:
    """A fault that comes in the middle of a motion to 20, and what is then so."""

    begin: object
    goes_on: bool = False
    """The program notices nothing."""
    arrives: bool | None = None
    """Whether the axis does; by itself, as the program says."""
    says: str = ""
    """What an active fault or an event of x says."""
    axis: str = "x"


CASES = {
    "jam": Case(lambda faults: faults.jam("x", at=10), says="position_error"),
    "slip": Case(lambda faults: faults.slip("x", 0.5, at=10), goes_on=True),
    "friction": Case(lambda faults: faults.friction("x", 5, at=10), goes_on=True),
    "load": Case(lambda faults: faults.load("x", 0.05, at=10), goes_on=True),
    "phase_lost": Case(lambda faults: faults.phase_lost("x", at=10), goes_on=True, says="unsettled"),
    "limit_closed": Case(lambda faults: faults.limit_closed("x", "forward", at=10), goes_on=True),
    "limit_stuck": Case(lambda faults: faults.limit_stuck("x", "forward"), goes_on=True),
    "index_lost": Case(lambda faults: faults.index_lost("x"), goes_on=True),
    "encoder_lost": Case(lambda faults: faults.encoder_lost("x", at=10), says="encoder"),
    "encoder_stuck": Case(lambda faults: faults.encoder_stuck("x", at=10)),
    "overheat": Case(lambda faults: faults.overheat("x", at=10), says="overheat"),
    "overcurrent": Case(lambda faults: faults.overcurrent("x", at=10), says="overcurrent"),
    "motor_short": Case(lambda faults: faults.motor_short("x", at=10), says="short"),
    "overvoltage": Case(lambda faults: faults.overvoltage("x", at=10), says="overvoltage"),
    "motor_supply_lost": Case(lambda faults: faults.motor_supply_lost("z", at=10), axis="z", says="power"),
    "stop_input": Case(lambda faults: faults.stop_input("x", at=10), says="stop_input"),
    "power_loss": Case(lambda faults: faults.power_loss("x", at=10, for_s=1.0), says="reset"),
    "mute": Case(lambda faults: faults.mute("x", at=10, for_s=2.0), says="link_lost"),
    "cable_cut": Case(lambda faults: faults.cable_cut("x", at=10, for_s=2.0), goes_on=True, says="link_lost"),
    "noise": Case(lambda faults: faults.noise(0.05, after_s=0.5, for_s=1.0), goes_on=True),
    "late_replies": Case(lambda faults: faults.late_replies(0.004, after_s=0.5, for_s=1.0), goes_on=True),
    "lost_replies": Case(lambda faults: faults.lost_replies(0.05, after_s=0.5, for_s=1.0), goes_on=True),
    "unplug": Case(lambda faults: faults.unplug(after_s=0.5, for_s=1.0), arrives=True, says="lost"),
    "reset_by_another": Case(lambda faults: faults.reset_by_another(after_s=0.5), says="reset"),
    "daemon_killed": Case(lambda faults: faults.daemon_killed(after_s=0.5, for_s=0.3)),
    "client_lost": Case(lambda faults: faults.client_lost(after_s=0.5), says="lease"),
}


@pytest.mark.parametrize("name", CASES)
async def test_every_fault_does_to_the_machine_what_its_name_says(ldcnd_rig, name):
    case = CASES[name]
    fault = case.begin(ldcnd_rig.faults)
    arrived = False
    try:
        async with ldcnd_rig.client.control(case.axis, client="test") as axis, asyncio.timeout(60):
            await axis.power(on=True)
            await (await axis.move_absolute(20, velocity=10)).done()
            arrived = True
    except ldcnd.LdcndError as error:
        ldcnd_rig.timeline.note(f"the program ends: {error}")
    await asyncio.sleep(4)
    told = str(ldcnd_rig.timeline)
    print(told)
    assert fault.begun or name in ("limit_stuck", "index_lost")
    assert arrived == case.goes_on
    truth = ldcnd_rig.truth(case.axis)
    assert (abs(truth.position - 20) < 0.05) == (case.goes_on if case.arrives is None else case.arrives)
    assert case.says in told


def bytes_of(rig):
    """Have all that the host writes from now on kept."""
    written = bytearray()
    for chain in rig.lines.values():
        write = chain.write

        def keep(now_s, data, write=write):
            written.extend(data)
            write(now_s, data)

        chain.write = keep
    return written


async def scanned(seed):
    async with simulated_rig(SIMULATED, seed=seed) as rig:
        rig.faults.noise(0.02)
        written = bytes_of(rig)
        await scan(rig.client, (1, -1))
        return bytes(written)


def test_the_same_seed_gives_the_same_bytes_without_pytest_too():
    first, other = run(scanned(7)), run(scanned(8))
    assert len(first) > 300
    assert first != other
    assert [run(scanned(7)) == first for _ in range(10)] == [True] * 10


@pytest.mark.soak
@pytest.mark.timeout(1800)
def test_a_thousand_runs_of_one_seed_are_the_same_to_the_byte():
    first = run(scanned(7))
    assert all(run(scanned(7)) == first for _ in range(999))


REAL = """
rig = "real"
state_dir = "state"

[[bus]]
name = "a"
port = "/dev/serial/by-id/nothing"
baud = 115200
module = [{ address = 3, model = "pic-io", name = "cell", outputs = [1] }]

[[bus.axis]]
name = "x"
address = 1
model = "ls-182ap"
unit = "mm"
counts_per_unit = 400
direction = "reverse"
velocity = 200
acceleration = 2000
limits = { position_min = -5, position_max = 300, velocity = 250, acceleration = 2500 }
gains = { kp = 35, kd = 700, ki = 20, il = 100, ol = 200, el = 2000 }
home = { method = "reverse_limit", velocity = 20, position = 310, move_to = 290 }

[[bus.axis]]
name = "y"
address = 2
model = "pic-servo-sc"
velocity = 9000
reference = "at_reset"
acceleration = 90000
gains = { kp = 1200, kd = 9000, el = 3000 }

[[bus]]
name = "b"
family = "smartstep"
port = "/dev/serial/by-id/else"
axis = [{ name = "feed", address = 1, model = "smartstep" }]
"""


async def test_a_rig_with_ports_is_rehearsed_without_them_and_leaves_nothing_behind(tmp_path):
    file = tmp_path / "rig.toml"
    file.write_text(REAL)
    async with simulated_rig(file) as rig, rig.client.control("x", "y", client="test") as (x, y):
        await x.power(on=True)
        await y.power(on=True)
        await (await x.home()).done()
        await (await x.move_absolute(0)).done()
        await (await y.move_absolute(5000)).done()
        await rig.at_rest()
        assert rig.truth("x").position == pytest.approx(0, abs=0.1)
        assert rig.truth("y").position == pytest.approx(5000, abs=20)
        assert rig.truth("feed").registers["Pn102"] == 40
        with pytest.raises(NotSupported, match="axis feed"):
            rig.faults.slip("feed", 1)
    assert list(tmp_path.iterdir()) == [file]


@pytest.mark.parametrize("start", [{"after_s": 1.0, "at": 2.0}, {"at": 1.0, "when": lambda truth: truth.at_rest}])
async def test_a_fault_begins_in_one_way(ldcnd_rig, start):
    with pytest.raises(ValueOutOfRange, match="give one of them"):
        ldcnd_rig.faults.jam("x", **start)


@pytest.mark.real_time
async def test_no_rehearsal_on_the_wall_clock():
    with pytest.raises(NotSupported, match="jumping clock") as found:
        async with simulated_rig(SIMULATED):
            pass
    assert "ldcnd_rig" in found.value.remedy


@pytest.mark.real_time
@pytest.mark.ldcnd_rig(SIMULATED)
def test_programs_in_other_processes_move_a_served_rig(ldcnd_served_rig):
    def ldcnd_(*words):
        command = [sys.executable, "-m", "ldcnd", *words]
        return subprocess.run(  # noqa: S603
            command, env=ldcnd_served_rig.environment, capture_output=True, text=True, timeout=60, check=False
        )

    assert ldcnd_("power", "on", "x").returncode == 0
    assert ldcnd_("move", "x", "3", "--wait").returncode == 0
    assert ldcnd_served_rig.ask(lambda rig: rig.truth("x").position) == pytest.approx(3, abs=0.02)

    ldcnd_served_rig.ask(lambda rig: rig.faults.jam("x", at=2.0))
    jammed = ldcnd_("move", "x", "0", "--wait")
    assert jammed.returncode != 0, jammed.stdout
    ldcnd_served_rig.until(lambda rig: rig.truth("x").at_rest)
    assert ldcnd_served_rig.ask(lambda rig: rig.truth("x").position) == pytest.approx(2, abs=0.1)
    assert "x move_absolute failed" in ldcnd_served_rig.ask(lambda rig: str(rig.timeline))


MY_LAB = """
async def scan(rig):
    async with rig.control("x", client="scan") as x:
        await x.power(on=True)
        for place in (2, 4, 6, 8):
            await (await x.move_absolute(place)).done()
"""


@pytest.mark.system
def test_the_blocks_of_the_page_run_in_an_empty_folder(tmp_path):
    in_a_test, alone, served = (
        block.text for block in blocks_of(ROOT / "docs/how-to/test-your-program.md") if block.language == "python"
    )
    (tmp_path / "rig.toml").write_text(SIMULATED.read_text())
    (tmp_path / "my_lab.py").write_text(MY_LAB)
    (tmp_path / "test_scan.py").write_text(in_a_test)
    (tmp_path / "test_script.py").write_text(served)
    (tmp_path / "alone.py").write_text("from my_lab import scan\n" + alone)

    def python(*words):
        environment = {**os.environ, "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
        return subprocess.run(  # noqa: S603
            [sys.executable, *words],
            cwd=tmp_path,
            env=environment,
            capture_output=True,
            text=True,
            timeout=50,
            check=False,
        )

    assert "2 passed" in (passes := python("-m", "pytest", "-p", "no:cacheprovider")).stdout, passes.stdout
    assert python("alone.py").returncode == 0

    (tmp_path / "my_lab.py").write_text(MY_LAB.replace("await (await x.move_absolute(place)).done()", "pass"))
    fails = python("-m", "pytest", "-p", "no:cacheprovider", "test_scan.py").stdout
    assert "1 failed" in fails
    assert "DID NOT RAISE" in fails
    assert "what happened on the rig" in fails
    assert "x power" in fails
    assert "the last packets on line0" in fails
