"""However control over an axis is lost, what moves does what `loss.client` says; on the jumping clock."""

import asyncio
import contextlib

import pytest

from ldcnd.axis.recorder import TraceRecorder
from ldcnd.axis.reference import ReferenceKeeper
from ldcnd.axis.stopping import AxisStops, OwnStop
from ldcnd.client.events import latest_events
from ldcnd.client.lease import control
from ldcnd.config.rig import RigConfig, load_config
from ldcnd.contract.commands import BufferMode, MoveAbsolute, MoveVelocity, Power
from ldcnd.contract.errors import LdcndError, LeaseExpired, LeaseHeld, LeaseRequired, SessionError
from ldcnd.contract.events import CommandStatus
from ldcnd.contract.leases import Acquire, LeaseReply
from ldcnd.contract.rig_commands import Rehearsal, Rehearse
from ldcnd.contract.samples import AxisState, Moving, TelemetryItem
from ldcnd.daemon.daemon import Daemon
from ldcnd.daemon.health import HealthWatch
from ldcnd.daemon.leases import LeaseWatch
from ldcnd.daemon.line import BusService
from ldcnd.drives.axis_config import LossConfig, LossPolicy
from ldcnd.net.session import Publication
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain
from tests.support.chain_rig import drive
from tests.support.rig import SIMULATED, RunningRig, running_rig

BOTH = ("x", "y")
REACTS_WITHIN_S = 0.05


def config(policy: LossPolicy = LossPolicy.HALT) -> RigConfig:
    rig = load_config(SIMULATED)
    bus = rig.bus[0]
    axes = tuple(axis.model_copy(update={"loss": LossConfig(client=policy)}) for axis in bus.axis)
    return rig.model_copy(update={"bus": (bus.model_copy(update={"axis": axes}),), "authority": "leased"})


async def acquired(
    rig: RunningRig, client: str, *axes: str, force: bool = False, replaces: tuple[str, ...] = ()
) -> LeaseReply:
    request = Acquire(client=client, axes=axes, lease_s=60.0, force=force, replaces=replaces)
    return await rig.client.ask(request)


async def jogging(rig: RunningRig, lease: LeaseReply, axis: str) -> None:
    await rig.until(axis, lambda state: state.link == "up")
    await rig.client.command(axis, Power(on=True, lease=lease.lease))
    await rig.client.command(axis, MoveVelocity(velocity=5.0, lease=lease.lease))


async def jogs_on(rig: RunningRig, axis: str) -> bool:
    await asyncio.sleep(REACTS_WITHIN_S)
    return (await rig.client.state(axis)).state is AxisState.CONTINUOUS_MOTION


@pytest.mark.promise("loss-of-control")
async def test_who_takes_one_axis_by_force_stops_all_that_its_holder_moved():
    async with running_rig(config()) as rig:
        await jogging(rig, await acquired(rig, "ann", *BOTH), "y")
        await acquired(rig, "bob", "x", force=True)
        assert not await jogs_on(rig, "y")


async def test_an_axis_taken_by_force_in_mid_motion_comes_to_rest():
    async with running_rig(config()) as rig:
        await jogging(rig, await acquired(rig, "ann", "x"), "x")
        await acquired(rig, "bob", "x", force=True)
        assert not await jogs_on(rig, "x")


async def test_who_exchanges_a_lease_for_one_that_covers_less_stops_the_rest():
    async with running_rig(config()) as rig:
        held = await acquired(rig, "ann", *BOTH)
        await jogging(rig, held, "y")
        await acquired(rig, "ann", "x", replaces=(held.lease,))
        assert not await jogs_on(rig, "y")


async def test_who_exchanges_a_lease_for_one_that_covers_more_keeps_moving():
    async with running_rig(config()) as rig:
        held = await acquired(rig, "ann", "y")
        await jogging(rig, held, "y")
        await acquired(rig, "ann", *BOTH, replaces=(held.lease,))
        assert await jogs_on(rig, "y")


@pytest.mark.promise("loss-of-control")
@pytest.mark.parametrize("leave_running", [False, True])
async def test_a_release_in_mid_motion_stops_unless_it_is_to_leave_it_running(leave_running):
    async with running_rig(config()) as rig:
        await rig.until("x", lambda state: state.link == "up")
        async with control(rig.client, "ann", "x", lease_s=60.0, leave_running=leave_running) as held:
            await held.command("x", Power(on=True))
            await held.command("x", MoveVelocity(velocity=5.0))
        assert await jogs_on(rig, "x") is leave_running


