"""Plans of a real RunEngine on a whole daemon: what they record, and how they end when something goes wrong."""

import asyncio
import math
import threading
from contextlib import AsyncExitStack, contextmanager, suppress

import bluesky.plan_stubs as bps
import bluesky.plans as bp
import pytest
from bluesky import protocols
from bluesky.preprocessors import monitor_during_wrapper
from bluesky.suspenders import (
    SuspendBoolHigh,
    SuspendBoolLow,
    SuspendCeil,
    SuspendFloor,
    SuspendInBand,
    SuspendOutBand,
    SuspendWhenChanged,
    SuspendWhenOutsideBand,
)
from bluesky.utils import FailedStatus, RunEngineInterrupted

import ldcnd.lab.bluesky.flight
from ldcnd.client.loop_thread import LoopThread
from ldcnd.client.rig import Rig
from ldcnd.client.rig_client import RigClient
from ldcnd.config.plan import plan_rig
from ldcnd.config.rig import RigConfig
from ldcnd.contract.codec import Encoding, encode
from ldcnd.contract.commands import Halt, MoveAbsolute, Power, SetPosition
from ldcnd.contract.errors import (
    CommandAborted,
    LdcndError,
    LeaseExpired,
    LeaseHeld,
    OutcomeUnknown,
    RequestRefused,
    SessionError,
    StopLatched,
    UnknownAxis,
    ValueOutOfRange,
    WrongState,
)
from ldcnd.contract.events import CommandStatus, ReadEvents
from ldcnd.contract.leases import Acquire, Release
from ldcnd.contract.samples import AxisState, LinkState, Moving, PositionSample, Quality, TelemetryItem
from ldcnd.drives.axis_config import LossPolicy
from ldcnd.lab.bluesky import Fly, PlanAxis, ReadableAxis, Signal, Status, TraceDetector
from ldcnd.net.session import Qos
from ldcnd.sim.ldcn.power import FaultCondition
from ldcnd.testing.memory_session import MemoryBroker
from tests.support.bluesky_engine import Laboratory, laboratory
from tests.support.lost_answers import losing
from tests.support.rig import EPOCH_NS, running_rig, two_axes

IN_POSITION = 0.02
"""Millimetres between where a motor stands and where it was sent."""


@pytest.fixture(scope="module")
def shared():
    with laboratory() as lab:
        yield lab


@pytest.fixture
def lab(shared: Laboratory):
    shared.documents.taken.clear()
    return shared


@contextmanager
def moved(lab: Laboratory):
    """Yield a list that gets at the end of the context where moves were sent that began in it."""

    def asked(**which: int):
        return lab.loop.run(lab.running.client.ask(ReadEvents(**which)))

    targets: list[float | None] = []
    before = asked(count=1).end_number
    yield targets
    began = [each for each in asked(from_number=before).events if each.status is CommandStatus.EXECUTING]
    targets += [each.target for each in began if each.verb == "move_absolute"]


def stands(lab: Laboratory, axis: str) -> bool:
    return lab.loop.run(lab.running.client.state(axis)).moving is Moving.NO


@contextmanager
def configured(lab: Laboratory, **changes: dict[str, float]):
    """Reload the daemon with other settings of x for the time of the context."""

    async def reload(config: RigConfig) -> None:
        lab.running.daemon.reconfigure(config, plan_rig(config))

    config = two_axes()
    (bus,) = config.bus
    x = bus.axis[0]
    x = x.model_copy(update={key: getattr(x, key).model_copy(update=change) for key, change in changes.items()})
    changed = config.model_copy(update={"bus": (bus.model_copy(update={"axis": (x, *bus.axis[1:])}),)})
    lab.loop.run(reload(changed))
    yield
    lab.loop.run(reload(config))


def test_devices_satisfy_the_protocols_without_a_base_class(lab: Laboratory):
    wanted = {
        ReadableAxis: ("Readable", "Triggerable", "Configurable", "Subscribable", "HasHints", "HasName", "HasParent"),
        PlanAxis: (
            "Movable",
            "Locatable",
            "Stoppable",
            "Checkable",
            "Preparable",
            "Flyable",
            "EventPageCollectable",
            "Pausable",
        ),
        Signal: ("Readable", "Triggerable", "Subscribable", "HasHints"),
        TraceDetector: ("Readable", "Triggerable", "HasHints"),
    }
    with lab.powered("x") as (x,), lab.devices.watch("y") as y:
        trace = x.trace("position")
        made = {ReadableAxis: y, PlanAxis: x, Signal: lab.devices.signal("x", "velocity"), TraceDetector: trace}
        lacking = [
            (kind.__name__, name)
            for kind, names in wanted.items()
            for name in names
            if not isinstance(made[kind], getattr(protocols, name))
        ]

    assert lacking == []
    assert {base for kind in wanted for base in kind.__mro__} == {*wanted, object}


def test_a_scan_records_where_the_motor_was(lab: Laboratory):
    truth = []
    with lab.powered("x") as (x,), lab.devices.watch("y") as y:
        located = lab.loop.run(x.locate())
        token = lab.engine.subscribe(lambda *_: truth.append(lab.truth("x")), "event")
        lab.engine(bp.scan([y], x, 0, 4, 5))
        lab.engine.unsubscribe(token)

    assert located["setpoint"] == pytest.approx(lab.documents.data("x")[0], abs=IN_POSITION)
    assert lab.documents.exit_status == "success"
    assert lab.documents.data("x") == pytest.approx(truth, abs=IN_POSITION)
    assert lab.documents.data("x_setpoint") == pytest.approx(range(5))
    assert len(lab.documents.data("y")) == 5


def test_a_reading_after_a_move_was_measured_after_its_end(lab: Laboratory):
    def moves():
        yield from bps.open_run()
        for target in (3, 1, 4):
            yield from bps.abs_set(x, target, wait=True)
            ended.append(x._axis.state.sample.t * 1e-9)
            yield from bps.create()
            yield from bps.read(x)
            yield from bps.save()
        yield from bps.close_run()

    ended = []
    with lab.powered("x") as (x,):
        lab.engine(moves())

    measured = [event["timestamps"]["x"] for event in lab.documents.of("event")]
    assert [at >= end for at, end in zip(measured, ended, strict=True)] == [True] * 3
    assert all(at < 1.8e9 for at in measured)  # of the rig's clock, not this machine's


@pytest.mark.long
def test_a_detector_in_a_step_scan_is_measured_at_its_point(lab: Laboratory):
    async def ended(status: Status) -> None:
        while not status.done:
            await asyncio.sleep(0.001)  # no longer: a plan goes on at once, and so does this

    async def step_scan() -> None:
        for target in range(0, 55, 5):
            await ended(x.set(target))
            for device in (adc, seen):
                await ended(device.trigger())
            measured.append(((await adc.read())["x_adc"]["value"], (await seen.read())["seen"]["value"]))
            truth.append((lab.potentiometer("x"), lab.truth("x")))

    measured, truth = [], []
    with configured(lab, rates={"adc": 1}), lab.powered("x") as (x,), lab.devices.watch("x", name="seen") as seen:
        adc = lab.devices.signal("x", "adc")
        lab.loop.run(step_scan())
        shown = lab.loop.run(lab.running.client.last("x", "adc"))

    volts_per_share = shown.volts * shown.full_scale / shown.counts
    (volts, places), (shares, positions) = zip(*measured, strict=True), zip(*truth, strict=True)
    assert volts == pytest.approx([each * volts_per_share for each in shares], abs=0.02)
    assert places == pytest.approx(positions, abs=IN_POSITION)
    assert len({*volts}) == 11


