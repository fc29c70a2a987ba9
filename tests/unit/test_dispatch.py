"""Who may command an axis, how often, and what becomes of it: dispatcher, leases and requests, without a line."""

import asyncio
import contextlib
import json
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from functools import partial
from types import SimpleNamespace

import pytest

from ldcnd.axis.axis import AxisService
from ldcnd.axis.clock import Clock
from ldcnd.contract.catalogue import BY_VERB, RENAMED
from ldcnd.contract.commands import (
    About,
    AxisCommand,
    BufferMode,
    Effect,
    Halt,
    Home,
    HomeMethod,
    Jog,
    MoveAbsolute,
    MoveAnalog,
    MoveRelative,
    MoveVelocity,
    Power,
    Probe,
    QuickStop,
    Reset,
    SetGains,
    SetOutputs,
    SetPosition,
    SetPwm,
    Stop,
    Track,
    Verb,
)
from ldcnd.contract.errors import (
    CommandExpired,
    CommandIdReused,
    DuplicateDaemon,
    LdcndError,
    LeaseExpired,
    LeaseHeld,
    LeaseRequired,
    MalformedRequest,
    NotReferenced,
    OutcomeUnknown,
    ReplyTimeout,
    StaleSequence,
    UnknownAxis,
)
from ldcnd.contract.events import CommandStatus, ReadEvents, ReadOutcome
from ldcnd.contract.leases import Acquire, LeaseReply, ListHolders, Release, Renew
from ldcnd.contract.questions import Preview, Why
from ldcnd.contract.rig_commands import AxisMove, MoveTogether, Rehearsal, Rehearse, SetSpeedOverride
from ldcnd.contract.samples import AxisState, LinkState
from ldcnd.daemon.dispatch import Dispatcher
from ldcnd.daemon.leases import Authority
from ldcnd.daemon.ledger import EventLog, Ledger
from ldcnd.daemon.requests import PENDING_REQUESTS, Requests
from ldcnd.daemon.rig import OwnedRig
from ldcnd.drives.driver import Fault, StopMode
from ldcnd.net.hand_over import Query
from tests.support.axis_bench import KEYS, RUNNING, STANDING, AxisBench, axis_bench, put, raising

THERE = MoveAbsolute(position=10.0)
INSTANCE = "run-1"


class Line:
    """What is asked of a line here."""

    network = None

    def __init__(self, axes: tuple[AxisService, ...], wire: list[bytes]) -> None:
        self.axes = axes
        log = SimpleNamespace(add=lambda _at_s, _event, line: wire.append(line))
        self.bus = SimpleNamespace(wire_log=log, settings=SimpleNamespace(name="line"))

    async def stop_together(self, _mode: StopMode, _names: frozenset[str]) -> None:
        """Every drive is stopped by itself as well."""


class Commanded:
    """Two axes and all that stands between them and the network."""

    def __init__(self, x: AxisBench, y: AxisBench, group: asyncio.TaskGroup, *, required: bool) -> None:
        self.x, self.y = x, y
        self.wire: list[bytes] = []
        self.rig = OwnedRig("bench", (Line((x.axis, y.axis), self.wire),), {"both": ("x", "y")})
        self.authority = Authority(["x", "y"], required=required)
        clock = Clock(lambda: round(asyncio.get_running_loop().time() * 1e9))
        events = EventLog(x._publisher, clock, INSTANCE)
        ledger = Ledger(events.changed, clock.now_s)
        self.dispatcher = Dispatcher(self.rig, self.authority, ledger, events, clock, INSTANCE)
        self.dispatcher.leases.group = group
        self.requests = Requests(self.rig, KEYS, group, self.dispatcher)
        for bench in (x, y):
            bench.axis.readings._on_ended = ledger.ended
        self.answers: list[dict] = []

    async def send(self, command, axis: str = "x", login: str | None = None):
        return await self.dispatcher.answer(axis, command, login)

    async def acquired(self, *axes: str, client: str = "ann", **fields: object) -> LeaseReply:
        return await self.send(Acquire(client=client, axes=axes, **fields), "_")

    def query(self, key: str, payload: bytes = b"") -> Query:
        """Return a query whose answer is kept."""
        return Query(key, {}, payload, "application/json", lambda answers: self.answers.extend(map(_json, answers)))

    def page(self) -> list[tuple[str, str, str]]:
        """Return what the events say: axis, verb, status."""
        found = self.dispatcher.events.page(ReadEvents(count=100)).events
        return [(event.axis, event.verb, event.status.value) for event in found]


