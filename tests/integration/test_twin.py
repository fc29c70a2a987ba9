"""A program is rehearsed on a twin of the rig that runs, and then does on the rig what it has done there."""

import asyncio
import json
import signal
import subprocess
import sys
import time

import pytest

import ldcnd
from ldcnd.config.rig import load_config
from ldcnd.contract.errors import LdcndError
from ldcnd.contract.parameters import ReadAllParameters
from ldcnd.sim.plant import PlantConfig
from ldcnd.testing import run, served_rig, simulated_rig
from ldcnd.testing.run_report import RunReport, rehearse, watch_run
from ldcnd.testing.twin import read_state
from tests.support.rig import SIMULATED

MIXED = SIMULATED.with_name("mixed.toml")


async def night(rig):
    """Scan over most of the travel, ask for a place beyond it, and park."""
    async with rig.control("x", "y", client="night") as (x, y):
        await x.power(on=True)
        await y.power(on=True)
        for number in range(20):
            await (await x.move_absolute(-60 + 7.5 * number)).done()
            await (await y.move_absolute(40 - 2.0 * number, velocity=10)).done()
        with pytest.raises(LdcndError):
            await x.move_absolute(101.0)
        await (await x.move_absolute(12.5)).done()


async def seen(rig, program):
    """Run a program on a rig; return the report of it."""
    running = asyncio.create_task(program(rig.client), name="program")
    report = await watch_run(rig.client.client, running)
    await running
    return report


def other_machines():
    """Return the simulated rig with other seeds, and machines that are a little heavier and stiffer."""
    config = load_config(SIMULATED)
    (line,) = config.sim
    modules = tuple(
        module.model_copy(update={"plant": PlantConfig(inertia_kg_m2=6e-5, friction_nm=0.002)})
        for module in line.module
    )
    return config.model_copy(update={"sim": (line.model_copy(update={"seed": 77, "module": modules}),)})


async def real_run(places):
    async with simulated_rig(other_machines(), seed=77) as rig:
        async with rig.client.control("x", "y", client="day") as (x, y):
            await x.power(on=True)
            await y.power(on=True)
            await (await x.move_absolute(places[0])).done()
            await (await y.move_absolute(places[1])).done()
            await x.set_gains(kp=500)
        return await read_state(rig.client.client), await seen(rig, night)


async def twin_run(state):
    async with simulated_rig(SIMULATED, state=state) as twin:
        where = {name: sample.value for name, sample in (await twin.client.client.positions()).items()}
        return where, await seen(twin, night), twin.truth("x").registers["kp"]


@pytest.mark.long
def test_a_twin_stands_where_the_rig_does_and_predicts_its_run():
    state, real = run(real_run((-31.25, 17.5)))
    where, rehearsed, kp = run(twin_run(state))

    assert where["x"] == pytest.approx(-31.25, abs=0.02)
    assert where["y"] == pytest.approx(17.5, abs=0.02)
    assert kp == 500
    assert real.duration_s == pytest.approx(rehearsed.duration_s, rel=0.02)
    assert real.refusals == rehearsed.refusals == ("x move_absolute: position_limit",)
    for name in "xy":
        for end in ("to_min", "to_max"):
            near, found = getattr(rehearsed.axes[name], end), getattr(real.axes[name], end)
            assert near == pytest.approx(found, abs=0.05 * rehearsed.axes[name].travel)
    assert list(rehearsed.differences(real)) == []


async def night_on_a_twin_of_a_rig_that_was_never_switched_on():
    async with simulated_rig(SIMULATED) as rig:
        state = await read_state(rig.client.client)
    async with simulated_rig(SIMULATED, state=state) as twin:
        return await seen(twin, night)


@pytest.mark.long
def test_the_drives_of_a_rig_that_was_never_switched_on_have_no_gains_and_their_twin_moves_all_the_same():
    report = run(night_on_a_twin_of_a_rig_that_was_never_switched_on())
    assert report.failures == ()
    assert report.axes["x"].motions == 21


