"""The Python client against a whole daemon: control, verbs, ends of motions, loss of control, cancellation."""

import ast
import asyncio
import errno
import inspect
import json
import os
import pydoc
import sys
import threading
import warnings
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager, suppress
from pathlib import Path

import pytest

import ldcnd
from ldcnd.client import blocking
from ldcnd.client.axis import Axis, at_rest
from ldcnd.client.loop_thread import loop_thread
from ldcnd.client.rig import Rig
from ldcnd.client.rig_client import RigClient
from ldcnd.contract.catalogue import COMMANDS
from ldcnd.contract.commands import About, Halt
from ldcnd.contract.errors import (
    ERRORS,
    CommandAborted,
    LeaseExpired,
    LeaseHeld,
    MalformedRequest,
    SessionError,
    UnknownAxis,
)
from ldcnd.contract.events import CommandStatus
from ldcnd.contract.leases import Acquire
from ldcnd.contract.samples import AxisState, LinkState, Moving, Quality
from ldcnd.daemon.assembly import build_daemon
from ldcnd.daemon.daemon import Daemon
from ldcnd.testing.memory_session import MemoryBroker
from tests.support.process import ROOT, answering, daemon, process
from tests.support.rig import EPOCH_NS, RunningRig, running_rig, two_axes
from tests.support.session_pair import free_endpoint
from tools.client_reference import client_reference
from tools.verb_methods import method_name, verb_methods, with_blocking_methods

CLIENT = ROOT / "ldcnd" / "client"


@asynccontextmanager
async def client_rig() -> AsyncIterator[tuple[RunningRig, Rig]]:
    async with running_rig() as running:
        for name in running.daemon.rig.axes:
            await running.until(name, lambda state: state.link is LinkState.UP)
        yield running, Rig(running.client, await running.client.daemon())


def test_every_command_of_an_axis_is_a_method_of_both_clients():
    names = {method_name(command) for command in COMMANDS if command.about is About.AXIS}

    assert names <= set(dir(Axis))
    assert names <= set(dir(blocking.BlockingAxis))


@pytest.mark.parametrize("kind", [Axis, blocking.BlockingAxis])
def test_help_shows_the_arguments_of_a_verb_with_what_they_mean(kind):
    parameters = inspect.signature(kind.move_absolute).parameters
    shown = pydoc.render_doc(kind.move_absolute, renderer=pydoc.plaintext)

    assert [str(parameters[name]) for name in ("position", "velocity")] == [
        "position: float | str",
        "velocity: float | str | None = None",
    ]
    assert "velocity: Speed in units a second" in shown


@pytest.mark.parametrize(
    ("given", "named", "said"),
    [
        ((), {}, "missing 1 required positional argument: 'position'"),
        ((1, 2), {}, "takes 2 positional arguments but 3 were given"),
        ((1,), {"speed": 2}, "got an unexpected keyword argument 'speed'"),
    ],
)
def test_wrong_arguments_of_a_verb_are_refused_where_it_is_called_and_not_where_it_is_awaited(given, named, said):
    assert inspect.iscoroutinefunction(Axis.move_absolute)
    with pytest.raises(TypeError, match=rf"move_absolute\(\) {said}"):
        Axis.move_absolute(object(), *given, **named)


@pytest.mark.long
def test_the_methods_are_those_that_the_commands_make():
    written = (CLIENT / "verbs.py").read_text()
    blocks = (CLIENT / "blocking.py").read_text()

    assert _class_of(written) == _class_of(verb_methods()), "run `make fix`"
    assert blocks == with_blocking_methods(blocks), "run `make fix`"


def _class_of(module: str) -> str:
    return next(ast.dump(node) for node in ast.parse(module).body if isinstance(node, ast.ClassDef))


def test_no_call_of_the_asyncio_client_is_missing_from_the_blocking_one():
    for theirs, ours in ((Axis, blocking.BlockingAxis), (Rig, blocking.BlockingRig)):
        public = {name for name, _ in inspect.getmembers(theirs) if not name.startswith("_")}
        inner = {
            "watched",
            "controlled",
            "news",
            "halt_now",
            "halt_unfinished",
            "begin",
            "begun",
            "client",
            "lost",
            "outcome",
            "under_way",
            "follow_descriptions",
        }
        assert public - inner <= set(dir(ours)), theirs


def test_the_reference_is_made_of_the_docstrings():
    page = (ROOT / "docs" / "reference" / "python.md").read_text()

    assert page == client_reference(), "run `make fix`"


