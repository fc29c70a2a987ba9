"""The checklist of commissioning, step by step, on a whole simulated daemon."""

import asyncio
import functools
import re
import shutil
from contextlib import asynccontextmanager, contextmanager
from xml.etree import ElementTree as ET

import pytest

from ldcnd.bench.commissioning.checklist import STEPS, Checklist, ChecklistWalk, change_of
from ldcnd.bench.commissioning.first_settings import SOFT_GAINS
from ldcnd.bench.commissioning.gains import gain_proposals
from ldcnd.bench.commissioning.holding import REACH
from ldcnd.bench.commissioning.limit_switches import _judged
from ldcnd.bench.commissioning.motor import CAUGHT, MOST_EL_COUNTS, OUTPUTS
from ldcnd.bench.commissioning.record import Result, StepState
from ldcnd.bench.commissioning.report import html_of
from ldcnd.bench.kept_gains import KeptGains, file_of, keep
from ldcnd.bench.machine_faults import MachineFault
from ldcnd.bench.person import Left
from ldcnd.bench.tuning.plant import Plant
from ldcnd.client.axis import Axis
from ldcnd.client.lease import program_name
from ldcnd.client.rig import Rig
from ldcnd.config.rig import load_config
from ldcnd.contract.errors import (
    CommandAborted,
    ConfigError,
    LeaseExpired,
    LeaseHeld,
    StopLatched,
    WrongState,
)
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain
from ldcnd.sim.ldcn.servo import FULL_PWM
from tests.support.commissioning import AXIS, GAINS, PLANT, ScriptedPerson, commissioning_rig, rig_text
from tests.support.process import ROOT
from tests.support.rig import running_rig
from tests.support.simulated_plants import drawn_plants


@pytest.fixture(autouse=True)
def state_home(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))


SEED = 7
SOAK = (pytest.mark.soak, pytest.mark.timeout(1800))
VELOCITIES = "velocity = 1000\nacceleration = 5000"
STANDS = {"did the axis move": "n", "did the shaft": "unseen"}


def figures(record):
    return {each.what: each.value for each in record.result.figures}


def proposed(record):
    return {each.name: each.value for each in record.result.proposals}


@pytest.mark.long
async def test_a_motor_that_agrees_with_its_encoder_is_found_within_the_stated_distance(tmp_path):
    async with commissioning_rig(tmp_path, STANDS) as rig:
        checklist = await rig.checklist()
        preview = await checklist.preview("motor")
        kept = await checklist.run("motor")

        assert kept.result.state is StepState.DONE
        assert "agree" in kept.result.text
        assert any("within 600 counts (0.6 mm)" in line for line in preview)
        assert 50 <= figures(kept)["moved"] <= CAUGHT * MOST_EL_COUNTS
        assert abs(rig.drive.shaft.position_counts) <= CAUGHT * MOST_EL_COUNTS
        assert await rig.registers() == GAINS
        assert checklist.gains_to_put_back is None
        assert not (await rig.running.client.state(AXIS)).enabled


@pytest.mark.parametrize("direction", ["forward", "reverse"])
@pytest.mark.sweep(2)
async def test_a_reversed_motor_is_caught_within_the_stated_distance(direction, tmp_path, monkeypatch):
    text = rig_text(direction=direction).replace("el = 4000", "cl = 121, el = 4000")
    async with commissioning_rig(tmp_path, STANDS, text=text, motor_reversed=True) as rig:
        checklist, loop, loaded = await rig.checklist(), rig.drive.loop, []
        monkeypatch.setattr(loop, "set_gains", lambda gains, real=loop.set_gains: (loaded.append(gains), real(gains)))
        kept = await checklist.run("motor")

        assert kept.result.state is StepState.FAILED
        assert "swap the two wires of the motor" in kept.result.text
        assert {gains.ol for gains in loaded} - {250} <= set(OUTPUTS)
        assert {gains.cl for gains in loaded} == {121}
        assert max(OUTPUTS) <= FULL_PWM / 4
        assert abs(rig.drive.shaft.position_counts) <= CAUGHT * MOST_EL_COUNTS
        assert await rig.registers() == GAINS


@pytest.mark.parametrize("count", [2, pytest.param(60, marks=SOAK)])
@pytest.mark.parametrize("wrong", ["", "motor_reversed", "encoder_disconnected"])
@pytest.mark.sweep(3)
async def test_drawn_machines_stay_near_whatever_is_wrong_with_their_wires(wrong, count, tmp_path):
    for drawn in drawn_plants(SEED, count):
        machine = dict(drawn.motor)
        plant = {**machine, "load_nm": 0.0, **({wrong: True} if wrong else {})}
        folder = tmp_path / str(drawn.number)
        folder.mkdir()
        async with commissioning_rig(folder, **plant) as rig:
            seen = functools.partial(is_seen_to_move, rig)
            rig.person.script["did the axis move"] = seen
            running = asyncio.create_task((await rig.checklist()).run("motor"))
            farthest = 0.0
            while not running.done():
                await asyncio.sleep(0.02)
                farthest = max(farthest, abs(rig.drive.shaft.position_counts))
            kept = await running

        what = f"machine {drawn.number} of seed {SEED}: {kept.result.text}"
        if wrong == "encoder_disconnected":  # nothing can be stated beforehand
            assert farthest <= drawn.motor.counts_per_rev / 8, what
        else:
            assert farthest <= CAUGHT * MOST_EL_COUNTS, what
        assert (kept.result.state is StepState.DONE) is (not wrong), what
        assert {"": "agree", "motor_reversed": "disagree", "encoder_disconnected": "wires of the encoder"}[
            wrong
        ] in what