async def stepper():
    config = load_config(MIXED)
    line, steps = config.sim
    unit = steps.unit[0].model_copy(update={"stored": {"Pn100": 70}})
    steps = steps.model_copy(update={"unit": (unit, *steps.unit[1:])})
    async with simulated_rig(config.model_copy(update={"sim": (line, steps)})) as rig:
        async with rig.client.control("feed", client="day") as feed:
            await feed.write_parameter("Pn102", 41)
        state = await read_state(rig.client.client)
    async with simulated_rig(MIXED, state=state) as twin:
        dump = await twin.client.client.ask(ReadAllParameters(), "feed")
    return {value.parameter: (value.active, value.stored) for value in dump.values}


@pytest.mark.long
def test_a_twin_has_the_parameters_of_the_rig_in_both_memories():
    values = run(stepper())
    assert values["Pn102"] == (41, 40)
    assert values["Pn100"][1] == 70


async def in_trouble():
    """Return what a twin shows of a rig with a jammed axis, a stopped one, and a SmartStep in alarm somewhere."""
    async with simulated_rig(MIXED) as rig:
        rig.faults.jam("x")
        async with rig.client.control("x", client="day") as x:
            await x.power(on=True)
            with pytest.raises(LdcndError):
                await (await x.move_relative(20)).done()
        feed = rig.machine("feed").unit.drive
        feed.set_run(asyncio.get_running_loop().time(), on=True)
        feed.set_pulse_rate(5000, asyncio.get_running_loop().time())
        await asyncio.sleep(1)
        feed.set_pulse_rate(0, asyncio.get_running_loop().time())
        feed.provoke(0x0070, asyncio.get_running_loop().time())
        await asyncio.sleep(5)
        state = await read_state(rig.client.client)
    async with simulated_rig(MIXED, state=state) as twin:
        await asyncio.sleep(5)
        return state, await read_state(twin.client.client), str(twin.timeline).splitlines()


@pytest.mark.long
def test_a_twin_begins_with_error_stop_and_alarms_and_nothing_is_commanded_for_it():
    real, twin, events = run(in_trouble())
    assert real.states["x"].state == twin.states["x"].state == "error_stop"
    assert twin.faults["x"].first.code == real.faults["x"].first.code
    assert real.positions["feed"].counts == pytest.approx(twin.positions["feed"].counts, abs=2)
    assert real.positions["feed"].counts > 1000
    assert [fault.code for fault in twin.faults["feed"].active] == [fault.code for fault in real.faults["feed"].active]
    assert not [line for line in events if "lost" in line or "released" in line]


BLOCKING = """
import sys, time
import ldcnd

rig = ldcnd.open()
with rig.control("x", client="night") as x:
    x.power(on=True)
    began = time.monotonic()
    x.move_absolute(float(sys.argv[1])).done()
    time.sleep(60)
    assert time.monotonic() - began > 60
    if len(sys.argv) > 2:
        sys.exit("the sample is empty")
"""
ASYNC = """
import asyncio, sys
import ldcnd

async def main():
    async with ldcnd.connect() as rig, rig.control("x", client="night") as x:
        await x.power(on=True)
        await (await x.move_absolute(float(sys.argv[1]))).done()
        await asyncio.sleep(60)

asyncio.run(main())
"""


async def minute(file, *arguments):
    async with simulated_rig(SIMULATED) as rig:
        return await rehearse(rig, file, arguments)


@pytest.mark.parametrize("source", [BLOCKING, ASYNC], ids=["blocking", "asyncio"])
@pytest.mark.sweep(2)
def test_a_program_of_a_minute_is_rehearsed_at_the_pace_of_its_waits(tmp_path, source):
    file = tmp_path / "night.py"
    file.write_text(source)
    report, failure = run(minute(file, "7.5"))
    assert failure is None
    assert report.axes["x"].highest == pytest.approx(7.5, abs=0.05)