def _json(answer) -> dict:
    return json.loads(answer.payload)


@asynccontextmanager
async def commanded(*, required: bool = False, **axis: object) -> AsyncIterator[Commanded]:
    async with axis_bench(**axis) as x, axis_bench(name="y", **axis) as y, asyncio.TaskGroup() as group:
        yield Commanded(x, y, group, required=required)


FIELDS: dict[str, dict[str, object]] = {
    "power": {"on": True},
    "move_absolute": {"position": 1.0},
    "move_relative": {"distance": 1.0},
    "move_velocity": {"velocity": 1.0},
    "jog": {"velocity": 1.0},
    "home": {"method": "index"},
    "probe": {"sources": ["index"], "position": 1.0},
    "set_position": {"position": 1.0},
    "set_gains": {"kp": 1},
    "move_analog": {"target": 1},
    "set_pwm": {"duty": 0.1, "duration_s": 1.0},
    "track": {"position": 1.0},
    "set_outputs": {},
    "clear_counter": {"counter": "command"},
    "write_parameter": {"parameter": "Pn102", "value": 1},
    "trace": {"channels": ["position"]},
}
"""The least that a command needs, by its verb."""


# -- at most once ------------------------------------------------------------------------------------------------------


async def test_a_repeated_command_moves_once_and_is_answered_alike_also_while_it_is_under_way():
    command = THERE.model_copy(update={"command_id": "c1"})
    async with commanded() as rig:
        released = asyncio.Event()
        rig.x.drive.during["load"] = released.wait
        async with asyncio.TaskGroup() as group:
            first = group.create_task(rig.send(command), name="first")
            await asyncio.sleep(0)
            second = group.create_task(rig.send(command), name="second")
            await asyncio.sleep(0.01)
            assert not second.done()
            released.set()
        third = await rig.send(command)

        assert first.result() == second.result() == third
        assert rig.x.drive.calls == ["load", "start"]
        with pytest.raises(CommandIdReused):
            await rig.send(command.model_copy(update={"position": 11.0}))
        with pytest.raises(CommandIdReused):
            await rig.send(command, "y")


def waiting_commands() -> list[type[AxisCommand]]:
    """Return what waits for its turn: all but questions, and what takes energy out."""
    known = BY_VERB[About.AXIS].values()
    return [kind for kind in known if issubclass(kind, AxisCommand) and kind.effect in (Effect.CHANGE, Effect.MOTION)]


@pytest.mark.parametrize("kind", waiting_commands(), ids=lambda kind: kind.verb.value)
async def test_what_gets_its_turn_after_its_sender_has_given_up_does_not_begin(kind):
    command = kind.model_validate(FIELDS.get(kind.verb, {}))
    async with commanded() as rig:
        released = asyncio.Event()
        rig.x.drive.during["set_gains"] = released.wait
        async with asyncio.TaskGroup() as group:
            group.create_task(rig.send(SetGains(kp=100)), name="takes long")
            await asyncio.sleep(0.1)
            waiting = group.create_task(refused(rig.send(command)), name="behind")
            await asyncio.sleep(command.answer_s)
            released.set()

        # a jog is over with its hold, which is shorter
        assert isinstance(waiting.result(), LeaseExpired if kind is Jog else CommandExpired)
        assert rig.x.drive.calls == ["set_gains"]


async def refused(sent) -> LdcndError | None:
    """Return the error that a command is answered with."""
    try:
        await sent
    except LdcndError as error:
        return error


async def test_a_repeated_refusal_stays_a_refusal():
    command = THERE.model_copy(update={"command_id": "c1"})
    async with commanded() as rig:
        put(rig.x.tracker, referenced=False)
        with pytest.raises(NotReferenced):
            await rig.send(command)
        put(rig.x.tracker, referenced=True)
        with pytest.raises(NotReferenced):
            await rig.send(command)

        outcome = await rig.send(ReadOutcome(command_id="c1"), "_")
        assert (outcome.status, outcome.axis, outcome.verb) == (CommandStatus.REFUSED, "x", "move_absolute")
        assert rig.x.drive.calls == []


