"""Who uses a port is shown to everyone, and can be sent away: a program on a terminal, one at an address."""

import asyncio
import json
import re
import threading
import time

import pytest
import serial

from ldcnd.client.events import fetch_wire_log
from ldcnd.client.overview import last_bus_health, last_health
from ldcnd.contract.commands import Power
from ldcnd.contract.errors import ValueOutOfRange, WrongState
from ldcnd.contract.events import ReadEvents
from ldcnd.contract.health import GuestHealth
from ldcnd.contract.leases import ListHolders, SendGuestAway
from ldcnd.drives.ldcn.packet import CommandCode, Packet, encode_packet
from ldcnd.line.flight_recorder import WireEvent, parse_records
from tests.integration.test_port_tcp import BEGINS, with_tcp_port
from tests.integration.test_ports import load_velocity
from tests.support.command_line import virtual_rig
from tests.support.guest_program import guest, open_port, with_port
from tests.support.machine_rig import chain_of_machine, running_machine
from tests.support.process import free_port

HOLDS, NO_OPERATION = Packet(1, CommandCode.STOP_MOTOR, b"\x05"), CommandCode.NO_OPERATION


async def shown(rig) -> GuestHealth:
    """Return what is published of the port once a second has gone by."""
    await asyncio.sleep(2.1)
    (line,) = await last_bus_health(rig.client)
    (found,) = line.guests
    return found


@pytest.mark.long
async def test_everyone_sees_who_is_there_what_it_controls_how_much_it_asks_and_what_was_refused(tmp_path):
    async with guest(tmp_path, "control") as (rig, program):
        assert await shown(rig) == GuestHealth(port="old", since=None, axes=(), packets_hz=0, refused=0)
        before = await last_health(rig.client)
        await program.begin()
        await program.send(HOLDS)
        await program.send(Packet(1, CommandCode.IO_CONTROL, b"\x00"))
        asking = asyncio.create_task(shown(rig))
        while not asking.done():
            await program.send(Packet(1, NO_OPERATION), 0.1)
            await asyncio.sleep(0.1)
        found = asking.result()

        after = await last_health(rig.client)
        assert before.t <= found.since < after.t - 1e9
        assert found.axes == ("rotor",)
        assert 3 < found.packets_hz < 11
        assert found.refused == 1


async def test_a_program_that_is_sent_away_loses_its_terminal_and_what_it_moves_halts(tmp_path):
    async with guest(tmp_path, "control") as (rig, program):
        await program.begin()
        await program.send(HOLDS)
        await program.send(load_velocity())
        await rig.until_speed(above=3.0)

        reply = await rig.client.ask(SendGuestAway(port="old", client="someone"))

        assert reply.axes == ("rotor",)
        assert not any(each.client for each in (await rig.client.ask(ListHolders())).holders)
        with pytest.raises(OSError, match="Input/output error"):
            program.send_bytes(encode_packet(Packet(1, NO_OPERATION)))
        await rig.until_speed(below=0.02)
        told = (await rig.client.ask(ReadEvents(axis="rotor"))).events
        assert any(each.verb == "send_guest_away" and each.client == "someone" for each in told)
        program.close()

        again = open_port(tmp_path / "port")
        await again.begin()
        assert await again.send(Packet(1, NO_OPERATION))
        again.close()


async def test_who_is_not_there_is_not_sent_away(tmp_path):
    async with guest(tmp_path) as (rig, _program):
        with pytest.raises(WrongState, match="no program uses the port old"):
            await rig.client.ask(SendGuestAway(port="old"))
        with pytest.raises(ValueOutOfRange, match="serves no port 'new'; it serves old"):
            await rig.client.ask(SendGuestAway(port="new"))


async def test_a_terminal_that_cannot_be_made_anew_leaves_the_program_where_it_is(tmp_path):
    async with guest(tmp_path) as (rig, program):
        await program.begin()
        (tmp_path / "port").unlink()
        (tmp_path / "port").mkdir()
        with pytest.raises(WrongState, match="File exists"):
            await rig.client.ask(SendGuestAway(port="old"))
        assert await program.send(Packet(1, NO_OPERATION))