@pytest.mark.long
def test_a_program_that_fails_has_a_report_too(tmp_path):
    file = tmp_path / "night.py"
    file.write_text(BLOCKING)
    report, failure = run(minute(file, "7.5", "empty"))
    assert "the sample is empty" in str(failure)
    assert report.axes["x"].motions == 1


async def heavier():
    async with simulated_rig(SIMULATED) as rig:
        state = await read_state(rig.client.client, {"x": PlantConfig(inertia_kg_m2=9e-5)})
    async with simulated_rig(SIMULATED, state=state) as twin:
        plant = twin.machine("x").servo.shaft.plant
        return plant.inertia_kg_m2, twin.machine("y").servo.shaft.plant.inertia_kg_m2, plant.forward_limit_counts


def test_an_identified_machine_is_on_the_shaft_of_its_axis_and_the_travel_stays():
    x, y, limit = run(heavier())
    assert x == 9e-5
    assert y != x
    assert limit < 1_000_000


async def ram_written():
    async with simulated_rig(MIXED) as rig:

        async def program(client):
            async with client.control("feed", client="night") as feed:
                await feed.write_parameter("Pn102", 41)

        return await seen(rig, program)


@pytest.mark.long
def test_a_write_to_ram_is_no_write_to_eeprom_and_what_is_not_counted_is_unknown():
    report = run(ram_written())
    assert report.eeprom_writes is None
    assert "unknown EEPROM writes" in next(report.lines())


@pytest.mark.long
def test_a_following_error_ten_times_as_large_is_said_either_way():
    _, one = run(real_run((0, 0)))
    x = one.axes["x"]
    worse = x.model_copy(update={"following_error": 10 * x.following_error})
    other = one.model_copy(update={"axes": {**one.axes, "x": worse}})
    assert ["following error" in text for text in one.differences(other)] == [True]
    assert ["following error" in text for text in other.differences(one)] == [True]


@pytest.mark.long
def test_a_place_in_between_that_differs_by_a_small_share_of_the_travel_is_said():
    _, one = run(real_run((0, 0)))
    x = one.axes["x"]
    assert x.ends == pytest.approx([*(-60 + 7.5 * number for number in range(20)), 12.5], abs=0.02)
    ends = (*x.ends[:5], x.ends[5] + 1.0, *x.ends[6:])
    other = one.model_copy(update={"axes": {**one.axes, "x": x.model_copy(update={"ends": ends})}})
    assert list(one.differences(other)) == [
        f"axis x: motion 6 ended at {ends[5] - 1:.6g} mm rehearsed, {ends[5]:.6g} in the run"
    ]


@pytest.mark.long
def test_a_report_says_where_the_run_differed():
    _, rehearsed = run(real_run((0, 0)))
    other = rehearsed.model_copy(
        update={"duration_s": rehearsed.duration_s * 1.1, "refusals": (), "stops": rehearsed.stops + 1}
    )
    told = " ".join(rehearsed.differences(other))
    assert "duration" in told
    assert "position_limit rehearsed, none in the run" in told
    assert "stops" in told


@pytest.mark.system
@pytest.mark.real_time
def test_a_twin_is_served_to_programs_that_know_nothing_of_it(tmp_path):
    rig_file = tmp_path / "rig.toml"
    rig_file.write_text(SIMULATED.read_text())
    with served_rig(rig_file) as real, ldcnd.connect_blocking(real.endpoint) as rig:
        with rig.control("x", client="day") as x:
            x.power(on=True)
            x.move_absolute(4.0, velocity=20).done()
            x.stop()
        command = [sys.executable, "-m", "ldcnd", "twin", str(rig_file), "--report", str(tmp_path / "night.json")]
        twin = subprocess.Popen(  # noqa: S603
            command, env=real.environment, stdout=subprocess.PIPE, text=True
        )
        try:
            assert twin.stdout is not None
            endpoint = twin.stdout.readline().strip().removeprefix("export LDCND_CONNECT=")
            with ldcnd.connect_blocking(endpoint, wait_s=20) as rehearsal:
                with rehearsal.control("x", client="night") as x:
                    assert x.position.value == pytest.approx(4.0, abs=0.02)
                    assert x.state.sample.stop_latched
                    x.reset()
                    x.power(on=True)
                    x.move_absolute(5.0, velocity=20).done()
            time.sleep(0.1)  # events are published up to 5 ms after what they tell
            twin.send_signal(signal.SIGINT)
            told, _ = twin.communicate(timeout=30)
        finally:
            twin.kill()
        assert real.ask(lambda there: there.truth("x").position) == pytest.approx(4.0, abs=0.02)

    assert twin.returncode == 0
    assert "axis x: " in told
    report = RunReport.model_validate(json.loads((tmp_path / "night.json").read_text()))
    assert report.axes["x"].highest == pytest.approx(5.0, abs=0.05)


