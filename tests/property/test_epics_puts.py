"""No sequence of puts, stops and reloads moves an axis that the gateway may not move, does not control, or has stopped.

After each, VAL is where the axis was sent or stands.
"""

import asyncio
import random
from contextlib import AsyncExitStack, suppress
from dataclasses import dataclass, field

import pytest
from caproto import CaprotoError, Forbidden

from ldcnd.client.axis import Axis
from ldcnd.client.rig import Rig
from ldcnd.config.plan import plan_rig
from ldcnd.contract.errors import LdcndError, StopLatched
from ldcnd.contract.events import ReadEvents
from ldcnd.contract.samples import AxisState, LinkState, Moving
from ldcnd.lab.epics.gateway import WHO, Gateway, gateway
from ldcnd.sim.chain import Chain
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain
from tests.support.chain_rig import drive
from tests.support.epics_records import STARTS, any_put, put, shows
from tests.support.rig import RunningRig, running_rig, two_axes

pytestmark = pytest.mark.timeout(3600)

PLACES = {"x": 1, "y": 2}
STILL_COUNTS = 3
COUNTS_PER_UNIT = 1000
SETTLING_COUNTS = 50
SETTLING_S = 3.0
"""By how much, and for how long, the loop goes on after the end of a profile that a halt has cut short."""
PAUSE_S = 5.0
STOPPED = 0.5
"""Share of the comparisons before which x is stopped; before the others it ends what was put."""
MOVES = {"move_absolute", "home", "jog"}


@dataclass
class Campaign:
    """A gateway that may move x and not y, another program that takes x now and then, and puts at random."""

    running: RunningRig
    rig: Rig
    chain: Chain
    made: Gateway
    dice: random.Random
    taken: AsyncExitStack | None = None
    ann: Axis | None = None
    under_way: set["asyncio.Task[None]"] = field(default_factory=set)
    rests_at: float | None = None
    """Where x stands, from the moment when nothing may move it."""
    checks: int = 0
    stops: int = 0
    compared: int = 0
    asked: int = 0
    """Puts that may begin a motion."""

    def counts(self, axis: str) -> float:
        return drive(self.chain, PLACES[axis]).shaft.position_counts

    def begin(self) -> None:
        """Put something, without waiting for the end of it."""
        name, value = any_put(self.made, self.dice)
        self.asked += name.endswith(STARTS) or name == "T:x"

        async def attempt() -> None:
            with suppress(LdcndError, ValueError, TypeError, CaprotoError, Forbidden):
                await put(self.made, name, value)

        task = asyncio.create_task(attempt(), name=f"put {value!r} to {name}")
        self.under_way.add(task)
        task.add_done_callback(self.under_way.discard)

    async def take(self) -> None:
        """Let another program have x, by force; what x was doing ends."""
        self.taken = AsyncExitStack()
        control = self.rig.control("x", client="ann", force=True, lease_s=60)
        self.ann = await self.taken.enter_async_context(control)
        await self.running.until("x", lambda state: state.moving is Moving.NO)
        ended_at = self.counts("x")
        await asyncio.sleep(SETTLING_S)
        self.rests_at = self.counts("x")
        assert abs(self.rests_at - ended_at) <= SETTLING_COUNTS

    async def give(self) -> None:
        """Let it go, and have the gateway control x again: nothing that was put before begins then."""
        assert self.taken
        assert self.ann
        while self.under_way:
            await asyncio.wait(self.under_way)
        # a stop that was put meanwhile is over first
        await self.running.until("x", lambda state: state.state is not AxisState.STOPPING)
        await self.ann.reset()
        await self.ann.power(on=True)
        self.rests_at = self.counts("x")  # a loop that closes may shift it by a little
        await self.taken.aclose()
        await asyncio.sleep(PAUSE_S)
        self.check()
        await put(self.made, "T:x.CNEN", "Enable")
        await shows(self.made, "T:x:control", WHO)
        self.taken = self.ann = self.rests_at = None

    async def heal(self) -> None:
        """Undo what keeps x from moving, as far as puts can."""
        if not self.taken:
            for field, value in (("SPMG", "Go"), ("SET", "Use"), ("CNEN", "Enable"), ("TWV", 1.0)):
                with suppress(LdcndError, ValueError):
                    await put(self.made, f"T:x.{field}", value)

    async def stop(self) -> None:
        """Put STOP right behind something else; nothing that was put before begins after it, nor goes on."""
        if not self.taken:
            self.begin()
            await asyncio.sleep(0)
            await put(self.made, "T:x.STOP", 1)
            await asyncio.sleep(SETTLING_S)
            state = await self.running.client.state("x")
            assert state
            assert state.moving is Moving.NO
            self.stops += 1

    def check(self) -> None:
        assert abs(self.counts("y")) <= STILL_COUNTS
        if self.rests_at is not None:
            self.checks += 1
            assert abs(self.counts("x") - self.rests_at) <= STILL_COUNTS

    async def stop_elsewhere(self) -> None:
        """Stop x as another program does, which latches, and clear that."""
        if not self.taken:
            self.begin()
            await self.running.client.stop("x")
            # a jog without a reference runs onto an end: behind that fault nothing is seen to stand before a reset
            await self.running.until("x", lambda state: state.moving is Moving.NO or bool(state.motion_hidden_by))
            while await self.refuses_reset():  # the stop of a put that has begun meanwhile is on its way
                await asyncio.sleep(0.01)

    async def refuses_reset(self) -> bool:
        try:
            await put(self.made, "T:x-ErrRst", 1)
        except StopLatched:
            return True
        return False

    async def reload(self) -> None:
        """Have the daemon read a configuration with other velocities."""
        config = two_axes()
        (bus,) = config.bus
        velocity = self.dice.choice([5.0, 10.0, 20.0])
        axes = tuple(axis.model_copy(update={"velocity": velocity}) for axis in bus.axis)
        config = config.model_copy(update={"bus": (bus.model_copy(update={"axis": axes}),)})
        self.running.daemon.reconfigure(config, plan_rig(config))

    async def compare(self) -> None:
        """At rest VAL is where x was sent, which is where it stands, whatever has been put or has stopped it."""
        if self.taken:
            return
        if stops := self.dice.random() < STOPPED:
            await asyncio.sleep(0)  # what was put before is before it
            await put(self.made, "T:x.STOP", 1)
        while self.under_way:
            await asyncio.wait(self.under_way)
        for jog in ("JOGF", "JOGR") if not stops else ():  # one that nobody releases has no end
            with suppress(LdcndError):
                await put(self.made, f"T:x.{jog}", 0)
        await self.running.until("x", lambda state: state.moving is Moving.NO and state.command is None)
        await asyncio.sleep(SETTLING_S)
        assert self.made.variables["T:x.DMOV"].value == 1
        target, here = (float(self.made.variables[f"T:x.{name}"].value) for name in ("VAL", "RBV"))
        assert abs(target - here) <= SETTLING_COUNTS / COUNTS_PER_UNIT, f"stopped: {stops}"
        self.compared += 1

    async def step(self) -> None:
        match self.dice.choice(
            ["put"] * 7 + ["wait"] * 3 + ["heal", "control", "stop", "elsewhere", "reload", "compare"]
        ):
            case "put":
                self.begin()
            case "wait":
                await asyncio.sleep(self.dice.choice([0.0, 0.05, self.dice.uniform(0.0, PAUSE_S)]))
            case "heal":
                await self.heal()
            case "stop":
                await self.stop()
            case "elsewhere":
                await self.stop_elsewhere()
            case "reload":
                await self.reload()
            case "compare":
                await self.compare()
            case _:
                await (self.give() if self.taken else self.take())
        self.check()