async def test_the_policy_of_the_axis_decides_what_a_release_does():
    async with running_rig(config(LossPolicy.POWER_OFF)) as rig:
        await rig.until("x", lambda state: state.link == "up")
        async with control(rig.client, "ann", "x", lease_s=60.0) as held:
            await held.command("x", Power(on=True))
            await held.command("x", MoveVelocity(velocity=5.0))
        await rig.until("x", lambda state: state.state is AxisState.DISABLED, within_s=1.0)


async def test_a_release_at_rest_does_nothing_and_leaves_no_event():
    async with running_rig(config()) as rig:
        await rig.until("x", lambda state: state.link == "up")
        async with control(rig.client, "ann", "x", lease_s=60.0) as held:
            await held.command("x", Power(on=True))
            await asyncio.sleep(0.5)
        assert (await rig.client.state("x")).enabled
        assert not [event for event in await latest_events(rig.client, 1000) if event.verb == "acquire"]


async def test_events_tell_who_lost_control_and_who_was_refused_it():
    async with running_rig(config()) as rig:
        await jogging(rig, await acquired(rig, "ann", *BOTH), "y")
        with pytest.raises(LeaseHeld):
            await acquired(rig, "bob", "x")
        await acquired(rig, "bob", "x", force=True)

        events = [event for event in await latest_events(rig.client, 1000) if event.verb == "acquire"]
        told = {(event.axis, event.client, event.status, event.code) for event in events}
        assert told == {
            ("x", "bob", CommandStatus.REFUSED, "lease_held"),
            ("x", "ann", CommandStatus.ABORTED, "lease_expired"),
            ("y", "ann", CommandStatus.ABORTED, "lease_expired"),
        }
        assert "taken by force by bob" in next(event.reason for event in events if event.client == "ann")


async def test_refused_acquires_do_not_flood_the_events():
    async with running_rig(config()) as rig:
        await acquired(rig, "ann", "x")
        for _ in range(200):
            with pytest.raises(LeaseHeld):
                await acquired(rig, "bob", "x")
        assert len([event for event in await latest_events(rig.client, 1000) if event.verb == "acquire"]) <= 30


@pytest.mark.parametrize("kind", list(Rehearsal))
async def test_a_loss_is_rehearsed_under_a_lease_that_covers_what_it_concerns(kind):
    async with running_rig(config()) as rig:
        held = await acquired(rig, "ann", "x")
        await jogging(rig, held, "x")

        with pytest.raises((LeaseHeld, LeaseRequired)):
            await rig.client.ask(Rehearse(kind=kind, axis="x"), timeout_s=30.0)
        mine = Rehearse(kind=kind, axis="x", lease=held.lease)
        if kind is Rehearsal.BUS_LOSS:
            with pytest.raises(LeaseHeld, match="does not cover axis y"):
                await rig.client.ask(mine, timeout_s=30.0)
            assert await jogs_on(rig, "x")
            assert (await rig.client.state("x")).referenced
            whole = await acquired(rig, "ann", replaces=(held.lease,))
            mine = Rehearse(kind=kind, axis="x", lease=whole.lease)
        await rig.client.ask(mine, timeout_s=30.0)
        assert not await jogs_on(rig, "x")


ENDS = {
    LossPolicy.HALT: (AxisState.STANDSTILL, True, 0.0),
    LossPolicy.QUICK_STOP: (AxisState.STANDSTILL, True, 0.0),
    LossPolicy.POWER_OFF: (AxisState.DISABLED, False, 0.0),
    LossPolicy.RUN_TO_TARGET: (AxisState.STANDSTILL, True, 20.0),
}
FROZEN_S = 3.0