@pytest.mark.real_time
async def test_a_program_that_is_sent_away_loses_its_connection_and_another_is_let_in():
    port = free_port()

    there = threading.Event()

    def talk() -> None:
        with serial.serial_for_url(f"socket://127.0.0.1:{port}", timeout=5) as line:
            for packet in BEGINS[:2]:
                line.write(encode_packet(packet))
                time.sleep(0.05)
            assert len(line.read(2)) == 2
            there.set()
            line.read(1)

    async with running_machine(with_tcp_port(port)) as rig:
        for _ in range(2):
            talking = asyncio.create_task(asyncio.to_thread(talk))
            assert await asyncio.to_thread(there.wait, 10)
            await rig.client.ask(SendGuestAway(port="old"))
            with pytest.raises(serial.SerialException, match="socket disconnected"):
                await talking
            there.clear()


def test_the_command_line_lists_guests_and_sends_them_away(tmp_path, monkeypatch):
    with virtual_rig(monkeypatch, with_port(tmp_path / "port", "control"), {"line": chain_of_machine()}) as rig:
        rig.wait(asyncio.sleep(2))
        assert "old        line       no program; 0 refused" in rig.run("bus list --guests").printed
        program = open_port(tmp_path / "port")
        rig.wait(program.begin())
        rig.wait(program.send(HOLDS))
        rig.wait(asyncio.sleep(2))

        row = rig.run("bus list --guests").printed.splitlines()[-1]
        found = json.loads(rig.run("bus list --guests --json").printed.splitlines()[-1])
        sent = rig.run("bus send-away old")
        again = rig.run("bus send-away old")

        assert row.startswith("old        line       since 2")
        assert row.endswith("; controls rotor; 0.0 packets/s; 0 refused")
        assert (found["port"], found["axes"]) == ("old", ["rotor"])
        assert "the program at old was sent away; it controlled rotor" in sent.printed
        assert again.code == 1
        assert "no program uses the port old" in again.errors
        program.close()
        assert (tmp_path / "port").is_symlink()


async def test_the_wire_log_says_which_packets_a_program_has_caused(tmp_path):
    async with guest(tmp_path, "control") as (rig, program):
        await program.begin()
        await program.send(HOLDS)
        await program.send(load_velocity())
        await rig.until_speed(above=3.0)
        await rig.client.ask(Power(on=True), "table")
        await program.send(Packet(2, NO_OPERATION))
        program.close()
        await rig.until_speed(below=0.02)

        wire_log = await fetch_wire_log(rig.client, "line", 60)
        sent = [each for each in parse_records(wire_log.lines) if each.event is WireEvent.SENT]
        found = {(each.guest, CommandCode(each.data[2] & 0x0F), each.data[1]) for each in sent}

        codes = {CommandCode.LOAD_TRAJECTORY, CommandCode.STOP_MOTOR}
        assert {each for each in found if each[1] in codes and each[2] < 3} == {
            ("old", CommandCode.LOAD_TRAJECTORY, 1),
            ("old", CommandCode.STOP_MOTOR, 1),
            ("", CommandCode.STOP_MOTOR, 2),
        }
        assert ("old", CommandCode.READ_STATUS, 2) in found
        assert ("", CommandCode.READ_STATUS, 2) in found


def test_the_words_of_a_wire_log_name_the_program(tmp_path, monkeypatch):
    with virtual_rig(monkeypatch, with_port(tmp_path / "port"), {"line": chain_of_machine()}) as rig:
        rig.wait(asyncio.sleep(1))
        program = open_port(tmp_path / "port")
        rig.wait(program.begin())
        words = rig.run("bus wire-log line --format words").printed
        program.close()
        assert re.search(r"sent +node 1: ReadStatus\(items=.*\) for old$", words, re.MULTILINE)
        assert re.search(r"sent +node 1: ReadStatus\(items=.*\)$", words, re.MULTILINE)


def test_a_rig_without_ports_says_so(monkeypatch):
    with virtual_rig(monkeypatch) as rig:
        assert "no port is served" in rig.run("bus list --guests").errors
        assert rig.run("bus list --guests --json").printed == ""


async def test_a_port_that_cannot_be_opened_is_shown_with_the_reason(tmp_path):
    (tmp_path / "old").write_text("a file that somebody has put there")
    async with running_machine(with_port(tmp_path / "old"), chain_of_machine()) as rig:
        found = await shown(rig)

    assert found.port == "old"
    assert found.problem.startswith("not served, tried again: ")
    assert (tmp_path / "old").read_text() == "a file that somebody has put there"
