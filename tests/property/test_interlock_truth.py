"""Two clients, a door that people open, contacts that lie, fall out or bounce, lost replies, daemons that are killed.

However they come together: the lock is never released while the simulated rotor is fast, the rotor is not fast for
longer than the bound with the door open, and no output changes that nobody wrote.
"""

import asyncio
import contextlib
import random

import pytest
from structlog.testing import capture_logs
from typing_extensions import override

from ldcnd.contract.commands import (
    AxisCommand,
    BufferMode,
    CommandReply,
    Halt,
    MoveRelative,
    MoveVelocity,
    Power,
    Reset,
    Stop,
)
from ldcnd.contract.errors import LdcndError
from ldcnd.contract.rig_commands import SetIo, SetSpeedOverride
from ldcnd.sim.faults import FaultInjector, FaultPlan, FaultyReply, FaultyRequest
from ldcnd.sim.ldcn.drive import SimulatedDrive
from ldcnd.sim.ldcn.io import SimulatedIo
from ldcnd.testing.jumping_loop import JumpingLoop
from tests.support.chain_rig import ChainRig, rig_on
from tests.support.machine_rig import (
    CLOSED,
    COUNTS,
    DOOR_OPENS,
    DOOR_SHUT,
    LOCK,
    OPEN,
    SAFE,
    chain_of_machine,
    machine,
)

FASTEST, ACCELERATION = 8.0, 20.0
WITHIN_S = 0.4
LOST_S = 0.2
"""Time that lost replies may cost the packet that starts or stops the rotor, and the judge's own period."""
RAMP_S = FASTEST / ACCELERATION
HUNTING = 1.0
"""Revolutions a second by which the shaft may be faster than its profile for a moment: it sticks, and breaks free."""
INPUTS = {
    "door_closed": {"line": CLOSED, "debounce_ms": 30},
    "door_open": {"line": OPEN, "debounce_ms": 30},
}
RULES = (DOOR_SHUT | {"within_ms": 1000 * WITHIN_S}, DOOR_OPENS)
MASK = 1 << LOCK - 1


class LostReplies(FaultInjector):
    """Loses some requests and some replies, in bursts."""

    def __init__(self, dice: random.Random) -> None:
        super().__init__(FaultPlan())
        self.on = False
        self._dice = dice
        self._fate, self._rest = "", 0

    @override
    def request(self, data: bytes, at_s: float) -> FaultyRequest:
        if self._rest == 0:
            self._fate = self._dice.choice(("request", "reply")) if self.on and self._dice.random() < 0.2 else ""
            self._rest = self._dice.choice((1, 1, 2, 5)) if self._fate else self._dice.randrange(1, 20)
        self._rest -= 1
        return FaultyRequest((None,) * len(data) if self._fate == "request" else tuple(data))

    @override
    def reply(self, data: bytes, at_s: float) -> FaultyReply:
        return FaultyReply(b"" if self._fate == "reply" else data)