def is_seen_to_move(rig):
    return "y" if rig.drive.shaft.plant.encoder_disconnected and abs(rig.drive.shaft.position_counts) > 20 else "n"


@pytest.mark.parametrize("wired", [("x", "y"), ("y", "x")])
@pytest.mark.sweep(2)
async def test_a_chain_that_is_numbered_from_the_other_end_is_noticed_when_the_first_axis_moves(wired, tmp_path):
    x = rig_text().partition("[[bus.axis]]")[2].partition("[[sim]]")[0]
    y = x.replace('"x" # the slide', '"y"').replace("address = 1", "address = 2")
    text = rig_text().replace("[[sim]]", f"[[bus.axis]]{y}[[sim]]")
    chain = build_chain(ChainSpec((ModuleSpec("picservo-sc", PLANT),) * 2))
    slide = chain.modules[wired.index("x")]  # what the person sees move
    async with commissioning_rig(tmp_path, STANDS, text=text, chain=chain) as rig:
        rig.person.script["was it axis x"] = lambda: "y" if abs(slide.shaft.position_counts) > 10 else "n"
        kept = await (await rig.checklist()).run("motor")

        right = wired == ("x", "y")
        assert kept.result.state is (StepState.DONE if right else StepState.FAILED)
        assert ("exchange the addresses" in kept.result.text) is not right


@pytest.mark.long
async def test_a_motor_with_friction_is_driven_with_little_more_than_that(tmp_path):
    async with commissioning_rig(tmp_path, STANDS, friction_nm=0.05) as rig:
        kept = await (await rig.checklist()).run("motor")

        assert kept.result.state is StepState.DONE
        assert figures(kept)["output limit"] * 1.53 / 255 < 2.2 * 0.05


@pytest.mark.long
async def test_no_more_output_is_tried_once_the_axis_moved_without_counts(tmp_path):
    async with commissioning_rig(tmp_path, encoder_disconnected=True, friction_nm=0.02) as rig:
        rig.person.script["did the axis move"] = lambda: "y" if abs(rig.drive.shaft.position_counts) > 4 else "n"
        kept = await (await rig.checklist()).run("motor")

        assert kept.result.state is StepState.FAILED
        assert "check the wires of the encoder" in kept.result.text
        assert figures(kept)["output limit"] * 1.53 / 255 < 2 * 0.02
        assert abs(rig.drive.shaft.position_counts) < 2000
        assert await rig.registers() == GAINS


@pytest.mark.long
async def test_a_motor_that_stands_is_said_to_stand(tmp_path):
    async with commissioning_rig(tmp_path, STANDS) as rig:
        rig.drive.shaft.stalled = True
        kept = await (await rig.checklist()).run("motor")

        assert kept.result.state is StepState.FAILED
        assert "it stood with up to 60" in kept.result.text
        assert await rig.registers() == GAINS


async def test_a_stop_in_the_middle_stays_latched_and_the_gains_are_put_back(tmp_path):
    async with commissioning_rig(tmp_path, STANDS, friction_nm=0.2) as rig:
        checklist = await rig.checklist()
        running = asyncio.create_task(checklist.run("motor"))
        while (await rig.registers())["el"] != MOST_EL_COUNTS:
            await asyncio.sleep(0.05)
        await rig.running.client.stop()
        with pytest.raises(StopLatched):
            await running
        latched = await rig.running.client.state(AXIS)

        assert latched.stop_latched
        assert checklist.gains_to_put_back is None
        assert checklist.record.of("motor").result.state is StepState.FAILED
        assert await rig.registers() == GAINS


@pytest.mark.promise("latch-outlasts-programs")
async def test_a_stop_between_a_trip_and_its_reset_stays_latched_and_ends_the_step(tmp_path, monkeypatch):
    async with commissioning_rig(tmp_path, STANDS) as rig:
        rig.drive.shaft.stalled = True
        reset = Axis.reset

        async def stopped_before(axis, **arguments):
            await rig.running.client.stop()
            return await reset(axis, **arguments)

        monkeypatch.setattr(Axis, "reset", stopped_before)
        with pytest.raises(StopLatched):
            await (await rig.checklist()).run("motor")

        assert (await rig.running.client.state(AXIS)).stop_latched
        assert await rig.registers() == GAINS


async def test_gains_are_put_back_when_the_step_is_cancelled(tmp_path):
    async with commissioning_rig(tmp_path, STANDS, friction_nm=0.2) as rig:
        checklist = await rig.checklist()
        running = asyncio.create_task(checklist.run("motor"))
        while (await rig.registers())["el"] != MOST_EL_COUNTS:
            await asyncio.sleep(0.05)
        await asyncio.sleep(0.7)
        running.cancel()
        with pytest.raises(asyncio.CancelledError):
            await running

        assert await rig.registers() == GAINS
        assert checklist.gains_to_put_back is None
        assert checklist.record.of("motor").result.state is StepState.OPEN
        assert not (await rig.running.client.state(AXIS)).enabled


async def test_gains_that_could_not_be_put_back_are_put_back_by_the_next_call(tmp_path):
    async with commissioning_rig(tmp_path, STANDS, friction_nm=0.2) as rig:
        checklist = await rig.checklist()
        running = asyncio.create_task(checklist.run("motor"))
        while (await rig.registers())["el"] != MOST_EL_COUNTS:
            await asyncio.sleep(0.05)
        other = Rig(rig.running.client, await rig.running.client.daemon())
        async with other.control(AXIS, client="other", lease_s=5.0, force=True):
            with pytest.raises(LeaseExpired):
                await running
            assert (await rig.registers())["el"] == MOST_EL_COUNTS
        again = await rig.checklist()
        assert again.gains_to_put_back is not None
        await again.put_back_gains()

        assert await rig.registers() == GAINS
        assert again.gains_to_put_back is None


