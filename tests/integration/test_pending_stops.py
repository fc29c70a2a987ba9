"""A stop that no drive has confirmed is sent until one does, whatever policies and states say; on the jumping clock."""

import asyncio
from contextlib import asynccontextmanager, contextmanager

import pytest

from ldcnd.axis.events import StopLatch, StopUnconfirmed
from ldcnd.axis.faults import STOP_UNCONFIRMED
from ldcnd.axis.rest import RestEvidence
from ldcnd.client.events import latest_events
from ldcnd.client.rig_client import RigClient
from ldcnd.config.rig import RigConfig, load_config
from ldcnd.contract.commands import Halt, MoveAbsolute, MoveVelocity, Power, Reset
from ldcnd.contract.errors import BusDown, OutcomeUnknown, StopNotConfirmed, WrongState
from ldcnd.contract.events import CommandStatus
from ldcnd.contract.samples import AxisState, LinkState, Moving, TelemetryItem
from ldcnd.daemon.assembly import build_daemon
from ldcnd.drives.axis_config import LossConfig, LossPolicy
from ldcnd.drives.ldcn.packet import CommandCode, Packet, PacketReader
from ldcnd.drives.network import AdoptFallback, StartPolicy
from ldcnd.sim.chain import Chain
from ldcnd.sim.faults import FaultInjector, FaultKind, FaultPlan, LineFault
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain
from ldcnd.testing import run, simulated_rig
from ldcnd.testing.memory_session import MemoryBroker
from tests.support.axis_bench import put
from tests.support.rig import EPOCH_NS, SIMULATED, RunningRig, openers_of, running_rig

RUN_ON = LossConfig(client=LossPolicy.RUN_TO_TARGET, bus=LossPolicy.RUN_TO_TARGET, daemon=LossPolicy.RUN_TO_TARGET)


def chain_of_four() -> Chain:
    return build_chain(ChainSpec(tuple(ModuleSpec(n) for n in ("ls182ap", "ls182ap", "picservo-v4", "picservo-v4"))))


def config(**bus: object) -> RigConfig:
    rig = load_config(SIMULATED)
    axes = tuple(axis.model_copy(update={"loss": RUN_ON}) for axis in rig.bus[0].axis)
    return rig.model_copy(update={"bus": (rig.bus[0].model_copy(update={"axis": axes} | bus),)})


def true_position(chain: Chain) -> float:
    """Where the shaft of x really is, in counts."""
    loop = asyncio.get_running_loop()
    chain.advance(loop.time())
    chain.modules[0].catch_up(loop.time())
    return chain.modules[0].shaft.position_counts


async def stands(chain: Chain) -> bool:
    before = true_position(chain)
    await asyncio.sleep(0.5)
    return abs(true_position(chain) - before) < 5


@asynccontextmanager
async def jogging(chain: Chain, velocity: float = 5.0, **bus: object):
    async with running_rig(config(**bus), {"line0": chain}) as rig:
        await rig.until("x", lambda state: state.link is LinkState.UP)
        await rig.client.command("x", Power(on=True))
        await rig.client.command("x", MoveVelocity(velocity=velocity))
        await asyncio.sleep(0.3)
        yield rig


async def unplugged(rig: RunningRig, chain: Chain) -> None:
    chain.unplug(asyncio.get_running_loop().time())
    await rig.until("x", lambda state: state.link is LinkState.DOWN)


@asynccontextmanager
async def stopped_in_vain(chain: Chain, **settings):
    """Run a daemon whose axis jogs on behind a line that is down, with a stop that waits for it."""
    async with jogging(chain, **settings) as rig:
        await unplugged(rig, chain)
        assert (await rig.client.stop("x")).confirmed == ()
        yield rig


@contextmanager
def deaf(rig: RunningRig):
    """Let no stop reach the drive of x."""
    driver = rig.daemon.rig.axes["x"].driver
    stop_of = driver.stop

    async def lost(_mode):
        raise BusDown("no reply")

    driver.stop = lost
    yield
    driver.stop = stop_of


