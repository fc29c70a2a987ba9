"""An old program moves axes through its port: the simulated shaft decides, and everybody's rules hold for it too."""

import asyncio
from contextlib import asynccontextmanager, suppress

import pytest

from ldcnd.contract.commands import Halt, MoveRelative, MoveVelocity, Power, Reset, SetPosition, Stop
from ldcnd.contract.errors import LdcndError
from ldcnd.contract.events import ReadEvents
from ldcnd.contract.leases import Acquire, ListHolders, Release
from ldcnd.contract.samples import AxisState, LinkState
from ldcnd.drives.ldcn.packet import CommandCode, Packet, StatusFlag, StatusItem, encode_packet
from ldcnd.drives.ldcn.profiles import PIC_SERVO_SC
from ldcnd.drives.ldcn.trajectory import programmed_acceleration, programmed_velocity
from ldcnd.sim.plant import MotorPlant
from tests.support.guest_program import guest, open_port, with_port
from tests.support.machine_rig import COUNTS, GAINS, chain_of_machine, running_machine

LOAD, START, STOP = CommandCode.LOAD_TRAJECTORY, CommandCode.START_MOTION, CommandCode.STOP_MOTOR
READ, NO_OPERATION = CommandCode.READ_STATUS, CommandCode.NO_OPERATION
ENABLE, SMOOTH, OFF = Packet(1, STOP, b"\x05"), Packet(1, STOP, b"\x09"), Packet(1, STOP, b"\x02")
GO_NOW, GO_LATER, RUN_NOW = 0x97, 0x17, 0xB6
POSITION = b"\x01"


def load(control, *, counts=None, speed=5.0, rate=20.0, address=1):
    """Return Load Trajectory with a position in counts, a speed and an acceleration in revolutions."""
    velocity = programmed_velocity(speed * COUNTS, 1, PIC_SERVO_SC) if speed else 0
    data = bytes((control,)) + (b"" if counts is None else counts.to_bytes(4, "little", signed=True))
    data += velocity.to_bytes(4, "little")
    data += programmed_acceleration(rate * COUNTS, 1, PIC_SERVO_SC).to_bytes(4, "little")
    return Packet(address, LOAD, data)


def set_gain(sr=1, cl=0, multiplier=1, kp=GAINS["kp"]):
    """Return Set Gain with the gains of the machine but for these."""
    data = b"".join(value.to_bytes(2, "little") for value in (kp, GAINS["kd"], GAINS["ki"], GAINS["il"]))
    data += bytes((GAINS["ol"], cl)) + GAINS["el"].to_bytes(2, "little")
    return Packet(1, CommandCode.SET_GAIN, data + bytes((sr, 0, multiplier)))


def flags(reply):
    return StatusFlag(bytes.fromhex(reply)[0])


def position(reply):
    return int.from_bytes(bytes.fromhex(reply)[1:5], "little", signed=True)


async def finished(program, address=1, within_s=10.0):
    """Poll as a program does until the drive says that its move is done; return its counter."""
    async with asyncio.timeout(within_s):
        while True:
            reply = await program.send(Packet(address, READ, POSITION))
            if flags(reply) & StatusFlag.MOVE_DONE:
                return position(reply)
            await asyncio.sleep(0.01)


async def moved(program, counts):
    """Move to a place as a program does, and return its counter once that is done."""
    await program.send(load(GO_NOW, counts=counts))
    return await finished(program)


async def searched(program):
    """Poll as a program does until no search is in progress."""
    async with asyncio.timeout(30):
        while flags(await program.send(Packet(1, NO_OPERATION))) & StatusFlag.HOME_IN_PROGRESS:
            await asyncio.sleep(0.02)


def shaft(rig, place=1):
    """Return where a simulated shaft is, in counts."""
    drive = rig.chain.modules[place - 1]
    drive.catch_up(asyncio.get_running_loop().time())
    return drive.shaft.position_counts


async def events(rig, axis="rotor"):
    return [each for each in (await rig.client.ask(ReadEvents(axis=axis, count=100))).events if each.client == "old"]


@asynccontextmanager
async def enabled(tmp_path, **axis):
    """Run the machine, and a program that has given out addresses and closed the loop of the rotor."""
    async with guest(tmp_path, "control", **axis) as (rig, program):
        await program.begin()
        await program.send(ENABLE)
        yield rig, program


@pytest.mark.long
async def test_a_program_enables_moves_and_finds_its_counts(tmp_path):
    async with guest(tmp_path, "control") as (rig, program):
        await program.begin()
        assert await program.send(ENABLE)
        assert await program.send(load(GO_NOW, counts=2500))
        assert await finished(program) == pytest.approx(2500, abs=5)
        assert shaft(rig) == pytest.approx(2500, abs=5)

        await program.send(load(GO_LATER, counts=-1200))
        await asyncio.sleep(0.3)
        assert shaft(rig) == pytest.approx(2500, abs=5)  # it waits for Start Motion
        await program.send(Packet(1, START))
        assert await finished(program) == pytest.approx(-1200, abs=5)
        assert shaft(rig) == pytest.approx(-1200, abs=5)
        holders = {each.axis: each.client for each in (await rig.client.ask(ListHolders())).holders}
        assert holders == {"rotor": "old", "table": None}


@pytest.mark.long
async def test_the_registers_of_the_drive_are_those_that_the_program_has_loaded(tmp_path):
    async with enabled(tmp_path) as (rig, program):
        sent = load(GO_NOW, counts=2500, speed=3.21, rate=17.3)
        await program.send(sent)
        await finished(program)
        info = next(each for each in await rig.client.axes() if each.axis == "rotor")
        known = {each.name: each.value for each in info.registers}
        loaded = tuple(int.from_bytes(sent.data[at : at + 4], "little") for at in (5, 9))
        assert (known["velocity"], known["acceleration"]) == loaded