async def test_a_repeated_halt_halts_again_under_an_id_of_its_own():
    async with commanded() as rig:
        for expected in (1, 2):
            await rig.x.send(MoveVelocity(velocity=1.0))
            await rig.x.pass_s(0.1, **RUNNING)
            reply = await rig.send(Halt(command_id="h1"))
            assert rig.x.drive.calls.count("stop") == expected
            await rig.x.settled()

    assert reply.command_id != "h1"


@pytest.mark.parametrize(
    ("error", "status"),
    [(ReplyTimeout("no reply"), CommandStatus.FAILED), (OutcomeUnknown("no reply"), CommandStatus.UNKNOWN)],
)
async def test_the_outcome_tells_what_became_of_a_command(error, status):
    async with commanded() as rig:
        rig.x.drive.during["start"] = raising(error)
        with pytest.raises(LdcndError):
            await rig.send(THERE.model_copy(update={"command_id": "c1"}))

        assert (await rig.send(ReadOutcome(command_id="c1"), "_")).status is status


async def test_a_motion_is_executing_until_the_readings_end_it_and_other_commands_are_done_at_once():
    async with commanded() as rig:
        await rig.send(SetGains(kp=100, command_id="c0"))
        await rig.send(THERE.model_copy(update={"command_id": "c1"}))
        await rig.x.pass_s(0.1, **RUNNING)
        await rig.send(SetGains(kd=100, command_id="c2"))  # ends at once, also while something moves
        assert [(await rig.send(ReadOutcome(command_id=each), "_")).status for each in ("c0", "c1", "c2")] == [
            CommandStatus.DONE, CommandStatus.EXECUTING, CommandStatus.DONE,
        ]  # fmt: skip
        await rig.x.pass_s(0.1, **STANDING)
        assert (await rig.send(ReadOutcome(command_id="c1"), "_")).status is CommandStatus.DONE


async def test_a_command_that_is_cut_short_is_unknown_and_not_carried_out_again():
    command = THERE.model_copy(update={"command_id": "c1"})
    async with commanded() as rig:
        rig.x.drive.during["load"] = asyncio.Event().wait
        task = asyncio.create_task(rig.send(command), name="cut short")
        await asyncio.sleep(0.01)
        task.cancel()
        await asyncio.wait([task])

        assert (await rig.send(ReadOutcome(command_id="c1"), "_")).status is CommandStatus.UNKNOWN
        with pytest.raises(OutcomeUnknown):
            await rig.send(command)
        assert rig.x.drive.calls == ["load"]


# -- who may -----------------------------------------------------------------------------------------------------------


async def test_what_brings_an_axis_to_rest_is_admitted_whatever_else_forbids():
    async with commanded(required=True) as rig:
        await rig.acquired("x", client="bob")
        rig.dispatcher.rivals.add("another")
        for command in (kind(not_after=1, instance="other", after_stops=9) for kind in (Stop, Halt)):
            await rig.x.pass_s(0.1, **RUNNING)
            await rig.send(command)
            await rig.x.settled()

    assert rig.x.drive.told[0] == ("stop", StopMode.SMOOTH)