@pytest.mark.promise("stop-until-confirmed")
async def test_a_stop_sent_while_the_line_is_down_reaches_the_drive_when_it_is_back():
    chain = chain_of_four()
    async with stopped_in_vain(chain) as rig:
        state = await rig.client.state("x")
        assert (state.stop_latched, state.stop_pending) == (True, True)
        faults = await rig.client.last("x", TelemetryItem.FAULT)
        assert STOP_UNCONFIRMED.code in {fault.code for fault in faults.active}
        await asyncio.sleep(3.0)
        assert not await stands(chain)

        chain.replug()
        state = await rig.until("x", lambda state: not state.stop_pending)
        await asyncio.sleep(0.5)

        assert await stands(chain)
        assert state.stop_latched
        faults = await rig.client.last("x", TelemetryItem.FAULT)
        assert STOP_UNCONFIRMED.code not in {fault.code for fault in faults.active}
        told = [event.status for event in await latest_events(rig.client, 1000) if event.verb == "stop"]
        assert told[0] is CommandStatus.UNKNOWN
        assert CommandStatus.DONE in told


def packets_to_the_line(chain: Chain) -> list[Packet]:
    """Return a list to which every packet of the host is added from now on."""
    sent: list[Packet] = []
    reader, write = PacketReader(), chain.write

    def noted(now_s: float, data: bytes) -> None:
        sent.extend(received.packet for value in data if (received := reader.feed(value)))
        write(now_s, data)

    chain.write = noted
    return sent


@pytest.mark.promise("stop-until-confirmed")
async def test_a_drive_whose_line_is_back_at_its_rate_is_asked_for_its_loop_and_then_stopped():
    chain = chain_of_four()
    async with stopped_in_vain(chain, baud=19_200) as rig:
        await asyncio.sleep(1.0)
        sent = packets_to_the_line(chain)
        chain.replug()
        await rig.until("x", lambda state: not state.stop_pending)

    first = [packet.command for packet in sent[:3]]
    assert first == [CommandCode.READ_STATUS, CommandCode.READ_STATUS, CommandCode.STOP_MOTOR]
    assert {packet.address for packet in sent[:3]} == {1}


@pytest.mark.promise("stop-until-confirmed")
async def test_a_stop_waits_for_no_search_where_a_line_is_back_and_one_of_its_drives_is_not():
    chain = chain_of_four()
    async with stopped_in_vain(chain) as rig:
        await asyncio.sleep(1.0)
        chain.modules[2].power(on=False, at_s=asyncio.get_running_loop().time())
        sent = packets_to_the_line(chain)
        chain.replug()
        await rig.until("x", lambda state: not state.stop_pending)

    assert CommandCode.STOP_MOTOR in [packet.command for packet in sent[:4]]


@pytest.mark.promise("stop-closes-no-loop")
async def test_a_loop_that_was_opened_while_the_line_was_away_is_not_closed_by_the_stop_that_waits():
    chain = chain_of_four()
    async with stopped_in_vain(chain) as rig:
        chain.modules[0].loop.open()  # another program, or the drive itself after a position error
        closed = []
        chain.replug()
        while (await rig.client.state("x")).stop_pending:
            closed.append(chain.modules[0].loop.servo_on)
            await asyncio.sleep(0.001)
        await asyncio.sleep(2.0)

        assert not any(closed)
        assert not chain.modules[0].loop.servo_on
        assert not (await rig.client.state("x")).enabled


@pytest.mark.promise("stop-until-confirmed")
async def test_a_drive_that_hears_and_is_not_heard_is_stopped_when_its_line_is_back():
    chain = chain_of_four()
    async with stopped_in_vain(chain, baud=19_200) as rig:
        chain.injector = FaultInjector(FaultPlan((LineFault(FaultKind.REPLY_LOST),)))
        chain.replug()
        await asyncio.sleep(1.5)

        assert await stands(chain)
        assert (await rig.client.state("x")).stop_pending


async def test_a_slow_motion_that_counts_as_rest_is_stopped_all_the_same():
    chain = chain_of_four()
    async with stopped_in_vain(chain, velocity=0.5) as rig:
        await asyncio.sleep(1.0)
        put(rig.daemon.rig.axes["x"].tracker, rest=RestEvidence(rests=True))
        chain.replug()
        await rig.until("x", lambda state: not state.stop_pending)
        await asyncio.sleep(0.3)
        assert await stands(chain)


@pytest.mark.promise("stop-until-confirmed")
async def test_a_drive_that_was_mute_is_stopped_as_soon_as_it_answers():
    chain = chain_of_four()
    async with jogging(chain) as rig:
        with deaf(rig):
            reply = await rig.client.stop("x")
            assert reply.confirmed == ()
            await asyncio.sleep(1.0)
            assert (await rig.client.state("x")).stop_pending
            assert not await stands(chain)

        await rig.until("x", lambda state: not state.stop_pending, within_s=2.5)
        await asyncio.sleep(0.5)
        assert await stands(chain)