async def test_a_program_runs_at_a_velocity_and_ends_it_with_a_velocity_of_0_or_a_stop(tmp_path):
    async with enabled(tmp_path) as (rig, program):
        for end in (load(RUN_NOW, speed=0), SMOOTH):
            await program.send(load(RUN_NOW, speed=4.0))
            await rig.until_speed(above=3.8)
            await program.send(end)
            await rig.until_speed(below=0.02)


async def test_a_stop_of_anybody_holds_against_the_program_until_a_person_resets(tmp_path):
    async with enabled(tmp_path) as (rig, program):
        await program.send(load(RUN_NOW, speed=4.0))
        await rig.until_speed(above=3.8)
        await rig.client.ask(Stop(), "rotor")
        await rig.until_speed(below=0.02)

        stands = shaft(rig)
        for packet in (ENABLE, Packet(1, CommandCode.CLEAR_STICKY_BITS), load(GO_NOW, counts=0), load(RUN_NOW)):
            assert await program.send(packet)
        await asyncio.sleep(1.0)
        assert shaft(rig) == pytest.approx(stands, abs=5)
        told = [each for each in await events(rig) if each.verb == "guest"]
        assert any("latched" in (each.reason or "") for each in told)


async def test_a_program_that_goes_loses_control_and_what_it_moved_halts(tmp_path):
    async with enabled(tmp_path) as (rig, program):
        await program.send(load(RUN_NOW, speed=4.0))
        await rig.until_speed(above=3.8)
        program.close()
        await rig.until_speed(below=0.02)
        assert all(each.client is None for each in (await rig.client.ask(ListHolders())).holders)


@pytest.mark.long
async def test_a_program_that_falls_silent_loses_control_too(tmp_path):
    async with enabled(tmp_path) as (rig, program):
        await program.send(load(RUN_NOW, speed=4.0))
        await asyncio.sleep(4.0)
        assert rig.speed() > 3.8
        await asyncio.sleep(3.0)
        assert rig.speed() < 0.02


@pytest.mark.long
async def test_a_program_that_only_reads_gives_axes_back_that_rest(tmp_path):
    async with enabled(tmp_path) as (rig, program):
        for _ in range(80):
            await program.send(Packet(1, NO_OPERATION))
            await asyncio.sleep(0.1)
        assert all(each.client is None for each in (await rig.client.ask(ListHolders())).holders)
        assert rig.daemon.rig.axes["rotor"].tracker.status.enabled


async def test_another_client_that_has_control_keeps_it(tmp_path):
    async with guest(tmp_path, "control") as (rig, program):
        await program.begin()
        await rig.client.ask(Power(on=True), "rotor")
        await rig.client.ask(Acquire(client="ada", axes=("rotor",), lease_s=60))
        await program.send(load(GO_NOW, counts=2500))
        await asyncio.sleep(1.0)
        assert shaft(rig) == pytest.approx(0, abs=5)
        assert any("controlled by ada" in (each.reason or "") for each in await events(rig))


async def test_a_hard_reset_of_the_program_switches_off_what_it_controls_and_nothing_else(tmp_path):
    async with guest(tmp_path, "control") as (rig, program):
        await program.begin()
        await rig.client.ask(Power(on=True), "table")
        await program.send(ENABLE)
        await program.send(load(RUN_NOW, speed=2.0))
        await asyncio.sleep(1.0)
        await program.send(Packet(0xFF, CommandCode.HARD_RESET), 0.05)
        async with asyncio.timeout(5):
            while rig.daemon.rig.axes["rotor"].tracker.status.enabled:
                await asyncio.sleep(0.02)
        assert rig.daemon.rig.axes["table"].tracker.status.enabled


@pytest.mark.long
async def test_after_a_hard_reset_the_program_finds_its_counter_at_zero(tmp_path):
    """Programs take it for their zero: with an older one they would move elsewhere, and back."""
    async with enabled(tmp_path) as (rig, program):
        await moved(program, 2000)
        await asyncio.sleep(1.0)
        await program.begin()
        await program.send(ENABLE)
        await moved(program, 1000)
        assert shaft(rig) == pytest.approx(3000, abs=20)


async def test_the_first_program_finds_the_counters_of_all_its_axes_at_zero(tmp_path):
    """Modules behind the first of a chain hear no Hard Reset before they have an address: their axes went elsewhere."""
    async with guest(tmp_path, "control") as (rig, program):
        for axis in ("rotor", "table"):
            await rig.client.ask(Power(on=True), axis)
            reply = await rig.client.ask(MoveRelative(distance=2.0, velocity=5.0), axis)
            await rig.client.wait_for_end(axis, reply.command_id)
        before = shaft(rig, 1), shaft(rig, 2)
        assert min(before) > COUNTS

        await program.begin()
        for address in (1, 2):
            assert abs(position(await program.send(Packet(address, READ, POSITION)))) <= 2
            await program.send(Packet(address, STOP, b"\x05"))
            await program.send(load(GO_NOW, counts=500, address=address))
            await finished(program, address)

        assert shaft(rig, 1) - before[0] == pytest.approx(500, abs=10)
        assert shaft(rig, 2) - before[1] == pytest.approx(500, abs=10)


