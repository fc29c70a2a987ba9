"""Killed or suspended at any await of a scenario, a daemon moves nothing twice, unasked or with nobody in charge.

The scenario has some forty commands: leases, buffered and aborting moves, a group, a homing, raw duties, a trace,
set-points, stops. A killed daemon is followed by one that adopts the line, and old commands are sent again. A suspended
one finds time gone by, its client dead or somebody else in control. Drives live on meanwhile.
"""

import asyncio
import contextlib
import random
from collections.abc import AsyncIterator
from typing import TypeVar

import pytest
from structlog.testing import capture_logs

from ldcnd.client.rig_client import RigClient
from ldcnd.config.rig import RigConfig
from ldcnd.contract.commands import (
    AxisCommand,
    BufferMode,
    Command,
    CommandReply,
    Effect,
    Halt,
    Home,
    HomeMethod,
    MoveAbsolute,
    MoveAnalog,
    MoveRelative,
    MoveVelocity,
    PinMode,
    Power,
    Preview,
    QuickStop,
    Reset,
    SetGains,
    SetOutputs,
    SetPosition,
    SetPwm,
    Track,
    Why,
)
from ldcnd.contract.errors import LdcndError, OutcomeUnknown
from ldcnd.contract.frozen import Frozen
from ldcnd.contract.keys import RIG_ITSELF
from ldcnd.contract.leases import Acquire, ListHolders, Release, Renew
from ldcnd.contract.rig_commands import AxisMove, MoveTogether
from ldcnd.contract.samples import StateSample
from ldcnd.contract.traces import TakeTrace
from ldcnd.daemon.assembly import build_daemon
from ldcnd.daemon.daemon import Daemon
from ldcnd.net.memory_session import MemoryBroker
from ldcnd.sim.chain import Chain
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain
from tests.support.interruptions import Chosen, CopiedLoop, Interruptions, in_new_loop, run_with_copies
from tests.support.rig import openers_of
from tests.support.witness import Witness

ReplyT = TypeVar("ReplyT", bound=Frozen)
LEASE_S = 0.6
FREEZES_S = (0.3, 1.0, 4.0)
LINE_S = 1.0
"""From the end of a lease until an axis stands: one stop, and its deceleration."""
PROFILE_S = 3.0
"""The longest profile of the scenario: a drive whose host is dead ends it by itself."""
GAINS = {"kp": 350, "kd": 3000, "ki": 400, "il": 400, "ol": 250, "el": 4000}
INDEX_AT, INDEX_SPACING = 700, 2000


def axis(name: str, address: int, model: str, **more: object) -> dict[str, object]:
    return {
        "name": name,
        "address": address,
        "model": model,
        "unit": "mm",
        "counts_per_unit": 1000.0,
        "velocity": 20.0,
        "acceleration": 500.0,
        "reference": "at_reset",
        "jog_horizon_s": 1.0,
        "gains": GAINS,
        "rates": {"position": 8, "velocity": 0, "adc": 0, "state": 8},
        **more,
    }


def config(**bus: object) -> RigConfig:
    tracking = {"step": 1.0, "rate": 20.0}
    return RigConfig.model_validate(
        {
            "rig": "sim",
            "authority": "leased",
            "bus": [
                {
                    "name": "a",
                    "port": "sim:a",
                    "baud": 115_200,
                    "margin_ms": 5,
                    "axis": [
                        axis("x", 1, "ls-182ap", tracking=tracking),
                        axis("y", 2, "ls-182ap"),
                        axis("z", 3, "pic-servo-v4", pwm={"duty": 0.1, "duration_s": 1.0}),
                    ],
                    "group": [{"name": "gantry", "axes": ["x", "y"]}],
                    **bus,
                }
            ],
            "sim": [{"name": "a", "module": [{"model": "ls182ap"}] * 2 + [{"model": "picservo-v4"}]}],
        }
    )


FIRST = config()
NEXT = config(start="adopt", adopt_fallback="reset")


def now_ns() -> int:
    return 10**18 + round(asyncio.get_running_loop().time() * 1e9)


