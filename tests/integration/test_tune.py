"""Tuning through the whole daemon: what is identified, applied and verified, and what comes back afterwards."""

import asyncio
import io
import json
from contextlib import asynccontextmanager, contextmanager
from dataclasses import replace

import click
import pytest

from ldcnd.bench.cli.commission import tune
from ldcnd.bench.kept_gains import file_of, kept_for, put_back
from ldcnd.bench.tuning.plan import plan
from ldcnd.bench.tuning.plant import Plant
from ldcnd.bench.tuning.report import plan_reported, reported
from ldcnd.bench.tuning.session import Findings, measure, verify
from ldcnd.cli.connection import Target
from ldcnd.client.lease import control
from ldcnd.client.rig import Rig
from ldcnd.config.rig import load_config
from ldcnd.contract.commands import Halt, MoveAbsolute, Power, SetGains
from ldcnd.contract.errors import (
    DriveFault,
    LeaseExpired,
    LeaseHeld,
    NotReferenced,
    PositionLimit,
    StopLatched,
    ValueOutOfRange,
    WrongState,
)
from ldcnd.drives.axis_config import ApproachConfig
from ldcnd.drives.ldcn.profiles import LS_182AP
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain
from ldcnd.sim.plant import MotorPlant
from ldcnd.testing.jumping_loop import JumpingLoop
from tests.support.rig import SIMULATED, running_rig

CONFIGURED = {"kp": 350, "kd": 3000, "ki": 400, "il": 400, "ol": 250, "el": 4000, "sr": 1, "deadband": 0}
WITHIN_COUNTS = 2000
WRONG_WITHIN = 0.5
STIFF = MotorPlant(inertia_kg_m2=2e-4, friction_nm=0.02, delay_s=0.0008)
"""Comes to rest soon, so that its traces are short."""


@pytest.fixture(autouse=True)
def state_home(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))


@asynccontextmanager
async def tuned_rig(machine=STIFF, **changes):
    """Run a rig with one axis, x, on this machine, which is up; with its shaft."""
    config = load_config(SIMULATED)
    (bus,) = config.bus
    axis = bus.axis[0].model_copy(update=changes)
    one = config.model_copy(update={"bus": (bus.model_copy(update={"axis": (axis,), "group": ()}),)})
    chain = build_chain(ChainSpec(modules=(ModuleSpec("ls182ap", machine),)))
    async with running_rig(one, {"line0": chain}) as rig:
        await rig.until("x", lambda state: state.link == "up")
        yield rig, chain.modules[0].shaft


async def registers(rig):
    (info,) = await rig.client.axes()
    return {each.name: each.value for each in info.registers if each.name in CONFIGURED}


async def is_off_with_its_old_gains(rig):
    state = await rig.client.state("x")
    return not state.enabled and await registers(rig) == CONFIGURED and not file_of("sim", "x").exists()


@asynccontextmanager
async def measuring(rig, until):
    """Measure in a task of its own; begins when a line that contains `until` has been said."""
    said = asyncio.Event()

    def tell(line):
        if until in line:
            said.set()

    planned = await plan(rig.client, "x", None)
    task = asyncio.create_task(measure(rig.client, planned, 20.0, tell), name="measure")
    await said.wait()
    await rig.until("x", lambda state: state.enabled)
    assert kept_for("sim", "x").gains == CONFIGURED
    yield task