async def test_a_drive_that_loses_power_is_silent_for_its_program_until_that_gives_it_an_address_again(tmp_path):
    """Its counter begins at 0 anew: the program read a false position, and its next move went elsewhere."""
    async with enabled(tmp_path) as (rig, program):
        await moved(program, 2000)
        drive = rig.chain.modules[0]
        drive.power(on=False, at_s=asyncio.get_running_loop().time())
        await rig.until("rotor", lambda state: state.link is LinkState.DOWN)
        drive.power(on=True, at_s=asyncio.get_running_loop().time())
        await rig.until("rotor", lambda state: state.link is LinkState.UP)
        before = shaft(rig)

        assert await program.send(Packet(1, READ, POSITION), 0.3) == ""
        await program.send(ENABLE, 0.3)
        await program.send(load(GO_NOW, counts=2000), 0.3)
        await asyncio.sleep(1.0)
        assert shaft(rig) == pytest.approx(before, abs=5)

        await program.begin()
        assert abs(position(await program.send(Packet(1, READ, POSITION)))) <= 5
        await program.send(ENABLE)
        await program.send(Packet(1, CommandCode.CLEAR_STICKY_BITS))
        await moved(program, 1000)
        assert shaft(rig) - before == pytest.approx(1000, abs=20)


def home(reply):
    return int.from_bytes(bytes.fromhex(reply)[1:5], "little", signed=True)


async def test_after_a_hard_reset_the_programs_home_register_is_zero_until_its_next_search(tmp_path):
    read = Packet(1, READ, bytes((StatusItem.HOME,)))

    async def searches(program):
        await program.send(ENABLE)
        await program.send(Packet(1, CommandCode.SET_HOMING_MODE, b"\x28"))
        await program.send(load(RUN_NOW, speed=0.5))
        await asyncio.sleep(6)

    async with guest(tmp_path, "control") as (_, program):
        await program.begin()
        await searches(program)
        found = home(await program.send(read))
        assert found
        await program.begin()
        assert home(await program.send(read)) == 0
        await searches(program)
        assert home(await program.send(read)) not in {0, found}


async def test_a_latched_stop_keeps_a_program_from_giving_the_axis_another_position(tmp_path):
    async with enabled(tmp_path) as (rig, program):
        await moved(program, 2000)
        await asyncio.sleep(1.0)
        await rig.client.ask(Stop(), "rotor")
        before = rig.daemon.rig.axes["rotor"].tracker.status.scale
        await program.send(Packet(1, CommandCode.RESET_POSITION))
        await asyncio.sleep(0.5)
        assert rig.daemon.rig.axes["rotor"].tracker.status.scale == before
        assert position(await program.send(Packet(1, READ, POSITION))) == pytest.approx(2000, abs=20)
        assert any("latched" in (each.reason or "") for each in await events(rig))


async def test_a_move_that_follows_one_that_has_still_to_settle_is_not_said_to_have_cut_it_short(tmp_path):
    async with enabled(tmp_path, reference="at_reset") as (rig, program):
        await program.send(Packet(1, CommandCode.RESET_POSITION))
        for counts in (1000, 2000):
            await program.send(load(GO_NOW, counts=counts))
            await finished(program)
        aborted = [each.reason for each in await events(rig) if each.status == "aborted"]
        assert all("its profile was over" in each for each in aborted), aborted


async def test_limits_hold_for_the_program_and_its_move_is_not_done(tmp_path):
    limits = {"limits": {"position_min": -2.0, "position_max": 2.0, "velocity": 11.0}}
    async with guest(tmp_path, "control", **limits) as (rig, program):
        await program.begin()
        await rig.client.ask(SetPosition(position=0.0), "rotor")
        await program.send(ENABLE)
        for packet in (load(GO_NOW, counts=2500), load(GO_NOW, counts=1500, speed=11.5)):
            await program.send(packet)
            await finished(program)
            assert shaft(rig) == pytest.approx(0, abs=5)
        refused = [each for each in await events(rig) if each.verb == "guest"]
        assert any("2.5 rev" in (each.reason or "") for each in refused)

        await moved(program, 1500)
        assert shaft(rig) == pytest.approx(1500, abs=20)  # its profile is over, the shaft follows


@pytest.mark.long
async def test_a_zero_that_the_program_sets_is_its_own_counter_and_the_position_of_everybody(tmp_path):
    async with enabled(tmp_path) as (rig, program):
        await moved(program, 2500)
        async with asyncio.timeout(5):
            while not rig.daemon.rig.axes["rotor"].tracker.status.at_rest:
                await asyncio.sleep(0.02)
        reply = await program.send(Packet(1, CommandCode.RESET_POSITION))
        assert reply
        assert position(await program.send(Packet(1, READ, POSITION))) == pytest.approx(0, abs=5)
        async with asyncio.timeout(5):
            while abs((await rig.client.last("rotor", "position")).value) > 0.01:
                await asyncio.sleep(0.02)

        assert await moved(program, -500) == pytest.approx(-500, abs=5)
        assert shaft(rig) == pytest.approx(2000, abs=8)


@pytest.mark.long
async def test_a_search_for_the_index_is_the_homing_of_everybody(tmp_path):
    async with enabled(tmp_path) as (rig, program):
        await moved(program, 300)
        armed = await program.send(Packet(1, CommandCode.SET_HOMING_MODE, b"\x28"))  # index, then a smooth stop
        assert flags(armed) & StatusFlag.HOME_IN_PROGRESS
        await program.send(load(RUN_NOW, speed=0.5))
        await searched(program)
        await finished(program)
        await program.send(Packet(1, CommandCode.RESET_POSITION, b"\x01"))  # relative to the home position
        await moved(program, 0)
        async with asyncio.timeout(5):
            while not (await rig.client.state("rotor")).referenced:
                await asyncio.sleep(0.02)
        assert (await rig.client.last("rotor", "position")).value == pytest.approx(0.0, abs=0.02)
        plant = rig.chain.modules[0].shaft.plant
        assert (shaft(rig) - plant.index_at_counts) % plant.counts_per_rev == pytest.approx(0, abs=10)


