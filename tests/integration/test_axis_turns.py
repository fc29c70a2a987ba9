"""Commands of one axis take turns: at once when it is free, in order when it is not, and a stop overtakes them all."""

import asyncio
from typing import Any

from ldcnd.axis.status import AxisStatus
from ldcnd.axis.turns import QUEUED_COMMANDS
from ldcnd.client.events import follow_events, latest_events
from ldcnd.client.rig_client import RigClient
from ldcnd.config.rig import load_config
from ldcnd.contract.codec import decode_received
from ldcnd.contract.commands import CommandReply, Halt, MoveVelocity, Power
from ldcnd.contract.errors import StopLatched, TooManyRequests
from ldcnd.contract.events import CommandEvent, CommandStatus
from ldcnd.contract.keys import EVENT, Keys
from ldcnd.contract.samples import AxisState, LinkState
from ldcnd.daemon.assembly import build_daemon
from ldcnd.net.session import Publication
from ldcnd.testing.memory_session import MemoryBroker
from tests.support.rig import EPOCH_NS, SIMULATED, RunningRig, running_rig


async def at_once(rig: RunningRig, count: int) -> list[CommandReply | BaseException]:
    """Ask to close the loop so many times without waiting for answers; that takes several exchanges each time."""
    await rig.until("x", lambda state: state.link is LinkState.UP)
    asked = [rig.client.command("x", Power(on=True, command_id=f"c{n}")) for n in range(count)]
    return await asyncio.gather(*asked, return_exceptions=True)


async def test_so_many_commands_wait_and_no_more():
    async with running_rig() as rig:
        answers = await at_once(rig, QUEUED_COMMANDS + 3)

    taken = QUEUED_COMMANDS + 1  # one does not wait
    assert [type(answer) for answer in answers[:taken]] == [CommandReply] * taken
    refused = answers[taken:]
    assert [(type(error), getattr(error, "limit", None)) for error in refused] == [(TooManyRequests, 8)] * 2


async def test_commands_that_had_to_wait_are_carried_out_in_order():
    async with running_rig() as rig, follow_events(rig.client) as events:
        await at_once(rig, QUEUED_COMMANDS)
        async with asyncio.timeout(60):
            found = [await anext(events) for _ in range(2 * QUEUED_COMMANDS)]

    done = [event.command_id for event in found if event.status is CommandStatus.DONE]
    assert done == [f"c{n}" for n in range(QUEUED_COMMANDS)]


async def test_a_stop_overtakes_all_that_waits():
    async with running_rig() as rig:
        await rig.until("x", lambda state: state.link is LinkState.UP)
        asked = asyncio.create_task(at_once(rig, 5), name="asked")
        await asyncio.sleep(0.001)  # the first is on the wire
        await rig.client.stop("x")
        _, *waited = await asked
        state = await rig.client.state("x")

    assert [type(answer) for answer in waited] == [StopLatched] * 4
    assert state
    assert state.stop_latched


async def test_an_event_can_be_asked_for_at_once_and_is_published_a_moment_later():
    async with running_rig() as rig, follow_events(rig.client) as events:
        await rig.until("x", lambda state: state.link is LinkState.UP)
        loop = asyncio.get_running_loop()
        asked_ns = EPOCH_NS + round(loop.time() * 1e9)
        reply = await rig.client.command("x", Power(on=False))
        replied_ns = EPOCH_NS + round(loop.time() * 1e9)
        listed = await latest_events(rig.client, 2)
        told = [await anext(events) for _ in range(2)]

    assert told == listed
    assert [event.command_id for event in listed] == [reply.command_id] * 2
    assert asked_ns <= listed[0].t <= listed[1].t <= replied_ns


async def test_what_has_just_happened_is_told_by_a_daemon_that_is_cut_short():
    told: list[Publication] = []
    loop = asyncio.get_running_loop()
    broker = MemoryBroker()
    async with broker.session() as session, broker.session() as client_session:
        daemon = build_daemon(load_config(SIMULATED), session, lambda: EPOCH_NS + round(loop.time() * 1e9), "test")
        running = loop.create_task(daemon.run(), name="daemon")
        await daemon.wait_up()
        await client_session.subscribe(Keys("sim").telemetry_pattern("*", EVENT), told.append)
        client = RigClient(client_session, "sim")
        while not (state := await client.state("x")) or state.link is not LinkState.UP:
            await asyncio.sleep(0.05)
        await client.command("x", Halt())
        assert told == []
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)
        await asyncio.sleep(0)

    statuses = [decode_received(CommandEvent, sample.payload, sample.encoding).status for sample in told]
    assert statuses == [CommandStatus.ACCEPTED, CommandStatus.DONE]


async def test_a_state_is_published_once_the_packet_that_brings_it_about_is_on_the_wire(monkeypatch):
    async with running_rig() as rig:
        await rig.power_on("x")
        await rig.until("x", lambda state: state.state is AxisState.STANDSTILL)
        axis = rig.daemon.rig.axes["x"]
        bus = rig.daemon.rig.buses[0].bus
        sent_when_begun: list[int] = []
        sent_when_told: list[int] = []
        publish = axis.telemetry.publish_state

        def note_begin(_before: AxisStatus, _after: AxisStatus) -> None:
            sent_when_begun.append(bus.statistics.exchanges)

        def note_state(*args: Any, due: bool = False) -> None:
            if axis.tracker.status.state is AxisState.CONTINUOUS_MOTION:
                sent_when_told.append(bus.statistics.exchanges)
            publish(*args, due=due)

        axis.tracker.watch(note_begin, "command")
        monkeypatch.setattr(axis.telemetry, "publish_state", note_state)
        await rig.client.command("x", MoveVelocity(velocity=1.0))

    assert sent_when_told[0] == sent_when_begun[0] + 1


async def test_who_has_the_answer_finds_the_state_that_came_of_the_command():
    async with running_rig() as rig:
        await rig.until("x", lambda state: state.link is LinkState.UP)
        for on in (True, False, True):
            await rig.client.command("x", Power(on=on))
            state = await rig.client.state("x")

            assert state is not None
            assert state.enabled is on
