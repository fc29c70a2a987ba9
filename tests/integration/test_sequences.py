"""Named positions and sequences of the centrifuge: carried out by a client, judged by the gate of the daemon."""

import asyncio
import json
import tomllib
from contextlib import asynccontextmanager

import pytest

from ldcnd.client.sequences import SequenceRun
from ldcnd.config.rig import RigConfig, load_config
from ldcnd.contract.commands import Halt, MoveVelocity, Power, Stop
from ldcnd.contract.errors import (
    CommandAborted,
    CommandExpired,
    ConfigError,
    InterlockViolated,
    LdcndError,
    RegisterUnknown,
    WrongState,
)
from ldcnd.contract.sequences import NamedPosition, SequenceConfig, SequenceStep
from ldcnd.drives.network import AdoptFallback, StartPolicy
from ldcnd.testing import run, simulated_rig
from tests.support.command_line import virtual_rig
from tests.support.process import ROOT

FILE = ROOT / "config" / "centrifuge.toml"
CENTRIFUGE = load_config(FILE)
SEQUENCES = {each.name: each for each in CENTRIFUGE.sequence}
POSITIONS = {each.name: each for each in CENTRIFUGE.position}
JAMMED = 4
"""Line of the sensor of the closed door."""


def machine(program):
    """Run a program with the simulated rig and a function that makes a run of a sequence and its reports."""

    async def whole():
        async with simulated_rig(CENTRIFUGE) as rig:

            def made(sequence):
                reports = []
                return SequenceRun(rig.client, sequence, POSITIONS, reports.append, lambda: 0), reports

            async with asyncio.timeout(600):
                return await program(rig, made)

    return run(whole())


def speed(rig):
    return abs(rig.truth("rotor").velocity)


@pytest.mark.long
def test_a_whole_cycle_runs_and_is_recorded():
    async def program(rig, made):
        fastest = 0.0

        async def look():
            nonlocal fastest
            while True:
                fastest = max(fastest, speed(rig))
                await asyncio.sleep(0.05)

        async with asyncio.TaskGroup() as group:
            looking = group.create_task(look())
            for name in ("shut", "spin", "shut"):
                running, reports = made(SEQUENCES[name])
                await running.run()
                steps = range(1, len(SEQUENCES[name].step) + 1)
                assert [(each.step, each.event) for each in reports] == [
                    (step, event) for step in steps for event in ("begun", "done")
                ]
            looking.cancel()
        return fastest, await rig.client.latest("rotor", "position"), (await rig.client.holders()).holders

    fastest, position, holders = machine(program)

    assert fastest == pytest.approx(15.77, rel=0.01)  # 100 g at 0.1 m
    assert position.value == pytest.approx(0.1, abs=0.002)
    assert [each.client for each in holders] == [None]


@pytest.mark.long
def test_a_step_that_fails_ends_the_sequence_and_halts_what_moves():
    spin = SequenceStep(
        do="move_velocity",
        axis="rotor",
        arguments={"velocity": 5.0, "duration_s": 60.0},
        leave_running=True,
        timeout_s=5,
    )
    sequence = SequenceConfig(
        name="fails", step=(spin, SequenceStep(until={"door_open": True}, timeout_s=3), SequenceStep(go="bucket1"))
    )

    async def program(rig, made):
        await made(SEQUENCES["shut"])[0].run()
        await made(SequenceConfig(name="ready", step=SEQUENCES["spin"].step[:3]))[0].run()
        running, reports = made(sequence)
        with pytest.raises(WrongState, match=r"step 2, until door_open is true, is not over within 3 s: door_open is"):
            await running.run()
        await rig.at_rest("rotor")
        return reports, speed(rig)

    reports, left = machine(program)

    assert [(each.step, each.event) for each in reports][-2:] == [(2, "begun"), (2, "failed")]
    assert left < 0.05


def test_an_interlock_that_ends_a_motion_beside_later_steps_ends_the_sequence():
    spin = SequenceStep(
        do="move_velocity", axis="rotor", arguments={"velocity": 5.0, "duration_s": 60.0}, leave_running=True
    )
    sequence = SequenceConfig(name="spins", step=(spin, SequenceStep(pause_s=20.0), SequenceStep(standstill=["rotor"])))

    async def program(rig, made):
        await made(SEQUENCES["shut"])[0].run()
        await made(SequenceConfig(name="ready", step=SEQUENCES["spin"].step[:3]))[0].run()
        running, reports = made(sequence)
        rig.faults.input_stuck("door_ajar", high=False, after_s=5.0)
        with pytest.raises(WrongState, match=r"axis rotor: .*door_shut.*; sequence spins ends"):
            await running.run()
        return [(each.step, each.event) for each in reports]

    assert machine(program) == [(1, "begun"), (1, "done"), (2, "begun"), (2, "stopped")]