@pytest.mark.long
async def test_a_search_that_is_armed_in_mid_motion_shows_what_a_drive_shows(tmp_path):
    """As the driver of a centrifuge does it: servo and amplifier in two packets, and armed once the rotor turns."""
    async with guest(tmp_path, "control") as (rig, program):
        await program.begin()
        for control in (b"\x02", b"\x04", b"\x01"):
            await program.send(Packet(1, STOP, control))
        await program.send(load(RUN_NOW, speed=0.5))
        async with asyncio.timeout(5):
            while not flags(await program.send(Packet(1, NO_OPERATION))) & StatusFlag.MOVE_DONE:
                await asyncio.sleep(0.01)
        assert 0.05 < rig.speed() < 0.7  # done is said of the velocity
        await program.send(Packet(1, CommandCode.SET_HOMING_MODE, b"\x28"))
        seen = []
        async with asyncio.timeout(20):
            while not seen or seen[-1] & StatusFlag.HOME_IN_PROGRESS:
                seen.append(flags(await program.send(Packet(1, NO_OPERATION))))
                await asyncio.sleep(0.05)
        assert len(seen) > 5
        assert all(each & StatusFlag.MOVE_DONE for each in seen[:-1])  # its velocity was reached, and its drive goes on
        assert rig.speed() < 0.02
        assert (await rig.client.state("rotor")).referenced


@pytest.mark.parametrize("relative", [False, True])
async def test_a_move_in_which_a_capture_is_armed_stops_where_it_is(tmp_path, relative):
    """As the drive itself does it; with no signal on the way it ends at its goal."""
    async with guest(tmp_path, "control") as (rig, program):
        await program.begin()
        await program.send(ENABLE)
        await program.send(load(GO_NOW | (0x40 if relative else 0), counts=9_000, speed=0.5))
        async with asyncio.timeout(5):
            while shaft(rig) < 700:
                await asyncio.sleep(0.01)
        assert flags(await program.send(Packet(1, CommandCode.SET_HOMING_MODE, b"\x28"))) & StatusFlag.HOME_IN_PROGRESS
        async with asyncio.timeout(20):
            while flags(await program.send(Packet(1, NO_OPERATION))) & StatusFlag.HOME_IN_PROGRESS:
                await asyncio.sleep(0.02)
        await asyncio.sleep(1.0)
        assert 700 < shaft(rig) < 6_000
        assert (await rig.client.state("rotor")).referenced


async def test_gains_that_the_program_sets_are_in_the_drive_and_in_the_books(tmp_path):
    async with enabled(tmp_path) as (rig, program):
        await program.send(set_gain(kp=77))
        await asyncio.sleep(0.2)
        assert rig.chain.modules[0].loop.gains.kp == 77
        info = next(each for each in await rig.client.axes() if each.axis == "rotor")
        assert {each.name: each.value for each in info.registers}["kp"] == 77


@pytest.mark.parametrize(
    "steps",
    [
        [((load(GO_NOW, counts=1234),), 1234)],
        [((SMOOTH, load(GO_NOW, counts=3000)), 3000)],
        [((load(GO_NOW, counts=3000), load(GO_LATER, counts=20_000)), 3000), ((Packet(1, START),), 20_000)],
    ],
    ids=["sent", "sent right behind a stop", "sent before another one was loaded"],
)
async def test_a_move_that_follows_a_motion_under_way_goes_where_it_says_even_without_a_reference(tmp_path, steps):
    """It is a distance for the daemon; measured in mid-motion it would end a braking distance too far."""
    async with enabled(tmp_path, modulo=1.0) as (rig, program):
        await program.send(load(RUN_NOW, speed=4.0))
        await rig.until_speed(above=3.8)
        for packets, goal in steps:
            program.send_bytes(b"".join(map(encode_packet, packets)))
            await asyncio.sleep(0.1)
            assert not flags(await program.send(Packet(1, NO_OPERATION))) & StatusFlag.MOVE_DONE
            assert await finished(program, within_s=30) == pytest.approx(goal, abs=8)
            assert shaft(rig) == pytest.approx(goal, abs=8)


async def test_two_axes_start_with_one_group_packet(tmp_path):
    async with guest(tmp_path, "control") as (rig, program):
        await program.begin()
        for address in (1, 2):
            await program.send(Packet(address, CommandCode.SET_ADDRESS, bytes((address, 0x80))))
            await program.send(Packet(address, STOP, b"\x05"))
            await program.send(load(GO_LATER, counts=1000 * address, address=address))
        await asyncio.sleep(0.2)
        assert shaft(rig, 1) == pytest.approx(0, abs=5)
        program.send_bytes(bytes.fromhex("aa800585"))
        await finished(program, 1)
        await finished(program, 2)
        assert shaft(rig, 1) == pytest.approx(1000, abs=5)
        assert shaft(rig, 2) == pytest.approx(2000, abs=5)


