"""A program that knows nothing of ldcnd reads and stops drives on a port while clients move them."""

import asyncio
import grp
import os
import random
import stat
from itertools import product

import pytest

from ldcnd.config.rig import RigConfig
from ldcnd.contract.commands import MoveVelocity, Power, Reset, Stop
from ldcnd.contract.errors import LdcndError
from ldcnd.contract.events import ReadEvents
from ldcnd.contract.samples import AxisState, LinkState
from ldcnd.drives.ldcn.packet import CommandCode, Packet, encode_packet
from ldcnd.drives.ldcn.profiles import PIC_SERVO_SC
from ldcnd.drives.ldcn.trajectory import programmed_acceleration, programmed_velocity
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain
from ldcnd.sim.ldcn.drive import SimulatedDrive
from tests.support.guest_program import guest, open_port, with_port
from tests.support.machine_rig import COUNTS, Machine, machine, running_machine

SET_ADDRESS, STOP, NO_OPERATION = CommandCode.SET_ADDRESS, CommandCode.STOP_MOTOR, CommandCode.NO_OPERATION
DEFINE_STATUS, READ_STATUS = CommandCode.DEFINE_STATUS, CommandCode.READ_STATUS
SMOOTH, OFF = b"\x09", b"\x02"
CHANGES = (
    Packet(1, CommandCode.RESET_POSITION),
    Packet(1, CommandCode.LOAD_TRAJECTORY, bytes((0x97, *(5000).to_bytes(4, "little"), *bytes(8)))),
    Packet(1, CommandCode.START_MOTION),
    Packet(1, CommandCode.SET_GAIN, bytes(14)),
    Packet(1, STOP, b"\x01"),
    Packet(1, STOP, b"\x11" + bytes(4)),
    Packet(1, CommandCode.IO_CONTROL, b"\x00"),
    Packet(1, CommandCode.SET_HOMING_MODE, b"\x02"),
    Packet(1, CommandCode.CLEAR_STICKY_BITS),
    Packet(1, CommandCode.SAVE_CURRENT_POSITION_AS_HOME),
)


def load_velocity() -> Packet:
    """Return Load Trajectory at 4 revolutions a second, which begins at once."""
    data = b"\xb6" + programmed_velocity(4 * COUNTS, 1, PIC_SERVO_SC).to_bytes(4, "little")
    data += programmed_acceleration(20 * COUNTS, 1, PIC_SERVO_SC).to_bytes(4, "little")
    return Packet(1, CommandCode.LOAD_TRAJECTORY, data)


def registers(rig: Machine) -> list[tuple[object, ...]]:
    """Return what the simulated drives hold that a guest could change."""
    drives = [each for each in rig.chain.modules if isinstance(each, SimulatedDrive)]
    return [(each.address, each.group, each.leader, each.baud, each.items) for each in drives]


def record_packets(rig: Machine) -> list[bytes]:
    """Record what is sent on the line from now on."""
    sent, write = [], rig.chain.write

    def record(now_s: float, data: bytes) -> None:
        sent.append(data)
        write(now_s, data)

    rig.chain.write = record
    return sent


async def turning(rig: Machine) -> None:
    await rig.client.ask(Power(on=True), "rotor")
    await rig.client.ask(MoveVelocity(velocity=5.0), "rotor")
    await rig.until_speed(above=4.0)


async def test_a_guest_resets_and_readdresses_and_the_motion_of_others_goes_on(tmp_path):
    async with guest(tmp_path) as (rig, program):
        await turning(rig)
        before = registers(rig)
        await program.begin()

        assert await program.send(Packet(1, NO_OPERATION))
        assert rig.speed() > 4.0
        assert registers(rig) == before


async def test_what_would_move_or_set_a_drive_is_answered_not_done_and_an_event(tmp_path):
    async with guest(tmp_path) as (rig, program):
        await turning(rig)
        await program.begin()

        for packet in CHANGES:
            assert await program.send(packet), packet

        assert rig.speed() > 4.0
        events = (await rig.client.ask(ReadEvents(axis="rotor"))).events
        refused = [event for event in events if event.client == "old"]
        assert {event.status.value for event in refused} == {"refused"}
        assert len(refused) >= 9


