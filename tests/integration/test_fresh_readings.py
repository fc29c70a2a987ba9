"""A port with `fresh_ms` answers a read with a reading that others have just made, if it has all that is asked for."""

import asyncio

import pytest

from ldcnd.drives.ldcn.packet import AuxFlag, CommandCode, Packet
from ldcnd.line.flight_recorder import WireEvent
from ldcnd.sim.smartstep.cable import smartstep_chain
from tests.integration.test_ports import turning
from tests.support.guest_program import guest
from tests.support.machine_rig import COUNTS
from tests.support.rig import running_rig
from tests.support.smartstep_line import simulated
from tests.support.units_program import UnitsProgram, with_units_port

OFTEN = {"position": 200, "velocity": 200, "adc": 0, "state": 20}
READ = CommandCode.READ_STATUS
CASES = ((1, b"\x00"), (1, b"\x01"), (1, b"\x04"), (1, b"\x05"), (3, b"\x01"))


def exchanges_of_guest(rig) -> int:
    """Return how many packets the guest has caused."""
    records = rig.daemon.rig.buses[0].bus.wire_log.records()
    return sum(each.event is WireEvent.SENT and each.guest == "old" for each in records)


@pytest.mark.long
async def test_a_fresh_reading_of_others_is_the_answer_and_an_old_one_is_none(tmp_path):
    replies = {}
    for fresh_ms in (0.0, 100.0):
        async with guest(tmp_path, fresh_ms=fresh_ms, rates=OFTEN) as (rig, program):
            await program.begin()
            before = exchanges_of_guest(rig)
            replies[fresh_ms] = []
            for address, items in CASES:
                await asyncio.sleep(0.2)
                replies[fresh_ms].append(await program.send(Packet(address, READ, items)))
            caused = exchanges_of_guest(rig) - before
            assert caused == (0 if fresh_ms else len(CASES))
            assert await program.send(Packet(1, READ, b"\x20"))  # nobody asks for the type of a module all the time
            assert exchanges_of_guest(rig) - before == caused + 1
    assert replies[0.0] == replies[100.0]


@pytest.mark.long
async def test_a_fresh_reading_is_that_of_the_moving_drive(tmp_path):
    async with guest(tmp_path, fresh_ms=20.0, rates=OFTEN) as (rig, program):
        await program.begin()
        await turning(rig)
        places = []
        for _ in range(20):
            await asyncio.sleep(0.05)
            reply = bytes.fromhex(await program.send(Packet(1, READ, b"\x01")))
            counts = int.from_bytes(reply[1:5], "little", signed=True)
            places.append(counts)
            drive = rig.chain.modules[0]
            drive.catch_up(asyncio.get_running_loop().time())
            assert 0 <= drive.shaft.position_counts - counts < 0.03 * 5 * COUNTS  # 20 ms, and the way of the reply
        assert places == sorted(set(places))


@pytest.mark.long
async def test_no_reading_from_before_a_command_of_the_guest_answers_it(tmp_path):
    async with guest(tmp_path, "control", fresh_ms=1000.0, rates=OFTEN) as (rig, program):
        await program.begin()
        for _ in range(10):
            for control, on in ((b"\x05", True), (b"\x02", False)):
                await asyncio.sleep(0.1)
                await program.send(Packet(1, CommandCode.STOP_MOTOR, control))
                reply = bytes.fromhex(await program.send(Packet(1, READ, b"\x08")))
                assert bool(reply[1] & AuxFlag.SERVO_ON) is on
                assert rig.daemon.rig.axes["rotor"].tracker.status.enabled is on


@pytest.mark.long
async def test_words_of_a_smartstep_that_are_polled_are_answered_fresh(tmp_path):
    loop = asyncio.get_running_loop()
    took = {}
    for fresh_ms in (0.0, 1000.0):
        (tmp_path / f"{fresh_ms:g}").mkdir()
        link = tmp_path / f"{fresh_ms:g}" / "port"
        port = {"name": "old", "bus": "steps", "link": str(link), "access": "control", "fresh_ms": fresh_ms}
        config = with_units_port(link, port=[port])
        async with running_rig(config, {"steps": smartstep_chain([simulated(1), simulated(2)])}) as rig:
            await rig.until("feed", lambda state: state.link == "up")
            await asyncio.sleep(3)
            program = UnitsProgram(str(link))
            assert await program.send("W1085180000") == "W1085180001"
            began_s = loop.time()
            assert await program.send("W1080000000") == "W1080000000"
            took[fresh_ms] = loop.time() - began_s
            assert await program.send("W1111000051") == "W1111000051"
            assert await program.send("W1011000000") == "W1011000051"
            assert await program.send("W1111000052") == "W1111000052"
            assert await program.send("W1011000000") == "W1011000052"
            program.port.close()
    assert took[0.0] > 0.035
    assert took[1000.0] < 0.005