async def test_an_output_that_the_program_writes_is_the_named_one_and_others_are_refused(tmp_path):
    async with guest(tmp_path, "control") as (rig, program):
        await program.begin()
        await program.send(Packet(3, CommandCode.RESET_POSITION, bytes((0xFF, 0x0D))))  # line 10 is an output
        await program.send(Packet(3, CommandCode.SET_GAIN, bytes((0x00, 0x02))))
        await rig.named(lock=True)
        await program.send(Packet(3, CommandCode.SET_GAIN, bytes(2)))
        await rig.named(lock=False)
        await program.send(Packet(3, CommandCode.RESET_POSITION, bytes((0xFE, 0x0D))))  # and line 1
        await asyncio.sleep(0.1)
        assert any("no output at line 1" in (each.reason or "") for each in await events(rig, "cabinet"))


@pytest.mark.parametrize("how", ["closes", "falls silent"])
async def test_outputs_of_a_program_that_goes_have_their_levels_for_the_loss_of_a_client(tmp_path, how):
    valve = {"outputs": {"lock": {"line": 10, "loss": {"client": "low"}}}}
    async with running_machine(with_port(tmp_path / "port", "control", module=valve)) as rig:
        program = open_port(tmp_path / "port")
        await program.begin()
        await program.send(Packet(3, CommandCode.RESET_POSITION, bytes((0xFF, 0x0D))))
        await program.send(Packet(3, CommandCode.SET_GAIN, bytes((0x00, 0x02))))
        await rig.named(lock=True)
        if how == "closes":
            program.close()
        else:
            await asyncio.sleep(5.0)
        await rig.named(lock=False)


@pytest.mark.parametrize("policy", ["keep", "low"])
async def test_a_program_sets_no_output_behind_the_end_of_the_daemon(tmp_path, policy):
    """Nobody would be left to take it back; programs of this kind write their outputs again and again."""
    valve = {"outputs": {"lock": {"line": 10, "loss": {"daemon": policy}}}}
    config = with_port(tmp_path / "port", "control", module=valve, acceleration=2.0)
    async with running_machine(config) as rig:
        program = open_port(tmp_path / "port")
        await program.begin()
        await program.send(ENABLE)
        await program.send(Packet(3, CommandCode.RESET_POSITION, bytes((0xFF, 0x0D))))
        await program.send(Packet(3, CommandCode.SET_GAIN, bytes(2)))
        await rig.named(lock=False)
        await program.send(load(RUN_NOW, speed=4.0))
        await asyncio.sleep(1.0)
        io = rig.io
        rig.daemon.end()
        for _ in range(100):
            with suppress(OSError):
                program.send_bytes(encode_packet(Packet(3, CommandCode.SET_GAIN, bytes((0x00, 0x02)))))
            await asyncio.sleep(0.02)
    assert not io.latch >> 9 & 1


async def test_what_the_program_has_set_going_is_refused_to_nobody_who_stops_it(tmp_path):
    async with enabled(tmp_path) as (rig, program):
        await program.send(load(RUN_NOW, speed=4.0))
        with pytest.raises(LdcndError, match="controlled by old"):
            await rig.client.ask(MoveRelative(distance=1.0), "rotor")
        await program.send(OFF)
        async with asyncio.timeout(5):
            while rig.daemon.rig.axes["rotor"].tracker.status.enabled:
                await asyncio.sleep(0.02)


async def test_a_motion_that_a_program_sends_before_it_ends_does_not_begin(tmp_path):
    async with enabled(tmp_path) as (rig, program):
        program.send_bytes(encode_packet(Packet(1, NO_OPERATION)) * 20 + encode_packet(load(RUN_NOW)))
        program.close()
        await asyncio.sleep(2.0)
        assert shaft(rig) == pytest.approx(0, abs=5)
        assert all(each.client is None for each in (await rig.client.ask(ListHolders())).holders)


@pytest.mark.parametrize(
    ("begun", "rest"),
    [
        (encode_packet(load(GO_LATER, counts=50_000)), encode_packet(Packet(1, START))),
        (encode_packet(load(RUN_NOW))[:5], encode_packet(load(RUN_NOW))[5:]),
    ],
    ids=["loaded", "half a packet"],
)
@pytest.mark.sweep(2)
async def test_what_a_program_has_loaded_is_not_begun_by_the_next_one(tmp_path, begun, rest):
    async with enabled(tmp_path) as (rig, program):
        program.send_bytes(begun)
        await asyncio.sleep(0.1)
        program.close()
        await asyncio.sleep(0.2)

        following, before = open_port(tmp_path / "port"), shaft(rig)
        following.send_bytes(rest)
        await asyncio.sleep(2.0)
        assert abs(shaft(rig) - before) < 20
        following.close()
        await asyncio.sleep(0.2)


async def test_hard_reset_reaches_modules_that_the_program_has_put_into_another_group(tmp_path):
    async with guest(tmp_path, "control") as (rig, program):
        await program.begin()
        for address in (1, 2):
            assert await program.send(Packet(address, CommandCode.SET_ADDRESS, bytes((address, 0x80))))
        await program.send(ENABLE)
        await program.send(load(RUN_NOW))
        await rig.until_speed(above=3.0)

        await program.send(Packet(0xFF, CommandCode.HARD_RESET), 0.05)

        assert await program.send(Packet(0, CommandCode.SET_ADDRESS, b"\x01\xff"))
        async with asyncio.timeout(10):
            while rig.speed() > 0.02 or rig.daemon.rig.axes["rotor"].tracker.status.enabled:
                await asyncio.sleep(0.02)