@pytest.mark.parametrize("control", [SMOOTH, OFF])
async def test_a_stop_of_a_guest_always_goes_out(tmp_path, control):
    async with guest(tmp_path) as (rig, program):
        await turning(rig)
        await program.begin()

        await program.send(Packet(1, STOP, control))

        await rig.until_speed(below=0.01, within_s=3.0)
        assert rig.daemon.rig.axes["rotor"].tracker.status.enabled is (control == SMOOTH)


def test_a_port_of_a_line_that_is_not_there_is_refused():
    document = machine().model_dump(mode="json", exclude_defaults=True)
    with pytest.raises(ValueError, match="port old: there is no bus 'other'; there are: line"):
        RigConfig.model_validate(document | {"port": [{"name": "old", "bus": "other", "link": "x"}]})


@pytest.mark.long
async def test_a_guest_that_reads_as_fast_as_it_can_leaves_polls_their_rate(tmp_path):
    async with guest(tmp_path, rates={"position": 400, "velocity": 400, "adc": 0, "state": 20}) as (rig, program):
        loop = asyncio.get_running_loop()
        sent = record_packets(rig)
        await asyncio.sleep(2.0)
        alone = len(sent)
        await program.begin()
        await program.change_rate()
        sent.clear()
        replies, until_s = 0, loop.time() + 2.0
        while loop.time() < until_s:
            replies += bool(await program.send(Packet(1, NO_OPERATION)))

        assert replies > 20
        assert len(sent) - replies >= 0.78 * alone


@pytest.mark.long
async def test_a_stop_waits_for_no_more_than_one_exchange_of_a_guest_that_reads_as_fast_as_it_can(tmp_path):
    async with guest(tmp_path) as (rig, program):
        loop, longest_s = asyncio.get_running_loop(), {False: 0.0, True: 0.0}
        await program.begin()
        await program.change_rate()
        sent = record_packets(rig)
        for greedy, delay_s in product((False, True), (0.0002 * count for count in range(20))):
            await rig.client.ask(Reset(), "rotor")
            await turning(rig)
            until_s = loop.time() + 0.2
            while loop.time() < until_s:
                await (program.send(Packet(1, NO_OPERATION)) if greedy else asyncio.sleep(0.01))
            if greedy:
                program.send_bytes(encode_packet(Packet(1, NO_OPERATION)))
            await asyncio.sleep(delay_s)
            sent.clear()
            asked_s, stopping = loop.time(), asyncio.create_task(rig.client.ask(Stop(), "rotor"))
            while not any(each[1] == 1 and each[2] & 0x0F == STOP for each in sent):
                await asyncio.sleep(0.0001)
            longest_s[greedy] = max(longest_s[greedy], loop.time() - asked_s)
            await stopping
            async with asyncio.timeout(5.0):
                while (await rig.client.state("rotor")).state is AxisState.STOPPING:
                    await asyncio.sleep(0.02)
        assert longest_s[True] < longest_s[False] + 0.003, longest_s  # an exchange at 115,200 bits/s takes 2 ms


@pytest.mark.parametrize(
    ("seed", "bursts"), [*((seed, 100) for seed in range(3)), pytest.param(3, 20_000, marks=pytest.mark.soak)]
)
@pytest.mark.sweep(2)
async def test_whatever_a_guest_sends_the_line_is_not_rearranged_and_nothing_moves_by_it(tmp_path, seed, bursts):
    """A random guest beside a client that moves another axis: valid packets, damaged ones, rubbish, resets, rates."""
    chance = random.Random(seed)
    async with guest(tmp_path) as (rig, program):
        await rig.client.ask(Power(on=True), "table")
        await rig.client.ask(MoveVelocity(velocity=2.0), "table")
        before, sent = registers(rig), record_packets(rig)
        await program.begin()
        for _ in range(bursts):
            for _ in range(chance.randrange(1, 5)):
                command = chance.choice(list(CommandCode))
                if command is STOP:
                    continue  # it may stop any axis: see above
                data = chance.randbytes(chance.choice((0, 1, 2, 5, 14, 15)))
                packet = bytearray(encode_packet(Packet(chance.choice((0, 1, 2, 3, 4, 0x80, 0xFF)), command, data)))
                if chance.random() < 0.2:
                    packet[chance.randrange(len(packet))] ^= 1 << chance.randrange(8)
                if chance.random() < 0.1:
                    packet += chance.randbytes(7)
                program.send_bytes(bytes(packet))
            await asyncio.sleep(chance.choice((0.0, 0.001, 0.03)))
            assert rig.speed(1) == 0.0
        await program.change_rate()
        await asyncio.sleep(0.5)

        assert {CommandCode(each[2] & 0x0F) for each in sent} <= {READ_STATUS, NO_OPERATION}
        assert registers(rig) == before
        assert not rig.daemon.rig.axes["rotor"].tracker.status.enabled


