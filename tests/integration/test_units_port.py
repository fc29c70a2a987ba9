"""A program that knows nothing of ldcnd reads and sets SmartSteps on a port, as it does on the bare line."""

import asyncio
import random

import pytest
import serial

from ldcnd.client.overview import last_bus_health
from ldcnd.client.traces import arm_trace, trace_header, wait_for_trace
from ldcnd.contract.errors import BusyTracing, LeaseHeld
from ldcnd.contract.events import ReadEvents
from ldcnd.contract.leases import Acquire, ListHolders
from ldcnd.contract.parameters import ReadParameter, WriteParameter
from ldcnd.contract.traces import AbortTrace, TakeTrace, TracePhase
from ldcnd.drives.smartstep.parameters import PN100, PN304
from ldcnd.line.exchange import Lane
from ldcnd.line.flight_recorder import WireEvent
from ldcnd.sim.smartstep.cable import smartstep_chain
from tests.support.process import free_port
from tests.support.rig import running_rig
from tests.support.smartstep_line import simulated
from tests.support.units_program import UnitsProgram, frame, units_guest, with_units_port

READS = (
    "W1011000000",
    "W1001000000",
    "W1088000000",
    "W1085180000",
    "W10850A0000",
    "W1020000000",
    "W10C0000000",
    "W1080000028",
    "W1050020000",
    "W2011000000",
    "W2030000004",
    "W1230000008",
    "W123000FFFE",
    "W12C0000004",
)
RUBBISH = (
    b"W10110000000\r",
    b"W1011000000",
    b"\r",
    frame("W3011000000"),
    frame("W1311000000"),
    frame("W1011000000").lower(),
    frame("W1011000000")[:-2] + b"0\r",
    bytes(range(128)) + b"\r",
)


def sent_of_guest(rig) -> list[bytes]:
    """Return the frames on the line that the guest has caused."""
    records = rig.daemon.rig.buses[0].bus.wire_log.records()
    return [each.data for each in records if each.event is WireEvent.SENT and each.guest == "old"]


async def refusals(rig, axis="feed") -> list[str]:
    """Return why what the guest asked for was not done."""
    events = (await rig.client.ask(ReadEvents(axis=axis))).events
    return [each.reason for each in events if (each.client, each.verb, each.status) == ("old", "guest", "refused")]


async def bare(head: bytes) -> str:
    """Return what the bare simulated line answers."""
    chain = smartstep_chain([simulated(1), simulated(2)])
    chain.write(0.0, head)
    return b"".join(piece for _, piece in chain.advance(5.0)).decode().rstrip("\r")


@pytest.mark.long
async def test_reads_are_answered_with_the_same_bytes_as_on_the_bare_line(tmp_path):
    async with units_guest(tmp_path, "read") as (_, program, _feed):
        for head in READS:
            assert await program.send_bytes(frame(head)) == await bare(frame(head)), head


@pytest.mark.long
async def test_what_drives_are_silent_about_gets_no_answer_and_the_next_frame_does(tmp_path):
    async with units_guest(tmp_path, "read") as (rig, program, _feed):
        for rubbish in RUBBISH:
            assert await program.send_bytes(rubbish, 0.5) == "" == await bare(rubbish), rubbish
            program.port.write(b"\r")
            assert await program.send("W1011000000") == "W1011000050"
        assert len(sent_of_guest(rig)) == len(RUBBISH)


async def test_a_program_that_makes_parity_by_itself_is_answered_so_and_one_at_another_rate_is_not(tmp_path):
    async with units_guest(tmp_path, "read") as (_, first, _feed):
        first.port.close()
        await asyncio.sleep(0.1)
        second = UnitsProgram(str(tmp_path / "port"), soft_parity=True)
        assert await second.send("W1011000000") == "W1011000050"
        second.port.close()
        await asyncio.sleep(0.1)
        third = UnitsProgram(str(tmp_path / "port"), baud=19_200)
        assert await third.send("W1011000000", 0.5) == ""
        third.port.close()


async def test_with_access_read_settings_are_answered_as_not_done_and_nothing_is_sent(tmp_path):
    async with units_guest(tmp_path, "read") as (rig, program, feed):
        for head in ("W1111000051", "W1101000051", "W1120002000", "W1120000000", "W1120010001", "W1150008101"):
            assert await program.send(head) == f"W19{head[3:]}"
        assert sent_of_guest(rig) == []
        assert feed.drive.memory.active(PN100) == 80
        assert all("access = read" in each for each in await refusals(rig))
        (line,) = await last_bus_health(rig.client)
        await asyncio.sleep(1.1)
        (line,) = await last_bus_health(rig.client)
        assert line.guests[0].refused == 6