async def test_gains_that_could_not_be_put_back_are_said(tmp_path):
    async with commissioning_rig(tmp_path, STANDS, friction_nm=0.2) as rig:
        running = asyncio.create_task((await rig.checklist()).run("motor"))
        while (await rig.registers())["el"] != MOST_EL_COUNTS:
            await asyncio.sleep(0.05)
        other = Rig(rig.running.client, await rig.running.client.daemon())
        async with other.control(AXIS, client="other", lease_s=5.0, force=True):
            with pytest.raises(LeaseExpired):
                await running

        assert "x: its former gains could not be put back: axis x is controlled by other" in rig.person.told[-2]
        assert "ldcnd tune x --put-back" in rig.person.told[-1]


MOVING = [name for name, step in STEPS.items() if step.moves]
ALL_ANSWERS = {
    "how far shall": "4",
    "how far did": "4",
    "how many": "2",
    "reverse end": "jog -1",
    "how far may": "4",
    "did the axis move": "n",
}


async def what_the_drive_has(rig):
    state = await rig.running.client.state(AXIS)
    return rig.drive.loop.gains, rig.drive.loop.servo_on, rig.drive.shaft.position_counts, state.enabled, state.state


@contextmanager
def recorded_requests(chain):
    """Yield the gains that come, and the changes of the loop of a simulated drive."""
    loop = chain.modules[0].loop
    seen = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loop, "set_gains", lambda gains, real=loop.set_gains: (seen.append(gains), real(gains)))
        yield seen


@pytest.mark.parametrize("powered", [False, True], ids=["open", "closed"])
@pytest.mark.parametrize("step", MOVING)
@pytest.mark.sweep(2)
async def test_a_step_that_is_refused_control_sends_nothing_and_leaves_the_record_as_it_was(step, powered, tmp_path):
    async with commissioning_rig(tmp_path, ALL_ANSWERS) as rig:
        checklist = await rig.checklist()
        other = Rig(rig.running.client, await rig.running.client.daemon())
        await rig.running.until(AXIS, lambda state: state.link == "up")
        async with other.control(AXIS, client="ann", lease_s=60.0) as held:
            await held.power(on=True)
            await held.power(on=powered)
            await rig.running.until(AXIS, lambda state: state.enabled is powered)
            await checklist.settle(step, Result(state=StepState.DONE, text="as it was"))
            before = await what_the_drive_has(rig)
            with recorded_requests(rig.chain) as gains, pytest.raises(LeaseHeld, match="ann") as refused:
                await checklist.run(step)

            assert await what_the_drive_has(rig) == before
        assert gains == []
        assert refused.value.remedy
        assert checklist.record.of(step).result.text == "as it was"
        assert checklist.gains_to_put_back is None


@pytest.mark.parametrize("step", [name for name in MOVING if name not in {"motor", "hold"}])
async def test_a_step_that_a_person_leaves_at_the_key_powers_nothing(step, tmp_path):
    def leave(what):
        powered.append(rig.drive.loop.servo_on)
        raise Left("another key was pressed")

    text = rig_text().replace("home =", 'reference = "at_reset"\nhome =')
    async with commissioning_rig(tmp_path, ALL_ANSWERS, text=text) as rig:
        checklist, powered = await rig.checklist(), []
        rig.person.holding = leave
        with pytest.raises(Left):
            await checklist.run(step)

        assert powered == [False]
        assert not (await rig.running.client.state(AXIS)).enabled


@pytest.mark.parametrize("step", ["scale", "home", "speed"])
async def test_a_step_that_ends_before_the_axis_moves_opens_the_loop_that_it_has_closed(step, tmp_path):
    text = rig_text().replace("home =", 'reference = "at_reset"\nhome =')
    async with commissioning_rig(tmp_path, ALL_ANSWERS, text=text) as rig:
        rig.person.holds_s = 0.0  # let go at once
        checklist = await rig.checklist()
        with pytest.raises(CommandAborted, match="the key was let go"):
            await checklist.run(step)

        assert not (await rig.running.client.state(AXIS)).enabled
        assert abs(rig.drive.shaft.position_counts) <= 2


async def test_another_process_of_the_same_program_takes_no_axis_away(tmp_path, monkeypatch):
    async with commissioning_rig(tmp_path, STANDS) as rig:
        other = Rig(rig.running.client, await rig.running.client.daemon())
        with monkeypatch.context() as elsewhere:
            elsewhere.setattr("os.getpid", lambda: 1)
            name = program_name("ldcnd commission")
        async with other.control(AXIS, client=name, lease_s=5.0):
            with pytest.raises(LeaseHeld, match="controlled by ldcnd commission, process 1 on"):
                await (await rig.checklist()).run("motor")


@pytest.mark.parametrize(
    ("kept", "said"),
    [
        (KeptGains(rig="bench", axis="y", gains=GAINS), "is about axis y of rig bench"),
        (KeptGains(rig="other", axis=AXIS, gains=GAINS), "is about axis x of rig other"),
        (KeptGains(rig="bench", axis=AXIS, gains=GAINS, model="ls-182ap"), "are those of a ls-182ap"),
    ],
)
async def test_gains_of_another_axis_or_drive_are_not_put_back(kept, said, tmp_path):
    async with commissioning_rig(tmp_path) as rig:
        file_of("bench", AXIS).parent.mkdir(parents=True)
        file_of("bench", AXIS).write_text(kept.model_dump_json())
        before = await rig.registers()
        with pytest.raises((ConfigError, WrongState), match=said):
            await (await rig.checklist()).put_back_gains()

        assert await rig.registers() == before
        assert file_of("bench", AXIS).exists()