@pytest.mark.long
async def test_replies_have_the_form_that_they_have_on_the_bare_line(tmp_path):
    loop = asyncio.get_running_loop()
    bare = build_chain(ChainSpec((ModuleSpec("pic-servo-sc"), ModuleSpec("pic-servo-sc"), ModuleSpec("pic-io"))))
    arrange = (
        Packet(0xFF, CommandCode.HARD_RESET),
        Packet(0, SET_ADDRESS, b"\x01\xff"),
        Packet(0, SET_ADDRESS, b"\x02\xff"),
        Packet(0, SET_ADDRESS, b"\x03\xff"),
        Packet(2, SET_ADDRESS, b"\x02\x81"),
        Packet(1, SET_ADDRESS, b"\x01\x01"),
    )
    reads = tuple(
        Packet(1, code, bytes((mask,))) for mask in (0, 1, 0x2D, 0xFF) for code in (DEFINE_STATUS, READ_STATUS)
    )
    others = (Packet(0x81, NO_OPERATION), Packet(0xFF, NO_OPERATION), Packet(9, NO_OPERATION), Packet(2, NO_OPERATION))
    async with guest(tmp_path) as (_, program):
        for packet in (*arrange, *reads, *others, *CHANGES):
            bare.write(loop.time(), encode_packet(packet))
            await asyncio.sleep(0.05)
            expected = b"".join(piece for _, piece in bare.advance(loop.time()))
            reply = await program.send(packet, 0.1)
            await asyncio.sleep(0.02)
            assert len(reply) // 2 == len(expected), packet


@pytest.mark.long
async def test_a_port_that_cannot_be_made_is_an_event_and_is_served_once_it_can_be(tmp_path):
    folder = tmp_path / "run"
    async with running_machine(with_port(folder / "port")) as rig:
        await turning(rig)
        told = (await rig.client.ask(ReadEvents())).events
        assert any(f"No such file or directory: '{folder}" in (each.reason or "") for each in told)
        folder.mkdir()
        async with asyncio.timeout(20):
            while not (folder / "port").is_symlink():
                await asyncio.sleep(0.1)


@pytest.mark.parametrize("second", ["x", "sim:"])
def test_no_two_have_one_place(second):
    document = machine().model_dump(mode="json", exclude_defaults=True)
    document["bus"][0]["port"] = "sim:"
    ports = [{"name": name, "bus": "line", "link": link} for name, link in (("old", "x"), ("other", second))]
    with pytest.raises(ValueError, match="is that of"):
        RigConfig.model_validate(document | {"port": ports})


async def test_while_the_line_is_lost_a_guest_hears_nothing_and_afterwards_it_reads_again(tmp_path):
    async with guest(tmp_path) as (rig, program):
        await program.begin()
        now_s = asyncio.get_running_loop().time()
        rig.chain.unplug(now_s)
        await asyncio.sleep(0.1)
        assert await program.send(Packet(1, NO_OPERATION), 0.3) == ""

        rig.chain.replug()
        await rig.until("rotor", lambda state: state.link is LinkState.UP)
        assert await program.send(Packet(1, NO_OPERATION))