@pytest.mark.timeout(300)  # some seconds of processor time, on a machine that may be busy
@pytest.mark.long
async def test_an_axis_is_identified_tuned_and_verified_and_worse_gains_are_not_kept():
    said = []
    async with tuned_rig(direction="reverse") as (rig, shaft):
        planned = await plan(rig.client, "x", None)
        found = await measure(rig.client, planned, 20.0, said.append)
        assert await is_off_with_its_old_gains(rig)

        weak = replace(found.proposal, gains=replace(found.proposal.gains, kp=10, kd=100, ki=1, il=0))
        refused = reported(found, await verify(rig.client, replace(found, proposal=weak), said.append))
        assert await is_off_with_its_old_gains(rig)

        report = reported(found, await verify(rig.client, found, said.append))
        state = await rig.client.state("x")
        loaded = await registers(rig)
        place = shaft.position_counts

    true = Plant.of(STIFF)
    assert found.known.plant.acceleration == pytest.approx(true.acceleration, rel=0.1)
    assert found.known.plant.friction_pwm == pytest.approx(true.friction_pwm, rel=0.2)
    assert found.known.plant.delay_s == pytest.approx(true.delay_s, abs=2 * LS_182AP.servo_cycle_s)
    assert not refused.applied
    assert refused.objection
    assert report.applied
    assert report.objection is None
    assert not state.enabled
    assert loaded == report.gains != CONFIGURED
    assert not file_of("sim", "x").exists()
    assert report.margins.phase_deg > 30
    assert report.after.settled
    assert report.after.settling_s <= report.before.settling_s + 0.005
    assert report.after.overshoot < 0.15
    assert report.after.following_error == pytest.approx(report.predicted.following_error, rel=0.2)
    assert report.farthest <= report.within == WITHIN_COUNTS / 1000
    assert abs(place) <= WITHIN_COUNTS
    assert said[0] == "pulses: does the encoder count the motor's way?"


@pytest.fixture
def loop():
    """A loop of the test's own, for commands that run one themselves."""
    jumping = JumpingLoop()
    yield jumping
    jumping.close()


@contextmanager
def rig_on(loop):
    """Run a rig on a loop whenever that runs."""
    up, end = loop.create_future(), asyncio.Event()

    async def run():
        async with tuned_rig() as (rig, _):
            up.set_result(rig)
            await end.wait()

    running = loop.create_task(run(), name="rig")
    try:
        yield loop.run_until_complete(up)
    finally:
        end.set()
        loop.run_until_complete(running)


@pytest.mark.system  # the picture takes ten seconds of processor time
@pytest.mark.timeout(300)
def test_the_command_tunes_draws_and_prints_its_report_as_json(loop, tmp_path, monkeypatch, capsys):
    pytest.importorskip("matplotlib")
    monkeypatch.setattr("ldcnd.bench.cli.commission.end_as_interrupted", lambda: None)
    monkeypatch.setattr("sys.stdin", io.StringIO())
    picture, file = tmp_path / "tune.png", tmp_path / "rig.toml"
    file.write_text(SIMULATED.read_text())

    with rig_on(loop) as rig:
        monkeypatch.setattr(Target, "run", lambda _, work: loop.run_until_complete(work(rig.client)))
        with pytest.raises(click.Abort):  # nothing can be typed here
            tune.main(["x", "--within", "1000 um"], standalone_mode=False)
        unasked = capsys.readouterr()
        tune.main(["x", "--json", "--dry-run"], standalone_mode=False)
        dry = capsys.readouterr()
        untouched = loop.run_until_complete(registers(rig))["kp"]
        options = ["--yes", "--bandwidth", "25", "--plot", str(picture), "--write", str(file)]
        tune.main(["x", "--json", *options], standalone_mode=False)
        done = capsys.readouterr()
        loaded = loop.run_until_complete(registers(rig))
        with pytest.raises(WrongState, match="no gains of an unfinished tuning"):
            tune.main(["x", "--put-back"], standalone_mode=False)

    assert "it will stay within 1 mm (1000 counts)" in unasked.err
    assert "move x now" in unasked.err
    assert untouched == 0
    assert json.loads(dry.out.splitlines()[-1])["within_counts"] == WITHIN_COUNTS
    report = json.loads(done.out.splitlines()[-1])
    assert report["applied"]
    assert report["gains"] == loaded
    written = load_config(file).bus[0].axis[0].gains.model_dump()
    assert {name: written[name] for name in loaded} == loaded
    assert report["margins"]["bandwidth_hz"] == pytest.approx(25, rel=0.1)
    assert "identifying" in done.err
    assert picture.read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("wrong", "said"),
    [({"motor_reversed": True}, "against an output"), ({"encoder_disconnected": True}, "the encoder counted nothing")],
    ids=["reversed motor", "disconnected encoder"],
)
@pytest.mark.sweep(2)
async def test_wrong_wires_end_it_within_the_stated_distance_and_the_gains_come_back(wrong, said):
    places = [0.0]

    async def watch(shaft):
        while True:
            places.append(shaft.position_counts)
            await asyncio.sleep(0.002)

    async with tuned_rig(MotorPlant(**wrong)) as (rig, shaft):
        planned = await plan(rig.client, "x", WRONG_WITHIN)
        watching = asyncio.create_task(watch(shaft), name="watch")
        with pytest.raises(DriveFault, match=f"axis x: .*{said}") as refused:
            await measure(rig.client, planned, 20.0, lambda _: None)
        watching.cancel()
        assert await is_off_with_its_old_gains(rig)

    assert refused.value.axis == "x"
    assert refused.value.remedy
    assert 1 < max(map(abs, places)) <= 1000 * WRONG_WITHIN