@pytest.mark.parametrize("half", ["", "{", '{"rig":"bench","axis":"x","gains":{"kp":1e400}}'])
async def test_a_file_of_kept_gains_that_is_none_ends_the_step_before_anything_is_sent(half, tmp_path):
    async with commissioning_rig(tmp_path, STANDS) as rig:
        file_of("bench", AXIS).parent.mkdir(parents=True)
        file_of("bench", AXIS).write_text(half)
        with pytest.raises(ConfigError, match="cannot be read"):
            await (await rig.checklist()).run("motor")

        assert await rig.registers() == GAINS
        assert rig.drive.shaft.position_counts == 0


async def test_gains_that_another_program_has_lent_are_never_taken_for_those_of_the_machine(tmp_path):
    async with commissioning_rig(tmp_path, STANDS) as rig:
        checklist = await rig.checklist()
        keep(KeptGains(rig=checklist.record.rig, axis=AXIS, gains=GAINS))
        with pytest.raises(WrongState, match="still to be put back"):
            await checklist.run("motor")

        assert await rig.registers() == GAINS
        assert checklist.gains_to_put_back is None  # the end of a step puts them back, whoever has lent others


def in_pwm(motor):
    """Return friction and load of a machine in PWM steps; a load that pulls forward is held by an output below 0."""
    plant = Plant.of(motor)
    return plant.friction_pwm, -plant.load_pwm


@pytest.mark.parametrize(("direction", "pulls"), [("forward", -3.2), ("reverse", -3.2), ("forward", 4.4)])
@pytest.mark.sweep(3)
async def test_the_output_at_rest_tells_friction_and_load(direction, pulls, tmp_path):
    nm = PLANT.torque_nm_per_a * PLANT.supply_v / PLANT.resistance_ohm / 255
    text = rig_text(direction=direction)
    async with commissioning_rig(tmp_path, text=text, friction_nm=6 * nm, load_nm=pulls * nm) as rig:
        checklist = await rig.checklist()
        preview = await checklist.preview("hold")
        kept = await checklist.run("hold")

        shown = figures(kept)
        sign = 1 if direction == "forward" else -1
        assert kept.result.state is StepState.DONE
        assert shown["output that holds the load, to half a step"] == pytest.approx(-sign * pulls, abs=0.5)
        assert shown["friction, to half a step"] == pytest.approx(6.0, abs=0.5)
        assert f"pulls it {'forward' if sign * pulls > 0 else 'back'}" in kept.result.text
        assert "holds it without power" in kept.result.text
        assert any("by 500 counts (0.5 mm)" in line for line in preview)
        assert any("stays within 1000 counts" in line for line in preview)
        assert abs(rig.drive.shaft.position_counts) <= REACH * MOST_EL_COUNTS
        assert await rig.registers() == GAINS
        assert checklist.gains_to_put_back is None
        assert not (await rig.running.client.state(AXIS)).enabled


@pytest.mark.long
async def test_a_load_that_friction_does_not_hold_contradicts_the_person(tmp_path):
    nm = PLANT.torque_nm_per_a * PLANT.supply_v / PLANT.resistance_ohm / 255
    script = {"what falls": "none", "remark": ""}
    text = rig_text().replace("[[sim]]", '[bus.axis.loss]\nclient = "power_off"\n\n[[sim]]')
    chain = build_chain(
        ChainSpec(
            (ModuleSpec("picservo-sc", PLANT.model_copy(update={"friction_nm": 2.5 * nm, "load_nm": -5.4 * nm})),)
        )
    )
    chain.modules[0].shaft.stalled = True
    async with commissioning_rig(tmp_path, script, text=text, chain=chain) as rig:
        checklist = await rig.checklist()
        await checklist.run("load")
        brake = asyncio.create_task(braked_without_power(rig))
        kept = await checklist.run("hold")
        brake.cancel()

        assert figures(kept)["output that holds the load, to half a step"] == pytest.approx(5.4, abs=0.6)
        assert "a brake holds it; without that it falls" in kept.result.text
        assert "`loss` powers it off when client is lost" in kept.result.text
        assert "run the step load again" in kept.result.text


async def braked_without_power(rig):
    """Let a brake hold the axis while its loop is open."""
    while True:
        rig.drive.catch_up(asyncio.get_running_loop().time())
        rig.drive.shaft.stalled = not rig.drive.loop.servo_on
        await asyncio.sleep(0.01)


@pytest.mark.parametrize("count", [2, pytest.param(20, marks=SOAK)])
@pytest.mark.long
async def test_friction_and_load_of_drawn_machines_are_measured(count, tmp_path):
    hanging = [drawn for drawn in drawn_plants(SEED, 5 * count) if drawn.motor.load_nm][:count]
    off = []
    for drawn in hanging:
        machine = dict(drawn.motor)
        folder = tmp_path / str(drawn.number)
        folder.mkdir()
        async with commissioning_rig(folder, **machine) as rig:
            kept = await (await rig.checklist()).run("hold")
            far = abs(rig.drive.shaft.position_counts)
        friction, load = in_pwm(drawn.motor)
        shown = figures(kept)
        print(drawn.number, f"friction {friction:.2f} load {load:.2f}", shown, kept.result.text, far)
        assert kept.result.state is StepState.DONE, drawn.number
        off.append(shown["friction, to half a step"] - friction)
        off.append(shown["output that holds the load, to half a step"] - load)

    assert max(map(abs, off)) < 1.0