async def test_nothing_moves_and_nothing_is_reset_while_a_stop_is_not_confirmed():
    async with jogging(chain_of_four()) as rig:
        with deaf(rig):
            await rig.client.stop("x")
            for command in (Reset(), Power(on=True), MoveAbsolute(position=0.0)):
                with pytest.raises(StopNotConfirmed, match="not confirmed"):
                    await rig.client.command("x", command)
            assert (await rig.client.state("x")).stop_latched


async def test_a_drive_that_had_no_power_meanwhile_has_nothing_to_confirm():
    chain = chain_of_four()
    async with jogging(chain) as rig:
        axis = rig.daemon.rig.axes["x"]
        axis.tracker.take(StopUnconfirmed(0))
        axis.stops.note_power_loss()
        assert not axis.tracker.status.stop_pending


@asynccontextmanager
async def starting(chain: Chain, **bus: object):
    """Run a daemon that has not brought its line up yet."""
    loop, broker, rig_config = asyncio.get_running_loop(), MemoryBroker(), config(**bus)
    async with broker.session() as session, broker.session() as client_session:
        daemon = build_daemon(
            rig_config,
            session,
            lambda: EPOCH_NS + round(loop.time() * 1e9),
            "test",
            openers_of(rig_config, {"line0": chain}),
        )
        async with asyncio.TaskGroup() as group:
            running = group.create_task(daemon.run(), name="daemon")
            try:
                await daemon.wait_serving()
                yield RunningRig(daemon, RigClient(client_session, rig_config.rig), client_session, broker)
            finally:
                daemon.end()
                await running


@pytest.mark.promise("stop-during-bring-up")
async def test_stops_during_bring_up_are_answered_at_once_and_do_not_restart_it():
    loop = asyncio.get_running_loop()
    async with starting(chain_of_four()) as rig:
        began_s = loop.time()
        await rig.daemon.wait_up()
        undisturbed_s = loop.time() - began_s
    async with starting(chain_of_four()) as rig:
        began_s, longest_s = loop.time(), 0.0
        up = asyncio.create_task(rig.daemon.wait_up())
        while not up.done():
            asked_s = loop.time()
            await rig.client.stop()
            longest_s = max(longest_s, loop.time() - asked_s)
            await asyncio.wait((up,), timeout=0.02)
        assert longest_s < 0.05
        assert loop.time() - began_s < undisturbed_s + 0.3
        assert (await rig.client.state("x")).stop_latched


async def test_a_stop_before_a_line_is_taken_over_stops_what_still_moves_there():
    chain = chain_of_four()
    async with jogging(chain):
        pass
    assert not await stands(chain)
    async with starting(chain, start=StartPolicy.ADOPT) as rig:
        reply = await rig.client.stop("x")
        assert reply.confirmed == ()
        await rig.daemon.wait_up()
        await rig.until("x", lambda state: not state.stop_pending)
        await asyncio.sleep(0.5)
        assert await stands(chain)
        assert (await rig.client.state("x")).enabled  # brought to rest, not switched off


@pytest.mark.promise("stop-until-confirmed")
async def test_a_stop_reaches_drives_of_a_line_that_cannot_be_brought_up():
    """One module is missing from the configuration's view, so the bring-up fails; the others can be stopped."""
    chain = chain_of_four()
    async with jogging(chain):
        pass
    axes = config().bus[0].axis
    wrong = (*axes[:3], axes[3].model_copy(update={"address": 9}))
    async with starting(chain, start=StartPolicy.ADOPT, axis=wrong, adopt_fallback=AdoptFallback.REFUSE) as rig:
        await asyncio.sleep(2.0)
        await rig.client.stop("x")
        await asyncio.sleep(1.0)
        assert await stands(chain)


async def refused(rig: RunningRig) -> None:
    """Wait until an attempt to bring the line up has failed."""
    async with asyncio.timeout(30.0):
        while "0 of 4" not in rig.daemon.rig.buses[0].problem:
            await asyncio.sleep(0.05)


@pytest.mark.promise("energy-out-always-sent")
@pytest.mark.parametrize("fallback", list(AdoptFallback))
async def test_a_drive_that_hears_and_is_not_heard_is_switched_off_by_a_daemon_that_has_not_read_it(fallback):
    chain = chain_of_four()
    async with jogging(chain):
        pass
    chain.injector = FaultInjector(FaultPlan((LineFault(FaultKind.REPLY_LOST),)))
    async with starting(chain, start=StartPolicy.ADOPT, adopt_fallback=fallback) as rig:
        await refused(rig)
        assert chain.modules[0].loop.servo_on
        with pytest.raises(OutcomeUnknown, match="not confirmed"):
            await rig.client.command("x", Power(on=False))
        await asyncio.sleep(1.0)

        assert not chain.modules[0].loop.servo_on