@pytest.mark.parametrize("command", [THERE, Power(on=True), MoveVelocity(velocity=1.0), SetGains(kp=1)])
async def test_what_may_move_or_changes_a_drive_is_refused_without_a_right_to_it(command):
    async with commanded(required=True) as rig:
        with pytest.raises(LeaseRequired):
            await rig.send(command)
        other = await rig.acquired("y")
        with pytest.raises(LeaseHeld):
            await rig.send(command.model_copy(update={"lease": other.lease}))
        mine = await rig.acquired("x")
        rig.dispatcher.rivals.add("another")
        with pytest.raises(DuplicateDaemon):
            await rig.send(command.model_copy(update={"lease": mine.lease}))
        rig.dispatcher.rivals.clear()
        past_ns = round((asyncio.get_running_loop().time() - 0.5) * 1e9)
        with pytest.raises(CommandExpired, match=r"0\.500 s later"):
            await rig.send(command.model_copy(update={"lease": mine.lease, "not_after": past_ns}))
        with pytest.raises(CommandExpired, match="another run"):
            await rig.send(command.model_copy(update={"lease": mine.lease, "instance": "run-0"}))
        with pytest.raises(CommandExpired, match="later than its sender allows"):
            await rig.send(command.model_copy(update={"lease": mine.lease, "not_after": 1}))
        assert rig.x.drive.calls == []

        later_ns = round((asyncio.get_running_loop().time() + 1.0) * 1e9)
        await rig.send(command.model_copy(update={"lease": mine.lease, "instance": INSTANCE, "not_after": later_ns}))
        assert rig.x.drive.calls or isinstance(command, Power)  # the loop is closed already


async def test_sequences_go_upwards_and_an_event_names_who_sent():
    async with commanded() as rig:
        mine = await rig.acquired("x")
        await rig.send(SetGains(kp=1, lease=mine.lease, sequence=5))
        with pytest.raises(StaleSequence):
            await rig.send(SetGains(kp=2, lease=mine.lease, sequence=5))
        events = rig.dispatcher.events.page(ReadEvents(count=10)).events

    assert [event.client for event in events if event.verb == "set_gains"] == ["ann", "ann"]


async def test_a_buffered_move_is_refused_when_its_lease_has_ended_before_its_turn():
    async with commanded() as rig:
        mine = await rig.acquired("x", lease_s=0.5)
        await rig.send(THERE.model_copy(update={"lease": mine.lease}))
        await rig.x.pass_s(0.1, **RUNNING)
        async with asyncio.TaskGroup() as group:
            waiting = group.create_task(
                _outcome(rig.send(MoveAbsolute(position=20.0, lease=mine.lease, buffer_mode=BufferMode.BUFFERED))),
                name="next",
            )
            await rig.x.pass_s(0.5, **STANDING)

        assert isinstance(waiting.result(), LeaseExpired)
        assert rig.x.drive.calls == ["load", "start"]


async def test_a_buffered_move_is_refused_when_it_comes_too_late_or_a_rival_has_appeared():
    async with commanded() as rig:
        for late in (True, False):
            await rig.send(THERE)
            await rig.x.pass_s(0.1, **RUNNING)
            not_after = round((asyncio.get_running_loop().time() + (0.3 if late else 9.0)) * 1e9)
            move = MoveAbsolute(position=20.0, buffer_mode=BufferMode.BUFFERED, not_after=not_after)
            async with asyncio.TaskGroup() as group:
                waiting = group.create_task(_outcome(rig.send(move)), name="next")
                await asyncio.sleep(0.5)
                rig.dispatcher.rivals = set() if late else {"another"}
                await rig.x.settled()
            assert isinstance(waiting.result(), CommandExpired if late else DuplicateDaemon)

    assert rig.x.drive.calls == ["load", "start"] * 2


async def test_why_and_preview_tell_what_the_sender_would_be_refused_with_and_do_nothing():
    async with commanded(required=True) as rig:
        mine = await rig.acquired("x")
        assert [cause.code for cause in (await rig.send(Why())).causes] == ["lease_held"]
        assert (await rig.send(Why(lease=mine.lease))).can_move
        rig.dispatcher.rivals.add("another")
        assert [cause.code for cause in (await rig.send(Why(lease=mine.lease))).causes] == ["duplicate_daemon"]
        put(rig.x.tracker, referenced=False)
        obstacles = (await rig.send(Preview(position=1.0))).obstacles
        assert len(obstacles) == 2
        assert len((await rig.send(Preview(distance=1.0))).obstacles) == 1

    assert rig.x.drive.calls == []
    assert rig.page() == []