def test_what_is_promised_at_the_top_is_there():
    named = {name: getattr(ldcnd, name) for name in dir(ldcnd)}

    assert set(ERRORS.values()) <= set(named.values())
    assert {"Axis", "AxisState", "LinePath", "Memory", "PositionSample", "TraceTrigger", "connect", "open"} <= set(
        named
    )
    assert not {"Halt", "MoveAbsolute"} & set(named)  # an axis has a method for each
    with pytest.raises(AttributeError, match="unknown"):
        ldcnd.unknown  # noqa: B018


async def test_a_program_moves_an_axis_and_waits_for_its_end():
    async with client_rig() as (_, rig), rig.control("x", client="ann") as x:
        await x.power(on=True)
        move = await x.move_absolute(5, velocity=5)
        steps = [step async for step in move]
        state = await move.done()
        position = x.position

    assert (state.state, state.moving) == (AxisState.STANDSTILL, Moving.NO)
    assert float(position) == pytest.approx(5.0, abs=0.01)
    assert (position.unit, position.quality) == ("mm", Quality.GOOD)
    assert steps[0].left > steps[-1].left
    assert str(position).startswith("5.0")
    assert repr(move) == "<move_absolute of x to 5: ended>"


async def test_positions_come_to_several_readers():
    async with client_rig() as (_, rig), rig.watch("x") as x:
        first, second = x.positions(), x.positions()
        async with asyncio.timeout(5):
            samples = [(await anext(first)).seq for _ in range(3)]
            assert samples == [(await anext(second)).seq for _ in range(3)]


async def test_a_motion_that_is_stopped_is_an_error_where_the_program_waits():
    async with client_rig() as (_, rig), rig.control("x", client="ann") as x:
        await x.power(on=True)
        move = await x.move_absolute(50, velocity=1)
        await rig.stop()
        with pytest.raises(CommandAborted, match="aborted"):
            await move.done()


async def test_a_value_that_a_command_cannot_have_is_refused_before_it_is_sent():
    async with client_rig() as (_, rig), rig.control("x", client="ann") as x:
        with pytest.raises(MalformedRequest, match="velocity"):
            await x.move_absolute(1, velocity=-1)


async def test_a_program_goes_on_with_the_daemon_that_follows_a_restart():
    broker = MemoryBroker()

    @asynccontextmanager
    async def life(instance: str) -> AsyncIterator[Daemon]:
        async with broker.session() as session, asyncio.TaskGroup() as group:
            made = build_daemon(two_axes(), session, lambda: EPOCH_NS, instance)
            running = group.create_task(made.run(), name=instance)
            async with asyncio.timeout(60):
                while any(axis.tracker.status.link is not LinkState.UP for axis in made.rig.axes.values()):
                    await asyncio.sleep(0.05)
            yield made
            made.end()
            await running

    async with broker.session() as session:
        client = RigClient(session, "sim")
        async with AsyncExitStack() as watching:
            async with life("first") as first:
                rig = Rig(client, await client.daemon())
                y = await watching.enter_async_context(rig.watch("y"))
                with pytest.raises(LeaseExpired):  # noqa: PT012 - raised where the program waits
                    async with rig.control("x", client="ann") as x:
                        await x.power(on=True)
                        first.end()
                        await asyncio.sleep(60)
            positions = y.positions()
            async with life("second"), rig.control("x", client="ann") as x:
                await x.power(on=True)
                await (await x.move_relative(1)).done()
                assert (await anext(positions)).quality is Quality.GOOD


async def test_control_that_is_taken_away_is_an_error_where_the_program_waits():
    async with client_rig() as (running, rig):
        with pytest.raises(LeaseExpired):  # noqa: PT012
            async with rig.control("x", client="ann") as x:
                await running.client.ask(Acquire(client="bob", axes=("x",), force=True))
                await asyncio.sleep(60)
        assert x.control.lost

        with pytest.raises(LeaseHeld):
            async with rig.control("x", client="ann"):
                pass


async def test_a_wait_that_is_cancelled_halts_the_axis():
    async with client_rig() as (running, rig), rig.control("x", client="ann") as x:
        await x.power(on=True)
        move = await x.move_absolute(50, velocity=5)
        with pytest.raises(TimeoutError):
            async with asyncio.timeout(1):
                await move.done()
        await running.until("x", lambda state: state.moving is Moving.NO)
        outcome = await rig.outcome(move.command_id)

    assert outcome.status is CommandStatus.ABORTED