class Client:
    """A client that sends each command under its own id, and again when it gets no answer.

    Attributes:
        sent: everything it has sent, by axis, as it was sent.
        refused: how many commands failed.
    """

    def __init__(self, rig: RigClient, name: str) -> None:
        self.rig = rig
        self.name = name
        self.sent: list[tuple[str, AxisCommand[CommandReply]]] = []
        self.refused = 0
        self.others = 0
        self.lease: str | None = None

    async def acquire(self, *axes: str, force: bool = False) -> None:
        if reply := await self.ask(Acquire(client=self.name, axes=axes, lease_s=LEASE_S, force=force)):
            self.lease = reply.lease

    async def ask(self, command: Command[ReplyT], axis: str = RIG_ITSELF) -> ReplyT | None:
        """Send what is no command of an axis."""
        self.others += 1
        try:
            return await self.rig.ask(command, axis)
        except LdcndError as error:
            self.refused += 1
            self.why = f"{command!r}: {error}"
            return None

    async def keep(self) -> None:
        while True:
            await asyncio.sleep(LEASE_S / 4)
            if self.lease:
                with contextlib.suppress(LdcndError):
                    await self.rig.ask(Renew(lease=self.lease), timeout_s=LEASE_S)

    async def send(self, axis: str, command: AxisCommand[CommandReply]) -> bool:
        """Send a command under an id of its own; tell whether it was accepted."""
        command_id = f"{self.name}{len(self.sent)}"
        stamped = command.model_copy(update={"command_id": command_id, "lease": self.lease})
        self.sent.append((axis, stamped))
        for _ in range(2):
            try:
                await self.rig.command(axis, stamped, timeout_s=2.0)
            except OutcomeUnknown:
                continue
            except LdcndError as error:
                self.refused += 1
                self.why = f"{axis} {command!r}: {error}"
                return False
            return True
        return False

    async def done(self, axis: str, command: AxisCommand[CommandReply]) -> None:
        """Send a command, and wait until its axis stands."""
        await self.send(axis, command)
        await self.standing(axis)

    async def standing(self, *axes: str) -> None:
        for axis in axes:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(PROFILE_S):
                    while not (state := await self.state(axis)) or state.moving != "no":
                        await asyncio.sleep(0.1)

    async def state(self, axis: str) -> StateSample | None:
        with contextlib.suppress(LdcndError):  # after a freeze no answer comes in time
            return await self.rig.state(axis)
        return None


async def play(ann: Client, bob: Client, places: dict[str, float], witness: Witness) -> None:
    """Send the forty commands; what is refused is counted and passed over."""
    while not (state := await ann.state("z")) or state.link != "up":
        await asyncio.sleep(0.05)
    await ann.acquire()
    for name in ("x", "y", "z"):
        await ann.send(name, Power(on=True))
    await ann.send("x", MoveAbsolute(position=3.0))
    await ann.send("x", MoveRelative(distance=1.0, buffer_mode=BufferMode.BUFFERED))
    await asyncio.sleep(0.1)
    await ann.send("x", MoveRelative(distance=-1.0, buffer_mode=BufferMode.ABORTING))
    await ann.standing("x")
    del places["x"]  # while nobody knows whether it has another one
    if await ann.send("x", SetPosition(position=0.0)):
        places["x"] = witness.drive("x").shaft.position_counts
    moves = (AxisMove(axis="x", position=2.0, lease=ann.lease), AxisMove(axis="y", position=2.0, lease=ann.lease))
    await ann.ask(MoveTogether(moves=moves))
    await ann.standing("x", "y")
    await ann.send("x", TakeTrace(channels=("position",), interval_s=0.02, samples=20))
    await ann.send("y", MoveVelocity(velocity=8.0))
    await asyncio.sleep(0.2)
    await ann.send("y", MoveVelocity(velocity=-8.0))
    await asyncio.sleep(0.2)
    await ann.done("y", Halt())
    await ann.send("z", SetPwm(duty=0.05, duration_s=0.2))
    await asyncio.sleep(0.3)
    await ann.standing("z")
    await ann.ask(Why(lease=ann.lease), "z")
    await ann.ask(Preview(position=1.0), "y")
    await ann.send("y", MoveRelative(distance=0.5))
    await ann.send("y", MoveRelative(distance=0.5, buffer_mode=BufferMode.BUFFERED))
    await ann.ask(ListHolders())
    places.pop("z", None)
    await ann.done("z", Home(method=HomeMethod.INDEX, velocity=1.0, position=0.0, timeout_s=PROFILE_S))
    for step in range(3):
        await ann.send("x", Track(position=2.0 + 0.2 * step))
        await asyncio.sleep(0.06)
    await ann.standing("x")
    await ann.send("x", SetGains(kp=351))
    await ann.send("z", SetOutputs(limit1=PinMode.HIGH))
    await ann.send("y", MoveAnalog(target=540, velocity=10.0, timeout_s=0.3))
    await asyncio.sleep(0.4)
    await ann.done("y", QuickStop())
    await ann.send("y", Reset())
    await ann.send("x", MoveRelative(distance=5.0))
    await ann.send("z", MoveVelocity(velocity=5.0))
    await asyncio.sleep(0.1)
    with contextlib.suppress(LdcndError):
        await ann.rig.stop()
    await ann.standing("x", "y", "z")
    for name in ("x", "y", "z"):
        await ann.send(name, Reset())
    await ann.send("z", Power(on=False))
    await ann.send("x", MoveRelative(distance=1.0))
    await ann.ask(Release(lease=ann.lease or "", leave_running=False))
    await bob.acquire("x", "y")
    await bob.standing("x")
    await bob.send("x", MoveVelocity(velocity=6.0))
    await asyncio.sleep(0.15)
    await ann.acquire("x", "y", force=True)
    await ann.standing("x")
    await ann.done("x", MoveRelative(distance=-2.0))
    await ann.send("y", Power(on=False))


