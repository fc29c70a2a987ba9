"""A program comes in to a port by TCP: raw bytes, or RFC 2217 with the serial settings that it makes."""

import asyncio
import socket
import time
from contextlib import suppress

import pytest
import serial

from ldcnd.config.rig import RigConfig
from ldcnd.contract.leases import ListHolders
from ldcnd.drives.ldcn.packet import CommandCode, Packet, encode_packet
from tests.integration.test_port_control import ENABLE, GO_NOW, load
from tests.integration.test_ports import load_velocity, turning
from tests.support.machine_rig import machine, running_machine
from tests.support.process import free_port

SET_ADDRESS, STOP = CommandCode.SET_ADDRESS, CommandCode.STOP_MOTOR
RESET = Packet(0xFF, CommandCode.HARD_RESET)
BEGINS = (RESET, *(Packet(0, SET_ADDRESS, bytes((each, 0xFF))) for each in (1, 2, 3)))


def with_tcp_port(port: int, **settings: object) -> RigConfig:
    """Return the machine with a port at a TCP address."""
    document = machine().model_dump(mode="json", exclude_defaults=True)
    tcp = {"name": "old", "bus": "line", "listen": f"127.0.0.1:{port}", "access": "control"}
    return RigConfig.model_validate(document | {"port": [tcp | settings]})


async def exchange(port: int, packets: tuple[Packet, ...]) -> list[bytes]:
    """Send packets by TCP, each once the reply to the one before has come; return the replies."""
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    replies = []
    for packet in packets:
        writer.write(encode_packet(packet))
        if packet is RESET:
            await asyncio.sleep(0.05)
            continue
        replies.append(await asyncio.wait_for(reader.read(100), 5))
    writer.close()
    await writer.wait_closed()
    return replies


@pytest.mark.real_time
async def test_one_program_at_a_time_and_what_it_moves_halts_when_it_goes():
    port = free_port()
    async with running_machine(with_tcp_port(port)) as rig:
        _, writer = await asyncio.open_connection("127.0.0.1", port)
        second, other = await asyncio.open_connection("127.0.0.1", port)
        with suppress(ConnectionError):  # it is refused by a reset, which may come before the read
            assert await asyncio.wait_for(second.read(), 5) == b""
        other.close()
        writer.close()
        replies: list[bytes] = []
        async with asyncio.timeout(10):
            while not replies or not all(replies):  # the first one may not have left yet
                with suppress(ConnectionError):
                    replies = await exchange(port, (*BEGINS, Packet(1, STOP, b"\x05"), load_velocity()))
                await asyncio.sleep(0.05)
        assert len(replies) == 5
        async with asyncio.timeout(10):
            while any(each.client for each in (await rig.client.ask(ListHolders())).holders) or rig.speed() > 0.02:
                await asyncio.sleep(0.05)


@pytest.mark.real_time
async def test_a_port_serves_the_next_program_behind_one_that_goes_in_the_turn_in_which_what_it_sent_is_refused():
    port, zero = free_port(), encode_packet(Packet(1, CommandCode.RESET_POSITION))
    async with running_machine(with_tcp_port(port)) as rig, asyncio.timeout(20):
        loop, status = asyncio.get_running_loop(), lambda: rig.daemon.rig.axes["rotor"].tracker.status
        with socket.create_connection(("127.0.0.1", port)) as program:
            program.settimeout(0)
            for packet in (*BEGINS, ENABLE, load(GO_NOW, counts=500)):
                await loop.sock_sendall(program, encode_packet(packet))
                await (asyncio.sleep(0.05) if packet is RESET else loop.sock_recv(program, 100))
            while status().command is None:
                await asyncio.sleep(0)
            await loop.sock_sendall(program, zero * 2)  # both wait until the move has settled
            while status().command:
                await asyncio.sleep(0)
        time.sleep(0.02)  # noqa: ASYNC251 - the end of the connection and the next look at the axis are due together

        replies = await exchange(port, BEGINS)

    assert len(replies) == 3
    assert all(replies)


def drive_by_rfc2217(port: int) -> tuple[list[bytes], float]:
    """Do what a program does that opens `rfc2217://`: return its replies, and the position that it read."""
    with serial.serial_for_url(f"rfc2217://127.0.0.1:{port}", baudrate=19_200, timeout=2.0) as line:

        def send(packet: Packet, size: int) -> bytes:
            line.write(encode_packet(packet))
            return bytes(line.read(size))

        replies = [send(packet, 0 if packet is RESET else 2) for packet in BEGINS]
        send(Packet(0xFF, CommandCode.SET_BAUD_RATE, b"\x0a"), 0)
        wrong_rate = line.timeout = 0.3
        assert send(Packet(1, CommandCode.NO_OPERATION), 2) == b"", wrong_rate  # its modules are at 115,200 now
        line.baudrate, line.timeout = 115_200, 2.0
        # 255 in the data is doubled on the connection
        replies += [
            send(Packet(1, CommandCode.RESET_POSITION), 2),
            send(Packet(1, CommandCode.READ_STATUS, b"\xff"), 2),
        ]
        return replies, line.baudrate


@pytest.mark.filterwarnings("ignore:set(Daemon|Name):DeprecationWarning")  # of pyserial's client
@pytest.mark.real_time
@pytest.mark.parametrize("access", ["read", "control"])
async def test_a_program_that_speaks_rfc_2217_sets_its_rate_by_it(access):
    port = free_port()
    async with running_machine(with_tcp_port(port, rfc2217=True, access=access)) as rig:
        replies, rate = await asyncio.to_thread(drive_by_rfc2217, port)
        assert rig.daemon.rig.axes["rotor"].tracker.status.referenced is (access == "control")

    assert rate == 115_200
    assert all(replies[1:])


async def test_a_port_whose_address_is_in_use_says_so_and_leaves_the_daemon_as_it_is(capfd):
    other = await asyncio.start_server(lambda *_: None, "127.0.0.1", 0)
    port = other.sockets[0].getsockname()[1]
    async with running_machine(with_tcp_port(port)) as rig:
        await rig.client.state("rotor")
    other.close()
    assert "address already in use" in capfd.readouterr().out


@pytest.mark.real_time
async def test_what_a_program_sends_beyond_its_rate_waits_and_all_of_it_comes():
    port = free_port()
    async with running_machine(with_tcp_port(port)):
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        writer.write(bytes(10_000))  # five seconds at 19,200 bits/s
        writer.write(encode_packet(RESET))
        await asyncio.sleep(0.05)
        writer.write(encode_packet(Packet(0, SET_ADDRESS, b"\x01\xff")))
        assert len(await asyncio.wait_for(reader.read(100), 30)) == 2
        writer.close()


@pytest.mark.real_time
async def test_a_stop_behind_more_than_its_line_carries_goes_out_at_once_where_the_program_ends():
    port = free_port()
    async with running_machine(with_tcp_port(port)) as rig:
        await exchange(port, BEGINS)
        await turning(rig)
        _, writer = await asyncio.open_connection("127.0.0.1", port)
        for packet in BEGINS:
            writer.write(encode_packet(packet))
            await asyncio.sleep(0.05)
        writer.write(bytes(40_000))  # 20 seconds
        writer.write(encode_packet(Packet(1, STOP, b"\x09")))
        await writer.drain()
        writer.close()

        await rig.until_speed(below=0.01, within_s=10.0)