def test_a_trigger_of_an_item_that_is_not_measured_any_more_says_which():
    with laboratory() as lab:
        adc = lab.devices.signal("x", "adc")
        lab.unplug("x")
        with pytest.raises(SessionError, match="no adc was measured within 10 s after the trigger"):
            adc.trigger().wait(60)


@pytest.mark.long
def test_a_relative_grid_ends_where_it_began(lab: Laboratory):
    with lab.powered("x", "y") as (x, y):
        began = (lab.truth("x"), lab.truth("y"))
        lab.engine(bp.rel_grid_scan([lab.devices.signal("x", "adc")], x, -1, 1, 2, y, -1, 1, 2))

    assert lab.documents.exit_status == "success"
    assert len(lab.documents.data("x_adc")) == 4
    assert (lab.truth("x"), lab.truth("y")) == pytest.approx(began, abs=IN_POSITION)


@pytest.mark.parametrize("ending", ["stop", "latch", "another program"])
@pytest.mark.sweep(2)
def test_where_an_axis_was_sent_is_forgotten_once_something_else_has_stopped_or_moved_it(lab: Laboratory, ending: str):
    async def end_it(x):
        # in one go: the clock of the rig runs on between two calls of this thread, and the motion may be over by then
        await lab.running.until("x", lambda state: state.moving is Moving.YES)
        if ending == "stop":
            await x.stop()
        elif ending == "latch":
            await lab.running.client.stop("x")
        else:
            await x._axis.move_absolute(3.0, buffer_mode="aborting")

    with lab.powered("x") as (x,):
        x.set(0.0).wait(60)
        status = x.set(40.0)
        lab.loop.run(end_it(x))
        with suppress(CommandAborted, StopLatched):
            status.wait(60)
        lab.loop.run(lab.running.until("x", lambda state: state.moving is Moving.NO and state.command is None))
        located = lab.loop.run(x.locate())
        x.reset().wait(10)

        # the shaft may swing back by some hundredths after readings have shown it at rest
        assert located["setpoint"] == pytest.approx(lab.truth("x"), abs=0.1)
        assert abs(located["setpoint"] - 40) > 1


def test_a_move_that_begins_before_its_caller_goes_on_ends_as_any_other(lab: Laboratory, monkeypatch):
    def start(self, work):
        future = began(self, work)
        if threading.current_thread() is threading.main_thread():
            for _ in range(3):
                began(self, asyncio.sleep(0)).result(10)
        return future

    began = LoopThread.start
    with lab.powered("x") as (x,):
        x.set(0.0).wait(60)
        with lab.caught_moving("x", 30.0) as wait_until_moving:
            monkeypatch.setattr(LoopThread, "start", start)
            moves = [x.set(40.0), x.set(30.0)]
            wait_until_moving()
            stopping = lab.loop.start(lab.running.client.stop("x"))
        stopping.result(60)
        ended = [move.exception(20) for move in moves]
        x.reset().wait(10)

    # the stop finds the second one on its way, or under way
    assert all(isinstance(error, CommandAborted | StopLatched) for error in ended)


def test_the_limits_of_a_description_follow_a_reload(lab: Laboratory):
    with lab.powered("x") as (x,), configured(lab, limits={"position_min": -3, "position_max": 6}):
        described = lab.loop.run(x.describe())["x"]

    assert described["limits"]["control"] == {"low": -3, "high": 6}


def test_a_fly_scan_yields_pages_of_positions_with_the_times_of_the_drive(lab: Laboratory, monkeypatch):
    monkeypatch.setattr(ldcnd.lab.bluesky.flight, "PAGE_SAMPLES", 10)

    with lab.powered("x") as (x,):
        lab.engine(flown(x, Fly(0, 5, velocity=5), "any name"))

    (descriptor,) = lab.documents.of("descriptor")
    pages = lab.documents.of("event_page")
    positions = [value for page in pages for value in page["data"]["x"]]
    times = [at for page in pages for at in page["timestamps"]["x"]]
    assert descriptor["name"] == "any name"
    assert len(positions) >= 15  # 1 s at 20 Hz
    assert {len(page["time"]) for page in pages[:-1]} == {10}
    assert (positions[0], positions[-1]) == pytest.approx((0, 5), abs=0.5)
    assert positions[-1] == pytest.approx(5, abs=IN_POSITION)
    assert times == sorted(set(times))
    middle = [(at, value) for at, value in zip(times, positions, strict=True) if 1 < value < 4]
    speed = (middle[-1][1] - middle[0][1]) / (middle[-1][0] - middle[0][0])
    assert speed == pytest.approx(5, rel=0.01)


def flown(device, flight, stream: str, **more):
    """Fly and collect while that goes on."""
    yield from bps.prepare(device, flight, wait=True)
    yield from bps.open_run()
    yield from bps.declare_stream(device, name=stream, collect=True)
    yield from bps.kickoff(device, wait=True)
    yield from bps.collect_while_completing([device], [device], stream_name=stream, **more)
    yield from bps.close_run()


def test_two_axes_fly_in_one_stream_that_is_collected_meanwhile(lab: Laboratory):
    truth: list[tuple[float, float]] = []

    async def look():
        while True:
            now_s = asyncio.get_running_loop().time()
            lab.chain.pass_until(now_s)
            lab.module("y").catch_up(now_s)
            truth.append((EPOCH_NS * 1e-9 + now_s, lab.truth("y")))
            await asyncio.sleep(0.005)

    with lab.powered("x", "y") as (x, y):
        both = lab.devices.flight(x, y)
        flights = {"x": Fly(0, 10, velocity=5), "y": Fly(0, -4, velocity=2)}
        looking = lab.loop.start(look())
        lab.engine(flown(both, flights, "both", flush_period=0.5))
        looking.cancel()
        with pytest.raises(WrongState, match="each of x, y"):
            both.prepare(Fly(0, 1))

    (descriptor,) = lab.documents.of("descriptor")
    pages = lab.documents.of("event_page")
    rows = [
        (page["timestamps"][name][at], page["data"][name][at])
        for page in pages
        for at in range(len(page["time"]))
        for name in ("x", "y")
    ]
    xs, ys = rows[0::2], rows[1::2]
    assert (descriptor["name"], lab.documents.exit_status) == ("both", "success")
    assert len(pages) >= 3
    assert (xs[-1][1], ys[-1][1]) == pytest.approx((10, -4), abs=IN_POSITION)
    for places, speed in ((xs, 5), (ys, -2)):
        middle = [(at, value) for at, value in places if 1 < abs(value) < 3]
        assert (middle[-1][1] - middle[0][1]) / (middle[-1][0] - middle[0][0]) == pytest.approx(speed, rel=0.02)
    assert [at for at, _ in xs] == [at for at, _ in ys]
    places = iter(truth)
    before = after = next(places)
    for at, value in ys:
        while after[0] < at:
            before, after = after, next(places)
        assert min(before[1], after[1]) - IN_POSITION / 2 < value < max(before[1], after[1]) + IN_POSITION / 2