@pytest.mark.long
async def test_a_program_that_begins_anew_after_a_fault_moves_the_axis_as_on_the_bare_line(tmp_path):
    """Hard Reset, Stop Motor, Clear Sticky Bits, and a move: as after a jam, when its program is started again."""
    async with enabled(tmp_path) as (rig, program):
        await program.send(load(RUN_NOW))
        await asyncio.sleep(0.5)
        rig.chain.modules[0].shaft.stalled = True
        await rig.until("rotor", lambda state: state.state is AxisState.ERROR_STOP)
        rig.chain.modules[0].shaft.stalled = False
        await asyncio.sleep(0.5)
        program.close()
        await asyncio.sleep(0.5)

        again, before = open_port(tmp_path / "port"), shaft(rig)
        await again.begin()
        await again.send(ENABLE)
        await again.send(Packet(1, CommandCode.CLEAR_STICKY_BITS))
        await again.send(load(0x97 | 0x40, counts=3000))  # relative to where it is
        await finished(again)
        assert shaft(rig) - before == pytest.approx(3000, abs=30)
        again.close()
        await asyncio.sleep(0.2)


async def test_what_a_program_has_sent_before_it_went_never_moves_anything_for_the_next_one(tmp_path):
    """It was open for so short a time that nobody saw it, as one that is killed right behind its write."""
    async with enabled(tmp_path) as (rig, program):
        program.close()
        await asyncio.sleep(1.0)
        before = shaft(rig)

        for _ in range(3):
            short = open_port(tmp_path / "port")
            short.send_bytes(encode_packet(load(GO_NOW, counts=round(before + 5 * COUNTS))))
            short.close()
        await asyncio.sleep(0.1)
        silent = open_port(tmp_path / "port")
        await asyncio.sleep(1.0)
        silent.close()

        assert abs(shaft(rig) - before) <= 2


@pytest.mark.parametrize("lived_s", [0.005, 0.03, 0.3])
async def test_an_axis_rests_soon_however_much_a_program_has_sent_before_it_was_killed(tmp_path, lived_s):
    async with enabled(tmp_path) as (rig, program):
        for number in range(400):
            with suppress(BlockingIOError):
                program.send_bytes(encode_packet(load(RUN_NOW, speed=3.0 + number % 7 / 10)))
        await asyncio.sleep(lived_s)
        program.close()
        await asyncio.sleep(1.5)
        before = shaft(rig)
        await asyncio.sleep(3.0)

        assert abs(shaft(rig) - before) <= 2
        assert not (await rig.client.ask(ListHolders())).holders[0].client


async def test_a_move_of_the_program_that_is_refused_ends_nobodys_motion(tmp_path):
    """It halted an axis without a reference first, which would move by a distance, and was refused then."""
    async with guest(tmp_path, "control", limits={"velocity": 60.0}) as (rig, program):
        await program.begin()
        await rig.client.ask(Power(on=True), "rotor")
        held = await rig.client.ask(Acquire(client="ada", axes=("rotor",), lease_s=60.0))
        await rig.client.ask(MoveVelocity(velocity=2.0, lease=held.lease), "rotor")
        await asyncio.sleep(1.0)
        for control in (GO_NOW, GO_NOW | 0x40):
            await program.send(load(control, counts=2500))
            await asyncio.sleep(0.5)
        assert rig.daemon.rig.axes["rotor"].tracker.status.command
        await rig.client.ask(Halt(), "rotor")
        await rig.until("rotor", lambda state: state.state is AxisState.STANDSTILL)
        await rig.client.ask(Release(lease=held.lease))

        await program.send(ENABLE)
        await program.send(load(RUN_NOW, speed=2.0))
        await asyncio.sleep(1.0)
        await program.send(load(GO_NOW | 0x40, counts=2500, speed=500.0))
        await asyncio.sleep(1.0)
        before = shaft(rig)
        await asyncio.sleep(0.5)
        assert shaft(rig) - before == pytest.approx(COUNTS, abs=0.2 * COUNTS)


async def test_force_on_one_axis_ends_control_of_all_until_it_is_given_back(tmp_path):
    async with guest(tmp_path, "control") as (rig, program):
        await program.begin()
        for address in (1, 2):
            await program.send(Packet(address, STOP, b"\x05"))
            await program.send(load(RUN_NOW, address=address))
        await asyncio.sleep(1.0)
        held = await rig.client.ask(Acquire(client="other", axes=("rotor",), lease_s=60.0, force=True))
        await asyncio.sleep(4.0)
        before = shaft(rig), shaft(rig, 2)
        for _ in range(5):
            await program.send(load(RUN_NOW, address=2))
            await asyncio.sleep(0.2)
        assert (shaft(rig), shaft(rig, 2)) == pytest.approx(before, abs=2)

        await rig.client.ask(Release(lease=held.lease))
        await program.send(load(RUN_NOW, address=2))
        await asyncio.sleep(1.0)
        assert shaft(rig, 2) > before[1] + COUNTS