def test_the_gate_of_the_daemon_judges_each_step():
    async def program(rig, made):
        running, reports = made(SequenceConfig(name="ready", step=SEQUENCES["spin"].step[:3]))
        await made(SEQUENCES["shut"])[0].run()
        await running.run()
        opened = SequenceConfig(name="opens", step=(*SEQUENCES["spin"].step[-2:], SequenceStep(go="bucket2")))
        running, reports = made(opened)
        with pytest.raises(InterlockViolated, match="door_shut"):
            await running.run()
        return reports

    assert machine(program)[-1].event == "failed"


@pytest.mark.parametrize("when_s", [0.5, 3.0, 14.0])
@pytest.mark.sweep(2)
def test_a_stop_halts_what_moves_and_a_pause_does_not(when_s):
    async def program(rig, made):
        await made(SEQUENCES["shut"])[0].run()
        running, reports = made(SEQUENCES["spin"])
        running.going.clear()
        task = asyncio.ensure_future(running.run())
        await asyncio.sleep(2)
        assert [each.event for each in reports] == ["paused"]
        running.going.set()
        await asyncio.sleep(when_s)
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task
        await rig.at_rest("rotor")
        return reports

    reports = machine(program)

    assert reports[-1].event == "stopped"


def test_what_would_begin_with_a_motion_leaves_a_motion_of_another_as_it_is():
    async def program(rig, made):
        await made(SEQUENCES["shut"])[0].run()
        async with rig.client.control("rotor", client="another") as rotor:
            await rotor.power(on=True)
            await (await rotor.home()).done()
        await rig.client.client.command("rotor", MoveVelocity(velocity=5.0))
        await asyncio.sleep(8)
        go = SequenceConfig(name="go", step=(SequenceStep(go=CENTRIFUGE.position[0].name),))
        for wanted in (go, SEQUENCES["spin"]):
            with pytest.raises(WrongState, match="has begun nothing"):
                await made(wanted)[0].run()
        await asyncio.sleep(3)
        return speed(rig)

    assert machine(program) == pytest.approx(5.0, abs=0.1)


@pytest.mark.promise("outputs-by-command")
def test_an_output_that_is_set_as_soon_as_its_module_is_within_reach_again_keeps_what_it_was_set_to(tmp_path):
    """Its drive had no power, and the line ends there: it has kept its own, and answers before its lines are read."""
    config = tmp_path / "rig.toml"
    pin = 'pin = { line = 9, start = "low", reset = "low"'
    text = FILE.read_text(encoding="utf-8")
    assert pin in text
    config.write_text(text.replace(pin, f'{pin}, loss = {{ bus = "high" }}'), encoding="utf-8")

    async def program():
        async with simulated_rig(load_config(config)) as rig, rig.client.control("rotor", client="a person"):
            await asyncio.sleep(45)
            rig.faults.power_loss("rotor", for_s=3)
            await asyncio.sleep(1)
            refused = set()
            async with asyncio.timeout(60):
                while True:
                    try:
                        await rig.client.set_io("cabinet", low=["pin"])
                        break
                    except LdcndError as error:
                        refused.add(error.message)
                    await asyncio.sleep(0.05)
            await asyncio.sleep(5)
            return refused, rig.module_truth("cabinet").outputs["pin"]

    refused, pin_is_high = run(program())

    assert "module cabinet was out of reach: its output pin gets its level of loss.bus first" in refused
    assert not pin_is_high