def test_a_flight_of_which_one_axis_fails_halts_the_other(lab: Laboratory):
    async def stop_y():
        await lab.running.until("y", lambda state: state.moving is Moving.YES)
        await lab.running.client.stop("y")

    with lab.powered("x", "y") as (x, y):
        both = lab.devices.flight(x, y)
        both.prepare({"x": Fly(0, 50, velocity=5), "y": Fly(0, 50, velocity=5)}).wait(60)
        both.kickoff().wait(20)
        lab.loop.run(stop_y())
        failed = both.complete().exception(60)
        y.reset().wait(20)

        assert isinstance(failed, CommandAborted)
        assert lab.truth("x") < 20
        assert stands(lab, "x")


def test_velocity_and_acceleration_are_moved_by_plans_and_configured(lab: Laboratory):
    def plan():
        yield from bps.mv(x.velocity, 4.0, x.acceleration, 50.0)
        seen.append((yield from bps.rd(x.velocity)))
        old, new = yield from bps.configure(x, {"velocity": 8.0})
        seen.extend((old["x_velocity"]["value"], new["x_velocity"]["value"]))
        yield from bp.scan([x.velocity], x, 0, 1, 2)

    seen = []
    with lab.powered("x") as (x,):
        lab.engine(plan())
        (descriptor,) = lab.documents.of("descriptor")
        with pytest.raises(ValueOutOfRange, match="limit"):
            x.configure({"acceleration": 20.0, "velocity": 51.0})
        assert x.acceleration.value == 50.0

    assert seen == pytest.approx([4.0, 4.0, 8.0], rel=1e-3)
    assert descriptor["configuration"]["x"]["data"]["x_velocity"] == pytest.approx(8, rel=1e-3)
    assert lab.documents.data("x_velocity") == pytest.approx([8, 8], rel=1e-3)


def test_a_move_that_takes_too_long_is_halted_and_fails(lab: Laboratory):
    with lab.powered("x") as (x,):
        x.set(0).wait(60)
        with pytest.raises(FailedStatus) as failed:
            lab.engine(bps.abs_set(x, 50, timeout=1.0, wait=True))
        assert isinstance(failed.value.__cause__, CommandAborted)

        assert 5 < lab.truth("x") < 30
        assert stands(lab, "x")
        assert lab.loop.run(lab.running.client.state("x")).stop_latched is False


def test_a_second_set_sends_a_moving_axis_elsewhere(lab: Laboratory):
    def plan():
        yield from bps.open_run()
        yield from bps.abs_set(x, 50, group="moves")
        yield from bps.sleep(0.5)
        yield from bps.abs_set(x, 3, group="moves")
        yield from bps.wait("moves")
        yield from bps.create()
        yield from bps.read(x)
        yield from bps.save()
        yield from bps.close_run()

    with lab.powered("x") as (x,):
        x.set(0).wait(60)
        lab.engine(plan())

        assert lab.documents.exit_status == "success"
        assert lab.documents.data("x") == pytest.approx([3], abs=IN_POSITION)
        assert lab.truth("x") == pytest.approx(3, abs=IN_POSITION)


@pytest.mark.parametrize("pace_s", [0.0, 0.001, 0.005, 0.02])
@pytest.mark.parametrize("goals", [(7, 2), (7, 7.5, 2), (7, 1, 6, 3, 9, 2)])
def test_of_sets_right_behind_each_other_the_newest_wins(lab: Laboratory, goals, pace_s: float):
    def plan():
        for goal in goals:
            yield from bps.abs_set(x, goal, group="moves")
            yield from bps.sleep(pace_s)
        yield from bps.wait("moves")

    with lab.powered("x") as (x,):
        x.set(0).wait(60)
        lab.engine(plan())
        sets = [x.set(goal) for goal in goals]
        for each in sets:
            each.wait(60)

        assert lab.truth("x") == pytest.approx(2, abs=IN_POSITION)


def test_an_adaptive_scan_of_a_signal_ends(lab: Laboratory):
    with lab.powered("x") as (x,):
        adc = lab.devices.signal("x", "adc")
        lab.engine(bp.adaptive_scan([adc], "x_adc", x, 0, 4, 0.5, 2, 0.5, backstep=False))

    assert lab.documents.exit_status == "success"
    assert len(lab.documents.data("x_adc")) >= 3


@pytest.mark.long
def test_a_plan_is_suspended_while_a_fault_or_a_value_is_there_and_goes_on_after_it(lab: Laboratory):
    async def trouble():
        await lab.running.until("x", lambda state: state.moving is Moving.YES)
        lab.module("y").set_condition(FaultCondition.MOTOR_SHORT, present=True, at_s=asyncio.get_running_loop().time())
        await lab.running.until("y", lambda state: state.state is AxisState.ERROR_STOP)
        await asyncio.sleep(20)
        suspended_for.append(len(lab.documents.of("event")))
        lab.module("y").set_condition(FaultCondition.MOTOR_SHORT, present=False, at_s=asyncio.get_running_loop().time())
        await y_axis._axis.reset()

    suspended_for = []
    with lab.powered("x", "y") as (x, y_axis):
        fault = lab.devices.signal("y", "fault")
        suspender = SuspendBoolHigh(fault)  # codes of faults, an empty text without one
        lab.engine.install_suspender(suspender)
        went_wrong = lab.loop.start(trouble())
        lab.engine(bp.scan([], x, 0, 40, 5))
        went_wrong.result(60)
        lab.engine.remove_suspender(suspender)
        tripped = []
        floor = lab.devices.signal("x", "velocity")

        def take(value, **_):
            tripped.append(value)

        floor.subscribe(take, event_type="value", run=True)
        x.set(0).wait(60)
        floor.clear_sub(take)

    assert lab.documents.exit_status == "success"
    assert suspended_for[0] < 5
    assert len({event["seq_num"] for event in lab.documents.of("event")}) == 5
    assert min(tripped) < -1


SUSPENDERS = {
    "ceil": lambda velocity, _: SuspendCeil(velocity, 1.0, resume_thresh=0.5),
    "floor": lambda velocity, _: SuspendFloor(velocity, -1.0, resume_thresh=-0.5),
    "outside band": lambda velocity, _: SuspendWhenOutsideBand(velocity, -1.0, 1.0),
    "in band": lambda velocity, _: SuspendInBand(velocity, -1.0, 1.0),
    "out band": lambda velocity, _: SuspendOutBand(velocity, 1.0, 100.0),
    "changed": lambda _, state: SuspendWhenChanged(state, allow_resume=True),
    "position": lambda _, __, y: SuspendWhenOutsideBand(y, -1.0, 1.0),
}