@pytest.mark.promise("stop-until-confirmed")
async def test_a_stop_on_a_line_that_has_come_back_deaf_goes_out_at_the_rate_of_its_drives():
    chain = chain_of_four()
    async with jogging(chain) as rig:
        await unplugged(rig, chain)
        chain.injector = FaultInjector(FaultPlan((LineFault(FaultKind.REPLY_LOST),)))
        chain.replug()
        await refused(rig)
        await rig.client.stop("x")
        await asyncio.sleep(0.4)  # before the line is tried again

        assert await stands(chain)


@pytest.mark.promise("reset-at-speed")
async def test_a_moving_axis_in_error_stop_is_not_switched_off_by_a_reset():
    chain = chain_of_four()
    async with jogging(chain) as rig:
        await unplugged(rig, chain)
        chain.replug()
        await rig.until("x", lambda state: state.link is LinkState.UP)
        await asyncio.sleep(0.3)
        state = await rig.client.state("x")
        assert (state.state, state.enabled, state.moving) == (AxisState.ERROR_STOP, True, Moving.YES)

        with pytest.raises(WrongState, match="at speed"):
            await rig.client.command("x", Reset())
        assert (await rig.client.state("x")).enabled

        await rig.client.command("x", Halt())
        await asyncio.sleep(1.0)
        assert await stands(chain)
        await rig.client.command("x", Reset())


@pytest.mark.promise("loss-of-line")
async def test_a_latched_axis_that_moves_when_its_line_is_back_comes_to_rest_whatever_the_policy_says():
    chain = chain_of_four()
    async with jogging(chain) as rig:
        rig.daemon.rig.axes["x"].tracker.take(StopLatch())  # latched and confirmed, as far as anyone knows
        await unplugged(rig, chain)
        chain.replug()
        await rig.until("x", lambda state: state.link is LinkState.UP)
        await asyncio.sleep(1.0)
        assert await stands(chain)


@pytest.mark.parametrize("axis", ["x", "z"])
@pytest.mark.parametrize("gap_s", [0.35, 0.5, 0.7])
@pytest.mark.parametrize("stop", ["halt", "stop", "quick_stop", "none"])
@pytest.mark.promise("stop-closes-no-loop")
@pytest.mark.sweep(2)
def test_a_drive_that_has_tripped_behind_a_gap_of_its_line_is_switched_off_again(axis, gap_s, stop):
    async def program():
        async with simulated_rig("config/simulated.toml") as rig, rig.client.control(axis, client="test") as moved:
            await moved.power(on=True)
            await moved.set_position(0.0)
            await moved.move_velocity(20.0, duration_s=5)
            await asyncio.sleep(0.5)
            rig.faults.cable_cut(axis, for_s=gap_s)
            rig.faults.jam(axis, for_s=gap_s)
            await rig.until(lambda: not rig.truth(axis).energised)
            stopped = asyncio.create_task(getattr(moved, stop)()) if stop != "none" else None
            await asyncio.sleep(4.0)
            if stopped:
                await asyncio.wait([stopped])
                stopped.exception()
            return rig.truth(axis).energised, moved.state.sample.state, moved.state.sample.enabled

    assert run(program()) == (False, AxisState.ERROR_STOP, False)


@pytest.mark.parametrize("mute", [(), ("x",), ("x", "y"), ("c",)])
def test_a_drive_that_answers_is_stopped_before_those_that_do_not(mute):
    async def program():
        async with simulated_rig("config/simulated.toml") as rig, rig.client.control("z", client="test") as moved:
            await moved.power(on=True)
            await moved.set_position(0.0)
            await moved.move_velocity(10.0, duration_s=20)
            for axis in mute:
                rig.faults.mute(axis, for_s=10.0)
            await asyncio.sleep(2.0)
            speed, at_s = abs(rig.truth("z").velocity), rig.now_s
            stopped = asyncio.create_task(rig.client.stop())
            while abs(rig.truth("z").velocity) > 0.99 * speed:
                await asyncio.sleep(0.001)
            slowed_s = rig.now_s - at_s
            await asyncio.wait([stopped])
            stopped.exception()
            return slowed_s

    # one packet that is on its way to who does not answer, and the flush behind it
    assert run(program()) < (0.12 if mute else 0.05)
