"""Killed, suspended or ended at any await of a scenario, a daemon moves nothing twice, unasked or without control.

The first scenario has some forty commands: leases, buffered and aborting moves, a group, a homing, raw duties, a trace,
set-points, stops. In the second one the daemon keeps latches and references, walks a path, and loses a module's power
and its line. A killed daemon is followed by one that adopts the line, and old commands are sent again. A suspended one
finds time gone by, its client dead or another one in control. One that is ended begins nothing more, and ends. Drives
live on meanwhile.
"""

import asyncio
import contextlib
import os
import random
import tempfile
from collections.abc import AsyncIterator, Awaitable, Callable
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
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
    Jog,
    MoveAbsolute,
    MoveAnalog,
    MoveRelative,
    MoveVelocity,
    PinMode,
    Power,
    QuickStop,
    Reset,
    SetGains,
    SetOutputs,
    SetPosition,
    SetPwm,
    Track,
)
from ldcnd.contract.errors import LdcndError, OutcomeUnknown
from ldcnd.contract.frozen import Frozen
from ldcnd.contract.keys import RIG_ITSELF
from ldcnd.contract.leases import Acquire, ListHolders, Release, Renew
from ldcnd.contract.questions import Preview, Why
from ldcnd.contract.rig_commands import AxisMove, AxisPath, MoveTogether, WalkPath
from ldcnd.contract.samples import LinkState, StateSample
from ldcnd.contract.traces import TakeTrace
from ldcnd.daemon.assembly import build_daemon
from ldcnd.daemon.daemon import Daemon
from ldcnd.sim.chain import Chain
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain
from ldcnd.sim.ldcn.drive import SimulatedDrive
from ldcnd.testing.memory_session import MemoryBroker
from tests.support.copied_state import copy_state
from tests.support.interruptions import (
    Chosen,
    CopiedLoop,
    EveryAwait,
    Interruptions,
    in_new_loop,
    own_folder,
    run_with_copies,
)
from tests.support.rig import openers_of
from tests.support.witness import Witness

ReplyT = TypeVar("ReplyT", bound=Frozen)
LEASE_S = 0.6
FREEZES_S = (0.3, 1.0, 4.0)
ENDS_WITHIN_S = 10.0
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
        "jog_reach_s": 1.0,
        "gains": GAINS,
        "rates": {"position": 8, "velocity": 0, "adc": 0, "state": 8},
        **more,
    }


def config(models: tuple[str, str, str], *, keeps: bool, **bus: object) -> RigConfig:
    tracking = {"step": 1.0, "rate": 20.0}
    more = {"tracking": tracking}, {}, {"pwm": {"duty": 0.1, "duration_s": 1.0}}
    axes = [axis(name, at, models[at - 1], **more[at - 1]) for at, name in enumerate("xyz", 1)]
    line = {"name": "a", "port": "sim:a", "baud": 115_200, "margin_ms": 5, "axis": axes}
    line |= {"group": [{"name": "gantry", "axes": ["x", "y"]}], **bus}
    sim = {"name": "a", "module": [{"model": model} for model in models]}
    rig = {"rig": "sim", "authority": "leased", "bus": [line], "sim": [sim]}
    return RigConfig.model_validate(rig | ({"state_dir": "state"} if keeps else {}))


def now_ns() -> int:
    return 10**18 + round(asyncio.get_running_loop().time() * 1e9)


class Client:
    """A client that sends each command under its own id, and again when it gets no answer.

    Attributes:
        sent: everything it has sent, by axis, as it was sent.
        refused: how many commands failed.
        latched: axes whose stop outlasts the daemon, as it has said; no reset was sent since.
    """

    def __init__(self, rig: RigClient, name: str) -> None:
        self.rig = rig
        self.name = name
        self.sent: list[tuple[str, AxisCommand[CommandReply]]] = []
        self.refused = 0
        self.others = 0
        self.lease: str | None = None
        self.latched: set[str] = set()

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


async def recover(ann: Client, *names: str) -> None:
    """Wait for axes that were out of reach, and close their loops again."""
    for name in names:
        while not (state := await ann.state(name)) or state.link != "up":
            await asyncio.sleep(0.05)
        await ann.standing(name)
        await ann.send(name, Reset())
        await ann.send(name, Power(on=True))