@pytest.mark.filterwarnings("ignore:SuspendInBand has been renamed", "ignore:bluesky.suspenders.SuspendOutBand")
@pytest.mark.parametrize("kind", SUSPENDERS)
@pytest.mark.sweep(7)
def test_a_plan_is_suspended_while_another_axis_turns(lab: Laboratory, capsys, kind: str):
    async def turn():
        await lab.running.until("x", lambda state: state.moving is Moving.YES)
        motion = await y._axis.move_absolute(-40 if kind == "floor" else 40, velocity=5)
        for _ in range(2):
            await asyncio.sleep(3)
            events.append(len(lab.documents.of("event")))
        await motion.done()
        if kind == "position":
            await (await y._axis.move_absolute(0)).done()

    events = []
    with lab.powered("x", "y") as (x, y):
        x.set(0).wait(60)
        y.set(0).wait(60)
        of_y = [lab.devices.signal("y", item) for item in ("velocity", "state")]
        suspender = SUSPENDERS[kind](*of_y, y) if kind == "position" else SUSPENDERS[kind](*of_y)
        lab.engine.install_suspender(suspender)
        turning = lab.loop.start(turn())
        lab.engine(bp.scan([], x, 0, 40, 41))
        turning.result(60)
        lab.engine.remove_suspender(suspender)

    assert lab.documents.exit_status == "success"
    assert events[0] == events[1] < 20
    assert len({event["seq_num"] for event in lab.documents.of("event")}) == 41
    assert "Justification for this suspension" in capsys.readouterr().out


GUARDS = {
    "floor": lambda adc, _: SuspendFloor(adc, -100.0),
    "ceil": lambda adc, _: SuspendCeil(adc, 100.0),
    "outside band": lambda adc, _: SuspendWhenOutsideBand(adc, -100.0, 100.0),
    "low": lambda _, state: SuspendBoolLow(state),
}
"""No value that the signals have trips one of them."""


@pytest.mark.parametrize("kind", GUARDS)
@pytest.mark.sweep(4)
def test_a_plan_is_suspended_while_the_value_of_its_guard_is_not_known(kind: str):
    async def lose():
        await lab.running.until("x", lambda state: state.moving is Moving.YES)
        lab.module("y").power(on=False, at_s=asyncio.get_running_loop().time())
        for _ in range(2):
            await asyncio.sleep(5)
            events.append(len(lab.documents.of("event")))
        suspender.remove()

    events = []
    with laboratory() as lab, lab.powered("x") as (x,):
        x.set(0).wait(60)
        suspender = GUARDS[kind](*(lab.devices.signal("y", item) for item in ("adc", "state")))
        lab.engine.install_suspender(suspender)
        losing = lab.loop.start(lose())
        lab.engine(bp.scan([], x, 0, 40, 41))
        losing.result(60)

    assert events[0] == events[1] < 20
    assert lab.documents.exit_status == "success"
    assert len({event["seq_num"] for event in lab.documents.of("event")}) == 41


@pytest.mark.parametrize("kind", GUARDS)
@pytest.mark.sweep(4)
def test_a_plan_begins_once_the_value_of_its_guard_is_known(kind: str):
    async def lose():
        lab.module("y").power(on=False, at_s=asyncio.get_running_loop().time())
        await lab.running.until("y", lambda state: state.link is LinkState.DOWN)
        await asyncio.sleep(5)

    async def let_go():
        await asyncio.sleep(5)
        events.append(len(lab.documents.of("event")))
        suspender.remove()

    events = []
    with laboratory() as lab, lab.powered("x") as (x,):
        suspender = GUARDS[kind](*(lab.devices.signal("y", item) for item in ("adc", "state")))
        lab.engine.install_suspender(suspender)
        lab.loop.run(lose())
        waits = suspender.tripped
        letting_go = lab.loop.start(let_go())
        lab.engine(bp.scan([], x, 0, 4, 5))
        letting_go.result(60)

    assert (waits, events) == (True, [0])
    assert lab.documents.exit_status == "success"
    assert len({event["seq_num"] for event in lab.documents.of("event")}) == 5


@pytest.mark.parametrize("gone", ["drive", "daemon"])
@pytest.mark.parametrize("item", ["position", "adc", "state"])
@pytest.mark.sweep(3)
def test_subscribers_are_told_that_nothing_is_known_of_what_does_not_answer(item: str, gone: str):
    def take(value, **_):
        told.append(value)

    told = []
    with laboratory() as lab:
        signal = lab.devices.signal("y", item)
        signal.subscribe(take, run=True)
        lab.loop.run(asyncio.sleep(2))
        known = signal.get()
        if gone == "drive":
            lab.unplug("y")
        else:
            lab.loop.run(lab.running.lives.kill_daemon())
        lab.loop.run(asyncio.sleep(10))
        with pytest.raises(LdcndError):
            signal.get()
        signal.clear_sub(take)

    assert known in told
    assert told[-1] == "unknown" if item == "state" else math.isnan(told[-1])


@pytest.mark.parametrize("kind", ["axis", "signal"])
def test_a_position_that_was_doubted_trips_nobody_once_a_newer_one_was_measured(kind: str):
    async def miss_a_poll():
        last = await client.position("y")
        doubted = last.model_copy(update={"quality": Quality.UNCERTAIN})
        measured = last.model_copy(update={"t": last.t + 1, "value": 0.125})
        for sample in (doubted, measured):  # taken together, as by a program that is a poll behind
            publish(lab, "y", sample)
        await asyncio.sleep(0.5)

    told = []
    with laboratory() as lab, lab.devices.watch("y") as y:
        client = lab.running.client
        device = y if kind == "axis" else lab.devices.signal("y", "position")
        device.subscribe(take := lambda value, **_: told.append(value), run=True)
        lab.loop.run(asyncio.sleep(1))
        lab.loop.run(miss_a_poll())
        device.clear_sub(take)

    assert 0.125 in told
    assert all(map(math.isfinite, told))


@pytest.mark.parametrize("gone", ["drive", "daemon"])
def test_who_is_told_of_an_axis_that_is_silent_at_first_is_told_of_its_positions_once_it_is_back(gone: str):
    async def begin():
        if gone == "drive":
            lab.module("y").power(on=False, at_s=asyncio.get_running_loop().time())
            await lab.running.until("y", lambda state: state.link is LinkState.DOWN)
        else:
            await lab.running.lives.kill_daemon()
            await asyncio.sleep(10)
        y.subscribe(take, run=True)
        await asyncio.sleep(5)

    async def come_back():
        if gone == "drive":
            lab.module("y").power(on=True, at_s=asyncio.get_running_loop().time())
        else:
            await lab.running.lives.start_daemon()
        await lab.running.until("y", lambda state: state.link is LinkState.UP)
        await asyncio.sleep(2)

    def take(value, **_):
        told.append(value)

    told = []
    with laboratory() as lab, lab.devices.watch("y") as y:
        lab.loop.run(begin())
        before = list(told)
        lab.loop.run(come_back())
        y.clear_sub(take)

    assert before
    assert all(map(math.isnan, before))
    assert told[-1] == pytest.approx(0, abs=0.05)


def test_faults_are_known_between_two_states_that_are_far_apart_until_the_daemon_is_gone():
    def take(value, **_):
        told.append(value)

    told = []
    config = two_axes()
    (bus,) = config.bus
    rare = bus.axis[1].model_copy(update={"rates": bus.axis[1].rates.model_copy(update={"state": 0.1})})
    config = config.model_copy(update={"bus": (bus.model_copy(update={"axis": (bus.axis[0], rare)}),)})
    with laboratory(config) as lab:
        signal = lab.devices.signal("y", "fault")
        signal.subscribe(take, run=True)
        lab.loop.run(asyncio.sleep(25))
        known = list(told)
        lab.loop.run(lab.running.lives.kill_daemon())
        lab.loop.run(asyncio.sleep(20))
        signal.clear_sub(take)

    assert set(known) == {""}
    assert told[-1] == "unknown"