FIT = {
    "power": Power(on=True),
    "move_absolute": THERE,
    "move_relative": MoveRelative(distance=1.0),
    "move_velocity": MoveVelocity(velocity=1.0),
    "jog": Jog(velocity=1.0),
    "halt": Halt(),
    "quick_stop": QuickStop(),
    "stop": Stop(),
    "home": Home(method=HomeMethod.INDEX, velocity=1.0),
    "probe": Probe(sources=("forward_limit",), distance=1.0),
    "reset": Reset(),
    "set_position": SetPosition(position=0.0),
    "set_gains": SetGains(kp=300, el=4000),
    "move_analog": MoveAnalog(target=500),
    "set_pwm": SetPwm(duty=0.1, duration_s=1.0),
    "track": Track(position=0.1),
    "set_outputs": SetOutputs(),
}
"""Commands whose values are right, by verb: only the state of the axis, or the right of the sender, refuses them."""


async def _latched(rig: Commanded) -> None:
    await rig.x.stop()
    await rig.x.settled()


async def _moving(rig: Commanded) -> None:
    await rig.send(MoveVelocity(velocity=1.0))
    await rig.x.pass_s(0.1, **RUNNING)


async def _disabled(rig: Commanded) -> None:
    await rig.send(Power(on=False))
    await rig.x.settled(enabled=False)


async def _turning(rig: Commanded) -> None:
    await _disabled(rig)
    await rig.x.pass_s(0.1, enabled=False, **RUNNING)


async def _without_gains(rig: Commanded) -> None:
    await _disabled(rig)
    rig.x.drive.wanted_gains = None


async def _faulted(rig: Commanded) -> None:
    await rig.x.settled(faults=(Fault("overheat", "too hot", stops=True),))


async def _foreign(rig: Commanded) -> None:
    await rig.acquired("x", client="bob")


async def _two_daemons(rig: Commanded) -> None:
    rig.dispatcher.rivals.add("another")


async def _put(rig: Commanded, **fields: object) -> None:
    put(rig.x.tracker, **fields)


STATES = {
    "standstill": _put,
    "disabled": _disabled,
    "turning, disabled": _turning,
    "gains unknown": _without_gains,
    "faulted": _faulted,
    "latched": _latched,
    "moving": _moving,
    "not homed": partial(_put, referenced=False),
    "position lost": partial(_put, referenced=False, position_lost=True),
    "link down": partial(_put, link=LinkState.DOWN),
    "link down, latched, not homed": partial(_put, link=LinkState.DOWN, stop_latched=True, referenced=False),
    "override 0 %": partial(_put, speed_share=0.0),
    "foreign control": _foreign,
    "two daemons": _two_daemons,
}


@pytest.mark.parametrize("state", STATES)
@pytest.mark.sweep(3)
async def test_why_says_of_each_command_what_it_is_refused_with(state):
    pwm, tracking = {"duty": 0.5, "duration_s": 5.0}, {"step": 3.0, "rate": 50.0}
    said, found = {}, {}
    for verb, command in FIT.items():
        async with commanded(pwm=pwm, tracking=tracking) as rig:
            await STATES[state](rig)
            groups = (await rig.send(Why(each_command=True))).commands
            (causes,) = [group.causes for group in groups if verb in group.verbs]
            said[verb] = (causes[0].code, causes[0].text, causes[0].remedy) if causes else None
            error = await refused(rig.send(command))
            found[verb] = (error.code.value, error.message, error.remedy) if error else None

    assert said == found


async def test_why_names_every_command_of_the_axis_once_and_a_stop_is_never_forbidden():
    async with commanded(required=True) as rig:
        await _latched(rig)
        await _put(rig, link=LinkState.DOWN, speed_share=0.0)
        groups = (await rig.send(Why(each_command=True))).commands

    assert sorted(verb for group in groups for verb in group.verbs) == sorted(Verb)
    assert {"halt", "stop", "quick_stop"} <= {verb for group in groups for verb in group.verbs if not group.causes}


async def test_why_says_each_cause_of_an_error_stop_once_and_that_the_loop_is_open_as_well():
    async with commanded() as rig:
        await rig.x.settled(faults=(Fault("overheat", "too hot"), Fault("overvoltage", "too high")), enabled=False)
        causes = (await rig.send(Why(absolute=False))).causes

    assert [(cause.code, cause.text) for cause in causes] == [
        ("drive_fault", "axis x: too hot"),
        ("drive_fault", "axis x: too high"),
        ("wrong_state", "axis x is in error stop"),
        ("wrong_state", "axis x is disabled"),
    ]


