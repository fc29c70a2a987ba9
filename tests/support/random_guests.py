"""A random program on a port beside a random client, cable cuts, killed programs and daemons; the shafts judge.

What must hold whatever they do: nothing moves an axis that is latched, or that somebody else controls; no module is
reset, readdressed or set to another rate by the program; a stop brings every shaft to rest within its bound; what the
daemon says of gains, positions, outputs, the timer and the rate is what the simulated modules hold.
"""

import asyncio
import random
import termios
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path

from ldcnd.contract.commands import Halt, MoveRelative, MoveVelocity, Power, Reset, Stop
from ldcnd.contract.errors import LdcndError
from ldcnd.contract.leases import Acquire, ListHolders, Release, Renew
from ldcnd.contract.samples import LinkState, PositionSample, TelemetryItem
from ldcnd.drives.ldcn.packet import CommandCode, Packet, encode_packet
from ldcnd.drives.ldcn.profiles import PIC_SERVO_SC
from ldcnd.drives.ldcn.servo import LdcnAxis
from ldcnd.drives.ldcn.trajectory import programmed_acceleration, programmed_velocity
from ldcnd.sim.ldcn.drive import SimulatedDrive
from tests.support.guest_program import Program, open_port
from tests.support.machine_rig import CLOSED, COUNTS, GAINS, LOCK, OPEN, Machine

AXES = ("rotor", "table")
STOP_BOUND_S = 3.0
"""From 10 rev/s at 20 rev/s² with two lost polls before."""
RESTS = 0.02
"""Speed of a shaft that stands and hunts, revolutions a second."""
CREEPS = 0.05
"""How far such a shaft strays, revolutions."""
RATES = (termios.B9600, termios.B19200, termios.B57600, termios.B115200)


def _load(chance: random.Random, address: int) -> Packet:
    control = chance.choice((0x97, 0x17, 0xB6, 0x36, 0xD7))
    data = bytes((control,))
    if control & 1:
        data += chance.randrange(-5000, 5000).to_bytes(4, "little", signed=True)
    data += programmed_velocity(chance.uniform(0.5, 8.0) * COUNTS, 1, PIC_SERVO_SC).to_bytes(4, "little")
    data += programmed_acceleration(20 * COUNTS, 1, PIC_SERVO_SC).to_bytes(4, "little")
    return Packet(address, CommandCode.LOAD_TRAJECTORY, data)


def _gains(chance: random.Random, address: int) -> Packet:
    kp = chance.randrange(40, 80)
    data = b"".join((kp if name == "kp" else GAINS[name]).to_bytes(2, "little") for name in ("kp", "kd", "ki", "il"))
    data += bytes((GAINS["ol"], 0)) + GAINS["el"].to_bytes(2, "little") + bytes((1, 0, 1))
    return Packet(address, CommandCode.SET_GAIN, data)


def _any_packet(chance: random.Random) -> bytes:
    address = chance.choice((1, 1, 1, 2, 2, 3, 4, 0, 0x80, 0xFF))
    kind = chance.randrange(10)
    if kind < 3:
        packet = _load(chance, address)
    elif kind < 4:
        packet = _gains(chance, address)
    elif kind < 6:
        packet = Packet(address, CommandCode.STOP_MOTOR, bytes((chance.choice((1, 2, 4, 5, 5, 5, 9, 0x11)),)))
    else:
        data = chance.randbytes(chance.choice((0, 1, 2, 5, 14, 15)))
        packet = Packet(address, chance.choice(list(CommandCode)), data)
        if packet.command is CommandCode.SET_GAIN and address in {1, 2}:
            packet = _gains(chance, address)  # others may shake the motor, and that is the program's own affair
    sent = bytearray(encode_packet(packet))
    if chance.random() < 0.1:
        sent[chance.randrange(len(sent))] ^= 1 << chance.randrange(8)
    if chance.random() < 0.05:
        sent += chance.randbytes(7)
    return bytes(sent)