@pytest.mark.long
def test_it_is_typed_and_taught(monkeypatch, tmp_path):
    config = tmp_path / "rig.toml"
    config.write_text(FILE.read_text(encoding="utf-8"), encoding="utf-8")
    with virtual_rig(monkeypatch, CENTRIFUGE) as rig:
        rig.wait(asyncio.sleep(1))
        record = tmp_path / "record.jsonl"
        unhomed = rig.run(f"position teach {config} there rotor")
        ran = [
            rig.run(line)
            for line in (
                f"sequence run {config} spin --record {record}",
                f"sequence run {config} shut",
                f"position go {config} bucket2",
                f"position teach {config} here rotor",
                f"position go {config} --list",
                f"sequence run {config} --list",
            )
        ]
        refused = rig.run(f"sequence run {config} shutt")
        jammed = SequenceStep(until={"door_open": True}, timeout_s=1)
        config.write_text(config.read_text() + f'\n[[sequence]]\nname = "waits"\nstep = [{_toml(jammed)}]\n')
        failed = rig.run(f"sequence run {config} waits")

    assert unhomed.code == 1
    assert "home it first" in unhomed.errors
    assert [each.code for each in ran] == [0] * 6, ran
    assert (
        "  8/8  door high, until door_closed is false, until door_ajar is true, until door_open is true: done in "
        in ran[0].printed
    )
    assert [json.loads(line)["event"] for line in record.read_text().splitlines()] == ["begun", "done"] * 8
    taught = {each["name"]: each["axes"] for each in tomllib.loads(config.read_text())["position"]}
    assert taught["here"]["rotor"] == pytest.approx(0.6, abs=0.002)
    assert "here             rotor 0.6" in ran[4].printed
    assert (refused.code, "did you mean 'shut'?" in refused.errors) == (1, True)
    assert failed.code == 1
    assert "door_open is false" in failed.errors


def test_numbers_of_a_file_go_to_no_rig_that_understands_them_otherwise(monkeypatch, tmp_path):
    """The daemon has millimetres, and one file of it centimetres by now; the other one is of another rig."""
    text = (ROOT / "config" / "simulated.toml").read_text(encoding="utf-8")
    text += '\n[[position]]\nname = "park"\naxes = { x = 1 }\n'
    text += '\n[[sequence]]\nname = "out"\nstep = [{ go = "park" }]\n'
    here = tmp_path / "rig.toml"
    here.write_text(text, encoding="utf-8")
    changed = {
        "unit": text.replace('unit = "mm"', 'unit = "cm"', 1),
        "rig": text.replace('rig = "sim"', 'rig = "cell"', 1),
    }
    with virtual_rig(monkeypatch, load_config(here)) as rig:
        rig.wait(asyncio.sleep(2))
        for line in ("power on x", "axis set-position x 0"):
            assert rig.run(line).code == 0
        refused = {}
        for what, other in changed.items():
            assert other != text
            here.write_text(other, encoding="utf-8")
            for words in ("position go {} park", "sequence run {} out", "position teach {} there x"):
                refused[what, words] = rig.run(words.format(here))
        here.write_text(text, encoding="utf-8")
        place = rig.run("list --json").printed
        went = rig.run(f"position go {here} park")

    for (what, _), each in refused.items():
        assert each.code == 1, each
        assert ("its unit" if what == "unit" else "is of rig cell") in each.errors
    assert json.loads(place.splitlines()[0])["position"] == pytest.approx(0.0, abs=0.01)
    assert went.code == 0


def test_a_place_of_fine_counts_is_taught_to_the_count(monkeypatch, tmp_path):
    config = tmp_path / "rig.toml"
    config.write_text("""
rig = "fine"
[[sim]]
name = "line0"
module = [{ model = "ls-182ap" }]
[[bus]]
name = "line0"
port = "sim:line0"
baud = 115200
[[bus.axis]]
name = "x"
address = 1
model = "ls-182ap"
unit = "m"
counts_per_unit = 50_000_000
velocity = 4e-4
acceleration = 4e-3
gains = { kp = 350, kd = 3000, ki = 400, il = 400, ol = 250, el = 4000 }
""")
    with virtual_rig(monkeypatch, load_config(config)) as rig:
        rig.wait(asyncio.sleep(2))
        lines = ("power on x", "axis set-position x 0", "move x 0.0001234 --wait", f"position teach {config} here x")
        ran = [rig.run(line) for line in lines]
        stands = rig.wait(rig.rig.client.position("x")).value

    assert [each.code for each in ran] == [0] * 4, ran
    (taught,) = tomllib.loads(config.read_text())["position"]
    assert taught["axes"]["x"] == pytest.approx(stands, abs=2 / 50_000_000)