def test_who_asks_for_a_value_that_is_not_known_keeps_nobody_up_who_is_told_of_it():
    def take(**_):
        free.append(held.acquire(timeout=3.0))
        if free[-1]:
            held.release()

    free, held = [], threading.Lock()  # as a suspender holds its own while it says why it has tripped
    with laboratory() as lab, lab.devices.watch("y") as y:
        y.subscribe(take, run=True)
        lab.loop.run(lab.running.lives.kill_daemon())
        lab.loop.run(asyncio.sleep(10))
        with held:
            returning = lab.loop.start(lab.running.lives.start_daemon())
            with suppress(LdcndError):
                y.get()
        returning.result(60)
        lab.loop.run(asyncio.sleep(10))
        place = y.get()
        y.clear_sub(take)

    assert set(free) == {True}
    assert place == pytest.approx(0, abs=0.05)


def test_who_asks_for_a_value_waits_for_nothing_while_anybody_is_told_of_it(lab: Laboratory, monkeypatch):
    """A suspender asks with its lock held, for which the devices' loop may wait: it has no answer then."""
    fault, told, others = lab.devices.signal("y", "fault"), [], []
    followers = [lambda value, **_: told.append(value), lambda value, **_: others.append(value)]
    for follower in followers:
        fault.subscribe(follower, run=True)
    while not (told and others):
        lab.loop.run(asyncio.sleep(0.1))
    fault.clear_sub(followers.pop())
    lab.loop.run(asyncio.sleep(0.1))
    with monkeypatch.context() as patched:
        patched.setattr(lab.loop, "run", None)
        value = fault.get()
    fault.clear_sub(followers.pop())

    assert value == told[-1]


def test_a_position_as_a_signal_is_worth_what_it_is_as_an_axis():
    config = two_axes()
    (bus,) = config.bus
    x = bus.axis[0].model_copy(update={"reference": "required"})
    unhomed = config.model_copy(update={"bus": (bus.model_copy(update={"axis": (x, *bus.axis[1:])}),)})
    with laboratory(unhomed) as lab, lab.devices.watch("x") as axis:
        signal = lab.devices.signal("x", "position")
        read, of_signal = lab.loop.run(axis.read())["x"], lab.loop.run(signal.read())["x_position"]

    assert "not homed" in of_signal["message"]
    assert [of_signal[key] for key in ("alarm_severity", "message")] == [read["alarm_severity"], read["message"]]


def test_a_scan_records_of_each_number_whether_it_may_be_believed():
    async def lose_reference():
        lab.module("y").power(on=False, at_s=asyncio.get_running_loop().time())
        await lab.running.until("y", lambda state: state.link is LinkState.DOWN)
        lab.module("y").power(on=True, at_s=asyncio.get_running_loop().time())
        await lab.running.until("y", lambda state: state.reference_lost and state.link is LinkState.UP)

    with laboratory() as lab, lab.powered("x") as (x,), lab.devices.watch("y") as y:
        devices = [y, *(lab.devices.signal("y", item) for item in ("position", "adc", "state"))]
        lab.engine(bp.count(devices))
        lab.loop.run(lose_reference())
        lab.engine(bp.scan(devices, x, 0, 4, 2))
        descriptor = lab.documents.of("descriptor")[-1]

    for name in ("y", "y_position"):
        assert lab.documents.data(f"{name}_quality") == ["good", "reference lost", "reference lost"]
    assert lab.documents.data("y_adc_quality") == ["good"] * 3
    assert lab.documents.data("x_quality") == ["good"] * 2
    assert "y_state_quality" not in descriptor["data_keys"]
    assert descriptor["hints"]["y"]["fields"] == ["y"]
    assert descriptor["object_keys"]["y_adc"] == ["y_adc", "y_adc_quality"]


def publish(lab: Laboratory, axis: str, sample: PositionSample) -> None:
    """Publish a position of an axis as the daemon would."""
    payload, encoding = encode(sample, Encoding.MSGPACK)
    key = lab.running.client.keys.telemetry(axis, TelemetryItem.POSITION)
    lab.running.daemon._session.publish(key, payload, encoding=encoding, qos=Qos.TELEMETRY)


@pytest.mark.parametrize("several", [False, True])
def test_a_flight_records_of_each_number_whether_it_may_be_believed_and_none_that_was_not_measured(several):
    async def doubt_one():
        last = await lab.running.client.position("x")
        for quality in (Quality.UNCERTAIN, Quality.BAD):  # the second one is the first once more
            publish(lab, "x", last.model_copy(update={"t": last.t + 1_000_000, "quality": quality}))

    with laboratory() as lab, lab.powered("x", "y") as (x, y):
        device = lab.devices.flight(x, y) if several else x
        flights = {"x": Fly(0, 3, velocity=1), "y": Fly(0, 3, velocity=1)} if several else Fly(0, 3, velocity=1)
        device.prepare(flights).wait(60)
        with lab.caught_moving("x", for_s=1.0) as wait_until_moving:
            device.kickoff().wait(20)
            wait_until_moving()
            lab.loop.run(doubt_one())
        device.complete().wait(60)
        lab.engine(collected(device))

    told, times = lab.documents.data_of_pages("x_quality"), lab.documents.data_of_pages("x", "timestamps")
    assert len(told) > 50
    assert [each for each in told if each != "good"] == ["uncertain"]
    assert times == sorted({*times})
    assert {*lab.documents.data_of_pages("y_quality")} == ({"good"} if several else set())


def collected(device):
    """Collect what was flown before."""
    yield from bps.open_run()
    yield from bps.declare_stream(device, name="flight", collect=True)
    yield from bps.collect(device, name="flight")
    yield from bps.close_run()


def test_positions_that_are_to_come_every_ten_seconds_are_not_old_between_two_of_them(lab: Laboratory):
    def take(value, **_):
        told.append(value)

    told, said = [], []
    signal = lab.devices.signal("x", "position")
    with lab.devices.watch("x") as x:
        signal.subscribe(take, run=True)
        with configured(lab, rates={"position": 0.1}):
            for _ in range(30):
                lab.loop.run(asyncio.sleep(1))
                said.append((x._axis.position.condition.mark, str(x._axis.state)))
        signal.clear_sub(take)

    assert not any(map(math.isnan, told))
    assert {mark for mark, _ in said} == {""}
    assert not [state for _, state in said if "was" in state]


@pytest.mark.long
def test_a_plan_is_suspended_while_a_text_is_empty(lab: Laboratory):
    async def short(*, present: bool):
        if present:
            await y._axis.power(on=True)
        lab.module("y").set_condition(
            FaultCondition.MOTOR_SHORT, present=present, at_s=asyncio.get_running_loop().time()
        )
        if present:
            await lab.running.until("y", lambda state: state.state is AxisState.ERROR_STOP)
        else:
            await y._axis.reset()

    async def cure():
        await lab.running.until("x", lambda state: state.moving is Moving.YES)
        await short(present=False)
        await asyncio.sleep(20)
        events.append(len(lab.documents.of("event")))
        await short(present=True)

    events = []
    with lab.powered("x", "y") as (x, y):
        x.set(0).wait(60)
        lab.loop.run(short(present=True))
        fault = lab.devices.signal("y", "fault")
        shown = fault.value
        suspender = SuspendBoolLow(fault)
        lab.engine.install_suspender(suspender)
        cured = lab.loop.start(cure())
        lab.engine(bp.scan([], x, 0, 40, 5))
        cured.result(60)
        lab.engine.remove_suspender(suspender)
        lab.loop.run(short(present=False))

    assert lab.documents.exit_status == "success"
    assert shown
    assert events[0] < 5