@pytest.mark.long
async def test_an_axis_that_a_brake_holds_is_said_not_to_follow(tmp_path):
    async with commissioning_rig(tmp_path) as rig:
        rig.drive.shaft.stalled = True
        kept = await (await rig.checklist()).run("hold")

        assert kept.result.state is StepState.FAILED
        assert MachineFault.BRAKE in kept.result.text
        assert await rig.registers() == GAINS


async def test_a_wrong_scale_and_a_reversed_encoder_are_found_and_written(tmp_path):
    script = {"how far shall": "4", "how far did": "-8"}  # half the counts a mm, and backwards
    async with commissioning_rig(tmp_path, script) as rig:
        checklist = await rig.checklist()
        kept = await checklist.run("scale")
        change = checklist.change("scale")
        checklist.write(change)

        assert proposed(kept) == {"direction": "reverse", "counts_per_unit": pytest.approx(500, rel=0.01)}
        assert change.restarts
        assert '+direction = "reverse"' in change.lines
        assert 'name = "x" # the slide' in rig.config.read_text()
        assert "# as ordered" in rig.config.read_text()
        axis = load_config(rig.config).bus[0].axis[0]
        assert (axis.direction, axis.counts_per_unit) == ("reverse", proposed(kept)["counts_per_unit"])
        with pytest.raises(WrongState, match="other counts_per_unit and direction"):
            await checklist.preview("home")


async def test_a_right_scale_proposes_nothing(tmp_path):
    async with commissioning_rig(tmp_path, {"how far shall": "0.4 cm", "how far did": "4000 um"}) as rig:
        kept = await (await rig.checklist()).run("scale")

        assert kept.result.state is StepState.DONE
        assert proposed(kept) == {}


async def test_a_turn_of_a_rotary_axis_is_proposed_as_a_whole_number_of_counts(tmp_path):
    text = rig_text().replace("limits = { position_min = -18, position_max = 18,", "modulo = 8\nlimits = {")
    async with commissioning_rig(tmp_path, {"how far shall": "4", "how far did": "3.98"}, text=text) as rig:
        checklist = await rig.checklist()
        kept = await checklist.run("scale")
        checklist.write(checklist.change("scale"))
        scale = proposed(kept)["counts_per_unit"]

        assert scale == f"{round(figures(kept)['counted'] / 3.98 * 8)}/8"
        assert load_config(rig.config).bus[0].axis[0].model_dump()["counts_per_unit"] == scale
        assert f"{scale} makes a turn whole" in kept.result.text


async def test_a_rotary_axis_whose_direction_alone_is_wrong_is_to_keep_its_scale(tmp_path):
    text = rig_text().replace("limits = { position_min = -18, position_max = 18,", "modulo = 8\nlimits = {")
    async with commissioning_rig(tmp_path, {"how far shall": "4", "how far did": "-3.998"}, text=text) as rig:
        kept = await (await rig.checklist()).run("scale")

        assert proposed(kept) == {"direction": "reverse"}
        assert "a turn" not in kept.result.text


async def test_a_motion_ends_when_the_key_is_released(tmp_path):
    script = {"how far shall": "10", "how far did": "5"}
    async with commissioning_rig(tmp_path, script) as rig:
        rig.person.holds_s = 1.2  # the loop is closed in the first 0.2 s
        kept = await (await rig.checklist()).run("scale")

        assert 4000 < figures(kept)["counted"] < 6000
        assert not (await rig.running.client.state(AXIS)).command


def pressing(rig, *sides):
    """Return what presses switches one after the other, by turning the shaft onto them."""
    places = {"reverse": -20_100.0, "forward": 20_100.0, "none": 0.0}

    async def press():
        for side in sides:
            await asyncio.sleep(1.0)
            for place in (side, "none"):
                rig.drive.catch_up(asyncio.get_running_loop().time())
                rig.drive.shaft.position_counts = places[place]
                await asyncio.sleep(1.0)

    return asyncio.create_task(press())


@pytest.mark.promise("held-step-ends")
@pytest.mark.parametrize(
    ("step", "said", "script"), [("home", "search 1:", {"how many": "3"}), ("speed", "followed", {"how far may": "4"})]
)
async def test_no_further_motion_begins_once_the_key_is_released(step, said, script, tmp_path, monkeypatch):
    async with commissioning_rig(tmp_path, script) as rig:
        begun = []
        move, tell, holding = Axis.move_relative, rig.person.tell, rig.person.holding

        async def recorded(axis, *arguments, **more):
            begun.append(arguments)
            return await move(axis, *arguments, **more)

        @asynccontextmanager
        async def holding_until_said(what):
            async with holding(what) as released:

                def release(*lines):
                    tell(*lines)
                    if said in lines[0]:
                        begun.clear()
                        released.set()

                rig.person.tell = release
                yield released

        rig.person.holding = holding_until_said
        monkeypatch.setattr(Axis, "move_relative", recorded)
        with pytest.raises(CommandAborted, match="the key was let go"):
            await (await rig.checklist()).run(step)

        assert begun == []