async def test_an_iteration_over_a_motion_halts_the_axis_when_it_is_cancelled_and_not_when_it_is_left():
    async with client_rig() as (running, rig), rig.control("x", client="ann") as x:
        await x.power(on=True)
        left = await x.move_absolute(5, velocity=5)
        async for _ in left:
            break
        state = await left.done()
        move = await x.move_absolute(50, velocity=5)
        with suppress(TimeoutError):
            async with asyncio.timeout(1):
                async for _ in move:
                    pass
        await running.until("x", lambda state: state.moving is Moving.NO)
        outcome = await rig.outcome(move.command_id)

    assert state.position == pytest.approx(5, abs=0.02)
    assert (outcome.status, "halt" in outcome.reason) == (CommandStatus.ABORTED, True)


async def test_an_error_of_the_program_halts_what_it_moved():
    async with client_rig() as (running, rig):
        with pytest.raises(ZeroDivisionError):  # noqa: PT012
            async with rig.control("x", client="ann") as x:
                await x.power(on=True)
                move = await x.move_absolute(50, velocity=5)
                raise ZeroDivisionError
        await running.until("x", lambda state: state.moving is Moving.NO)
        outcome = await rig.outcome(move.command_id)

    assert (outcome.status, "halt" in outcome.reason) == (CommandStatus.ABORTED, True)


async def test_a_cancelled_wait_without_control_halts_nothing():
    async with client_rig() as (running, rig), rig.control("x", client="ann") as x:
        await x.power(on=True)
        move = await x.move_absolute(50, velocity=5)
        x.control.lost = LeaseExpired("taken away")
        with pytest.raises((TimeoutError, LeaseExpired)):
            async with asyncio.timeout(1):
                await move.done()
        assert (await running.client.state("x")).moving is Moving.YES
        x.control.lost = None
        await running.client.command("x", Halt())


async def test_several_axes_and_questions_under_one_lease():
    async with client_rig() as (_, rig), rig.control("x", "y", client="ann") as (x, y):
        assert (x.name, y.name) == ("x", "y")
        why = await x.why()
        held = {holder.axis: holder.client for holder in (await rig.holders()).holders}

    assert [cause.code for cause in why.causes if cause.code.startswith("lease")] == []
    assert (held["x"], held["y"], held["z"]) == ("ann", "ann", None)


async def test_an_unknown_axis_is_named_with_those_that_there_are():
    async with client_rig() as (_, rig):
        with pytest.raises(UnknownAxis, match="x, y, z, c"):
            async with rig.watch("nowhere"):
                pass


@pytest.mark.real_time
@pytest.mark.long
async def test_the_first_program_runs(tmp_path: Path):
    program = """
        import asyncio, ldcnd

        async def main() -> None:
            async with ldcnd.connect() as rig:
                async with rig.control("x", client="demo") as x:
                    await x.power(on=True)
                    move = await x.move_absolute(5, velocity=5)
                    await move.done()
                    print(x.position, x.state)
                    async for sample in x.positions():
                        print(sample.value)
                        break

        asyncio.run(main())
    """
    async with daemon(ROOT / "config" / "simulated.toml") as endpoint:
        printed = await run_program(inspect.cleandoc(program), endpoint)
        quietly = """
            import ldcnd

            with ldcnd.connect_blocking() as rig, rig.control("y", client="demo") as y:
                y.power(on=True)
                move = y.move_absolute(2, velocity=5)
                print(len(list(move)) > 1)
                move.done()
                print(all(word in move._repr_html_() for word in ("move_absolute of y: ended", "<td>target</td>")))
                trace = y.take_trace("position", samples=20)
                print(trace._repr_html_().count("<svg"), len(trace.table()["offset_ns"]), len(repr(trace)) < 2000)
                print(y.position, y)
                print(next(y.positions()).unit, "<td>x</td>" in rig._repr_html_())
                with y.jogging(5) as jog:
                    while y.position.value < 2.5:
                        jog.held()
                print("jogged")
        """
        blocked = await run_program(inspect.cleandoc(quietly), endpoint)
        async with process("axis", "at", "y", "--ago", "0.1", "--json", "-e", endpoint) as asked:
            assert asked.stdout
            was = json.loads(await asked.stdout.read())

    assert float(printed[0].split()[0]) == pytest.approx(5.0, abs=0.05)
    assert "mm (" in printed[0]
    assert "standstill (" in printed[0]
    assert float(printed[1]) == pytest.approx(5.0, abs=0.05)
    assert blocked[:3] == ["True", "True", "1 20 True"]
    assert float(blocked[3].split()[0]) == pytest.approx(2.0, abs=0.05)
    assert blocked[4].endswith("True")
    assert blocked[5] == "jogged"
    assert was["position"]["lower"] <= was["position"]["value"] <= was["position"]["upper"]
    assert 2.4 < was["position"]["value"] < 10


