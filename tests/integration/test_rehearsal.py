"""Programs that move machines, tried on a rig in the process of a test."""

import asyncio
import os
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest
import serial

import ldcnd
from ldcnd.contract.errors import NotSupported, ValueOutOfRange
from ldcnd.drives.ldcn.packet import CommandCode, Packet, encode_packet
from ldcnd.testing import run, served_rig, simulated_rig
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


@pytest.mark.long
async def test_a_blocking_program_waits_on_the_clock_of_the_rig(ldcnd_rig):
    began_s, real_s = ldcnd_rig.now_s, time.perf_counter()
    found = await ldcnd_rig.run_blocking(slow_scan, [1, -1, 2])
    assert [place for place, _ in found] == pytest.approx([1, -1, 2], abs=0.02)
    assert [waited_s for _, waited_s in found] == pytest.approx([30] * 3, abs=0.001)
    assert 90 < ldcnd_rig.now_s - began_s < 100
    assert time.perf_counter() - real_s < 60
    assert ldcnd_rig.truth("x").at_rest


async def test_a_blocking_program_fails_where_its_machine_does(ldcnd_rig):
    ldcnd_rig.faults.jam("x", at=0.5)
    with pytest.raises(ldcnd.LdcndError, match="move_absolute"):
        await ldcnd_rig.run_blocking(slow_scan, [1, -1, 2])


@pytest.mark.long
async def test_a_jam_ends_the_program_where_it_is(ldcnd_rig):
    ldcnd_rig.faults.jam("x", at=7.5)
    with pytest.raises(ldcnd.LdcndError, match="move_absolute"):
        await scan(ldcnd_rig.client)
    assert ldcnd_rig.truth("x").at_rest
    assert ldcnd_rig.truth("x").position == pytest.approx(7.5, abs=0.02)


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


@pytest.mark.long
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


@pytest.mark.long
async def test_a_rig_on_serial_lines_is_rehearsed_without_them_and_leaves_nothing_behind(tmp_path):
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


def with_guest(file: Path) -> Path:
    """Write the simulated rig with a port for an old program; return the link that the program would open."""
    link = file.with_name("old")
    file.write_text(SIMULATED.read_text() + f'\n[[port]]\nname = "old"\nbus = "line0"\nlink = "{link}"\n')
    return link


async def test_a_rehearsal_opens_no_port_for_an_old_program(tmp_path):
    link = with_guest(tmp_path / "rig.toml")
    async with simulated_rig(tmp_path / "rig.toml"):
        assert not link.is_symlink()


@pytest.mark.system
@pytest.mark.real_time
def test_an_old_program_finds_a_served_rig_at_a_link_of_its_own(tmp_path):
    link = with_guest(tmp_path / "rig.toml")
    with served_rig(tmp_path / "rig.toml") as rig:
        assert not link.is_symlink()
        with serial.Serial(str(rig.ports["old"]), 19200, timeout=10) as line:
            line.write(encode_packet(Packet(0xFF, CommandCode.HARD_RESET)))
            line.write(encode_packet(Packet(0, CommandCode.SET_ADDRESS, bytes((1, 0xFF)))))
            assert len(line.read(2)) == 2
    assert not rig.ports["old"].is_symlink()


@pytest.mark.parametrize("start", [{"after_s": 1.0, "at": 2.0}, {"at": 1.0, "when": lambda truth: truth.at_rest}])
async def test_a_fault_begins_in_one_way(ldcnd_rig, start):
    with pytest.raises(ValueOutOfRange, match="give one of them"):
        ldcnd_rig.faults.jam("x", **start)


@pytest.mark.parametrize("mistyped", ["at_s", "att", "after"])
async def test_a_mistyped_start_of_a_fault_is_refused(ldcnd_rig, mistyped):
    with pytest.raises(TypeError, match=f"no '{mistyped}'; there are after_s, at, for_s, when"):
        ldcnd_rig.faults.jam("x", **{mistyped: 1.0})


async def test_a_switch_or_a_probability_that_there_is_not_is_refused(ldcnd_rig):
    with pytest.raises(ValueOutOfRange, match="forward or reverse"):
        ldcnd_rig.faults.limit_closed("x", "fwd")
    with pytest.raises(ValueOutOfRange, match="0 to 1, not 50"):
        ldcnd_rig.faults.lost_replies(50)


async def test_the_truth_of_an_axis_keeps_its_coordinates_when_its_daemon_does_not(ldcnd_rig):
    await scan(ldcnd_rig.client, (7.5,))
    await ldcnd_rig.kill_daemon()
    assert ldcnd_rig.truth("x").position == pytest.approx(7.5, abs=0.02)
    await ldcnd_rig.start_daemon()
    assert ldcnd_rig.truth("x").position == pytest.approx(7.5, abs=0.02)