@pytest.mark.promise("held-step-ends")
async def test_a_search_goes_as_the_preview_has_said_whatever_the_daemon_was_started_with(tmp_path, monkeypatch):
    text = rig_text().replace('method = "index", velocity = 0.5', 'method = "index", velocity = 0.6')
    async with commissioning_rig(tmp_path, {"how many": "2"}, text=text) as rig:
        rig.config.write_text(rig_text())
        checklist = await rig.checklist()
        velocities, home = [], Axis.home

        async def recorded(axis, **more):
            begun = await home(axis, **more)
            velocities.append(begun.reply.velocity)
            return begun

        monkeypatch.setattr(Axis, "home", recorded)
        preview = await checklist.preview("home")
        await checklist.run("home")

        assert "at 0.5 mm/s at most" in preview[0]
        assert velocities == [pytest.approx(0.5, rel=0.01)] * 2


@pytest.mark.long
async def test_a_distance_too_short_for_the_velocity_is_asked_for_again(tmp_path):
    distances = iter(["0", "0.5", "4"])
    text = rig_text().replace("velocity = 40, acceleration = 400", "velocity = 15, acceleration = 150")
    async with commissioning_rig(tmp_path, {"how far may": lambda: next(distances)}, text=text) as rig:
        kept = await (await rig.checklist()).run("speed")

        assert figures(kept)["distance"] == 4
        assert rig.person.told.count("in less than 1 mm it does not reach its velocity") == 2


async def test_numbers_with_which_nothing_can_be_worked_out_are_asked_for_again(tmp_path):
    measured, ends = iter(["1e-320", "4"]), iter(["-1e308", "-10"])
    script = {"how far shall": "4", "how far did": lambda: next(measured), "reverse end": lambda: next(ends)}
    text = rig_text().replace("home =", 'reference = "at_reset"\nhome =')
    async with commissioning_rig(tmp_path, script | {"forward end": "10"}, text=text) as rig:
        checklist = await rig.checklist()
        await checklist.run("scale")
        await checklist.run("travel")
        again = await rig.checklist()

        assert again.record.of("scale").result.state is StepState.DONE
        assert proposed(again.record.of("travel")) == {"limits.position_min": -9.6, "limits.position_max": 9.6}


async def test_limit_switches_are_watched_and_nothing_is_sent_that_moves(tmp_path):
    text = rig_text().replace("velocity = 0.5 }", 'velocity = 0.5, switch_active = "low" }')
    async with commissioning_rig(tmp_path, {"has the axis": "y"}, text=text) as rig:
        checklist = await rig.checklist()
        pressed = pressing(rig, "reverse", "forward")
        kept = await checklist.run("limits")
        await pressed

        assert proposed(kept) == {"home.switch_active": "high", "limit_switches": "stop"}
        checklist.write(checklist.change("limits"))
        assert load_config(rig.config).bus[0].axis[0].switch_active == "high"
        assert load_config(rig.config).bus[0].axis[0].limit_switches == "stop"
        assert not await checklist.refresh()


async def test_a_level_that_the_configuration_cannot_say_yet_makes_no_drive_stop_on_its_switches(tmp_path):
    text = re.sub("home = .*\n", "", rig_text())
    async with commissioning_rig(tmp_path, {"has the axis": "y"}, text=text) as rig:
        site = await (await rig.checklist())._site()
        found = _judged(site, (True, True), [0, 1])

        assert found.state is StepState.DONE
        assert found.proposals == ()
        assert 'write `switch_active = "low"` into `home`' in found.text


async def test_swapped_switches_are_found(tmp_path):
    async with commissioning_rig(tmp_path, {"has the axis": "y"}) as rig:
        pressed = pressing(rig, "forward", "reverse")
        kept = await (await rig.checklist()).run("limits")
        await pressed

        assert kept.result.state is StepState.FAILED
        assert "swapped" in kept.result.text


@pytest.mark.long
async def test_a_reference_is_searched_several_times(tmp_path):
    async with commissioning_rig(tmp_path, {"how many": "4"}) as rig:
        kept = await (await rig.checklist()).run("home")

        assert kept.result.state is StepState.DONE
        assert figures(kept)["searches"] == 4
        assert figures(kept)["spread"] <= 0.005
        assert len(kept.result.series[0].points) == 4


@pytest.mark.parametrize("velocity", [0.5, -0.5])
async def test_a_reference_of_a_rotary_axis_is_searched_again_from_just_before_it(velocity, tmp_path, monkeypatch):
    text = re.sub("limits = .*\n", "", rig_text()).replace("velocity = 0.5", f"velocity = {velocity}")
    text = text.replace("counts_per_unit = 1000", "counts_per_unit = 1000\nmodulo = 20").replace(
        "acceleration = 100", "acceleration = 0.5"
    )
    async with commissioning_rig(tmp_path, {"how many": "4"}, text=text) as rig:
        distances, move_relative = [], Axis.move_relative

        async def recorded(axis, distance, **more):
            distances.append(distance)
            return await move_relative(axis, distance, **more)

        monkeypatch.setattr(Axis, "move_relative", recorded)
        kept = await (await rig.checklist()).run("home")

        assert kept.result.state is StepState.DONE
        assert figures(kept)["spread"] <= 0.005
        assert len(distances) == 3
        assert all(abs(distance) < 1.6 and (distance < 0) == (velocity > 0) for distance in distances), distances


async def test_travel_is_jogged_and_typed(tmp_path):
    answers = iter(["jog -30", "here"])
    script = {"reverse end": lambda: next(answers), "forward end": "16"}
    async with commissioning_rig(
        tmp_path, script, text=rig_text().replace("home =", 'reference = "at_reset"\nhome =')
    ) as rig:
        rig.person.holds_s = 1.5  # likewise
        checklist = await rig.checklist()
        kept = await checklist.run("travel")
        change = checklist.change("travel")

        low = figures(kept)["reverse end"]
        assert low == pytest.approx(-12, abs=1.5)
        margin = 0.02 * (16 - low)
        assert proposed(kept) == {
            "limits.position_min": pytest.approx(low + margin, abs=0.01),
            "limits.position_max": pytest.approx(16 - margin, abs=0.01),
        }
        assert not change.restarts