@pytest.mark.parametrize("policy", list(LossPolicy))
@pytest.mark.sweep(2)
async def test_a_client_that_freezes_in_mid_motion_has_its_axis_do_what_the_policy_says(policy):
    """What it sends when it goes on is refused, whatever the policy."""
    state, enabled, target = ENDS[policy]
    async with running_rig(config(policy)) as rig:
        lease = await rig.client.ask(Acquire(client="ann", axes=("x",), lease_s=1.0))
        await rig.until("x", lambda state: state.link == "up")
        await rig.client.command("x", Power(on=True, lease=lease.lease))
        await rig.client.command("x", MoveAbsolute(position=20.0, velocity=5.0, lease=lease.lease))
        waiting = MoveAbsolute(position=-20.0, lease=lease.lease, buffer_mode=BufferMode.BUFFERED)
        buffered = await rig.client.command("x", waiting)
        await asyncio.sleep(FROZEN_S)
        with pytest.raises(LeaseExpired):
            await rig.client.command("x", MoveVelocity(velocity=5.0, lease=lease.lease))
        assert await rig.refusal(buffered) in {"lease_expired", "stop_latched", "aborted"}
        await asyncio.sleep(3.0)
        last, position = await rig.client.state("x"), await rig.client.position("x")

    assert (last.state, last.enabled, last.moving) == (state, enabled, Moving.NO)
    assert position.value == pytest.approx(target, abs=0.05) if target else 4.0 < position.value < 7.0


@pytest.mark.promise("error-ends-in-order")
@pytest.mark.parametrize("part", ["health", "leases", "liveliness", "reference", "traces", "bring up"])
async def test_an_internal_error_brings_axes_to_rest_before_it_ends_the_daemon(monkeypatch, part):
    broken = asyncio.Event()
    chain = build_chain(ChainSpec(tuple(map(ModuleSpec, ("ls182ap", "ls182ap", "picservo-v4", "picservo-v4")))))

    async def fails(*_: object) -> None:
        await broken.wait()
        raise ZeroDivisionError

    for owner, method in {
        "health": [(HealthWatch, "run")],
        "leases": [(LeaseWatch, "run")],
        "liveliness": [(Daemon, "_watch_axes")],
        "reference": [(ReferenceKeeper, "run")],
        "traces": [(TraceRecorder, "run")],
        "bring up": [(BusService, "_scan_for_lost_drives")],
    }[part]:
        monkeypatch.setattr(owner, method, fails)

    with pytest.raises(ExceptionGroup):  # noqa: PT012 - the daemon's, with the error that ended it
        async with running_rig(load_config(SIMULATED), {"line0": chain}) as rig:
            await rig.power_on("x")
            await rig.client.command("x", MoveVelocity(velocity=5.0))
            await asyncio.sleep(0.5)
            broken.set()
            await asyncio.sleep(3.0)  # the daemon is gone by then
    await asyncio.sleep(1.0)  # a drive decelerates by itself

    assert drive(chain, 1).loop.trajectory.at_rest
    assert drive(chain, 1).loop.servo_on


@pytest.mark.promise("error-ends-in-order")
@pytest.mark.parametrize("error", [ZeroDivisionError, BaseException])
async def test_an_internal_error_where_a_reply_is_delivered_brings_axes_to_rest_before_it_ends_the_daemon(error):
    """It went into the loop, which closes a connection over it, or drops the reply."""
    chain = build_chain(ChainSpec(tuple(map(ModuleSpec, ("ls182ap", "ls182ap", "picservo-v4", "picservo-v4")))))
    loop, said = asyncio.get_running_loop(), list[object]()
    loop.set_exception_handler(lambda _, context: said.append(type(context["exception"])))

    def fails(*_: object) -> None:
        raise error

    with pytest.raises(BaseExceptionGroup):  # noqa: PT012 - the daemon's, with the error that ended it
        async with running_rig(load_config(SIMULATED), {"line0": chain}) as rig:
            await rig.power_on("x")
            await rig.client.command("x", MoveVelocity(velocity=5.0))
            await asyncio.sleep(0.5)
            rig.daemon.rig.lines["line0"].bus.listeners.append(fails)
            await asyncio.sleep(3.0)  # the daemon is gone by then
    await asyncio.sleep(1.0)  # a drive decelerates by itself

    assert drive(chain, 1).loop.trajectory.at_rest
    assert drive(chain, 1).loop.servo_on
    assert said == [error]