def blocking_program():
    with ldcnd.connect_blocking() as rig, rig.control("x", client="scan") as x:
        x.power(on=True)


async def test_a_program_that_is_not_given_to_the_rehearsal_reaches_no_real_rig(ldcnd_rig):
    """As when the test calls it without `run_blocking`: by default it would find whichever daemon runs here."""
    with pytest.raises(NotSupported, match="a program is rehearsed in this process"):
        blocking_program()
    with pytest.raises(NotSupported, match="a program is rehearsed in this process"):
        await asyncio.to_thread(blocking_program)
    assert not ldcnd_rig.truth("x").energised


UNHAPPY = """
import asyncio
import pytest

@pytest.mark.ldcnd_rig(within_s=60)
async def test_waits_for_ever(ldcnd_rig):
    await asyncio.Event().wait()

@pytest.mark.ldcnd_rig(seeed=3)
async def test_mistyped(ldcnd_rig):
    pass

async def test_meets_nothing(ldcnd_rig):
    ldcnd_rig.faults.jam("x", at=50)

async def test_goes_on(ldcnd_rig):
    assert ldcnd_rig.now_s < 60
"""


@pytest.mark.long
@pytest.mark.parametrize(
    "loaded", [("ldcnd.testing.plugin", "pytest_asyncio.plugin"), ("pytest_asyncio.plugin", "ldcnd.testing.plugin")]
)
def test_a_test_that_never_ends_fails_with_what_happened_and_a_fault_that_never_came_is_said(tmp_path, loaded):
    (tmp_path / "test_unhappy.py").write_text(UNHAPPY)
    plugins = [word for plugin in (*loaded, "no:cacheprovider") for word in ("-p", plugin)]
    done = subprocess.run(  # noqa: S603
        [sys.executable, "-m", "pytest", "-q", *plugins, "--rootdir", tmp_path, "-c", os.devnull, "."],
        cwd=tmp_path, capture_output=True, text=True, timeout=60, check=False,
        env={**os.environ, "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"},
    )  # fmt: skip
    # one more warning where pytest has not rewritten a plugin that the other one imports
    assert re.search("1 failed, 2 passed, (1 warning|2 warnings), 1 error", done.stdout), done.stdout
    assert "it waits for what never comes" in done.stdout
    assert "daemon 1 starts" in done.stdout
    assert "unexpected keyword argument 'seeed'" in done.stdout
    assert "x: jam: to come> never began" in done.stdout


@pytest.mark.long
async def test_a_program_of_asyncio_has_the_clock_of_the_rig(ldcnd_rig):
    began_s, began_at = time.monotonic(), time.time()
    await asyncio.sleep(30)
    time.sleep(10)  # noqa: ASYNC251 - this is what a program may do
    assert time.monotonic() - began_s == pytest.approx(40)
    assert time.time() - began_at == pytest.approx(40)
    assert ldcnd_rig.now_s > 40


@pytest.mark.real_time
async def test_no_rehearsal_on_the_wall_clock():
    with pytest.raises(NotSupported, match="jumping clock") as found:
        async with simulated_rig(SIMULATED):
            pass
    assert "ldcnd_rig" in found.value.remedy


@pytest.mark.system
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
    assert "the shaft was not seen to go where its motion sent it" in jammed.stdout, jammed
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
        return in_folder(tmp_path, *words)

    passes = python("-m", "pytest", "-p", "no:cacheprovider")
    assert "2 passed" in passes, passes
    assert "Traceback" not in python("alone.py")

    (tmp_path / "my_lab.py").write_text(MY_LAB.replace("await (await x.move_absolute(place)).done()", "pass"))
    fails = python("-m", "pytest", "-p", "no:cacheprovider", "test_scan.py")
    assert "1 failed" in fails
    assert "DID NOT RAISE" in fails
    assert "what happened on the rig" in fails
    assert "x power" in fails
    assert "the last packets on line0" in fails


def in_folder(folder, *words, python=sys.executable):
    """Run Python in a folder, with the programs of its environment at hand; return what it printed."""
    environment = {**os.environ, "PATH": f"{Path(python).parent}:{os.environ['PATH']}"}
    ran = subprocess.run(  # noqa: S603
        [python, *words], cwd=folder, env=environment, capture_output=True, text=True, timeout=200, check=False
    )
    return ran.stdout + ran.stderr


@pytest.mark.long
def test_the_lab_of_the_examples_tries_its_own_scripts(tmp_path):
    lab = shutil.copytree(ROOT / "examples" / "lab", tmp_path / "lab")
    told = in_folder(lab, "-m", "pytest", "-q", "-p", "no:cacheprovider")
    assert "6 passed" in told, told