async def test_the_link_is_gone_with_the_daemon(tmp_path):
    async with guest(tmp_path):
        assert (tmp_path / "port").is_symlink()
    assert not (tmp_path / "port").is_symlink()


async def test_set_address_is_repeated_as_programs_do_and_the_next_module_keeps_its_own(tmp_path):
    async with guest(tmp_path) as (_, program):
        await program.send(Packet(0xFF, CommandCode.HARD_RESET), 0.05)
        for address in (1, 1, 1, 2, 2, 3):
            assert await program.send(Packet(0, SET_ADDRESS, bytes((address, 0xFF))))
        kinds = [await program.send(Packet(address, READ_STATUS, b"\x20")) for address in (1, 2, 3)]
        assert kinds[0] == kinds[1] != kinds[2]
        assert all(kinds)


@pytest.mark.parametrize("access", ["read", "control"])
async def test_a_stop_that_a_program_sends_before_it_ends_goes_out(tmp_path, access):
    async with guest(tmp_path, access) as (rig, program):
        await turning(rig)
        await program.begin()
        program.send_bytes(encode_packet(Packet(1, NO_OPERATION)) * 20 + encode_packet(Packet(1, STOP, SMOOTH)))
        program.close()

        await rig.until_speed(below=0.01, within_s=3.0)


@pytest.mark.parametrize("access", ["read", "control"])
async def test_the_last_stop_of_a_program_goes_out_though_the_next_one_comes_before_the_line_has_carried_it(
    tmp_path, access
):
    async with guest(tmp_path, access) as (rig, program):
        await turning(rig)
        await program.begin()
        program.send_bytes(encode_packet(Packet(1, NO_OPERATION)) * 900 + encode_packet(Packet(1, STOP, SMOOTH)))
        program.close()
        await asyncio.sleep(0.1)  # all of it would take two seconds
        following = open_port(tmp_path / "port")
        following.send_bytes(encode_packet(Packet(1, NO_OPERATION)))

        await rig.until_speed(below=0.01, within_s=1.0)
        following.close()
        await asyncio.sleep(0.2)


async def test_a_stop_behind_more_than_the_line_carries_goes_out_in_its_turn(tmp_path):
    async with guest(tmp_path, "control") as (rig, program):
        await turning(rig)
        await program.begin()
        for size in (1000, 300):  # the first ones are on their way when the others come
            program.send_bytes(encode_packet(Packet(1, NO_OPERATION)) * size)
            await asyncio.sleep(0.02)
        program.send_bytes(encode_packet(Packet(1, STOP, SMOOTH)))

        await rig.until_speed(below=0.01, within_s=6.0)
        program.close()
        await asyncio.sleep(0.2)


@pytest.mark.parametrize(
    ("way", "complaint"),
    [
        ({}, "give it either link or listen"),
        ({"link": "x", "listen": "127.0.0.1:1"}, "give it either link or listen"),
        ({"listen": "0.0.0.0:4001"}, "other machines could reach 0.0.0.0:4001"),
        ({"listen": "4001"}, "is not HOST:PORT"),
        ({"link": "x", "rfc2217": True}, "give it listen"),
        ({"listen": "127.0.0.1:4001", "mode": "0660"}, "mode and group are of a terminal"),
    ],
)
def test_a_port_has_one_way_in_and_none_for_other_machines_unless_it_says_so(way, complaint):
    document = machine().model_dump(mode="json", exclude_defaults=True)
    with pytest.raises((ValueError, LdcndError), match=complaint):
        RigConfig.model_validate(document | {"port": [{"name": "old", "bus": "line"} | way]})


async def test_the_terminal_has_the_group_and_the_mode_of_the_configuration(tmp_path):
    mine = grp.getgrgid(max(os.getgroups(), default=os.getgid()))
    config = with_port(tmp_path / "port")
    (port,) = config.port
    shared = config.model_copy(update={"port": (port.model_copy(update={"mode": "0660", "group": mine.gr_name}),)})
    async with running_machine(shared):
        found = (tmp_path / "port").stat()
        assert (found.st_gid, stat.S_IMODE(found.st_mode)) == (mine.gr_gid, 0o660)