def test_what_a_subscriber_raises_is_said_and_it_is_told_of_the_next_value(lab: Laboratory, caplog):
    def take(value, **_):
        told.append(value)
        raise ValueError("too fast")

    told = []
    with lab.powered("x") as (x,):
        for device in (lab.devices.signal("x", "velocity"), x):
            device.subscribe(take, run=True)
            x.set(2 if device is x else 4).wait(60)
            assert device.get() == told[-1]
            device.clear_sub(take)

    assert len(told) > 4
    assert {record.name for record in caplog.records} == {"ldcnd.bluesky"}
    assert "too fast" in caplog.text


def test_what_devices_are_fits_a_line_of_a_terminal(lab: Laboratory):
    with lab.powered("x") as (x,), lab.devices.watch("y") as y:
        shown = [repr(each) for each in (x, y, x.velocity, lab.devices.signal("x", "adc"), lab.devices.flight(x))]

    assert shown == [
        "<axis x: ldcnd://sim/x>",
        "<read-only axis y: ldcnd://sim/y>",
        "<x_velocity: default>",
        "<signal x_adc: ldcnd://sim/x/adc>",
        "<flight flight: x>",
    ]


def test_a_flight_is_prepared_first_and_within_the_limits(lab: Laboratory):
    with lab.powered("x") as (x,):
        with pytest.raises(WrongState, match="prepare"):
            x.kickoff().wait(20)
        with pytest.raises(RequestRefused, match="100"):
            x.prepare(Fly(0, 1000)).wait(20)
        with pytest.raises(WrongState, match="under way"):
            x.complete()


def test_signals_are_monitored_while_an_axis_moves(lab: Laboratory):
    with lab.powered("x") as (x,):
        velocity = lab.devices.signal("x", "velocity")
        state = lab.devices.signal("x", "state")
        lab.engine(monitor_during_wrapper(bp.list_scan([state], x, [0, 5, 0]), [velocity, x]))
        faults = lab.loop.run(lab.devices.signal("x", "fault").read())

    assert {descriptor["name"] for descriptor in lab.documents.of("descriptor")} == {
        "primary",
        "x_velocity_monitor",
        "x_monitor",
    }
    assert max(lab.documents.data("x_velocity")) > 1
    assert lab.documents.data("x_state") == ["standstill"] * 3
    assert faults["x_fault"]["value"] == ""
    with pytest.raises(UnknownAxis, match="velocity"):
        lab.devices.signal("x", "monitor/speed_feedback")


def test_a_trace_is_a_detector(lab: Laboratory):
    with lab.powered("x") as (x,):
        trace = x.trace("position", samples=40)
        with pytest.raises(WrongState, match="no trace"):
            lab.loop.run(trace.read())
        lab.engine(bp.scan([trace], x, 0, 1, 2))

    rows = lab.documents.data("x_trace_position")
    assert [len(row) for row in rows] == [40, 40]
    assert rows[1] == pytest.approx([1.0] * 40, abs=IN_POSITION)


def test_what_the_daemon_would_refuse_is_raised_by_the_check(lab: Laboratory):
    with lab.devices.control("x", client="scan") as x:
        x.power(on=False).wait(20)
        with pytest.raises(RequestRefused, match="disabled"):
            lab.loop.run(x.check_value(1))
        x.power(on=True).wait(20)
        lab.loop.run(x.check_value(1))
        with pytest.raises(RequestRefused) as refused:
            lab.loop.run(x.check_value(1000))

    assert refused.value.nearest == 100


def test_configuration_says_what_the_registers_would_hold(lab: Laboratory):
    with lab.powered("x") as (x,):
        x.velocity.set(7.0).wait()
        configured = lab.loop.run(x.read_configuration())
        described = lab.loop.run(x.describe_configuration())

    assert configured["x_velocity"]["value"] == pytest.approx(7, rel=1e-3)
    assert configured["x_acceleration"]["value"] == pytest.approx(200, rel=1e-2)
    assert set(configured) == set(described)


def test_a_scan_into_a_limit_fails_and_leaves_the_axis_at_rest(lab: Laboratory):
    with lab.powered("x") as (x,):
        with pytest.raises(FailedStatus):
            lab.engine(bp.scan([], x, 95, 105, 3))
        assert stands(lab, "x")

    assert lab.documents.exit_status == "fail"
    assert lab.documents.data("x") == pytest.approx([95, 100], abs=IN_POSITION)


@pytest.mark.long
def test_a_stop_from_elsewhere_ends_the_run_as_failed(lab: Laboratory):
    def stop_at_the_third(name, document):
        if document["seq_num"] == 3:
            stopping.append(lab.loop.start(stop_while_moving()))

    async def stop_while_moving():
        await lab.running.until("x", lambda state: state.moving is Moving.YES)
        await lab.running.client.stop()

    stopping = []
    with lab.powered("x") as (x,):
        token = lab.engine.subscribe(stop_at_the_third, "event")
        with pytest.raises(FailedStatus):
            lab.engine(bp.scan([], x, 0, 4, 5))
        lab.engine.unsubscribe(token)
        stopping[0].result(20)
        latched = lab.loop.run(lab.running.client.state("x")).stop_latched
        assert stands(lab, "x")
        x.reset().wait(20)
        lab.loop.run(lab.running.until("y", lambda state: state.state is not AxisState.STOPPING))
        with lab.devices.control("y", client="scan") as y:
            y.reset().wait(20)

    assert latched
    assert lab.documents.exit_status == "fail"


@pytest.mark.parametrize("later_s", [0.0, 0.001, 0.002, 0.0025])
def test_a_move_that_a_stop_overtakes_ends_with_the_axis_at_rest(lab: Laboratory, later_s: float):
    async def move_and_stop():
        status = x.set(-20 if lab.truth("x") > 0 else 20)
        await asyncio.sleep(later_s)
        await lab.running.client.stop("x")
        return status

    with lab.powered("x") as (x,):
        error = lab.loop.run(move_and_stop()).exception(20)
        ended_at = lab.truth("x")
        # a stop of a standing drive is "stopping" until the next poll, which may be after the refusal of the move
        lab.loop.run(lab.running.until("x", lambda state: state.stop_latched and state.state is AxisState.STANDSTILL))
        x.reset().wait(20)

    assert isinstance(error, StopLatched | CommandAborted)
    assert lab.truth("x") == pytest.approx(ended_at, abs=IN_POSITION)


def test_an_aborted_plan_halts_without_the_latch(lab: Laboratory):
    def pause_while_moving():
        with lab.caught_moving("x") as wait_until_moving:
            wait_until_moving()
            lab.engine.request_pause()

    with lab.powered("x") as (x,):
        pausing = threading.Thread(target=pause_while_moving)
        pausing.start()
        with pytest.raises(RunEngineInterrupted):
            lab.engine(bp.scan([], x, 20, -20, 2))
        pausing.join()
        lab.engine.abort("enough")
        state = lab.loop.run(lab.running.client.state("x"))

    assert (state.stop_latched, state.moving) == (False, Moving.NO)
    assert lab.documents.exit_status == "abort"