async def test_why_names_what_else_has_led_to_an_error_stop():
    async with commanded() as rig:
        await rig.x.settled(enabled=False)  # the drive has opened its loop by itself
        causes = (await rig.send(Why(absolute=False))).causes

    assert [cause.text.partition(":")[0] for cause in causes] == ["axis x is in error stop", "axis x is disabled"]
    assert "opened its position loop by itself" in causes[0].text


async def test_a_warning_of_a_drive_keeps_no_axis_from_moving():
    async with commanded() as rig:
        await rig.x.settled(faults=(Fault("servo_overrun", "late", stops=False),))
        reply = await rig.send(Why(absolute=False))
        await rig.send(MoveRelative(distance=1.0))

    assert (reply.can_move, reply.causes) == (True, ())


async def test_why_marks_what_a_move_may_wait_for():
    async with commanded() as rig:
        await _moving(rig)
        reply = await rig.send(Why(each_command=True))
        assert [cause.passes for cause in reply.causes] == [True]
        reply = await rig.send(Why())
        assert reply.commands == ()


@pytest.mark.parametrize("kind", Rehearsal)
async def test_a_loss_is_rehearsed_only_by_who_may_move_all_that_it_concerns(kind):
    async with commanded(required=True) as rig:
        mine = await rig.acquired("x")
        rig.dispatcher.rivals.add("another")
        with pytest.raises(DuplicateDaemon):
            await rig.send(Rehearse(kind=kind, axis="x", lease=mine.lease), "_")
        rig.dispatcher.rivals.clear()
        with pytest.raises((LeaseRequired, LeaseHeld)):
            await rig.send(Rehearse(kind=kind, axis="y"), "_")
        if kind is Rehearsal.BUS_LOSS:  # y is on the same line
            with pytest.raises(LeaseHeld):
                await rig.send(Rehearse(kind=kind, axis="x", lease=mine.lease), "_")
        else:
            await rig.x.send(MoveVelocity(velocity=1.0))
            await rig.x.pass_s(0.1, **RUNNING)
            reply = await rig.send(Rehearse(kind=kind, axis="x", lease=mine.lease), "_")
            assert (reply.policy, rig.x.drive.told[-1]) == ("halt", ("stop", StopMode.SMOOTH))


async def test_a_group_move_names_each_axis_once_and_axes_of_one_line():
    async with commanded() as rig:
        with pytest.raises(MalformedRequest):
            await rig.send(MoveTogether(moves=(AxisMove(axis="x", position=1.0),) * 2), "_")
        with pytest.raises(UnknownAxis):
            await rig.send(
                MoveTogether(moves=(AxisMove(axis="x", position=1.0), AxisMove(axis="q", position=1.0))), "_"
            )


# -- leases ------------------------------------------------------------------------------------------------------------


async def moving(rig: Commanded, lease: str | None = None) -> None:
    await rig.send(MoveVelocity(velocity=1.0, lease=lease))
    await rig.x.pass_s(0.1, **RUNNING)
    rig.x.drive.told.clear()


@pytest.mark.parametrize("how", ["expired", "forced", "subset", "released"])
async def test_however_control_ends_what_moved_comes_to_rest(how):
    async with commanded(loss={"client": "quick_stop"}) as rig:
        mine = await rig.acquired("x", "y", lease_s=1.0)
        await moving(rig, mine.lease)
        if how == "expired":
            await asyncio.sleep(1.0)
            rig.dispatcher.leases.expire()
        elif how == "forced":
            await rig.acquired("y", client="bob", force=True)
        elif how == "subset":
            await rig.acquired("y", replaces=(mine.lease,))
        else:
            await rig.send(Release(lease=mine.lease), "_")
        await asyncio.sleep(0.001)

        assert rig.x.drive.told == [("stop", StopMode.ABRUPT)]
        assert rig.y.drive.calls == []  # it stands
        lost = [event for event in rig.page() if event[1] == "acquire"]
        assert ("x", "acquire", "aborted") in lost