async def test_a_tuning_that_is_cancelled_puts_the_gains_back():
    async with tuned_rig() as (rig, _), measuring(rig, "pulses") as task:
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task

        assert await is_off_with_its_old_gains(rig)


async def test_a_stop_by_anyone_ends_a_tuning_and_the_gains_are_put_back():
    async with tuned_rig() as (rig, _), measuring(rig, "pulses") as task:
        await rig.client.stop()
        with pytest.raises(StopLatched):
            await task

        assert await is_off_with_its_old_gains(rig)
        assert (await rig.client.state("x")).stop_latched
        with pytest.raises(StopLatched):
            await plan(rig.client, "x", None)


@pytest.mark.parametrize("ending", [Halt(client="ann"), Power(on=False, client="ann")], ids=lambda each: each.verb)
async def test_a_halt_or_power_off_by_anyone_ends_a_tuning_between_its_moves_too(ending):
    async with tuned_rig() as (rig, _), measuring(rig, "pulses") as task:
        await rig.until("x", lambda state: not state.enabled)
        await rig.client.command("x", ending)
        with pytest.raises(WrongState, match="by ann; tuning ends"):
            await task

        assert await is_off_with_its_old_gains(rig)


async def test_gains_come_back_under_a_new_lease_when_the_first_was_lost():
    async with tuned_rig() as (rig, _), measuring(rig, "pulses") as task:
        async with control(rig.client, "ann", "x", force=True):
            pass
        with pytest.raises(LeaseExpired):
            await task

        assert await is_off_with_its_old_gains(rig)


async def test_gains_wait_on_the_disk_while_another_client_has_control():
    async with tuned_rig() as (rig, _), measuring(rig, "pulses") as task:
        async with control(rig.client, "ann", "x", force=True):
            with pytest.raises(WrongState, match="could not be put back") as refused:
                await task
            with pytest.raises(WrongState, match="earlier tuning"):
                await plan(rig.client, "x", None)
        assert await registers(rig) != CONFIGURED

        await put_back(Rig(rig.client, await rig.client.daemon()), kept_for("sim", "x"), "ldcnd tune")

        assert await is_off_with_its_old_gains(rig)
    assert "ldcnd tune x --put-back" in str(refused.value.remedy)


@pytest.mark.parametrize("powered", [False, True], ids=["open", "closed"])
async def test_an_axis_that_another_client_controls_is_not_tuned(powered):
    async with tuned_rig() as (rig, shaft):
        planned = await plan(rig.client, "x", None)
        found = Findings(planned, CONFIGURED, None, None, None, (), 0)  # it is refused before the rest matters
        async with control(rig.client, "ann", "x") as held:
            await held.command("x", Power(on=True))
            await held.command("x", Power(on=powered))
            await rig.until("x", lambda state: state.enabled is powered)
            place = shaft.position_counts
            for work in (measure(rig.client, planned, 20.0, print), verify(rig.client, found, print)):
                with pytest.raises(LeaseHeld, match="ann") as refused:
                    await work

                assert refused.value.remedy
                assert shaft.position_counts == place
                assert await registers(rig) == CONFIGURED
                assert (await rig.client.state("x")).enabled is powered
                assert not file_of("sim", "x").exists()