async def campaign(seed: int, steps: int) -> tuple[int, int]:
    """Return how many motions of x were begun, and how often x was checked while it was another program's."""
    chain = build_chain(ChainSpec(tuple(ModuleSpec(model) for model in ("ls182ap", "ls182ap"))))
    async with running_rig(two_axes(), {"line0": chain}) as running:
        for axis in PLACES:
            await running.until(axis, lambda state: state.link is LinkState.UP)
        rig = Rig(running.client, await running.client.daemon())
        async with rig.control("x", "y", client="setup") as axes:
            for each in axes:
                await each.power(on=True)
        async with gateway(rig, prefix="T:", axes=("x", "y"), moves=("x",)) as made:
            await put(made, "T:x.HVEL", 1.0)
            going = Campaign(running, rig, chain, made, random.Random(seed))
            for _ in range(steps):
                await going.step()
            if not going.taken:
                await going.compare()
                await going.take()
            await going.give()
            await going.compare()
        events = (await running.client.ask(ReadEvents(count=1000))).events
    begun = [event for event in events if event.verb in MOVES]
    assert len({event.command_id for event in begun}) <= going.asked
    assert {(event.axis, event.client) for event in begun} <= {("x", WHO)}
    return len(begun), going.checks


@pytest.mark.parametrize("seed", [1, 3])
async def test_puts_move_only_what_the_gateway_controls(seed: int):
    begun, checks = await campaign(seed, steps=40)

    assert begun > 0
    assert checks > 5


@pytest.mark.soak
async def test_no_sequence_of_many_puts_moves_what_the_gateway_does_not_control():
    first = random.SystemRandom().randrange(1_000_000)
    print(f"first seed {first}")
    begun = checks = 0
    for seed in range(first, first + 100):
        try:
            more = await campaign(seed, steps=100)
        except AssertionError as error:
            raise AssertionError(f"seed {seed}: {error}") from error
        begun, checks = begun + more[0], checks + more[1]
    print(f"{begun} motions, {checks} checks")
    assert min(begun, checks) > 100