async def play_with_losses(ann: Client, bob: Client, places: dict[str, float], witness: Witness) -> None:
    """Jog, walk a path, lose the power of one module, stop, lose the line, name a place."""
    loop = asyncio.get_running_loop()
    while not (state := await ann.state("z")) or state.link != "up":
        await asyncio.sleep(0.05)
    await ann.acquire()
    await recover(ann, "x", "y", "z")
    await ann.send("z", Jog(velocity=5.0, hold_s=0.3))
    for velocity in (5.0, -5.0):
        await asyncio.sleep(0.15)
        held = Jog(velocity=velocity, hold_s=0.3, renews=ann.sent[-1][1].command_id, lease=ann.lease)
        with contextlib.suppress(LdcndError):
            await ann.rig.command("z", held)
    await ann.standing("z")
    moves = tuple(AxisPath(axis=name, via=(1.0, 1.5), position=0.5, lease=ann.lease) for name in "xy")
    await ann.ask(WalkPath(moves=moves))
    await ann.send("z", MoveRelative(distance=4.0))
    await asyncio.sleep(0.1)
    witness.drive("z").power(on=False, at_s=loop.time())
    await asyncio.sleep(0.02)
    witness.drive("z").power(on=True, at_s=loop.time())
    await ann.standing("x", "y")
    await asyncio.sleep(0.5)
    await recover(ann, "z")
    await ann.send("z", MoveVelocity(velocity=5.0))
    await ann.send("y", MoveRelative(distance=3.0))
    with contextlib.suppress(LdcndError):
        ann.latched |= set((await ann.rig.stop()).kept)
    await ann.standing("x", "y", "z")
    ann.latched.clear()
    await recover(ann, "x", "y", "z")
    del places["x"]
    if await ann.send("x", SetPosition(position=1.0)):
        places["x"] = witness.drive("x").shaft.position_counts - 1000.0
    await ann.send("x", MoveRelative(distance=4.0))
    await asyncio.sleep(0.1)
    witness.chain.unplug(loop.time(), 0.05)
    await asyncio.sleep(0.5)
    await recover(ann, "x", "y", "z")
    await ann.done("x", MoveRelative(distance=-2.0))


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


@dataclass(frozen=True)
class Stage:
    """A rig, and what is done on it.

    Attributes:
        models: of x, y and z.
        play: what clients do.
        keeps: its daemons have a folder for references and latches.
    """

    models: tuple[str, str, str]
    play: Callable[[Client, Client, dict[str, float], Witness], Awaitable[None]]
    keeps: bool = False


FORTY = Stage(("ls-182ap", "ls-182ap", "pic-servo-v4"), play)
LOSSES = Stage(("pic-servo-sc", "pic-servo-sc", "ls-182ap"), play_with_losses, keeps=True)


class How(StrEnum):
    """What is done to a daemon at an await."""

    KILLED = "killed"
    SUSPENDED = "suspended"
    ENDED = "ended"


@contextlib.asynccontextmanager
async def life(
    settings: RigConfig, chain: Chain, instance: str
) -> AsyncIterator[tuple[Daemon, MemoryBroker, asyncio.Task[None]]]:
    broker = MemoryBroker()
    async with broker.session() as session, asyncio.TaskGroup() as group:
        daemon = build_daemon(settings, session, now_ns, instance, openers_of(settings, {"a": chain}))
        running = group.create_task(daemon.run(), name="daemon")
        yield daemon, broker, running
        daemon.end()
        await running