@pytest.mark.real_time
@pytest.mark.parametrize("closing", ["x.close(); x.close(); rig.close()", "rig.close(); x.close(); rig.close()", ""])
async def test_what_a_notebook_opens_ends_with_its_close_or_with_that_of_its_rig(closing):
    program = f"""
        import ldcnd

        rig = ldcnd.open()
        x = rig.control("x", client="notebook").open()
        x.power(on=True)
        x.move_absolute(40, velocity=2)
        {closing}
        print("closed")
    """
    async with daemon(ROOT / "config" / "simulated.toml") as endpoint:
        printed = await run_program(inspect.cleandoc(program), endpoint)
        async with ldcnd.connect(endpoint) as rig, rig.watch("x") as x:
            await at_rest(x)
            assert not x.state.sample.holder
            assert x.position.value < 20

    assert printed == ["closed"]


@pytest.mark.real_time
def test_what_cannot_be_opened_is_an_error_and_leaves_no_thread():
    with pytest.raises(SessionError), blocking.connect(free_endpoint()):
        pass

    assert not [thread for thread in threading.enumerate() if thread.name.startswith("ldcnd client")]


def test_a_thread_that_cannot_have_a_loop_is_an_error(monkeypatch):
    def none_left():
        raise OSError(errno.EMFILE, "too many open files")

    monkeypatch.setattr(asyncio.events, "new_event_loop", none_left)

    with pytest.raises(OSError, match="too many"), loop_thread():
        pass


async def test_control_that_is_left_in_mid_motion_says_so():
    async with client_rig() as (_, rig):
        with pytest.warns(ldcnd.UnfinishedMotion, match=r"axis x: move_absolute to 30 was under way .* was aborted: "):
            await begin_to_move(rig)
        async with rig.watch("x") as x:
            while x.state.moving is not Moving.NO:
                await x.news(1.0)
            assert 0 < x.position.value < 10


async def begin_to_move(rig: Rig) -> None:
    async with rig.control("x", client="ann") as x:
        await x.power(on=True)
        await x.move_absolute(30, velocity=5)
        await asyncio.sleep(0.5)


async def test_control_whose_motions_have_ended_is_left_without_a_word():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        async with client_rig() as (_, rig), rig.control("x", "y", client="ann") as (x, y):
            await x.power(on=True)
            await y.power(on=True)
            await (await x.move_absolute(2)).done()
            moved = await y.move_absolute(2)
            async for _ in moved:
                pass


async def test_telemetry_and_events_are_iterated_over_with_and_without_a_context():
    async with client_rig() as (_, rig), rig.control("x", client="ann") as x:
        async for axis, sample in rig.samples("x", "position"):
            first = axis, sample.unit
            break
        async with rig.samples("x", "state") as states:
            _, state = await anext(states)
        async with asyncio.TaskGroup() as group:
            follower = group.create_task(first_event(rig))
            await asyncio.sleep(0.1)
            await x.power(on=True)
        event = follower.result()

    assert first == ("x", "mm")
    assert state.state is AxisState.DISABLED
    assert (event.axis, event.verb) == ("x", "power")


async def first_event(rig: Rig) -> ldcnd.CommandEvent:
    async for event in rig.events("x"):
        return event
    raise AssertionError("it is endless")


@pytest.mark.real_time
@pytest.mark.long
async def test_a_program_waits_for_a_daemon_that_starts_and_may_leave_it_open():
    endpoint = free_endpoint()
    program = """
        import ldcnd
        rig = ldcnd.open(wait_s=30)
        x = rig.control("x", client="demo").open()
        x.power(on=True)
        for axis, sample in rig.samples(item="state"):
            print(axis in rig.axes, type(sample) is ldcnd.StateSample)
            break
        with rig.events("x", history=True) as events:
            print(next(events).verb)
        other = ldcnd.open()
        other.close()
        other.close()
        x.move_absolute(90)  # and the end of the program gives up control
    """
    running = asyncio.create_task(run_program(inspect.cleandoc(program), endpoint))
    await asyncio.sleep(2)
    async with process("run", "--config", str(ROOT / "config" / "simulated.toml"), "--listen", endpoint) as started:
        await answering(started, endpoint)
        printed = await running

    assert printed == ["True True", "power"]


async def run_program(text: str, endpoint: str) -> list[str]:
    process = await asyncio.create_subprocess_exec(
        sys.executable, "-c", text, stdout=-1, stderr=-1, env={**os.environ, "LDCND_CONNECT": endpoint}
    )
    async with asyncio.timeout(45):
        printed, said = await process.communicate()
    assert process.returncode == 0, said
    assert b"Traceback" not in said
    return printed.decode().splitlines()