async def test_a_renewed_or_wider_lease_keeps_what_moves_and_leave_running_lets_it_go_on():
    async with commanded() as rig:
        mine = await rig.acquired("x", lease_s=1.0)
        await moving(rig, mine.lease)
        await asyncio.sleep(0.6)
        renewed = await rig.send(Renew(lease=mine.lease), "_")
        await asyncio.sleep(0.6)
        rig.dispatcher.leases.expire()
        wider = await rig.acquired("both", replaces=(mine.lease,))
        await rig.send(Release(lease=wider.lease, leave_running=True), "_")
        await asyncio.sleep(0.001)

        assert (renewed.lease, wider.axes) == (mine.lease, ("x", "y"))
        assert rig.x.drive.calls == []
        assert [event for event in rig.page() if event[1] == "acquire"] == [("x", "acquire", "done")]


@pytest.mark.parametrize("mine", [True, False])
async def test_a_lease_that_is_exchanged_for_another_keeps_what_moves_and_one_that_is_taken_does_not(mine):
    async with commanded() as rig:
        first = await rig.acquired("x")
        await moving(rig, first.lease)
        await rig.acquired("x", force=True, replaces=(first.lease,) if mine else ())
        await asyncio.sleep(0.001)

        assert rig.x.drive.calls == ([] if mine else ["stop"])
        assert [event for event in rig.page() if event[1] == "acquire"] == (
            [] if mine else [("x", "acquire", "aborted")]
        )


async def test_so_many_refused_acquires_leave_an_event_and_no_more():
    async with commanded(required=True) as rig:
        await rig.acquired("x", lease_s=60.0)
        for _ in range(100):
            with pytest.raises(LeaseHeld):
                await rig.acquired("x", client="bob")
        assert rig.page().count(("x", "acquire", "refused")) == 20

        await asyncio.sleep(10.0)
        with pytest.raises(LeaseHeld):
            await rig.acquired("x", client="bob")
        assert rig.page().count(("x", "acquire", "refused")) == 21


async def test_holders_are_told_and_a_refused_acquire_leaves_an_event():
    async with commanded(required=True) as rig:
        await rig.acquired("x")
        with pytest.raises(LeaseHeld):
            await rig.acquired("x", client="bob")
        holders = await rig.send(ListHolders(), "_")

        assert holders.required
        assert [(each.axis, each.client) for each in holders.holders] == [("x", "ann"), ("y", None)]
        assert rig.page() == [("x", "acquire", "refused")]


async def test_the_watch_ends_leases_by_itself():
    async with commanded() as rig:
        mine = await rig.acquired("x", lease_s=1.0)
        await moving(rig, mine.lease)
        watch = asyncio.create_task(rig.dispatcher.leases.run(), name="watch")
        await asyncio.sleep(1.01)
        assert rig.x.drive.calls == ["stop"]
        watch.cancel()
        await asyncio.wait([watch])


# -- queries -----------------------------------------------------------------------------------------------------------


async def test_a_lease_that_has_ended_is_acted_upon_before_a_command_that_waited_is_looked_at():
    async with commanded(loss={"client": "power_off"}) as rig:
        mine = await rig.acquired("x", lease_s=1.0)
        await moving(rig, mine.lease)
        await asyncio.sleep(2.0)  # nobody has looked: the process was frozen

        rig.requests.on_command(rig.query(KEYS.command("x", "power"), b'{"on": true}'))
        await asyncio.sleep(0.01)

        assert rig.x.drive.told[0] == ("stop", StopMode.OFF)


async def test_so_many_commands_may_be_under_way_and_no_more():
    async with commanded() as rig:
        released = asyncio.Event()
        rig.x.drive.during["set_gains"] = released.wait
        for _ in range(PENDING_REQUESTS + 1):
            rig.requests.on_command(rig.query(KEYS.command("x", "set_gains"), b'{"kp": 1}'))
        assert [answer["code"] for answer in rig.answers] == ["too_many_requests"]
        released.set()
        await asyncio.sleep(0.01)
        rig.answers.clear()
        rig.requests.on_command(rig.query(KEYS.command("x", "set_gains"), b'{"kp": 1}'))
        await asyncio.sleep(0.01)

    assert rig.answers[0]["verb"] == "set_gains"