async def test_an_axis_that_was_moved_since_it_was_agreed_to_is_not_tuned():
    async with tuned_rig() as (rig, shaft):
        planned = await plan(rig.client, "x", None)
        await rig.client.command("x", Power(on=True))
        reply = await rig.client.command("x", MoveAbsolute(position=1.5))
        await rig.client.wait_for_end("x", reply.command_id)
        await rig.client.command("x", Power(on=False))
        place = shaft.position_counts

        with pytest.raises(WrongState, match="was moved since"):
            await measure(rig.client, planned, 20.0, lambda _: None)

        assert shaft.position_counts == pytest.approx(place, abs=2)
        assert await is_off_with_its_old_gains(rig)


async def test_an_axis_with_another_scale_than_was_agreed_to_is_not_tuned():
    async with tuned_rig() as (rig, _):
        planned = await plan(rig.client, "x", 2.0)
    async with tuned_rig(counts_per_unit=5000.0) as (rig, shaft):
        with pytest.raises(WrongState, match="another counts_per_unit"):
            await measure(rig.client, planned, 20.0, lambda _: None)

        assert shaft.position_counts == 0
        assert not (await rig.client.state("x")).enabled


@pytest.mark.parametrize("within", [1e308, -1.0, float("nan"), float("inf")])
async def test_a_distance_that_is_none_is_refused(within):
    async with tuned_rig() as (rig, _):
        with pytest.raises(ValueOutOfRange, match="are no distance"):
            await plan(rig.client, "x", within)


async def test_nothing_is_sent_by_a_plan_and_it_states_the_distance():
    async with tuned_rig(counts_per_unit=500.0) as (rig, _):
        planned = await plan(rig.client, "x", 1.5)

        assert (await registers(rig))["kp"] == 0
    document = plan_reported(planned)
    assert (document.within, document.within_counts, document.unit) == (1.5, 750, "mm")
    assert "it will stay within 1.5 mm (750 counts)" in document.lines[0]


async def test_a_closed_loop_is_not_tuned():
    async with tuned_rig() as (rig, _):
        await rig.client.command("x", Power(on=True))

        with pytest.raises(WrongState, match="begins with the loop open") as refused:
            await plan(rig.client, "x", None)

    assert "ldcnd power off x" in refused.value.remedy


async def test_a_distance_must_fit_into_the_travel_and_be_long_enough():
    async with tuned_rig() as (rig, _):
        with pytest.raises(ValueOutOfRange, match="within 100 counts"):
            await plan(rig.client, "x", 0.1)
        await rig.client.command("x", Power(on=True))
        reply = await rig.client.command("x", MoveAbsolute(position=99.0))
        await rig.client.wait_for_end("x", reply.command_id)
        await rig.client.command("x", Power(on=False))

        with pytest.raises(PositionLimit, match="2 mm either way"):
            await plan(rig.client, "x", None)
        assert (await plan(rig.client, "x", 0.5)).bounds.within_counts == 500


async def test_an_axis_that_has_limits_and_no_reference_is_not_tuned():
    async with tuned_rig(reference="required") as (rig, _):
        with pytest.raises(NotReferenced, match="does not know where it is"):
            await plan(rig.client, "x", None)


async def test_an_axis_that_comes_from_one_side_is_not_tuned():
    async with tuned_rig(approach=ApproachConfig(direction="positive", distance=0.5)) as (rig, _):
        with pytest.raises(WrongState, match="approach"):
            await plan(rig.client, "x", None)


async def test_an_axis_without_gains_is_told_to_get_some():
    async with tuned_rig(gains=None) as (rig, _):
        planned = await plan(rig.client, "x", None)
        with pytest.raises(WrongState, match="no gains yet"):
            await measure(rig.client, planned, None, lambda _: None)
        await rig.client.command("x", SetGains(kp=350, el=4000))

        assert not file_of("sim", "x").exists()