class World:
    """The machine, the program on its port, a person, and who judges.

    Attributes:
        history: what was done, for a message.
    """

    def __init__(self, rig: Machine, link: Path, seed: int) -> None:
        self.rig, self._link, self._chance = rig, link, random.Random(seed)
        self.history: list[str] = []
        self._loop = asyncio.get_running_loop()
        self._program: Program | None = open_port(link)
        self._lease: str | None = None
        self._cut = False
        self._addresses = self._arranged()
        self._stand: dict[str, float] = {}  # where axes stand that nobody may move now
        self._moved: set[str] = set()  # axes that the person may have set going

    # -- what is done ------------------------------------------------------------------------------------------------

    async def round(self) -> None:
        """Do one thing, let some time pass, and judge."""
        chance = self._chance
        act = chance.choices(
            (
                self._packets,
                self._begins,
                self._rate,
                self._closes,
                self._cable,
                self._person,
                self._stops,
                self._takes,
                self._daemon,
            ),
            (40, 8, 4, 6, 3, 15, 6, 8, 2),
        )[0]
        self.history.append(act.__name__)
        if self._lease:
            await self.rig.client.ask(Renew(lease=self._lease))
        await act()
        await asyncio.sleep(chance.choice((0.0, 0.003, 0.05, 0.3)))
        self._judge()

    async def end(self) -> None:
        """Stop everything, and compare what the daemon knows with what the drives hold."""
        if self._cut:
            await self._cable()
        await self._stops()
        if self._program:
            await self._closes()
        await self._compare_registers()
        await self._compare_places()
        await self._compare_outputs()

    async def _opens(self) -> None:
        if self._program is not None:
            return
        async with asyncio.timeout(10):
            while not self._link.exists():  # a daemon has just begun
                await asyncio.sleep(0.05)
        self._program = open_port(self._link)

    async def _daemon(self) -> None:
        """End the daemon, or kill it, beside the program; the next one finds the drives as they are."""
        await self.rig.begin_anew(self._chance.choice((0.0, 0.3, 3.0)), killed=self._chance.random() < 0.5)
        if self._program:
            self._program.close()  # its terminal has gone, as an adapter that was unplugged
        self._program = self._lease = None
        self._stand.clear()  # its latches end with it, without a folder for them
        self._moved.update(AXES)  # what a killed one has left moving

    async def _packets(self) -> None:
        await self._opens()
        assert self._program
        for _ in range(self._chance.randrange(1, 5)):
            with suppress(BlockingIOError):
                self._program.send_bytes(_any_packet(self._chance))
            await asyncio.sleep(self._chance.choice((0.0, 0.005, 0.02)))

    async def _begins(self) -> None:
        """Set the line up as every program does, and move."""
        await self._opens()
        assert self._program
        self._program.set_rate(termios.B19200)
        await self._program.send(Packet(0xFF, CommandCode.HARD_RESET), 0.05)
        for address in (1, 2, 3):
            await self._program.send(Packet(0, CommandCode.SET_ADDRESS, bytes((address, 0xFF))), 0.1)
        for address in (1, 2):
            await self._program.send(Packet(address, CommandCode.STOP_MOTOR, b"\x05"), 0.1)
            await self._program.send(_load(self._chance, address), 0.1)

    async def _rate(self) -> None:
        if self._program:
            self._program.set_rate(self._chance.choice(RATES))

    async def _closes(self) -> None:
        """End the program as a kill does: what it controlled halts, and is anybody's."""
        if self._program is None:
            return
        self._program.close()
        self._program = None
        await asyncio.sleep(STOP_BOUND_S)
        for place, each in enumerate((await self.rig.client.ask(ListHolders())).holders, 1):
            assert each.client != "old", f"{each.axis} is controlled by a program that has gone"
            assert each.axis in self._moved or self.rig.speed(place) < RESTS, f"{each.axis} goes on without its program"

    async def _cable(self) -> None:
        if self._cut:
            self.rig.chain.replug()
            self._cut = False
            for name in AXES:
                await self.rig.until(name, lambda state: state.link is LinkState.UP)
        else:
            self.rig.chain.unplug(self._loop.time())
            self._cut = True
            await asyncio.sleep(self._chance.choice((0.01, 0.3)))
            await self._cable()

    async def _person(self) -> None:
        axis, lease = self._chance.choice(AXES), self._lease
        command = self._chance.choice(
            (
                Power(on=True, lease=lease),
                Power(on=False),
                MoveRelative(distance=self._chance.uniform(-3, 3), lease=lease),
                MoveVelocity(velocity=self._chance.uniform(-8, 8), lease=lease),
                Halt(),
                Reset(lease=lease),
            )
        )
        self._stand.clear()
        self._moved.add(axis)
        with suppress(LdcndError):
            await self.rig.client.ask(command, axis)

    async def _stops(self) -> None:
        """Stop every axis: it is at rest within the bound, and stands until somebody resets it."""
        for name in AXES:
            await self.rig.client.ask(Stop(), name)
        self._moved.clear()
        await asyncio.sleep(STOP_BOUND_S)
        for place, name in enumerate(AXES, 1):
            assert self.rig.speed(place) < RESTS, f"{name} turns {STOP_BOUND_S} s after a stop"
            self._stand[name] = self._place(place)
        await self._packets()
        self._judge()
        if self._chance.random() < 0.7:
            for name in AXES:
                with suppress(LdcndError):
                    await self.rig.client.ask(Reset(lease=self._lease), name)
            self._stand.clear()

    async def _takes(self) -> None:
        """A person takes control by force, or gives it back."""
        self._stand = {name: place for name, place in self._stand.items() if self._latched(name)}
        if self._lease:
            with suppress(LdcndError):
                await self.rig.client.ask(Release(lease=self._lease))
            self._lease = None
            return
        taken = await self.rig.client.ask(Acquire(client="ada", axes=AXES, lease_s=60, force=True))
        self._lease = taken.lease
        for name in AXES:
            await self.rig.client.ask(Halt(), name)
        await asyncio.sleep(STOP_BOUND_S)
        self._stand |= {name: self._place(place) for place, name in enumerate(AXES, 1)}

    # -- what is judged ----------------------------------------------------------------------------------------------

    def _drives(self) -> Sequence[SimulatedDrive]:
        return [each for each in self.rig.chain.modules if isinstance(each, SimulatedDrive)]

    def _arranged(self) -> list[tuple[object, ...]]:
        return [(each.address, each.group, each.leader, each.baud) for each in self._drives()]

    def _place(self, place: int) -> float:
        drive = self._drives()[place - 1]
        drive.catch_up(self._loop.time())
        return drive.shaft.position_counts / COUNTS

    def _latched(self, name: str) -> bool:
        return self.rig.daemon.rig.axes[name].tracker.status.stop_latched

    def _judge(self) -> None:
        assert self._arranged() == self._addresses, "the program has rearranged the line"
        for place, name in enumerate(AXES, 1):
            if (stood := self._stand.get(name)) is not None:
                assert abs(self._place(place) - stood) < CREEPS, f"{name} has moved without permission"

    async def _compare_registers(self) -> None:
        for info in await self.rig.client.axes():
            drive = self._drives()[AXES.index(info.axis)]
            holds = asdict(drive.loop.gains)
            for register in info.registers:
                if register.value is not None and register.name in holds:
                    assert holds[register.name] == register.value, f"{info.axis}: {register.name}"

    async def _compare_places(self) -> None:
        """Compare positions, whose origin programs and persons have set, with where the shafts are."""
        for place, name in enumerate(AXES, 1):
            axis = self.rig.daemon.rig.axes[name]
            async with self.rig.client.samples(name, TelemetryItem.POSITION) as samples:
                _, sample = await anext(samples)
            assert isinstance(sample, PositionSample)
            assert isinstance(axis.driver, LdcnAxis)
            drive = self._drives()[place - 1]
            drive.catch_up(self._loop.time())
            counts = drive.loop.position + axis.driver.state.offset_counts
            assert abs(sample.counts - counts) < CREEPS * COUNTS, f"{name}: counts"
            assert abs(sample.value - axis.tracker.status.scale.position(counts)) < CREEPS, f"{name}: position"
            if axis.tracker.status.referenced and self.rig.lives:
                truth = self.rig.lives.truth(name).position
                assert abs(sample.value - truth) < CREEPS, f"{name} is said to be at {sample.value}, and is at {truth}"
            assert abs(self.rig.daemon.rig.buses[0].bus.baud / drive.baud - 1) < 0.03, f"{name}: rate"

    async def _compare_outputs(self) -> None:
        await asyncio.sleep(0.2)
        io, cabinet = self.rig.io, self.rig.daemon.rig.modules["cabinet"]
        for name, line in (("lock", LOCK), ("door_closed", CLOSED), ("door_open", OPEN)):
            held = bool(io.levels & 1 << line - 1)
            assert cabinet.values[name] in {None, held}, f"{name}: {cabinet.values[name]}, and is {held}"
        driven = bool(io.outputs & 1 << LOCK - 1)
        assert driven is (cabinet.values["lock"] is not None), f"lock: {cabinet.values['lock']}, driven: {driven}"