@pytest.mark.parametrize("ending", ["resume", "abort", "stop"])
@pytest.mark.parametrize("several", [False, True])
@pytest.mark.parametrize("checkpoint", ["before prepare", "before kickoff"])
@pytest.mark.sweep(5)
def test_a_flight_is_halted_while_its_plan_is_paused_and_begun_anew_when_it_goes_on(
    lab: Laboratory, several, checkpoint, ending
):
    def pause_in_flight():
        with lab.caught_moving("x", for_s=1.0) as wait_until_moving:
            wait_until_moving()
            lab.engine.request_pause()

    def plan(device, flight):
        yield from bps.open_run()
        yield from bps.mv(x, 1, y, 1)
        yield from bps.prepare(device, flight, wait=True)
        yield from bps.checkpoint()
        yield from bps.prepare(device, flight, wait=True)
        yield from bps.declare_stream(device, name="flight", collect=True)
        if checkpoint == "before kickoff":
            yield from bps.checkpoint()
        yield from bps.kickoff(device, wait=checkpoint == "before prepare")
        pausing.start()
        yield from bps.complete(device, wait=True)
        yield from bps.collect(device, name="flight")
        yield from bps.close_run()

    with lab.powered("x", "y") as (x, y):
        x.set(0.0).wait(60)
        pausing = threading.Thread(target=pause_in_flight)
        device = lab.devices.flight(x, y) if several else x
        flights = {"x": Fly(0, 30, velocity=5), "y": Fly(0, 4, velocity=5)} if several else Fly(0, 30, velocity=5)
        with pytest.raises(RunEngineInterrupted):
            lab.engine(plan(device, flights))
        pausing.join()
        paused_at = lab.truth("x")
        assert stands(lab, "x")
        assert stands(lab, "y")
        assert 0 < paused_at < 29
        getattr(lab.engine, ending)()

        assert stands(lab, "x")
        if ending == "resume":
            flown = [value for page in lab.documents.of("event_page") for value in page["data"]["x"]]
            assert (min(flown), max(flown)) == (pytest.approx(0, abs=0.5), pytest.approx(30, abs=0.5))
            assert lab.documents.exit_status == "success"
            with pytest.raises(WrongState, match="prepare"):
                device.kickoff().wait(20)
        assert lab.truth("x") == pytest.approx(30 if ending == "resume" else paused_at, abs=0.1)


def test_a_stop_that_was_meant_is_a_success(lab: Laboratory):
    with lab.powered("x") as (x,):
        meant, unmeant = [], []
        for success, ends in ((True, meant), (False, unmeant)):
            with lab.caught_moving("x") as wait_until_moving:
                status = x.set(50 if lab.truth("x") < 0 else -50)
                wait_until_moving()
                stopped = x.stop(success=success)
            stopped.wait(20)
            ends.append(status.exception(20))

    assert meant == [None]
    assert isinstance(unmeant[0], CommandAborted)


def test_a_stop_that_overtakes_its_move_leaves_the_axis_at_rest(lab: Laboratory):
    with lab.powered("x") as (x,):
        x.set(0.0).wait(60)
        with lab.clock_standing():
            status = x.set(40)
            stopped = x.stop(success=True)
        stopped.wait(20)
        ended = status.exception(20)

        assert ended is None
        assert stands(lab, "x")
        assert lab.truth("x") < 30


def test_a_kickoff_that_a_stop_overtakes_is_no_failure_of_a_plan_that_was_paused(lab: Laboratory):
    with lab.powered("x") as (x,):
        x.prepare(Fly(0, 30)).wait(60)
        with lab.clock_standing():
            kicked_off = x.kickoff()
            stopped = x.stop(success=True)
        stopped.wait(20)

        assert kicked_off.exception(20) is None
        assert x.complete().exception(20) is None
        assert stands(lab, "x")
        assert lab.truth("x") < 29


def test_a_stop_while_a_flight_is_checked_begins_no_motion(lab: Laboratory):
    async def prepare_and_stop():
        status = x.prepare(Fly(40, 50))
        await asyncio.sleep(0)  # the check is on its way
        await x.stop(success=True)
        return status

    with lab.powered("x") as (x,):
        x.prepare(Fly(0, 30)).wait(60)
        with moved(lab) as targets:
            ended = lab.loop.run(prepare_and_stop()).exception(20)
            with pytest.raises(WrongState, match="prepare"):
                x.kickoff().wait(20)

    assert ended is None
    assert targets == []


def test_a_kickoff_waits_for_the_preparation_that_was_called_last_and_completes_at_the_end_of_its_flight(lab):
    async def fly():
        x.prepare(Fly(20, 25))
        x.kickoff()
        return x.complete()

    with lab.powered("x") as (x,):
        x.prepare(Fly(0, 30)).wait(60)
        x.kickoff().wait(20)
        x.complete().wait(60)
        x.prepare(Fly(0, 30)).wait(60)
        with moved(lab) as targets:
            lab.loop.run(fly()).wait(60)
            assert lab.truth("x") == pytest.approx(25, abs=IN_POSITION)

    assert targets == [20, 25]


@pytest.mark.parametrize(
    "between", ["refusal", "stop of one axis", "pause", "their halt", "their stop", "their power off"]
)
def test_what_is_prepared_outlasts_no_stop_of_its_axes_by_anybody_and_no_refused_prepare(lab: Laboratory, between):
    def at_rest_as(wanted: AxisState) -> None:
        lab.loop.run(lab.running.until("y", lambda state: state.state is wanted and state.moving is Moving.NO))

    client = lab.running.client
    with lab.powered("x", "y") as (x, y):
        both, flights = lab.devices.flight(x, y), {"x": Fly(0, 3), "y": Fly(0, 3)}
        both.prepare(flights).wait(60)
        with moved(lab) as targets:
            match between:
                case "refusal":
                    assert isinstance(both.prepare({**flights, "y": Fly(0, 1000)}).exception(20), RequestRefused)
                case "stop of one axis":
                    y.stop().wait(20)
                case "pause":
                    lab.loop.run(both.pause())
                case "their halt":
                    lab.loop.run(client.command("y", Halt()))
                case "their stop":
                    lab.loop.run(client.stop("y"))
                    at_rest_as(AxisState.STANDSTILL)
                    y.reset().wait(20)
                case "their power off":
                    lab.loop.run(client.command("y", Power(on=False)))
                    at_rest_as(AxisState.DISABLED)
                    y.power(on=True).wait(20)
            assert isinstance(both.kickoff().exception(20), WrongState | RequestRefused)
        assert targets == []

        both.prepare(flights).wait(60)
        both.kickoff().wait(20)
        both.complete().wait(60)
        assert (lab.truth("x"), lab.truth("y")) == pytest.approx((3, 3), abs=IN_POSITION)