def _toml(step):
    return f"{{ until = {{ door_open = true }}, timeout_s = {step.timeout_s:g} }}"


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('go = "bucket1"', 'go = "bucket3"', "sequence spin: step 6: there is no position 'bucket3'"),
        ("axes = { rotor = 0.1 }", "axes = { lid = 0.1 }", "position bucket1: there is no axis 'lid'"),
        (
            "{ pin = false,",
            "{ pim = false,",
            "sequence shut: step 2: there is no output 'pim'; there are: cabinet.LINE, door",
        ),
        (
            'velocity = "100 g"',
            'velocity = "100 mm/s"',
            "sequence[1].step[3].arguments.velocity: \u201cmm/s\u201d",
        ),
        ('velocity = "100 g", ', "", "sequence spin: step 4: move_velocity needs velocity"),
        ("arguments = { on = true }", "arguments = { off = true }", "power has no off and needs on"),
        (
            "axes = { rotor = 0.6 }",
            'axes = { rotor = "0.6 mm" }',
            "position[1].axes.rotor: \u201cmm\u201d is not",
        ),
    ],
)
def test_what_cannot_be_carried_out_is_refused_with_the_configuration(tmp_path, old, new, said):
    config = tmp_path / "rig.toml"
    text = FILE.read_text(encoding="utf-8")
    assert old in text
    config.write_text(text.replace(old, new, 1), encoding="utf-8")

    with pytest.raises(ConfigError) as refused:
        load_config(config)

    assert said in refused.value.message


def test_axes_go_to_a_position_one_after_the_other_in_the_order_of_the_configuration(tmp_path):
    config = tmp_path / "rig.toml"
    text = (ROOT / "config" / "simulated.toml").read_text(encoding="utf-8")
    config.write_text(text + '\n[[position]]\nname = "park"\naxes = { y = "1 cm", x = 2 }\n', encoding="utf-8")
    wanted = load_config(config)
    go = SequenceConfig(name="park", step=(SequenceStep(go="park"),))

    async def program():
        async with simulated_rig(wanted) as rig:
            async with rig.client.control("x", "y", client="test") as axes:
                for axis in axes:
                    await axis.set_position(0.0)
                    await axis.power(on=True)
            async with rig.client.events() as events:
                await SequenceRun(rig.client, go, {"park": wanted.position[0]}, lambda _: None, lambda: 0).run()
                ended = [await anext(events) for _ in range(6)]
            there = [(await rig.client.latest(axis, "position")).value for axis in "xy"]
            return [(each.axis, each.status.value) for each in ended], there

    order, there = run(program())

    assert order == [(axis, status) for axis in "yx" for status in ("accepted", "executing", "done")]
    assert there == pytest.approx([2.0, 10.0], abs=0.05)


@pytest.mark.parametrize(
    "doing",
    [SequenceStep(pause_s=5.0), SequenceStep(do="move_relative", axis="x", arguments={"distance": 20, "velocity": 4})],
)
def test_a_stop_of_an_axis_that_stands_ends_the_sequence_that_would_move_another(doing):
    later = SequenceStep(do="move_relative", axis="y", arguments={"distance": 2.0})

    async def program():
        async with simulated_rig(ROOT / "config" / "simulated.toml") as rig:
            async with rig.client.control("x", "y", client="test") as axes:
                for axis in axes:
                    await axis.set_position(0.0)
                    await axis.power(on=True)
            running = SequenceRun(
                rig.client, SequenceConfig(name="part", step=(doing, later)), {}, lambda _: None, lambda: 0
            )
            run_of_it = asyncio.create_task(running.run())
            await asyncio.sleep(1.0)
            await rig.client.client.command("y", Stop(client="anna"))
            with pytest.raises(WrongState, match="axis y was stopped; sequence part ends"):
                await run_of_it
            await rig.at_rest("x")
            return rig.truth("x").position, rig.truth("y").position

    x, y = run(program())

    assert (x < 10, y) == (True, pytest.approx(0.0, abs=0.05))