@pytest.mark.long
async def test_speed_is_raised_until_the_drive_does_not_follow(tmp_path):
    script = {"how far may": "15"}
    async with commissioning_rig(tmp_path, script, supply_v=4.0) as rig:
        rig_limits = load_config(rig.config).bus[0].axis[0].limits
        kept = await (await rig.checklist()).run("speed")

        assert kept.result.state is StepState.DONE
        best = figures(kept)["highest velocity that it followed"]
        assert best < rig_limits.velocity
        assert 10 < best < 20
        assert proposed(kept)["limits.velocity"] == pytest.approx(0.8 * best, rel=0.01)
        assert kept.result.series


@pytest.mark.long
async def test_an_axis_that_follows_up_to_its_limits_keeps_them(tmp_path):
    text = rig_text().replace("velocity = 40, acceleration = 400", "velocity = 15, acceleration = 150")
    async with commissioning_rig(tmp_path, {"how far may": "4"}, text=text) as rig:
        kept = await (await rig.checklist()).run("speed")

        assert kept.result.state is StepState.DONE
        assert proposed(kept) == {}
        assert "velocity: it followed up to 15; acceleration: it followed up to 150" in kept.result.text


async def test_leaving_in_the_middle_and_resuming(tmp_path):
    script = {"what falls": "none", "a remark": ""}
    async with commissioning_rig(tmp_path, script) as rig:
        checklist = await rig.checklist()
        await checklist.run("load")
        await checklist.settle("motor", Result(state=StepState.SKIPPED, text="seen to be right"))
        await checklist.settle("hold", Result(state=StepState.SKIPPED, text="a spindle"))
        with pytest.raises(Left):
            await checklist.run("scale")
        again = await rig.checklist()

        assert again.next_open() == "scale"
        assert again.record.of("load").by == "ada"
        assert again.record.of("load").at == "2026-11-23T12:00:00+00:00"
        assert again.record.of("motor").result.text == "seen to be right"
        assert not (await rig.running.client.state(AXIS)).command


@pytest.mark.long
async def test_a_changed_configuration_and_another_drive_open_steps_again(tmp_path):
    async with commissioning_rig(tmp_path, {"how many": "2", "what falls": "none", "a remark": ""}) as rig:
        checklist = await rig.checklist()
        await checklist.run("load")
        await checklist.run("home")
        rig.config.write_text(rig.config.read_text().replace("velocity = 0.5", "velocity = 0.6"))
        messages = await checklist.refresh()

        assert len(messages) == 1
        assert "home" in messages[0].lower()
        assert checklist.next_open() == "motor"
        assert checklist.record.of("home").result.state is StepState.OPEN
        assert checklist.record.of("load").result.state is StepState.DONE

    other = rig_text("ls-182ap")
    async with commissioning_rig(tmp_path, text=other, module="ls182ap") as rig:
        await rig.checklist()

        assert any("Brake or hanging load is open again" in line for line in rig.person.told)
        assert any("model was pic-servo-sc and is ls-182ap" in line for line in rig.person.told)


async def test_two_sessions_keep_the_results_of_each_other(tmp_path):
    async with commissioning_rig(tmp_path, {"what falls": "none", "a remark": ""}) as rig:
        first, second = await rig.checklist(), await rig.checklist()
        await first.settle("motor", Result(state=StepState.SKIPPED, text="seen to be right"))
        await second.run("load")

        again = await rig.checklist()
        assert again.record.of("motor").result.state is StepState.SKIPPED
        assert again.record.of("load").result.state is StepState.DONE


@pytest.mark.promise("held-step-ends")
async def test_what_a_person_has_agreed_to_is_what_is_run(tmp_path):
    answers = iter(["yes", "no"])

    def agree():
        rig.config.write_text(rig.config.read_text().replace("el = 4000", "el = 100"))
        return next(answers)

    async with commissioning_rig(tmp_path, STANDS) as rig:
        rig.person.script["run it"] = agree
        checklist = await rig.checklist()
        await ChecklistWalk(checklist, rig.person, "rig.toml", lambda _: None).one("motor")

        assert "what it will do has changed meanwhile:" in rig.person.told
        assert any("by about 200 counts" in line for line in rig.person.told)
        assert checklist.record.of("motor").result.state is StepState.OPEN
        assert not (await rig.running.client.state(AXIS)).enabled


async def test_a_configuration_that_was_changed_while_a_change_was_looked_at_keeps_both(tmp_path):
    async with commissioning_rig(tmp_path, {"how far shall": "4", "how far did": "8"}) as rig:
        checklist = await rig.checklist()
        await checklist.run("scale")
        late = checklist.change("scale")
        asked = []

        def approve(file, lines):
            asked.append(lines)
            rig.config.write_text(rig.config.read_text().replace("position_max = 18", "position_max = 12"))
            return "y"

        rig.person.script["write this"] = lambda: approve("", "")
        assert await ChecklistWalk(checklist, rig.person, "rig.toml", lambda _: None).offer("scale")
        with pytest.raises(ConfigError, match="changed meanwhile"):
            checklist.write(late)

        axis = load_config(rig.config).bus[0].axis[0]
        assert len(asked) == 2
        assert axis.limits.position_max == 12
        assert axis.counts_per_unit == pytest.approx(500, rel=0.01)