class Run:
    """One run of a scenario, with what is done to its copies."""

    def __init__(self, stage: Stage, seed: int, how: How) -> None:
        self._dice = random.Random(seed)
        self._stage, self._how = stage, how
        specs = tuple(ModuleSpec(model) for model in stage.models)
        self.chain = build_chain(ChainSpec(specs, seed=seed))
        self.witness = Witness(self.chain, {1: ("x",), 2: ("y",), 3: ("z",), 0x81: ("x", "y")})
        self.places: dict[str, float] = {"x": 0.0, "y": 0.0, "z": 0.0}
        self.refused = -1
        self.why = ""
        self.sent = 0

    async def scenario(self) -> None:
        loop, stage = asyncio.get_running_loop(), self._stage
        assert isinstance(loop, CopiedLoop)
        first = config(stage.models, keeps=stage.keeps)
        async with life(first, self.chain, "first") as (daemon, broker, running), broker.session() as session:
            self.witness.daemon = daemon
            self._daemon, self._running, self._rig = daemon, running, RigClient(session, "sim")
            self._ann, self._bob = ann, bob = Client(self._rig, "ann"), Client(self._rig, "bob")
            async with asyncio.TaskGroup() as group:
                self._group = group
                self._playing = [group.create_task(each.keep(), name="renewals") for each in (ann, bob)]
                player = group.create_task(stage.play(ann, bob, self.places, self.witness), name="player")
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
            if not stage.keeps:
                check_homed(self.witness, daemon)
            self.refused, self.why = ann.refused + bob.refused, getattr(ann, "why", "")
            self.sent = sum(len(each.sent) + each.others for each in (ann, bob))
            await ann.acquire()
            await ann.send("x", MoveRelative(distance=1.0))
            loop.interrupt = self._interrupt if self._how is How.KILLED else None
        loop.interrupt = None

    def _interrupt(self, step: int) -> list[str] | None:
        loop = asyncio.get_running_loop()
        assert isinstance(loop, CopiedLoop)
        if self._stage.keeps:  # what a copy keeps is its own
            folder = tempfile.mkdtemp(dir=".")
            copy_state(Path("state"), Path(folder, "state"))
            os.chdir(folder)
        if self._how is How.KILLED:
            self.witness.daemon = None
            return in_new_loop(self._next_life, loop.time())
        if self._how is How.ENDED:
            self._group.create_task(self._end(loop), name="judge")
            return None
        self._dice.seed(step)
        loop.hold_up(self._dice.choice(FREEZES_S))
        self._group.create_task(self._after_freeze(loop), name="judge")
        return None

    async def _next_life(self) -> list[str]:
        """Restart with adoption, send old commands again, and see what comes of it."""
        witness, loop, stage = self.witness, asyncio.get_running_loop(), self._stage
        killed_s = loop.time()
        self._give_power()
        settings = config(stage.models, keeps=stage.keeps, start="adopt", adopt_fallback="reset")
        async with life(settings, self.chain, "second") as (daemon, broker, _), broker.session() as session:
            rig = RigClient(session, "sim")
            await all_up(daemon, 30.0)
            unknown = {name for name in self._ann.latched if not daemon.rig.axes[name].tracker.status.stop_latched}
            witness.wrong += [f"{name} was latched and is not" for name in unknown]
            for name, command in (*self._ann.sent[-4:], *self._bob.sent[-2:]):
                if command.effect is not Effect.REST and not command.takes_energy_out:
                    with contextlib.suppress(LdcndError):
                        await rig.command(name, command.model_copy(update={"instance": "first"}), timeout_s=1.0)
                        witness.wrong.append(f"{command.verb} of {name} was accepted from an earlier life")
            await asyncio.sleep(max(0.0, killed_s + PROFILE_S - loop.time()))
            await witness.look(daemon, self.places)
        return witness.wrong

    async def _end(self, loop: CopiedLoop) -> None:
        """End the daemon, as SIGTERM does: nothing begins any more, and it ends with everything at rest."""
        try:
            self._daemon.end()
            self.witness.daemon = None
            await asyncio.wait([self._running], timeout=ENDS_WITHIN_S)
            if not self._running.done():
                self.witness.wrong.append("the daemon does not end")
            await asyncio.sleep(PROFILE_S)  # a line that was lost meanwhile takes no stop: motions end by themselves
            self.witness.wrong += [f"{name} moves" for name in "xyz" if not await self.witness.stands(name)]
        except BaseException as error:  # noqa: BLE001 - nothing of this process may be lost
            self.witness.wrong.append(f"{type(error).__name__}: {error}")
        loop.leave(self.witness.wrong)

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
            self._give_power()
            await asyncio.sleep(LEASE_S + LINE_S)
            await all_up(self._daemon, 30.0)
            await self.witness.look(self._daemon, self.places)
            if not self._stage.keeps:
                check_homed(self.witness, self._daemon)
        except BaseException as error:  # noqa: BLE001 - nothing of this process may be lost
            self.witness.wrong.append(f"{type(error).__name__}: {error}")
        loop.leave(self.witness.wrong)

    def _give_power(self) -> None:
        """Switch on again what its player had switched off."""
        for module in self.chain.modules:
            if isinstance(module, SimulatedDrive) and not module._powered:
                module.power(on=True, at_s=asyncio.get_running_loop().time())


async def all_up(daemon: Daemon, within_s: float) -> None:
    """Return as soon as every drive answers."""
    async with asyncio.timeout(within_s):
        await daemon.wait_up()
        while any(each.tracker.status.link is not LinkState.UP for each in daemon.rig.axes.values()):
            await asyncio.sleep(0.05)


def interrupted(stage: Stage, seed: int, chosen: Chosen, how: How) -> Interruptions:
    """Run a scenario once, interrupted at chosen steps."""
    run = Run(stage, seed, how)
    with capture_logs(), own_folder():
        came = run_with_copies(run.scenario, chosen)
    print(f"seed {seed}: {how} at {came.visited} of {came.steps} steps of {run.sent} commands")
    assert not run.refused, f"{run.refused} commands of the uninterrupted run were refused: {run.why}"
    assert not run.witness.wrong
    assert not came.wrong, f"seed {seed}, {len(came.wrong)} of {came.visited} points:\n" + "\n".join(came.wrong[:40])
    return came


EVERYTHING = pytest.mark.parametrize(
    ("stage", "how"),
    [(stage, how) for stage in (FORTY, LOSSES) for how in How],
    ids=lambda each: getattr(each, "value", ""),
)


@pytest.mark.promise("kill-moves-nothing-twice")
@pytest.mark.timeout(300)
@EVERYTHING
@pytest.mark.sweep(6)
def test_a_daemon_may_be_interrupted_at_every_await(stage, how):
    """At each await that the scenario reaches, once; the awaits are found where tasks are suspended."""
    awaits = EveryAwait()

    came = interrupted(stage, 1, awaits, how)

    print(f"{len(awaits.reached)} awaits reached")
    assert 40 < came.visited <= len(awaits.reached)


PARTS = 25
"""All steps are visited in so many runs, each at every so many steps: any of them can be had by itself."""


@pytest.mark.soak
@pytest.mark.timeout(3600)
@EVERYTHING
@pytest.mark.parametrize("part", range(PARTS))
def test_a_daemon_may_be_interrupted_at_every_step(part, stage, how):
    came = interrupted(stage, 1, lambda step: step % PARTS == part, how)

    assert came.visited == sum(step % PARTS == part for step in range(1, came.steps + 1)) > 100