async def test_parameters_are_written_under_a_lease_and_each_eeprom_write_is_counted(tmp_path):
    async with units_guest(tmp_path) as (rig, program, feed):
        assert await program.send("W1111000051") == "W1111000051"
        assert await program.send("W1103040123") == "W1103040123"
        assert await program.send("W1103040123") == "W1103040123"

        assert feed.drive.memory.active(PN100) == 0x51
        assert feed.drive.memory.read(PN304.eeprom_address) == 0x123
        holders = (await rig.client.ask(ListHolders())).holders
        assert {each.axis: each.client for each in holders} == {"feed": "old", "spool": None}
        value = (await rig.client.command("feed", ReadParameter(parameter="Pn304"))).value
        assert (value.eeprom_writes, value.eeprom_total) == (1, 1)
        with pytest.raises(LeaseHeld):
            await rig.client.command("feed", WriteParameter(parameter="Pn100", value=90))


@pytest.mark.parametrize(
    ("head", "answer", "why"),
    [
        ("W1111000BB8", "5", "refuses"),  # the drive's own limit: manual, example 6
        ("W1109990001", "9", "lists no parameter 'Pn999'"),
        ("W1100000200", "9", "would be unit 2"),
        ("W1120002002", "5", "not one of the manual's"),
        ("W1120010002", "5", "executes nothing"),
        ("W1180000001", "9", "does not set 8000H"),
        ("W1151000001", "9", "does not set 5100H"),
        ("W1230000003", "6", "even number"),
    ],
)
@pytest.mark.sweep(2)
async def test_what_is_not_done_has_the_drives_own_error_and_an_event(tmp_path, head, answer, why):
    async with units_guest(tmp_path) as (rig, program, feed):
        before = feed.drive.memory.read(0)
        assert (await program.send_bytes(frame(head)))[2] == answer
        assert why in (await refusals(rig))[-1]
        assert feed.drive.memory.read(0) == before
        assert feed.drive.mode == 0


async def test_who_has_no_control_sets_nothing(tmp_path):
    async with units_guest(tmp_path) as (rig, program, feed):
        await rig.client.ask(Acquire(client="someone", axes=("feed",), lease_s=60))
        assert await program.send("W1111000051") == "W1911000051"
        assert feed.drive.memory.active(PN100) == 80
        assert "someone" in (await refusals(rig))[-1]


TRACE = ("W1150008101", "W1150010000", "W1150020002", "W1150030000", "W1150040000", "W1150050000")
EXECUTE = ("W1120002000", "W1120010001")


async def test_settings_of_a_trace_are_answered_with_the_same_bytes_as_on_the_bare_line(tmp_path):
    async with units_guest(tmp_path) as (_, program, _feed):
        for head in (*TRACE, "W1150020001", "W1150040001", "W1150007777", *EXECUTE):
            assert await program.send_bytes(frame(head)) == await bare(frame(head)), head


@pytest.mark.parametrize(("mode", "moving"), [("2003", True), ("2003", False), ("2004", False)])
@pytest.mark.sweep(1)
async def test_a_counter_is_cleared_by_mode_and_execute_as_on_the_bare_line(tmp_path, mode, moving):
    async with units_guest(tmp_path) as (rig, program, feed):
        loop = asyncio.get_running_loop()
        feed.drive.set_pulse_rate(1000.0, loop.time())
        await asyncio.sleep(5)
        if not moving:
            feed.drive.set_pulse_rate(0.0, loop.time())
            await asyncio.sleep(0.5)
        assert await program.send(f"W112000{mode}") == f"W112000{mode}"
        assert await program.send("W1020000000") == f"W102000{mode}"
        assert await program.send("W1120010001") == "W1120010001"
        async with asyncio.timeout(5):
            while await program.send("W1020000000") != "W1020000000":
                await asyncio.sleep(0.05)
        cleared = feed.drive.command_counter if mode == "2003" else feed.drive.feedback_counter
        assert cleared < 3000
        events = (await rig.client.ask(ReadEvents(axis="feed"))).events
        assert any(mode in (each.reason or "") and each.client == "old" for each in events)
        await asyncio.sleep(2.5)
        if not moving:
            async with rig.client.samples("feed", "position") as samples:
                _, sample = await anext(samples)
            assert abs(sample.counts - feed.drive.feedback_counter) < 10