def check_homed(witness: Witness, daemon: Daemon) -> None:
    """Hold what z says of its place against its index pulses, once it was homed."""
    z = daemon.rig.axes["z"]
    if not z.tracker.status.referenced or z.tracker.status.scale.origin_counts == 0:
        return
    drive = witness.drive("z")
    at_zero = drive.shaft.position_counts - (drive.loop.position - z.tracker.status.scale.origin_counts)
    off = (at_zero - INDEX_AT + INDEX_SPACING / 2) % INDEX_SPACING - INDEX_SPACING / 2
    if abs(off) > 20:
        witness.wrong.append(f"z is referenced {off:g} counts beside an index pulse")


@contextlib.asynccontextmanager
async def life(settings: RigConfig, chain: Chain, instance: str) -> AsyncIterator[tuple[Daemon, MemoryBroker]]:
    broker = MemoryBroker()
    async with broker.session() as session, asyncio.TaskGroup() as group:
        daemon = build_daemon(settings, session, now_ns, instance, openers_of(settings, {"a": chain}))
        running = group.create_task(daemon.run(), name="daemon")
        yield daemon, broker
        daemon.end()
        await running


class Run:
    """One run of the scenario, with what is done to its copies."""

    def __init__(self, seed: int, *, kill: bool) -> None:
        self._dice = random.Random(seed)
        self._kill = kill
        specs = (ModuleSpec("ls182ap"), ModuleSpec("ls182ap"), ModuleSpec("picservo-v4"))
        self.chain = build_chain(ChainSpec(specs, seed=seed))
        self.witness = Witness(self.chain, {1: ("x",), 2: ("y",), 3: ("z",), 0x81: ("x", "y")})
        self.places: dict[str, float] = {"x": 0.0, "y": 0.0, "z": 0.0}
        self.refused = -1
        self.why = ""
        self.sent = 0

    async def scenario(self) -> None:
        loop = asyncio.get_running_loop()
        assert isinstance(loop, CopiedLoop)
        async with life(FIRST, self.chain, "first") as (daemon, broker), broker.session() as session:
            self.witness.daemon = daemon
            self._daemon, self._rig = daemon, RigClient(session, "sim")
            self._ann, self._bob = ann, bob = Client(self._rig, "ann"), Client(self._rig, "bob")
            async with asyncio.TaskGroup() as group:
                self._group = group
                self._playing = [group.create_task(each.keep(), name="renewals") for each in (ann, bob)]
                player = group.create_task(play(ann, bob, self.places, self.witness), name="player")
                self._playing.append(player)
                loop.interrupt = self._interrupt
                await asyncio.wait([player])
                loop.interrupt = None
                if loop.is_copy:
                    await asyncio.Event().wait()  # until it was judged
                for task in self._playing:
                    task.cancel()
            await asyncio.sleep(0.5)
            await self.witness.look(daemon, self.places)
            check_homed(self.witness, daemon)
            self.refused, self.why = ann.refused + bob.refused, getattr(ann, "why", "")
            self.sent = sum(len(each.sent) + each.others for each in (ann, bob))

    def _interrupt(self, step: int) -> list[str] | None:
        loop = asyncio.get_running_loop()
        assert isinstance(loop, CopiedLoop)
        if self._kill:
            self.witness.daemon = None
            return in_new_loop(self._next_life, loop.time())
        self._dice.seed(step)
        loop.hold_up(self._dice.choice(FREEZES_S))
        self._group.create_task(self._after_freeze(loop), name="judge")
        return None

    async def _next_life(self) -> list[str]:
        """Restart with adoption, send old commands again, and see what comes of it."""
        witness, loop = self.witness, asyncio.get_running_loop()
        killed_s = loop.time()
        async with life(NEXT, self.chain, "second") as (daemon, broker), broker.session() as session:
            rig = RigClient(session, "sim")
            async with asyncio.timeout(30):
                await daemon.wait_up()
            for name, command in (*self._ann.sent[-4:], *self._bob.sent[-2:]):
                if command.effect is not Effect.REST and not command.takes_energy_out:
                    with contextlib.suppress(LdcndError):
                        await rig.command(name, command.model_copy(update={"instance": "first"}), timeout_s=1.0)
                        witness.wrong.append(f"{command.verb} of {name} was accepted from an earlier life")
            await asyncio.sleep(max(0.0, killed_s + PROFILE_S - loop.time()))
            await witness.look(daemon, self.places)
        return witness.wrong

    async def _after_freeze(self, loop: CopiedLoop) -> None:
        """Let others act after a freeze, then lose all clients, and see what comes of it."""
        try:
            match self._dice.choice(("go on", "replay", "force", "stop")):
                case "replay" if self._ann.sent:
                    name, command = self._ann.sent[-1]
                    if command.effect is not Effect.REST:
                        with contextlib.suppress(LdcndError):
                            await self._rig.command(name, command, timeout_s=1.0)
                case "force":
                    for task in self._playing:
                        task.cancel()
                    await self._bob.acquire(force=True)
                case "stop":
                    with contextlib.suppress(LdcndError):
                        await self._rig.stop()
            await asyncio.sleep(self._dice.uniform(0.0, 0.6))
            for task in self._playing:
                task.cancel()
            await asyncio.sleep(LEASE_S + LINE_S)
            await self._daemon.wait_up()
            await self.witness.look(self._daemon, self.places)
            check_homed(self.witness, self._daemon)
        except BaseException as error:  # noqa: BLE001 - nothing of this process may be lost
            self.witness.wrong.append(f"{type(error).__name__}: {error}")
        loop.leave(self.witness.wrong)