@pytest.mark.promise("error-ends-in-order")
@pytest.mark.parametrize("error", [ZeroDivisionError, BaseException])
async def test_an_internal_error_while_one_axis_is_brought_to_rest_leaves_no_other_one_running(monkeypatch, error):
    """It was cancelled with the task of a lease, and of the end of the daemon; a panic of Zenoh is no Exception."""
    chain = build_chain(ChainSpec(tuple(map(ModuleSpec, ("ls182ap", "ls182ap", "picservo-v4", "picservo-v4")))))
    to_rest = AxisStops.bring_to_rest

    async def fails(stops: AxisStops, *args: object, **kwargs: object) -> OwnStop:
        if stops is rig.daemon.rig.axes["x"].stops:
            raise error
        return await to_rest(stops, *args, **kwargs)

    with pytest.raises(BaseExceptionGroup):  # noqa: PT012 - the daemon's, with the error that ended it
        async with running_rig(load_config(SIMULATED), {"line0": chain}) as rig:
            lease = await rig.client.ask(Acquire(client="ann", axes=("x",), lease_s=1.0))
            await jogging(rig, lease, "x")
            await rig.client.command("y", Power(on=True))
            await rig.client.command("y", MoveVelocity(velocity=5.0))
            monkeypatch.setattr(AxisStops, "bring_to_rest", fails)
            await asyncio.sleep(4.0)  # the lease ends, and the daemon
    await asyncio.sleep(1.0)

    assert drive(chain, 2).loop.trajectory.at_rest


async def test_an_internal_error_in_the_stop_of_one_axis_leaves_no_other_one_running(monkeypatch):
    chain = build_chain(ChainSpec(tuple(map(ModuleSpec, ("ls182ap", "ls182ap", "picservo-v4", "picservo-v4")))))
    stop = AxisStops.stop

    async def fails(stops: AxisStops, *args: object) -> OwnStop:
        if stops is rig.daemon.rig.axes["x"].stops:
            raise ZeroDivisionError
        return await stop(stops, *args)

    async with running_rig(load_config(SIMULATED), {"line0": chain}) as rig:
        await rig.power_on("y")
        await rig.client.command("y", MoveVelocity(velocity=5.0))
        await asyncio.sleep(0.5)
        monkeypatch.setattr(AxisStops, "stop", fails)
        with contextlib.suppress(LdcndError):
            await rig.client.stop()
        await asyncio.sleep(1.0)
        at_rest = drive(chain, 2).loop.trajectory.at_rest
        monkeypatch.undo()

    assert at_rest


async def test_a_network_that_takes_no_token_for_a_while_stops_no_axis(monkeypatch):
    """The daemon ended for it, and brought everything to rest."""
    async with running_rig(load_config(SIMULATED)) as rig:
        await rig.power_on("x")
        await rig.client.command("x", MoveVelocity(velocity=5.0))
        bus, session = rig.daemon.rig.lines["line0"].bus, type(rig.session)

        async def takes_none(_session: object, key: str) -> None:
            raise SessionError(f"{key}: cannot declare within 5 s: a peer takes nothing")

        with monkeypatch.context() as patched:
            patched.setattr(session, "declare_token", takes_none)
            bus.drop("a cable that comes loose")
            await rig.until("x", lambda state: state.link == "down")
            await rig.until("x", lambda state: state.link == "up")
            await asyncio.sleep(1.0)
            await rig.client.command("y", Power(on=True))
        await asyncio.sleep(1.0)
        assert (await rig.client.state("y")).enabled


async def test_a_network_that_takes_no_value_for_a_while_stops_no_axis(monkeypatch):
    """The daemon ended for the first sample that could not be put."""
    async with running_rig(load_config(SIMULATED)) as rig:
        await rig.power_on("x")
        await rig.client.command("x", MoveVelocity(velocity=5.0))
        before = await rig.client.last("x", TelemetryItem.POSITION)

        def takes_none(_session: object, sample: Publication) -> None:
            raise SessionError(f"{sample.key}: cannot publish")

        with monkeypatch.context() as patched:
            patched.setattr(type(rig.session), "_offer", takes_none)
            await asyncio.sleep(3.0)  # also what is published once a second
        assert await jogs_on(rig, "x")
        after = await rig.client.last("x", TelemetryItem.POSITION)
        assert after.seq - before.seq > 3.0 * 5  # those that were lost have their numbers