@pytest.mark.parametrize(
    ("ending", "said"), [(Halt(client="anna"), "halted"), (Power(on=False, client="anna"), "switched off")]
)
def test_a_halt_between_two_steps_ends_the_sequence(ending, said):
    steps = (SequenceStep(pause_s=1.5), SequenceStep(do="move_relative", axis="x", arguments={"distance": 2.0}))

    async def program():
        async with simulated_rig(ROOT / "config" / "simulated.toml") as rig:
            async with rig.client.control("x", client="test") as x:
                await x.set_position(0.0)
                await x.power(on=True)
            running = SequenceRun(rig.client, SequenceConfig(name="part", step=steps), {}, lambda _: None, lambda: 0)
            run_of_it = asyncio.create_task(running.run())
            await asyncio.sleep(1.0)
            await rig.client.client.command("x", ending)
            with pytest.raises(WrongState, match=f"axis x was {said} by anna; sequence part ends"):
                await run_of_it
            return rig.truth("x").position

    assert run(program()) == pytest.approx(0.0, abs=0.05)


@asynccontextmanager
async def two_axes():
    """Yield a rig of axes that stand at 0 with their loops closed."""
    async with simulated_rig(ROOT / "config" / "simulated.toml") as rig:
        async with rig.client.control("x", "y", client="test") as axes:
            for axis in axes:
                await axis.set_position(0.0)
                await axis.power(on=True)
        yield rig


HALTED = "axis x was halted by anna; sequence part ends"


@pytest.mark.parametrize("pause_s", [1.5, 60.0])
def test_a_halt_in_the_pause_of_the_last_step_ends_the_sequence_at_once(pause_s):
    step = SequenceStep(do="power", axis="x", arguments={"on": True}, pause_s=pause_s)

    async def program():
        async with two_axes() as rig:
            reports = []
            part = SequenceConfig(name="part", step=(step,))
            running = asyncio.create_task(SequenceRun(rig.client, part, {}, reports.append, lambda: 0).run())
            await asyncio.sleep(1.0)
            await rig.client.client.command("x", Halt(client="anna"))
            async with asyncio.timeout(0.2):
                with pytest.raises(WrongState, match=HALTED):
                    await running
            return [(each.event, each.reason) for each in reports]

    assert run(program()) == [("begun", None), ("failed", HALTED)]


def test_a_halt_of_another_axis_at_the_end_of_the_last_step_ends_the_sequence():
    steps = (
        SequenceStep(do="power", axis="x", arguments={"on": True}),
        SequenceStep(do="move_absolute", axis="y", arguments={"position": 4.0}),
    )

    async def program():
        async with two_axes() as rig:
            reports = []
            part = SequenceConfig(name="part", step=steps)
            running = asyncio.create_task(SequenceRun(rig.client, part, {}, reports.append, lambda: 0).run())
            while rig.truth("y").position < 3.9:
                await asyncio.sleep(0.01)
            await rig.client.client.command("x", Halt(client="anna"))
            with pytest.raises(WrongState, match=HALTED):
                await running
            return reports[-1]

    last = run(program())
    assert (last.step, last.event, last.reason) == (2, "failed", HALTED)


def test_a_halt_of_an_axis_whose_turn_is_yet_to_come_in_a_step_is_the_end_before_its_turn():
    park = NamedPosition(name="park", axes={"y": 4.0, "x": 2.0})

    async def program():
        async with two_axes() as rig:
            part = SequenceConfig(name="part", step=(SequenceStep(go="park"),))
            running = asyncio.create_task(
                SequenceRun(rig.client, part, {"park": park}, lambda _: None, lambda: 0).run()
            )
            while rig.truth("y").position < 3.9:
                await asyncio.sleep(0.01)
            await rig.client.client.command("x", Halt(client="anna"))
            with pytest.raises(WrongState, match=HALTED):
                await running
            await rig.at_rest("x")
            return rig.truth("x").position

    assert run(program()) == pytest.approx(0.0, abs=0.05)


def test_a_halt_just_before_a_step_goes_on_that_waits_is_the_end_of_it():
    step = SequenceStep(do="move_relative", axis="x", arguments={"distance": 2.0})

    async def program():
        async with two_axes() as rig:
            part = SequenceConfig(name="part", step=(step,))
            running = SequenceRun(rig.client, part, {}, lambda _: None, lambda: 0)
            running.going.clear()
            run_of_it = asyncio.create_task(running.run())
            await asyncio.sleep(1.0)
            await rig.client.client.command("x", Halt(client="anna"))
            running.going.set()
            with pytest.raises(WrongState, match=HALTED):
                await run_of_it
            await rig.at_rest("x")
            return rig.truth("x").position

    assert run(program()) == pytest.approx(0.0, abs=0.05)