@pytest.mark.long
async def test_a_counter_that_a_program_clears_at_any_instant_of_the_polls_is_0_from_then_on(tmp_path):
    told: list[int] = []
    async with units_guest(tmp_path) as (rig, program, feed), rig.client.samples("feed", "position") as samples:

        async def listen() -> None:
            async for _, sample in samples:
                told.append(sample.counts)

        async with asyncio.TaskGroup() as group:
            listening = group.create_task(listen(), name="listen")
            loop = asyncio.get_running_loop()
            for step in range(20):
                feed.drive.motor.position += 70_196  # by hand
                await asyncio.sleep(3.0 + (0.05 * step - loop.time()) % 1.0)
                assert told[-1] == 70_196
                del told[:]
                for head in ("W1120002004", "W1120010001"):
                    assert await program.send(head) == head
                await asyncio.sleep(6.0)

                assert set(told) <= {70_196, 0}
                assert told[-1] == 0
            listening.cancel()


async def reads_its_trace(program: UnitsProgram, pause_s: float) -> tuple[float, float]:
    """Set up a trace, execute it and read its memory; return the longest waits for a setting and for a string."""
    loop, settings, strings = asyncio.get_running_loop(), [], []
    for head in (*TRACE, *EXECUTE):
        asked_s = loop.time()
        assert await program.send(head, 1.0) == head
        settings.append(loop.time() - asked_s)
    async with asyncio.timeout(10):
        while await program.send("W1020000000", 1.0) != "W1020000000":
            await asyncio.sleep(0.05)
    for address in range(0x3000, 0x3000 + 1000, 100):
        asked_s = loop.time()
        assert len(await program.send(f"W12{address:04X}0064", 1.0)) > 200
        strings.append(loop.time() - asked_s)
        await asyncio.sleep(pause_s)
    return max(settings), max(strings)


@pytest.mark.parametrize("pause_s", [0.0, 0.3])
@pytest.mark.sweep(1)
async def test_a_program_traces_again_and_again_as_on_the_bare_line(tmp_path, pause_s):
    async with units_guest(tmp_path) as (rig, program, _feed):
        loop = asyncio.get_running_loop()
        for _ in range(4):
            again_s = loop.time() + 10
            setting_s, string_s = await reads_its_trace(program, pause_s)
            print(f"setting {setting_s:.3f} s, string {string_s:.3f} s")
            assert setting_s < 0.2
            assert string_s < 0.5
            await asyncio.sleep(again_s - loop.time())
        assert await refusals(rig) == []


async def test_a_program_leaves_its_own_trace_and_not_that_of_others(tmp_path):
    async with units_guest(tmp_path) as (rig, program, feed):
        other = await arm_trace(rig.client, "feed", TakeTrace(channels=("speed_feedback",), interval_s=0.05))
        for head in ("W1120000000", *EXECUTE, "W1120002003", "W1111000051", "W1150008101"):
            assert await program.send(head) == f"W19{head[3:]}", head
        assert feed.drive.mode == 0x2000
        await wait_for_trace(rig.client, "feed", other.trace_id, 120)
        assert (await trace_header(rig.client, "feed")).phase is TracePhase.COMPLETE

        for head in ("W1150020200", *EXECUTE):
            assert await program.send(head) == head
        assert feed.drive.mode == 0x2000
        assert await program.send("W1111000051") == "W1911000051"  # a drive in Data Trace Mode takes no other setting
        assert await program.send("W1120000000") == "W1120000000"
        assert feed.drive.mode == 0


async def test_others_trace_once_the_trace_of_a_program_is_over_or_ended(tmp_path):
    async with units_guest(tmp_path) as (rig, program, feed):
        for head in ("W1150020200", *EXECUTE):
            assert await program.send(head) == head
        program.port.close()
        await asyncio.sleep(0.5)
        assert feed.drive.mode == 0x2000
        request = TakeTrace(channels=("speed_feedback",), interval_s=0.01)
        with pytest.raises(BusyTracing):
            await arm_trace(rig.client, "feed", request)
        await rig.client.command("feed", AbortTrace())
        assert feed.drive.mode == 0
        await arm_trace(rig.client, "feed", request)


async def test_what_a_program_sends_by_itself_is_not_sent_once_control_was_taken_from_it(tmp_path):
    async with units_guest(tmp_path) as (rig, program, feed):
        assert await program.send("W1150020200") == "W1150020200"
        await rig.client.ask(Acquire(client="ada", axes=("feed",), lease_s=60, force=True))
        for head in EXECUTE:
            assert await program.send(head) == f"W19{head[3:]}"
        assert feed.drive.mode == 0


async def test_a_mode_that_a_program_has_entered_and_not_executed_is_left_when_it_goes(tmp_path):
    async with units_guest(tmp_path) as (_, first, feed):
        await first.send("W1120002003")
        assert feed.drive.mode == 0x2003
        first.port.close()
        await asyncio.sleep(0.5)
        assert feed.drive.mode == 0