@pytest.mark.parametrize("who", ["program", "person"])
async def test_a_search_that_is_halted_has_found_no_home_and_is_in_progress_until_one_has(tmp_path, who):
    async with enabled(tmp_path) as (rig, program):
        await moved(program, 300)
        await program.send(Packet(1, CommandCode.SET_HOMING_MODE, b"\x28"))
        await program.send(load(RUN_NOW, speed=0.2))
        await asyncio.sleep(0.5)
        if who == "program":
            await program.send(SMOOTH)
        else:
            await rig.client.ask(Halt(), "rotor")
        await rig.until("rotor", lambda state: state.state is AxisState.STANDSTILL)
        assert flags(await program.send(Packet(1, NO_OPERATION))) & StatusFlag.HOME_IN_PROGRESS
        stands = position(await program.send(Packet(1, READ, POSITION)))
        await program.send(Packet(1, CommandCode.RESET_POSITION, b"\x01"))
        await asyncio.sleep(0.5)
        assert position(await program.send(Packet(1, READ, POSITION))) == pytest.approx(stands, abs=5)
        assert any("captured no home" in (each.reason or "") for each in await events(rig))

        await program.send(load(RUN_NOW, speed=0.5))  # homing is armed still
        await searched(program)
        await program.send(Packet(1, CommandCode.RESET_POSITION, b"\x01"))
        await moved(program, 0)
        plant = rig.chain.modules[0].shaft.plant
        assert (shaft(rig) - plant.index_at_counts) % plant.counts_per_rev == pytest.approx(0, abs=10)


@pytest.mark.parametrize("who", ["program", "person", "the program's end"])
async def test_a_stop_keeps_a_move_from_beginning_that_waits_for_rest(tmp_path, who):
    """The move was sent before the stop, and had no permit yet that the stop could have made void."""
    async with enabled(tmp_path, modulo=1.0) as (rig, program):
        await program.send(load(RUN_NOW, speed=8.0))
        await rig.until_speed(above=7.8)
        await program.send(load(GO_NOW, counts=30_000))
        if who == "program":
            await program.send(SMOOTH)
        elif who == "person":
            await rig.client.ask(Halt(), "rotor")
        else:
            program.close()
        await rig.until_speed(below=0.02)
        stands = shaft(rig)
        await asyncio.sleep(2.0)
        assert shaft(rig) == pytest.approx(stands, abs=20)
        if who == "the program's end":
            assert all(each.client is None for each in (await rig.client.ask(ListHolders())).holders)
            return
        assert any("a stop has come" in (each.reason or "") for each in await events(rig))

        await program.send(load(GO_NOW, counts=30_000))  # what is sent behind the stop begins
        assert await finished(program, within_s=30) == pytest.approx(30_000, abs=8)


@pytest.mark.parametrize(
    "ends",
    [(load(RUN_NOW, speed=0),), (load(RUN_NOW & 0x7F, speed=0), Packet(1, START)), (Packet(1, LOAD, b"\x88\x00"),)],
    ids=["a velocity of 0", "one that was loaded", "servo off"],
)
async def test_a_stop_by_load_trajectory_waits_behind_nothing(tmp_path, ends):
    """Each Reset Position waits until the axis has settled, and the axis runs; 32 of them fill what may wait."""
    async with enabled(tmp_path) as (rig, program):
        await program.send(load(RUN_NOW, speed=4.0))
        await rig.until_speed(above=3.8)
        for _ in range(35):
            program.send_bytes(encode_packet(Packet(1, CommandCode.RESET_POSITION)))
            await asyncio.sleep(0.01)
        for packet in ends:
            await program.send(packet)
        await rig.until_speed(below=0.02, within_s=1.0)


async def test_a_move_that_comes_to_its_goal_from_one_side_is_done_at_the_goal(tmp_path):
    """It was said to be done where it turns round, past the goal."""
    approach = {"direction": "negative", "distance": 0.5}
    async with enabled(tmp_path, approach=approach) as (rig, program):
        assert await moved(program, 1000) == pytest.approx(1000, abs=8)
        assert shaft(rig) == pytest.approx(1000, abs=20)


async def test_behind_a_zero_that_was_refused_no_move_goes_to_a_position(tmp_path):
    """The program counts from there, and would be sent by the whole way between the two zeros."""
    async with enabled(tmp_path) as (rig, program):
        await moved(program, 2000)
        await asyncio.sleep(1.0)
        await rig.client.ask(Stop(), "rotor")
        await program.send(Packet(1, CommandCode.RESET_POSITION))
        for _ in range(70):  # it only reads, and control ends
            await program.send(Packet(1, NO_OPERATION))
            await asyncio.sleep(0.1)
        await rig.client.ask(Reset(), "rotor")
        await program.send(ENABLE)
        before = shaft(rig)
        await program.send(load(GO_NOW, counts=500))
        await asyncio.sleep(2.0)
        assert shaft(rig) == pytest.approx(before, abs=8)
        assert any("its counter is not" in (each.reason or "") for each in await events(rig))

        await program.send(Packet(1, CommandCode.RESET_POSITION))
        await program.send(load(GO_NOW, counts=500))
        await asyncio.sleep(0.1)
        await finished(program)
        assert shaft(rig) == pytest.approx(before + 500, abs=20)


async def test_what_a_program_sets_right_before_its_stop_is_set(tmp_path):
    async with enabled(tmp_path) as (rig, program):
        await program.send(load(RUN_NOW, speed=4.0))
        await asyncio.sleep(1.0)
        sent = (Packet(1, CommandCode.RESET_POSITION), set_gain(kp=77), SMOOTH)
        program.send_bytes(b"".join(map(encode_packet, sent)))
        await asyncio.sleep(3.0)
        assert rig.speed() < 0.02
        assert rig.chain.modules[0].loop.gains.kp == 77
        before = shaft(rig)
        await program.send(load(GO_NOW, counts=500))
        await asyncio.sleep(0.1)
        await finished(program)
        assert shaft(rig) == pytest.approx(before + 500, abs=20)