def test_a_halt_just_before_outputs_are_written_leaves_them():
    async def program(rig, made):
        await made(SEQUENCES["shut"])[0].run()
        running, _ = made(SequenceConfig(name="opens", step=(SequenceStep(set={"unlock": True}),)))
        running.going.clear()
        run_of_it = asyncio.create_task(running.run())
        await asyncio.sleep(1.0)
        await rig.client.client.command("rotor", Halt(client="anna"))
        running.going.set()
        with pytest.raises(WrongState, match="axis rotor was halted by anna; sequence opens ends"):
            await run_of_it
        return rig.module_truth("cabinet").outputs["unlock"]

    assert not machine(program)


def test_a_sequence_goes_on_behind_its_own_halts():
    steps = (
        SequenceStep(do="move_velocity", axis="x", arguments={"velocity": 1.0}, leave_running=True, pause_s=1.0),
        SequenceStep(do="halt", axis="x"),
        SequenceStep(do="power", axis="x", arguments={"on": False}),
        SequenceStep(do="power", axis="x", arguments={"on": True}),
        SequenceStep(do="move_absolute", axis="x", arguments={"position": 2.0}),
    )

    async def program():
        async with two_axes() as rig:
            part = SequenceConfig(name="part", step=steps)
            await SequenceRun(rig.client, part, {}, lambda _: None, lambda: 0).run()
            return rig.truth("x").position

    assert run(program()) == pytest.approx(2.0, abs=0.05)


@pytest.mark.parametrize("calm", [Halt(client="anna"), Stop(client="anna"), Power(on=False, client="anna")])
def test_a_halt_while_control_is_asked_for_leaves_everything_where_it_is(calm, monkeypatch):
    step = SequenceStep(do="move_relative", axis="x", arguments={"distance": 2.0})

    async def program():
        async with simulated_rig(ROOT / "config" / "simulated.toml") as rig:
            async with rig.client.control("x", client="test") as x:
                await x.set_position(0.0)
                await x.power(on=True)
            controlled = rig.client.controlled

            @asynccontextmanager
            async def late(*asked, **how):
                await rig.client.client.command("x", calm)
                async with controlled(*asked, **how) as held:
                    yield held

            monkeypatch.setattr(rig.client, "controlled", late)
            running = SequenceRun(rig.client, SequenceConfig(name="part", step=(step,)), {}, lambda _: None, lambda: 0)
            with pytest.raises(CommandExpired, match="axis x: a stop, halt or power off came after this was asked"):
                await running.run()
            return rig.truth("x").position

    assert run(program()) == pytest.approx(0.0, abs=0.05)


@pytest.mark.parametrize("ending", [Halt(client="anna"), Power(on=False, client="anna")])
def test_a_sequence_that_somebody_else_ends_says_who_and_what_it_was_doing(ending):
    slow = {"velocity": 5.0, "acceleration": 10.0, "duration_s": 60.0}
    spin = SequenceStep(do="move_velocity", axis="rotor", arguments=slow)

    async def program(rig, made):
        await made(SEQUENCES["shut"])[0].run()
        await made(SequenceConfig(name="ready", step=SEQUENCES["spin"].step[:3]))[0].run()
        running, reports = made(SequenceConfig(name="spins", step=(spin, SequenceStep(go="bucket1"))))
        spinning = asyncio.create_task(running.run())
        while speed(rig) < 4.9:
            await asyncio.sleep(0.05)
        await rig.client.client.command("rotor", ending)
        with pytest.raises(CommandAborted, match=f"aborted by {ending.verb} of anna$"):
            await spinning
        return reports

    begun, failed = machine(program)

    assert begun.title == failed.title == "move velocity rotor at 300 rpm (10.06 g) with 10 rev/s² for 60 s"
    assert failed.event == "failed"
    assert failed.reason.endswith(f"aborted by {ending.verb} of anna")


@pytest.mark.parametrize("percent", [25, 100])
def test_a_step_that_a_speed_override_made_slower_says_so(percent):
    async def program(rig, made):
        await made(SEQUENCES["shut"])[0].run()
        await made(SequenceConfig(name="ready", step=SEQUENCES["spin"].step[:3]))[0].run()
        await asyncio.sleep(1)
        await rig.client.set_speed_override(percent)
        spin = SequenceStep(do="move_velocity", axis="rotor", arguments={"velocity": 5.0, "duration_s": 1.0})
        running, reports = made(SequenceConfig(name="spins", step=(spin,)))
        await running.run()
        return [(each.event, each.reason) for each in reports]

    slowed = "at a speed override of 25 %" if percent == 25 else None
    assert machine(program) == [("begun", None), ("done", slowed)]