async def test_a_mode_whose_reply_was_lost_is_left_when_the_program_goes(tmp_path, monkeypatch):
    async with units_guest(tmp_path) as (_, first, feed):
        with monkeypatch.context() as on_the_way:
            sent = feed.transmissions
            on_the_way.setattr(feed, "transmissions", lambda to_s: sent(to_s)[:0])
            first.port.write(frame("W1120002000"))
            await asyncio.sleep(0.5)
        assert feed.drive.mode == 0x2000
        first.port.close()
        await asyncio.sleep(1.0)
        assert feed.drive.mode == 0


async def test_a_frame_that_is_repeated_before_its_reply_is_carried_out_once(tmp_path):
    async with units_guest(tmp_path) as (rig, program, _feed):
        write = frame("W1103040123")
        program.port.write(write)
        await asyncio.sleep(0.05)
        program.port.write(write)
        await asyncio.sleep(2)
        assert program.port.read(100) == write  # the reply to a setting is the same again
        value = (await rig.client.command("feed", ReadParameter(parameter="Pn304"))).value
        assert value.eeprom_writes == 1


@pytest.mark.long
async def test_a_program_that_asks_as_fast_as_it_can_leaves_polls_their_rate(tmp_path):
    async with units_guest(tmp_path) as (rig, program, _feed):
        bus, loop = rig.daemon.rig.buses[0].bus, asyncio.get_running_loop()

        def polls() -> int:
            return sum(bus.statistics.latency[Lane.POLL].counts)

        before = polls()
        await asyncio.sleep(30)
        alone = polls() - before
        for pays in (False, True):
            replies, before, until_s = 0, polls(), loop.time() + 30
            while loop.time() < until_s:
                replies += bool(await program.send("W1011000000"))
            assert replies > 100
            # the line is full of polls alone: a guest has a fifth of it, after 7 s of it that it has for nothing
            assert polls() - before >= (0.7 if pays else 0.55) * alone


@pytest.mark.filterwarnings("ignore:set(Daemon|Name):DeprecationWarning")  # of pyserial's client
@pytest.mark.real_time
@pytest.mark.parametrize("scheme", ["socket", "rfc2217"])
@pytest.mark.sweep(2)
async def test_a_program_comes_in_by_the_network(tmp_path, scheme):
    port = free_port()
    tcp = {"name": "old", "bus": "steps", "listen": f"127.0.0.1:{port}", "rfc2217": scheme == "rfc2217"}
    config = with_units_port(tmp_path / "port", port=[tcp])

    def asks() -> bytes:
        url = f"{scheme}://127.0.0.1:{port}"
        with serial.serial_for_url(url, 9600, bytesize=7, parity="E", timeout=5) as line:
            line.write(frame("W1011000000"))
            return bytes(line.read(14))

    async with running_rig(config, {"steps": smartstep_chain([simulated(1), simulated(2)])}) as rig:
        await rig.until("feed", lambda state: state.link == "up")
        assert await asyncio.to_thread(asks) == frame("W1011000050")


@pytest.mark.parametrize(
    ("seed", "frames"), [*((seed, 60) for seed in range(2)), pytest.param(3, 3000, marks=pytest.mark.soak)]
)
@pytest.mark.sweep(2)
async def test_whatever_a_program_sends_no_other_mode_is_entered_and_polls_go_on(tmp_path, seed, frames):
    chance = random.Random(seed)
    addresses = (0x0000, 0x0100, 0x1100, 0x2000, 0x2001, 0x3000, 0x5000, 0x5002, 0x8000, 0xC000)
    async with units_guest(tmp_path) as (rig, program, feed):
        modes: set[int] = set()
        enter = feed.drive._enter
        feed.drive._enter = lambda value: (modes.add(value), enter(value))[1]
        for _ in range(frames):
            address, data = chance.choice(addresses), chance.choice((0, 1, 2, 4, 0x2000, 0x2002, 0x2003, 0x2005))
            packet = bytearray(frame(f"W{chance.choice('123')}{chance.randrange(4)}{address:04X}{data:04X}"))
            if chance.random() < 0.2:
                packet[chance.randrange(len(packet))] ^= 1 << chance.randrange(8)
            await program.send_bytes(bytes(packet), chance.choice((0.0, 0.01, 0.3)))
        await asyncio.sleep(1)
        assert modes <= {0, 0x2000, 0x2003, 0x2004}
        assert feed.drive.unit == 1
        await rig.until("feed", lambda state: state.link == "up")