@pytest.mark.system
@pytest.mark.timeout(300)
def test_whoever_has_nothing_but_the_wheel_can_rehearse(tmp_path):
    uv = [str(Path(sys.executable).with_name("uv"))]
    made = tmp_path / "made"
    subprocess.run([*uv, "build", "--wheel", "--out-dir", made, ROOT], check=True, capture_output=True)  # noqa: S603
    (wheel,) = made.glob("*.whl")
    subprocess.run([*uv, "venv", tmp_path / "env"], check=True, capture_output=True)  # noqa: S603
    python = str(tmp_path / "env" / "bin" / "python")
    wanted = f"ldcnd[testing] @ {wheel.as_uri()}"
    subprocess.run([*uv, "pip", "install", "--python", python, wanted], check=True, capture_output=True)  # noqa: S603
    lab = shutil.copytree(ROOT / "examples" / "lab", tmp_path / "lab")
    shutil.copy(Path(__file__).with_name("test_named_faults.py"), lab)
    told = in_folder(lab, "-m", "pytest", "-q", "-p", "no:cacheprovider", python=python)
    passed = re.search(r"^(\d+) passed in", told, re.MULTILINE)
    assert passed, told
    assert int(passed[1]) >= 32


@pytest.mark.system
@pytest.mark.real_time
def test_what_is_asked_of_a_served_rig_takes_no_reply_from_its_daemon(tmp_path):
    """A fault that begins at a place is looked for two thousand times a second, and so is the truth of an axis."""

    def counted(there):
        return there.daemon.rig.buses[0].bus.statistics

    with served_rig(SIMULATED) as served, ldcnd.connect_blocking(served.endpoint) as rig:
        jam = served.ask(lambda there: there.faults.jam("x", at=7.5))
        exchanges, timeouts = served.ask(lambda there: (counted(there).exchanges, counted(there).timeouts))
        served.until(lambda there: counted(there).exchanges > exchanges + 150)
        assert served.ask(lambda there: counted(there).timeouts) == timeouts
        with rig.control("x", client="scan") as x:
            x.power(on=True)
            with pytest.raises(ldcnd.DriveFault):
                x.move_absolute(10.0, velocity=20).done()
        assert jam.begun
        assert served.ask(lambda there: there.truth("x").position) == pytest.approx(7.5, abs=0.5)


CENTRIFUGE = ROOT / "config" / "centrifuge.toml"


@pytest.mark.ldcnd_rig(CENTRIFUGE)
async def test_what_stands_at_an_io_module_can_be_seen_and_can_fail(ldcnd_rig):
    def cabinet():
        return ldcnd_rig.module_truth("cabinet")

    async def said():
        return (await ldcnd_rig.client.latest("cabinet", "io")).named

    assert cabinet().powered
    assert cabinet().parts == {"lock": 1.0, "door": 0.0, "pin": 0.0}
    assert cabinet().inputs["locked"]
    await asyncio.sleep(45)  # the rotor is known to stand by then
    await ldcnd_rig.client.set_io("cabinet", high=["unlock"])
    await ldcnd_rig.until(lambda: cabinet().parts["lock"] == 0.0)
    assert cabinet().outputs["unlock"] is True

    with ldcnd_rig.faults.input_stuck("unlocked", high=True):
        assert not cabinet().inputs["unlocked"]
        await asyncio.sleep(1)
        assert (await said())["unlocked"] is False
    await asyncio.sleep(1)
    assert (await said())["unlocked"] is True

    with ldcnd_rig.faults.part_stuck("door"):
        await ldcnd_rig.client.set_io("cabinet", high=["door"])
        await asyncio.sleep(3)
        assert cabinet().parts["door"] == 0.0
    await ldcnd_rig.until(lambda: cabinet().parts["door"] == 1.0)

    with ldcnd_rig.faults.module_power_loss("cabinet"):
        await asyncio.sleep(3)
        assert cabinet().outputs["unlock"] is None
        assert (cabinet().powered, cabinet().parts["lock"]) == (False, 1.0)  # its spring pushes the bolt in
    assert "cabinet: power loss begins" in str(ldcnd_rig.timeline)


@pytest.mark.ldcnd_rig(CENTRIFUGE)
async def test_what_is_not_at_an_io_module_is_refused_with_what_there_is(ldcnd_rig):
    for use, says in (
        (lambda: ldcnd_rig.module_truth("rotor"), "there are: cabinet"),
        (lambda: ldcnd_rig.faults.module_power_loss("rotor"), "there are: cabinet"),
        (lambda: ldcnd_rig.faults.part_stuck("lid"), "there are: lock, pin, door"),
        (lambda: ldcnd_rig.faults.input_stuck("door", high=True), "there are: pin_out, "),
    ):
        with pytest.raises(ldcnd.LdcndError, match=says):
            use()