def test_a_step_waits_for_no_value_that_was_read_before_its_module_fell_silent():
    async def program(rig, made):
        await asyncio.sleep(1)
        shut = SequenceStep(until={"door_closed": True}, timeout_s=20)
        running, _ = made(SequenceConfig(name="shut", step=(shut,)))
        waiting = asyncio.create_task(running.run())
        await asyncio.sleep(0)
        rig.faults.module_power_loss("cabinet", for_s=5)
        began_s = asyncio.get_running_loop().time()
        await waiting
        return asyncio.get_running_loop().time() - began_s

    assert machine(program) > 5


def test_steps_are_called_by_what_they_command():
    units = {axis.name: axis.axis_units for bus in CENTRIFUGE.bus for axis in bus.axis}
    titles = [
        step.title(units, POSITIONS)
        for step in (
            SequenceStep(do="power", axis="rotor", arguments={"on": False}),
            SequenceStep(do="move_absolute", axis="rotor", arguments={"position": 0.25, "velocity": 0.5}),
            SequenceStep(do="set_gains", axis="rotor", arguments={"kp": 100.0}),
            SequenceStep(go="bucket2"),
            SequenceStep(name="by hand", go="bucket2"),
        )
    ]

    assert titles == [
        "power rotor off",
        "move absolute rotor to 0.25 rev at 30 rpm (0.1006 g)",
        "set gains rotor kp 100",
        "go to bucket2 (rotor 0.6 rev)",
        "by hand",
    ]


def taken_over(sequence, config=CENTRIFUGE):
    """Run a sequence behind a daemon that was killed while the rotor stood; return levels, and the error if any."""
    (line,) = config.bus
    line = line.model_copy(update={"start": StartPolicy.ADOPT, "adopt_fallback": AdoptFallback.RESET})

    async def program():
        async with simulated_rig(config.model_copy(update={"bus": (line,)})) as rig:
            await asyncio.sleep(45)
            await rig.client.set_io("cabinet", low=(9, 10, 11))
            await rig.kill_daemon()
            await asyncio.sleep(2)
            await rig.start_daemon()
            await asyncio.sleep(45)
            error = None
            try:
                await SequenceRun(rig.client, sequence, POSITIONS, lambda _: None, lambda: 0).run()
                await asyncio.sleep(1)
            except LdcndError as raised:
                error = raised
            return rig.module_truth("cabinet"), error

    return run(program())


def test_the_door_is_shut_by_its_sequence_behind_a_daemon_that_took_its_outputs_over():
    truth, error = taken_over(SEQUENCES["shut"])
    assert error is None
    assert (truth.parts["door"], truth.parts["lock"]) == (0.0, 1.0)


def test_a_sequence_that_leaves_out_an_output_that_is_not_known_is_told_all_of_them_at_once():
    step = SequenceStep(set={"pin": False})
    _, error = taken_over(SequenceConfig(name="one", step=(step,)))
    assert isinstance(error, RegisterUnknown)
    assert "outputs door (line 10), unlock (line 11)" in error.message
    (named,) = error.remedy.steps
    assert {*named.arguments["low"]} == {"pin", "door", "unlock"}


def test_a_line_without_a_name_is_named_by_its_number():
    data = tomllib.loads(FILE.read_text(encoding="utf-8"))
    (module,) = data["bus"][0]["module"]
    module["outputs"] = [9, 10, 11]
    del data["interlock"], data["sequence"]
    levels = {"cabinet.9": True, "cabinet.10": False, "cabinet.11": False}
    data["sequence"] = [{"name": "free", "step": [{"set": levels}]}]
    config = RigConfig.model_validate(data)
    truth, error = taken_over(config.sequence[0], config)
    assert error is None
    assert truth.parts["pin"] == 1.0

    for wrong in ("cabinet.x", "cupboard.9"):
        data["sequence"][0]["step"] = [{"set": {wrong: True}}]
        with pytest.raises(ValueError, match=f"there is no output '{wrong}'.*cabinet.LINE"):
            RigConfig.model_validate(data)