class History:
    """What happens to one machine: its door, its clients, one daemon after another."""

    def __init__(self, seed: int) -> None:
        self.dice = random.Random(seed)
        self.chain = chain_of_machine()
        rotor, _, io = self.chain.modules
        assert isinstance(rotor, SimulatedDrive)
        assert isinstance(io, SimulatedIo)
        self.rotor, self.io = rotor, io
        self.faults = self.chain.injector = LostReplies(self.dice)
        self.shut, self.lie = True, ""
        self.wrong: list[str] = []
        self.asked: set[str] = set()
        self.open_since_s: float | None = None
        self.fast = self.ended = self.released = 0
        self._watch_outputs()

    @property
    def now_s(self) -> float:
        return asyncio.get_running_loop().time()

    @property
    def speed(self) -> float:
        self.rotor.catch_up(self.now_s)
        return abs(self.rotor.shaft.velocity_counts) / self.rotor.profile.servo_cycle_s / COUNTS

    # -- judges ------------------------------------------------------------------------------------------------------

    def _watch_outputs(self) -> None:
        """Judge each packet that the module executes."""
        io, execute = self.io, self.io.execute

        def watched(command: object) -> None:
            before = io.outputs, io.latch & io.outputs, io.pwm
            held = bool(before[1] & MASK)
            execute(command)
            after = io.outputs, io.latch & io.outputs, io.pwm
            if before != after and not self.asked:
                self.wrong.append(f"{command!r} has made {after} of {before}, and nobody asked for it")
            if held and not after[1] & MASK:
                self.released += 1
                if self.speed > SAFE + HUNTING:
                    self.wrong.append(f"the lock was released at {self.speed:.2f} rev/s")

        io.execute = watched

    async def watch_shaft(self) -> None:
        """Judge the rotor and the door, often."""
        fast_before = False
        while True:
            await asyncio.sleep(0.02)
            fast = self.speed > SAFE + HUNTING
            self.fast += fast
            if self.shut and self.io.outputs & self.io.latch & MASK:
                self.open_since_s = None
            else:
                self.open_since_s = self.now_s if self.open_since_s is None else self.open_since_s
                open_s = self.now_s - self.open_since_s
                if fast and open_s > WITHIN_S + LOST_S + RAMP_S:
                    self.wrong.append(f"{self.speed:.2f} rev/s and the door not shut for {open_s:.2f} s")
                if fast and not fast_before and open_s > WITHIN_S + LOST_S:
                    self.wrong.append(f"has become fast with the door not shut for {open_s:.2f} s")
                self.ended += fast_before and not fast
            fast_before = fast

    # -- people and sensors ------------------------------------------------------------------------------------------

    def show_door(self) -> None:
        """Drive the contacts as the door stands, but for one that lies."""
        closed = self.shut if self.lie != "closed" else True
        opened = not self.shut if self.lie != "open" else False
        self.io.drive_line(CLOSED, high=closed, at_s=self.now_s)
        self.io.drive_line(OPEN, high=opened, at_s=self.now_s)

    async def live_around(self) -> None:
        """Open and shut the door, and let contacts lie, bounce and fall out."""
        dice = self.dice
        while True:
            await asyncio.sleep(dice.uniform(0.1, 2.5))
            match dice.choice(("door", "door", "shut", "lie", "bounce", "fall out", "truth")):
                case "door":
                    self.shut = False  # a lock that is broken is no excuse
                case "shut":
                    self.shut = True
                case "lie":
                    self.lie = dice.choice(("closed", "open"))
                case "truth":
                    self.lie = ""
                case "fall out":
                    self.io.drive_line(CLOSED, high=False, at_s=self.now_s)
                    await asyncio.sleep(dice.uniform(0.0, 0.3))
                case "bounce":
                    for _ in range(dice.randrange(2, 20)):
                        self.io.drive_line(CLOSED, high=dice.random() < 0.5, at_s=self.now_s)
                        await asyncio.sleep(dice.uniform(0.001, 0.03))
            self.show_door()

    def command(self) -> tuple[str, AxisCommand[CommandReply]]:
        dice = self.dice
        axis = dice.choice(("rotor", "rotor", "rotor", "table"))
        fast, slow = dice.choice((3.0, FASTEST)), dice.choice((0.5, 0.9))
        mode = dice.choice(list(BufferMode))
        return axis, dice.choice(
            (
                MoveVelocity(velocity=fast, buffer_mode=mode),
                MoveVelocity(velocity=fast),
                MoveVelocity(velocity=slow),
                MoveVelocity(velocity=slow, buffer_mode=mode),
                MoveRelative(distance=dice.choice((0.3, 5.0)), velocity=fast, buffer_mode=mode),
                dice.choice((Halt(), Stop())),
                Power(on=dice.random() < 0.8),
            )
        )

    async def client(self, rig: ChainRig, acts: int) -> None:
        dice = self.dice
        for _ in range(acts):
            with contextlib.suppress(LdcndError, TimeoutError):
                match dice.random():
                    case share if share < 0.25:
                        await self.set_lock(rig, dice.choice(("high", "low", "low", "inputs")))
                    case share if share < 0.3:
                        override = SetSpeedOverride(percent=dice.choice((10.0, 50.0, 100.0)))
                        await rig.client.ask(override, timeout_s=2.0)
                    case share if share < 0.6:
                        await self.spin(rig)
                    case _:
                        axis, command = self.command()
                        await rig.client.command(axis, command, timeout_s=2.0)
            await asyncio.sleep(dice.choice((0.0, 0.0, 0.05, 0.4)))

    async def spin(self, rig: ChainRig) -> None:
        """Do what a whole cycle begins with, if nothing is in its way."""
        if self.dice.random() < 0.7:
            self.shut, self.lie = True, ""
            self.show_door()
            await asyncio.sleep(0.1)
        await self.set_lock(rig, "high")
        for command in (Reset(), Power(on=True), MoveVelocity(velocity=FASTEST)):
            with contextlib.suppress(LdcndError):
                await asyncio.sleep(0.1)
                await rig.client.command("rotor", command, timeout_s=2.0)
        await asyncio.sleep(self.dice.uniform(0.2, 1.0))

    async def set_lock(self, rig: ChainRig, use: str) -> None:
        number = f"{use} {self.dice.random()}"
        self.asked.add(number)
        pwm = {"pwm1": 0.0, "pwm2": 0.0} if self.dice.random() < 0.3 else {}
        try:
            await rig.client.ask(SetIo(module="cabinet", **{use: ("lock",)}, **pwm), timeout_s=2.0)
        finally:
            self.asked.discard(number)

    async def daemon(self, start: str, acts: int) -> None:
        config = machine(*RULES, axis={"longest_run_s": 60}, module={"inputs": INPUTS}, start=start, margin_ms=2)
        async with rig_on(self.chain, config) as rig:
            await asyncio.sleep(0.5)
            if start == "reset":
                with contextlib.suppress(LdcndError):
                    self.asked.add("first")
                    await rig.client.ask(SetIo(module="cabinet", high=("lock",)))
                    self.asked.discard("first")
                    await rig.client.command("rotor", Power(on=True))
                    await rig.client.command("rotor", MoveVelocity(velocity=FASTEST))
            self.faults.on = True
            judge = asyncio.create_task(self.watch_shaft())
            around = asyncio.create_task(self.live_around())
            await asyncio.gather(self.client(rig, acts), self.client(rig, acts))
            for task in (judge, around):
                task.cancel()
            self.faults.on, self.open_since_s = False, None
            await rig.kill()
        self.asked.clear()

    async def live(self) -> None:
        await self.daemon("reset", 8)
        await self.daemon("adopt", 5)


def live_through(seeds: range) -> None:
    fast = ended = released = 0
    for seed in seeds:
        history = History(seed)
        with capture_logs(), asyncio.Runner(loop_factory=JumpingLoop) as runner:
            runner.run(history.live())
        assert not history.wrong, f"seed {seed}: {'; '.join(history.wrong[:3])}"
        fast, ended, released = fast + (history.fast > 0), ended + history.ended, released + history.released
    print(f"seeds {seeds}: {fast} with a fast rotor, {ended} motions ended with the door open, {released} releases")
    assert fast > len(seeds) / 2


@pytest.mark.timeout(120)
def test_no_history_opens_the_door_of_a_fast_rotor_or_writes_an_output_that_nobody_wrote():
    live_through(range(12))


def test_a_lock_is_not_released_by_the_speed_of_a_slow_motion_that_has_just_replaced_a_fast_one():
    live_through(range(4170, 4171))


@pytest.mark.soak
@pytest.mark.timeout(3600 * 6)
@pytest.mark.parametrize("batch", range(200))
def test_no_history_ever_opens_the_door_of_a_fast_rotor_or_writes_an_output_that_nobody_wrote(batch):
    live_through(range(100 * batch, 100 * (batch + 1)))