@pytest.mark.parametrize(
    ("axis", "verb", "payload", "code"),
    [
        ("q", "halt", b"", "unknown_axis"),
        ("q", "dance", b"", "unknown_axis"),
        ("x", "dance", b"", "unknown_verb"),
        ("_", "dance", b"", "unknown_verb"),
        ("x", "plan", b"", "unknown_verb"),
        ("x", "power", b"nonsense", "malformed_request"),
    ],
)
async def test_a_query_that_means_nothing_is_refused(axis, verb, payload, code):
    async with commanded() as rig:
        rig.requests.on_command(rig.query(KEYS.command(axis, verb), payload))
        await asyncio.sleep(0.01)

    assert [answer["code"] for answer in rig.answers] == [code]


async def test_a_command_that_was_renamed_is_refused_with_its_name_of_now():
    (before, now), *_ = RENAMED.items()
    async with commanded() as rig:
        rig.requests.on_command(rig.query(KEYS.command("x", before)))
        await asyncio.sleep(0.01)

    assert f"is called '{now}' now" in rig.answers[0]["message"]


async def test_a_halt_of_an_axis_that_stands_is_done_with_its_reply():
    async with commanded() as rig:
        await rig.send(Halt(command_id="h1"))

        assert (await rig.send(ReadOutcome(command_id="h1"), "_")).status is CommandStatus.DONE


async def test_a_daemon_that_ends_takes_stops_and_refuses_everything_else():
    async with commanded() as rig:
        await moving(rig)
        rig.requests.close()
        rig.requests.on_command(rig.query(KEYS.command("x", "power"), b'{"on": true}'))
        rig.requests.on_stop(rig.query(KEYS.stop("x"), b"nonsense"))
        await asyncio.sleep(0.01)

    assert [answer.get("code") for answer in rig.answers] == ["shutting_down", None]
    assert rig.answers[1]["confirmed"] == ["x"]
    assert rig.x.drive.calls == ["stop"]
    assert rig.page()[-1] == ("x", "stop", "done")


async def test_a_stop_of_the_rig_latches_every_axis_and_enters_one_event_for_each():
    async with commanded() as rig:
        rig.y.drive.during["stop"] = raising(ReplyTimeout("no reply"))
        rig.y.bus.is_open = False
        rig.requests.on_stop(rig.query(KEYS.stop(None), b'{"client": "ann"}'))
        assert not rig.x.tracker.status.stop_latched  # callbacks only hand over
        await asyncio.sleep(0.01)

        assert (rig.x.tracker.status.stop_latched, rig.y.tracker.status.stop_latched) == (True, True)
        assert rig.answers[0]["axes"] == ["x", "y"]
        assert rig.answers[0]["confirmed"] == ["x"]
        assert rig.page() == [("x", "stop", "done"), ("y", "stop", "unknown")]
        assert rig.wire[-1] == b"@stop {}"


async def test_no_reader_of_the_wire_log_can_command_with_what_it_contains():
    async with commanded(required=True) as rig:
        held = (await rig.acquired("both")).lease
        again = (await rig.acquired("both", replaces=(held,))).lease
        moves = tuple(AxisMove(axis=name, position=1.0, lease=held) for name in ("x", "y"))
        for command in (MoveTogether(moves=moves), SetSpeedOverride(percent=50.0, leases=(held, again))):
            with contextlib.suppress(LdcndError):
                await rig.send(command, "_")
        noted = b"".join(rig.wire)
        assert all(verb in noted for verb in (b"_/acquire", b"replaces", b"_/move_together", b"_/set_speed_override"))
        assert held.encode() not in noted
        assert again.encode() not in noted


async def test_commands_are_noted_on_the_wire_log_and_questions_are_not():
    async with commanded() as rig:
        await rig.send(THERE)
        await rig.send(Why())
        await rig.send(ListHolders(), "_")
        await rig.acquired("x")

        assert [line.split(b" ")[0] for line in rig.wire] == [b"x/move_absolute", b"_/acquire"]
        assert rig.x.tracker.status.state is AxisState.DISCRETE_MOTION


async def _outcome(call):
    try:
        return await call
    except LdcndError as error:
        return error