@pytest.mark.parametrize(
    ("between", "several"),
    [("move", False), ("move", True), ("home", False), ("their move", False), ("their set position", False)],
)
def test_a_flight_begins_only_where_its_preparation_has_left_its_axes(between, several):
    async def theirs(command: MoveAbsolute | SetPosition) -> None:
        lease = next(each.lease for each in client.held.values() if "x" in each.axes)
        await client.command("x", command.model_copy(update={"lease": lease}))

    with laboratory() as lab, lab.powered("x", "y") as (x, y):
        client = lab.running.client
        device = lab.devices.flight(x, y) if several else x
        flights = {"x": Fly(1, 5), "y": Fly(1, 5)} if several else Fly(1, 5)
        device.prepare(flights).wait(60)
        match between:
            case "move":
                x.set(8).wait(60)
            case "home":
                x.home().wait(60)
            case "their move":
                lab.loop.run(theirs(MoveAbsolute(position=8.0)))
                lab.loop.run(lab.running.until("x", lambda state: state.target == 8 and state.command is None))
            case "their set position":
                lab.loop.run(theirs(SetPosition(position=8.0)))
        with moved(lab) as targets, pytest.raises(WrongState, match="no fly scan is prepared: x was moved since"):
            device.kickoff().wait(20)
        assert targets == []

        device.prepare(flights).wait(60)
        x.set(8).wait(60)
        x.set(1).wait(60)  # back at the start: the flight is the one that was prepared
        device.kickoff().wait(20)
        device.complete().wait(60)
        assert x.get() == pytest.approx(5, abs=IN_POSITION)


@pytest.mark.parametrize("several", [False, True])
def test_a_stop_at_the_prompt_halts_without_anybody_who_awaits_it(lab: Laboratory, several):
    with lab.powered("x") as (x,):
        x.set(0.0).wait(60)
        device = lab.devices.flight(x) if several else x
        with lab.caught_moving("x") as wait_until_moving:
            moving = x.set(40.0)
            wait_until_moving()
            said = device.stop()

        moving.wait(60)
        said.wait(20)
        assert lab.truth("x") < 39
        assert stands(lab, "x")


@pytest.mark.parametrize("powered", [True, False])
def test_a_stop_of_a_standing_axis_changes_nothing_and_is_no_error(lab: Laboratory, powered):
    def told():
        state = lab.loop.run(lab.running.until("x", lambda state: state.moving is Moving.NO and state.command is None))
        kept = (state.state, state.enabled, state.referenced, state.stop_latched, state.target, state.last_error)
        return (*kept, x._axis.target if powered else None), lab.truth("x")

    with lab.powered("x") as (x,):
        x.set(3.0004).wait(60)
        if not powered:
            x.power(on=False).wait(20)
        before, stood = told()
        x.stop().wait(20)
        lab.devices.flight(x).stop(success=False).wait(20)
        after, stands = told()

    assert after == before
    assert stands == pytest.approx(stood, abs=0.02)  # the loop still settles


def test_a_stop_sends_nothing_to_an_axis_that_another_program_has_taken_and_moves(lab: Laboratory):
    with suppress(LeaseExpired), lab.powered("x") as (x,):
        x.set(0.0).wait(60)
        ann = lab.loop.run(lab.running.client.ask(Acquire(client="ann", axes=("x",), force=True, lease_s=60.0)))
        assert isinstance(x.set(1.0).exception(20), LeaseExpired)
        lab.loop.run(asyncio.sleep(3.0))  # the next renewal says so, too
        lab.loop.run(lab.running.client.command("x", MoveAbsolute(position=20.0, lease=ann.lease)))
        x.stop().wait(20)
        lab.loop.run(lab.running.until("x", lambda state: state.moving is Moving.NO and state.command is None))
        reached = lab.truth("x")
        lab.loop.run(lab.running.client.ask(Release(lease=ann.lease)))

    assert reached == pytest.approx(20, abs=IN_POSITION)


def test_a_move_whose_start_is_not_answered_in_time_is_halted_and_fails(lab: Laboratory):
    with lab.powered("x") as (x,):
        x.set(0.0).wait(60)
        with losing(lab.running.session, answers={"move_absolute"}):
            failed = x.set(90.0, timeout=1.0).exception(60)

        assert isinstance(failed, CommandAborted)
        assert "was halted" in failed.message
        assert 1 < lab.truth("x") < 60
        assert stands(lab, "x")


def test_a_move_whose_halt_has_no_answer_is_not_said_to_be_halted_and_a_stop_ends_it(lab: Laboratory):
    with lab.powered("x") as (x,):
        x.set(0.0).wait(60)
        x.velocity.set(1.0).wait()
        with losing(lab.running.session, answers={"move_absolute"}, commands={"halt"}):
            failed = x.set(90.0, timeout=1.0).exception(60)
        x.stop().wait(60)  # no move of the device is under way, as far as its statuses tell

        assert isinstance(failed, OutcomeUnknown)
        assert "not confirmed" in failed.message
        assert 1 < lab.truth("x") < 60
        assert stands(lab, "x")


def test_an_exception_that_leaves_the_context_of_a_device_halts_its_axis(lab: Laboratory):
    with configured(lab, loss={"client": LossPolicy.RUN_TO_TARGET}):
        with pytest.raises(ZeroDivisionError), lab.powered("x") as (x,):  # noqa: PT012 - raised where the program is
            x.set(0.0).wait(60)
            x.velocity.set(1.0).wait()
            with lab.caught_moving("x", 90.0) as wait_until_moving:
                x.set(90.0)
                wait_until_moving()
            raise ZeroDivisionError
        lab.loop.run(lab.running.until("x", lambda state: state.moving is Moving.NO and state.command is None))
        place = lab.truth("x")

    assert place < 60


def test_each_device_has_a_lease_of_its_own(lab: Laboratory):
    with lab.powered("y") as (y,):
        with (
            suppress(LeaseExpired),
            lab.powered("x") as (x,),
        ):  # the end of the context may find it before the plan does
            lab.loop.run(lab.running.client.ask(Acquire(client="ann", axes=("x",), force=True)))
            refused = x.set(1).exception(20)
        assert isinstance(refused, LeaseExpired)
        y.set(1).wait(20)
        with pytest.raises(LeaseHeld), lab.devices.control("y", client="bob"):
            pass


async def test_values_of_a_daemon_with_another_unit_are_in_no_document_that_describes_the_former_one():
    broker, loop = MemoryBroker(), LoopThread(asyncio.get_running_loop())
    document = two_axes().model_dump(mode="json", exclude_unset=True)
    document["bus"][0]["axis"][0] |= {"unit": "um"}
    async with broker.session() as session, AsyncExitStack() as held:
        client = RigClient(session, "sim")
        async with running_rig(two_axes(), broker=broker) as first:
            await first.until("x", lambda state: state.link is LinkState.UP)
            rig = Rig(client, await client.daemon())
            (info,) = [each for each in await rig.describe() if each.axis == "x"]
            watched = await held.enter_async_context(rig.watch("x"))
            axis = ReadableAxis("x", watched, info, rig, loop)
            signal = Signal("x_position", rig, info, "position", loop)
            units = [(await device.describe())[device.name]["units"] for device in (axis, signal)]
            read = await axis.read()
        async with running_rig(RigConfig.model_validate(document), broker=broker) as second:
            await second.until("x", lambda state: state.link is LinkState.UP)
            await asyncio.sleep(1)
            for device in (axis, signal):
                with pytest.raises(WrongState, match="in um now"):
                    await device.read()
            again = [(await device.describe())[device.name]["units"] for device in (axis, signal)]
            read_again = await axis.read()

    assert (units, again) == (["mm", "mm"], ["um", "um"])
    assert (read["x"]["value"], read_again["x"]["value"]) == (pytest.approx(0, abs=1), pytest.approx(0, abs=1))