@pytest.mark.system
@pytest.mark.real_time
def test_a_program_is_rehearsed_fast_from_the_rig_that_runs(tmp_path):
    rig_file, night = tmp_path / "rig.toml", tmp_path / "night.py"
    night.write_text(BLOCKING)
    with served_rig(SIMULATED) as real, ldcnd.connect_blocking(real.endpoint) as rig:
        rig_file.write_text(SIMULATED.read_text().replace("tcp/127.0.0.1:7447", real.endpoint))
        with rig.control("x", client="day") as x:
            x.power(on=True)
            x.move_absolute(4.0, velocity=20).done()

        def twin(*arguments):
            command = [sys.executable, "-m", "ldcnd", "twin", str(rig_file), "--fast", str(night), "--", *arguments]
            return subprocess.run(  # noqa: S603
                command, capture_output=True, text=True, timeout=60, check=False
            )

        good, bad = twin("5.5"), twin("5.5", "empty")
        assert real.ask(lambda there: there.truth("x").position) == pytest.approx(4.0, abs=0.02)
    assert (good.returncode, bad.returncode) == (0, 1)
    assert "axis x: 1 motions" in good.stdout
    assert "the sample is empty" in bad.stderr
    assert "axis x: 1 motions" in bad.stdout


SCAN = """
import ldcnd.bluesky
from bluesky import RunEngine
from bluesky.plans import scan

seen = []
with ldcnd.bluesky.connect() as rig, rig.control_all("x", client="night") as (x,):
    x.power(on=True).wait()
    RunEngine()(scan([], x, 0, 10, 200), {"event": lambda name, document: seen.append(document["data"])})
print(len(seen), "points")
"""


@pytest.mark.system
@pytest.mark.real_time
@pytest.mark.timeout(300)
def test_a_bluesky_scan_runs_on_a_twin_as_it_is(tmp_path):
    rig_file, night, scan = tmp_path / "rig.toml", tmp_path / "night.json", tmp_path / "scan.py"
    rig_file.write_text(SIMULATED.read_text())
    scan.write_text(SCAN)
    with served_rig(rig_file) as real:
        command = [sys.executable, "-m", "ldcnd", "twin", str(rig_file), "--report", str(night)]
        with subprocess.Popen(command, env=real.environment, stdout=subprocess.PIPE, text=True) as twin:  # noqa: S603
            assert twin.stdout is not None
            endpoint = twin.stdout.readline().strip().removeprefix("export LDCND_CONNECT=")
            environment = {**real.environment, "LDCND_CONNECT": endpoint}
            ran = subprocess.run(  # noqa: S603
                [sys.executable, str(scan)], env=environment, capture_output=True, text=True, timeout=200, check=False
            )
            twin.send_signal(signal.SIGINT)
            twin.communicate(timeout=30)
        assert real.ask(lambda there: there.truth("x").position) == pytest.approx(0, abs=0.02)
    assert ran.stdout.endswith("200 points\n"), ran.stdout + ran.stderr
    report = RunReport.model_validate(json.loads(night.read_text()))
    assert report.axes["x"].ends[-1] == pytest.approx(10, abs=0.02)