def interrupted(seed: int, chosen: Chosen, *, kill: bool) -> Interruptions:
    """Run the scenario once, interrupted at chosen steps."""
    run = Run(seed, kill=kill)
    with capture_logs():
        came = run_with_copies(run.scenario, chosen)
    what = "killed" if kill else "suspended"
    print(f"seed {seed}: {what} at {came.visited} of {came.steps} steps of {run.sent} commands")
    assert not run.refused, f"{run.refused} commands of the uninterrupted run were refused: {run.why}"
    assert not run.witness.wrong
    assert not came.wrong, f"seed {seed}, {len(came.wrong)} of {came.visited} points:\n" + "\n".join(came.wrong[:40])
    return came


@pytest.mark.promise("kill-moves-nothing-twice")
@pytest.mark.timeout(300)
@pytest.mark.parametrize("kill", [True, False], ids=["killed", "suspended"])
def test_a_daemon_may_be_interrupted_anywhere(kill):
    dice = random.Random(1)

    came = interrupted(1, lambda _: dice.random() < 0.006, kill=kill)

    assert came.visited > 10


PARTS = 25
"""All steps are visited in so many runs, each at every so many steps: any of them can be had by itself."""


@pytest.mark.soak
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("kill", [True, False], ids=["killed", "suspended"])
@pytest.mark.parametrize("part", range(PARTS))
def test_a_daemon_may_be_interrupted_at_every_await(part, kill):
    came = interrupted(1, lambda step: step % PARTS == part, kill=kill)

    assert came.visited == sum(step % PARTS == part for step in range(1, came.steps + 1)) > 100