@pytest.mark.long
async def test_the_report_is_well_formed_and_has_the_numbers(tmp_path):
    script = {"how many": "3", "what falls": "none", "a remark": "<b>spring</b> & \x1b[2J"}
    async with commissioning_rig(tmp_path, script) as rig:
        checklist = await rig.checklist()
        await checklist.run("load")
        kept = await checklist.run("home")
        report = html_of(checklist.record, STEPS, rig.config.read_text(), "1.2", "now")

    page = ET.fromstring(report.partition("\n")[2])  # noqa: S314 - written here
    text = " ".join(page.itertext())
    assert f"{figures(kept)['spread']:.6g} mm" in text
    assert "<b>spring</b> & \\x1b[2J" in text
    assert "counts_per_unit = 1000 # as ordered" in text
    assert len(list(page.iter("svg"))) == 1
    assert len(list(page.iter("circle"))) == 3
    assert "http" not in report
    assert "<script" not in report


async def test_a_drive_that_takes_no_motion_over_its_line_has_the_steps_that_ask(tmp_path):
    config = tmp_path / "rig.toml"
    shutil.copy(ROOT / "config" / "mixed.toml", config)
    async with running_rig(load_config(config).model_copy(update={"state_dir": tmp_path})) as running:
        rig = Rig(running.client, await running.client.daemon())
        answers = {"what falls": "brake", "a remark": "", "are the gains of feed tuned": "y"}
        checklist = Checklist(rig, config, "feed", ScriptedPerson(answers), by="ada")
        await checklist.refresh()
        await checklist.run("load")
        await checklist.run("gains")

        assert checklist.next_open() is None
        states = {name: checklist.record.of(name).result.state for name in STEPS}
        assert (states.pop("load"), states.pop("gains")) == (StepState.DONE, StepState.DONE)
        assert set(states.values()) == {StepState.NOT_POSSIBLE}
        assert "a smartstep has no" in checklist.record.of("motor").result.text


async def test_a_configuration_that_a_scan_has_begun_gets_unit_scale_and_soft_gains(tmp_path):
    text = rig_text()
    text = text.replace('unit = "mm"\ncounts_per_unit = 1000 # as ordered\nd', 'unit = "count" # your unit\nd')
    text = re.sub(r"velocity = 10\nacceleration = 100\nlimits.*\ngains.*\nhome.*", VELOCITIES, text)
    script = {"unit of the axis": "mm", "counts of one mm": "1000", "of its moves": "", "reference position": "index"}
    async with commissioning_rig(tmp_path, script, text=text) as rig:
        checklist = await rig.checklist()
        impossible = checklist.record.of("motor").result
        kept = await checklist.run("settings")
        change = checklist.change("settings")
        checklist.write(change)
        told = await checklist.refresh()

    assert impossible.state is StepState.NOT_POSSIBLE
    assert kept.result.state is StepState.DONE
    assert change.restarts
    axis = load_config(rig.config).bus[0].axis[0]
    assert (axis.unit, axis.counts_per_unit, axis.velocity, axis.acceleration) == ("mm", 1000, 1, 5)
    assert axis.gains.model_dump(include=set(SOFT_GAINS)) == SOFT_GAINS
    assert (axis.home.method.value, axis.home.velocity) == ("index", 0.5)
    assert told == []
    assert checklist.record.of("motor").result.state is StepState.OPEN


@pytest.mark.parametrize(
    "form",
    [
        "gains = { kp = 350, kd = 3000, ki = 400, el = 4000 } # soft",
        "",
        "[bus.axis.gains]\nkp = 100\nel = 900",
    ],
    ids=["inline", "none", "table"],
)
def test_tuned_gains_are_written_as_the_one_table_of_the_axis(form, tmp_path):
    text = re.sub("gains = .*\n", "", rig_text())
    place = "home =" if form.startswith("gains") else "[[sim]]"
    text = text.replace(place, f"{form}\n{place}")
    config = tmp_path / "rig.toml"
    config.write_text(text)
    gains = {"kp": 721, "kd": 6000, "ki": 90, "il": 300, "ol": 250, "el": 3000, "sr": 1, "deadband": 0}
    change = change_of(config, AXIS, gain_proposals(gains))
    config.write_text(change.text)

    assert load_config(config).bus[0].axis[0].gains.model_dump(include=set(gains)) == gains
    assert change_of(config, AXIS, gain_proposals(gains)) is None
    assert change.restarts == tuple(f"gains.{name}" for name in gains)


def test_gains_come_before_what_needs_them():
    order = list(STEPS)

    assert order.index("motor") < order.index("gains") < order.index("speed")


async def test_settings_that_are_there_are_not_asked_for(tmp_path):
    async with commissioning_rig(tmp_path) as rig:
        checklist = await rig.checklist()

        assert checklist.record.of("settings").result.state is StepState.NOT_NEEDED
        assert checklist.next_open(after="load") == "motor"


@pytest.mark.long
async def test_an_axis_in_counts_has_no_scale_to_find(tmp_path):
    text = rig_text().replace('unit = "mm"\ncounts_per_unit = 1000 # as ordered\n', "")
    axis, rates, rest = text.partition("rates")
    axis = re.sub(r"(velocity|acceleration|position_min|position_max) = (-?[0-9.]+)", r"\1 = \g<2>000", axis)
    async with commissioning_rig(tmp_path, STANDS, text=axis + rates + rest) as rig:
        checklist = await rig.checklist()
        kept = await checklist.run("motor")

        assert kept.result.state is StepState.DONE
        assert checklist.record.of("scale").result.state is StepState.NOT_POSSIBLE