@pytest.mark.parametrize(("model", "refused"), [("ls-182ap", {"cl": 101}), ("pic-servo-sc", {"multiplier": 4})])
async def test_behind_gains_that_were_refused_nothing_moves_at_another_speed(tmp_path, model, refused):
    """The profile of an SC has the same speed with every divisor: there it moves."""
    speed_hangs_on_it = model != "pic-servo-sc"
    async with enabled(tmp_path, chain=chain_of_machine(model), model=model) as (rig, program):
        await program.send(set_gain(2, **refused))
        for packet in (load(RUN_NOW, speed=4.0),) * speed_hangs_on_it + (load(GO_NOW, counts=2000),):
            await program.send(packet)
            await asyncio.sleep(2.0)
            assert shaft(rig) == pytest.approx(0 if speed_hangs_on_it else 2000, abs=20)
        said = any("servo rate divisor 2" in (each.reason or "") for each in await events(rig))
        assert said is speed_hangs_on_it
        await program.send(set_gain(1))
        assert await moved(program, 3000) == pytest.approx(3000, abs=8)  # friction holds it before it


async def test_a_search_of_the_program_ends_where_it_has_captured_whatever_the_axis_does_in_its_own(tmp_path):
    preset = {"method": "index", "velocity": 0.5, "move_to": 5.0}
    async with enabled(tmp_path, home=preset) as (rig, program):
        await moved(program, 300)
        await program.send(Packet(1, CommandCode.SET_HOMING_MODE, b"\x28"))
        await program.send(load(RUN_NOW, speed=0.5))
        await searched(program)
        await asyncio.sleep(1.0)
        assert 300 < shaft(rig) < 300 + 1.5 * COUNTS
        assert (await rig.client.state("rotor")).referenced


async def test_a_search_that_would_go_on_behind_its_home_position_is_refused(tmp_path):
    async with enabled(tmp_path) as (rig, program):
        await program.send(Packet(1, CommandCode.SET_HOMING_MODE, b"\x08"))
        await program.send(load(GO_NOW, counts=5000, speed=0.5))
        await asyncio.sleep(3.0)
        assert shaft(rig) == pytest.approx(0, abs=5)
        assert any("behind its home position" in (each.reason or "") for each in await events(rig))


async def test_a_search_on_the_position_error_leaves_the_motor_off(tmp_path):
    async with enabled(tmp_path) as (rig, program):
        await program.send(Packet(1, CommandCode.SET_HOMING_MODE, b"\x40"))
        await program.send(load(RUN_NOW, speed=2.0))
        await asyncio.sleep(1.0)
        rig.chain.modules[0].shaft.stalled = True
        await searched(program)
        await asyncio.sleep(2.0)
        assert not rig.chain.modules[0].loop.servo_on


@pytest.mark.parametrize("halted", [False, True])
async def test_a_search_up_to_a_goal_goes_there_from_where_the_axis_comes_to_rest(tmp_path, halted):
    """Its way is known once the motion before has ended, which the daemon halts for a search."""
    async with enabled(tmp_path) as (rig, program):
        await program.send(load(GO_NOW, counts=10_000))
        async with asyncio.timeout(5):
            while shaft(rig) < 3_000:
                await asyncio.sleep(0.01)
        if halted:
            await program.send(SMOOTH)
        await program.send(Packet(1, CommandCode.SET_HOMING_MODE, b"\x40"))  # finds nothing on the way
        await program.send(load(GO_NOW, counts=9_000, speed=5.0))
        places = [shaft(rig)]
        async with asyncio.timeout(20):
            while max(places) < 8_900 and (await rig.client.state("rotor")).state is not AxisState.ERROR_STOP:
                await program.send(Packet(1, NO_OPERATION))
                places.append(shaft(rig))
        await asyncio.sleep(1.0)
        places.append(shaft(rig))
        assert min(places) >= 3_000
        assert places[-1] == pytest.approx(9_000, abs=50)


@pytest.mark.promise("limit-switches")
@pytest.mark.parametrize("relative", [False, True])
async def test_a_program_moves_its_axis_off_the_limit_switch_that_it_stands_on_and_searches_that(tmp_path, relative):
    """Whatever it is refused is done for the program: it would take the axis for elsewhere, or for referenced."""
    plant = MotorPlant(reverse_limit_counts=-(10**9), forward_limit_counts=2_000)
    async with guest(tmp_path, "control", chain=chain_of_machine(plant=plant), limit_switches="stop") as (rig, program):
        await program.begin()
        await program.send(ENABLE)
        await moved(program, 5_000)
        on_switch = shaft(rig)
        await program.send(load(GO_NOW | 0x40, counts=-1_500) if relative else load(GO_NOW, counts=500))
        left = await finished(program)
        await moved(program, 5_000)
        await program.send(Packet(1, CommandCode.SET_HOMING_MODE, b"\x21"))  # forward limit switch, then a smooth stop
        await program.send(load(RUN_NOW, speed=0.5))
        await searched(program)
        async with asyncio.timeout(10):
            while (state := await rig.client.state("rotor")).command:
                await asyncio.sleep(0.02)

        assert on_switch > 2_000 > left
        assert (state.referenced, state.last_error) == (True, None)
        assert shaft(rig) == pytest.approx(2_000, abs=50)


async def test_a_search_without_a_way_moves_nothing_and_stays_armed(tmp_path):
    async with enabled(tmp_path) as (rig, program):
        await moved(program, 300)
        await program.send(Packet(1, CommandCode.SET_HOMING_MODE, b"\x28"))
        await program.send(load(GO_NOW, counts=300))
        await asyncio.sleep(2.0)
        assert shaft(rig) == pytest.approx(300, abs=5)
        assert flags(await program.send(Packet(1, NO_OPERATION))) & StatusFlag.HOME_IN_PROGRESS
