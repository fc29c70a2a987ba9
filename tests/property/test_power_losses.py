"""Whichever modules of a chain lose power at whichever instant, none ever has the address of another place.

The simulated chain is the judge: at every instant a module has the address of its place, or one at which nothing is
commanded. Once all have power the chain is whole again within `BACK_WITHIN_S`, without a reset of what had kept its
power, and a stop reaches every drive that can receive it.
"""

import asyncio
import contextlib
import random

import pytest

from ldcnd.config.rig import RigConfig
from ldcnd.contract.commands import Halt, MoveAbsolute, Power
from ldcnd.contract.errors import LdcndError
from ldcnd.contract.samples import LinkState
from ldcnd.drives.ldcn.addressing import WAITING_ADDRESSES
from ldcnd.drives.network import AdoptFallback, StartPolicy
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain
from ldcnd.testing.jumping_loop import JumpingLoop
from tests.support.chain_rig import rig_on

MODELS = ("ls-182ap", "ls-182ap", "ls-182ap", "pic-servo-v4", "pic-servo-v4", "pic-servo-sc", "pic-io")
BACK_WITHIN_S = 8.0
LATER_S = 60.0
"""Until modules whose servo cycles end within microseconds of each other have been told apart."""
STOPPED_WITHIN_S = 3.0
LOOKED_EVERY_S = 0.002
TAKEN_OVER_WITHIN_S = 30.0
ALONE = "switch one of them off and on again, alone"


def config_of(models: tuple[str, ...], baud: int) -> RigConfig:
    """Return a rig with these modules on one line; those that are no drives have no name."""
    axes = [
        {
            "name": f"a{address}",
            "address": address,
            "model": model,
            "unit": "mm",
            "counts_per_unit": 1000,
            "velocity": 5,
            "acceleration": 200,
            "limits": {"position_min": -900, "position_max": 900, "velocity": 50, "acceleration": 1000},
            "gains": {"kp": 350, "kd": 3000, "ki": 400, "il": 400, "ol": 250, "el": 4000},
            "loss": {"bus": "run_to_target"},
        }
        for address, model in enumerate(models, 1)
        if model != "pic-io"
    ]
    modules = [{"address": address, "model": model} for address, model in enumerate(models, 1) if model == "pic-io"]
    bus = {"name": "line0", "port": "sim:line0", "baud": baud, "margin_ms": 5, "axis": axes, "module": modules}
    return RigConfig.model_validate(
        {"rig": "sim", "bus": [bus], "sim": [{"name": "line0", "module": [{"model": model} for model in models]}]}
    )


class History:
    """One chain, and what happens to it."""

    def __init__(self, seed: int) -> None:
        self.dice = random.Random(seed)
        count = self.dice.randint(1, 5)
        kinds = self.dice.sample(MODELS, self.dice.randint(1, 3))
        self.models = tuple(self.dice.choice(kinds) for _ in range(count))
        if all(model == "pic-io" for model in self.models):
            self.models = ("ls-182ap", *self.models[1:])
        self.baud = self.dice.choice((57_600, 115_200, 115_200))
        self.chain = build_chain(ChainSpec(tuple(ModuleSpec(model) for model in self.models), seed=seed))
        self.lost: set[int] = set()
        self.off_until: dict[int, float] = {}
        self.flaws: list[str] = []
        self.named = False

    def look(self) -> None:
        """Note every module whose address may be taken for that of another place."""
        for place, module in enumerate(self.chain.modules, 1):
            if module.address not in (0, place, *WAITING_ADDRESSES):
                self.flaws.append(f"place {place} has address {module.address}")

    async def watch(self) -> None:
        """Look at the addresses again and again."""
        while True:
            self.look()
            await asyncio.sleep(LOOKED_EVERY_S)

    async def lose(self) -> None:
        """Let modules lose power, together or one after another, some again and again."""
        loop = asyncio.get_running_loop()
        for _ in range(self.dice.randint(1, 3)):
            places = [place for place in range(len(self.models)) if self.dice.random() < 0.5]
            together = self.dice.random() < 0.6
            for place in places:
                self.lost.add(place)
                self.chain.modules[place].power(on=False, at_s=loop.time())
                if not together:
                    await asyncio.sleep(self.dice.choice((0.0005, 0.005, 0.05, 0.3)) * self.dice.random())
            await asyncio.sleep(self.dice.choice((0.001, 0.02, 0.3, 3.0)) * self.dice.random())
            for place in places:
                self.chain.modules[place].power(on=True, at_s=loop.time())
                if not together:
                    await asyncio.sleep(self.dice.choice((0.0005, 0.005, 0.05, 1.0)) * self.dice.random())
            await asyncio.sleep(self.dice.choice((0.0, 0.05, 1.0)) * self.dice.random())

    async def quietly(self, command) -> None:
        """Carry out a command, which may fail."""
        with contextlib.suppress(LdcndError):
            await command

    async def work(self, rig, names: list[str]) -> None:
        """Command whatever while modules lose power."""
        for _ in range(self.dice.randint(0, 4)):
            name = self.dice.choice(names)
            what = self.dice.randrange(4)
            if what == 0:
                await self.quietly(rig.client.stop(name))
            elif what == 1:
                await self.quietly(rig.client.command(name, Halt()))
            elif what == 2:
                await self.quietly(rig.client.command(name, MoveAbsolute(position=400.0)))
            await asyncio.sleep(self.dice.random() * 0.1)

    async def run(self) -> None:
        """Play the history and judge it."""
        watching = asyncio.create_task(self.watch(), name="watch")
        try:
            await self.judge()
        finally:
            watching.cancel()
            await asyncio.wait([watching])

    async def judge(self) -> None:
        """Play the history; note what is wrong in the end."""
        names = [f"a{address}" for address, model in enumerate(self.models, 1) if model != "pic-io"]
        in_bring_up = self.dice.random() < 0.2
        async with rig_on(self.chain, config_of(self.models, self.baud), up=False) as rig:
            if in_bring_up:
                await asyncio.sleep(self.dice.random() * 0.6)
                await self.lose()
            await asyncio.wait_for(rig.daemon.wait_up(), 60)
            self.lost.clear()
            for name in names:
                await rig.until(name, lambda state: state.link is LinkState.UP)
                await self.quietly(rig.client.command(name, Power(on=True)))
                if self.dice.random() < 0.7:
                    await self.quietly(rig.client.command(name, MoveAbsolute(position=600.0)))
            await asyncio.sleep(self.dice.random())
            async with asyncio.TaskGroup() as group:
                group.create_task(self.lose(), name="lose")
                group.create_task(self.work(rig, names), name="work")
            kept = [place for place in range(len(self.models)) if place not in self.lost]
            moving = [place for place in kept if f"a{place + 1}" in names and self.chain.modules[place].loop.servo_on]
            stopped = [place for place in moving if self.dice.random() < 0.5]
            for place in stopped:
                await self.quietly(rig.client.stop(f"a{place + 1}"))
            await asyncio.sleep(STOPPED_WITHIN_S)
            now_s = asyncio.get_running_loop().time()
            for place in stopped:
                module = self.chain.modules[place]
                module.catch_up(now_s)
                if not self.stands(module):
                    self.flaws.append(f"place {place + 1} was not stopped")
            await asyncio.sleep(BACK_WITHIN_S - STOPPED_WITHIN_S)
            if "not proven" in rig.line.problem:
                self.named = True  # the cycles of two modules end together: they are asked again and again
                await asyncio.sleep(LATER_S)
            self.judge_end(rig, kept)

    def judge_end(self, rig, kept) -> None:
        """Note which modules are not back where they belong, unless the daemon says what a person must do."""
        for place in kept:
            if self.chain.modules[place].address != place + 1:
                self.flaws.append(f"place {place + 1} was reset by the daemon")
        if ALONE in rig.line.network.problem:
            return
        for place, module in enumerate(self.chain.modules, 1):
            if module.address != place:
                self.flaws.append(f"place {place} is not back: {module.address}; {rig.line.network.problem}")
        if not rig.line.bus.proofs.all_hold():
            self.flaws.append("not every module is proven")

    def stands(self, module) -> bool:
        """Tell whether a drive does not move by itself."""
        before = module.loop.position
        module.catch_up(asyncio.get_running_loop().time() + 0.05)
        return abs(module.loop.position - before) <= 2


def play(seed: int, kind: type[History] = History) -> str:
    """Play one history; return what was wrong."""
    loop = JumpingLoop()
    history = kind(seed)
    try:
        loop.run_until_complete(history.run())
    finally:
        loop.close()
    return f"seed {seed}, {history.models}, {history.baud} baud: {history.flaws[:4]}" if history.flaws else ""


def flaws_of(seeds: range) -> list[str]:
    """Return what was wrong in these histories."""
    return [flaw for seed in seeds if (flaw := play(seed))]


@pytest.mark.promise("address-only-of-its-place")
def test_no_module_ever_has_the_address_of_another_place_and_the_chain_comes_back() -> None:
    print("seeds 0 to 24")
    assert flaws_of(range(25)) == []


@pytest.mark.parametrize("seed", [262, 1398, 1443, 1627])
@pytest.mark.sweep(2)
def test_a_module_that_is_deaf_while_others_are_reset_is_found_at_its_waiting_address(seed: int) -> None:
    assert play(seed) == ""


@pytest.mark.promise("address-only-of-its-place")
def test_a_module_gets_no_address_by_the_silence_of_one_that_lost_power_after_it_was_asked() -> None:
    assert play(2828) == ""


@pytest.mark.promise("address-only-of-its-place")
@pytest.mark.parametrize("seed", [14902, 17021, 17034])
def test_modules_that_get_power_while_they_are_addressed_are_not_numbered_in_the_order_in_which_they_came(seed) -> None:
    assert play(seed) == ""


@pytest.mark.promise("address-only-of-its-place")
@pytest.mark.long
def test_modules_behind_one_without_power_get_no_address_while_the_line_is_brought_up() -> None:
    history = History(0)
    history.models = ("ls-182ap", "ls-182ap", "pic-servo-v4")
    history.chain = build_chain(ChainSpec(tuple(ModuleSpec(model) for model in history.models)))

    async def bring_up() -> None:
        watching = asyncio.create_task(history.watch(), name="watch")
        config, first = config_of(history.models, 57_600), history.chain.modules[0]
        async with rig_on(history.chain, config):
            pass
        first.power(on=False, at_s=asyncio.get_running_loop().time())
        # the second one is deaf now, with its address: the third is the first that answers after a reset
        async with rig_on(history.chain, config, up=False) as rig:
            await asyncio.sleep(10.0)
            assert "1 module(s) found" in rig.line.problem
            first.power(on=True, at_s=asyncio.get_running_loop().time())
            await asyncio.wait_for(rig.daemon.wait_up(), 60)
        watching.cancel()
        await asyncio.wait([watching])

    with asyncio.Runner(loop_factory=JumpingLoop) as runner:
        runner.run(bring_up())
    assert history.flaws == []
    assert [module.address for module in history.chain.modules] == [1, 2, 3]


class MuteHistory(History):
    """A chain of which some modules also hear and are not heard for a while, at one rate more."""

    def __init__(self, seed: int) -> None:
        super().__init__(seed)
        self.baud = self.dice.choice((19_200, self.baud, self.baud))

    async def lose(self) -> None:
        """Let modules lose power, and others or the same fall mute before, meanwhile and behind that."""
        mute = [place for place, _ in enumerate(self.models, 1) if self.dice.random() < 0.4]
        async with asyncio.TaskGroup() as group:
            group.create_task(super().lose(), name="lose power")
            for place in mute:
                self.chain.mute(place, on=True)
                await asyncio.sleep(self.dice.choice((0.0, 0.05, 1.0)) * self.dice.random())
        await asyncio.sleep(self.dice.choice((0.0, 1.0, 4.0)))
        for place in mute:
            self.chain.mute(place, on=False)


@pytest.mark.promise("address-only-of-its-place")
@pytest.mark.long
def test_no_module_gets_the_address_of_another_place_by_the_silence_of_one_that_hears() -> None:
    print("seeds 0 to 24")
    assert [flaw for seed in range(25) if (flaw := play(seed, MuteHistory))] == []


class SurplusHistory(History):
    """A chain that may have more modules than are configured, of which some have no power while it is brought up."""

    def __init__(self, seed: int) -> None:
        super().__init__(seed)
        self.surplus = self.dice.choice((0, 0, 1, 2, 3))
        self.configured = len(self.models)
        self.models += tuple(self.dice.choice(self.models) for _ in range(self.surplus))
        self.chain = build_chain(ChainSpec(tuple(ModuleSpec(model) for model in self.models), seed=seed))

    async def judge(self) -> None:
        """Bring the line up once, and again while modules are without power."""
        loop = asyncio.get_running_loop()
        config = config_of(self.models[: self.configured], self.baud)
        if self.dice.random() < 0.8:
            async with rig_on(self.chain, config, up=not self.surplus):
                await asyncio.sleep(4.0 if self.surplus else 0.0)
        off = [module for module in self.chain.modules if self.dice.random() < 0.4]
        for module in off:
            module.power(on=False, at_s=loop.time())
        async with rig_on(self.chain, config, up=False) as rig:
            for module in off:
                await asyncio.sleep(self.dice.choice((0.001, 0.05, 0.5, 3.0)) * self.dice.random())
                module.power(on=True, at_s=loop.time())
            await asyncio.sleep(BACK_WITHIN_S)
            if not self.surplus and rig.line.problem:
                self.flaws.append(f"not up: {rig.line.problem}")


@pytest.mark.promise("address-only-of-its-place")
@pytest.mark.long
def test_no_module_gets_the_address_of_another_place_on_a_chain_with_more_modules_than_are_configured() -> None:
    print("seeds 0 to 11")
    assert [flaw for seed in range(12) if (flaw := play(seed, SurplusHistory))] == []


@pytest.mark.soak
@pytest.mark.parametrize("first", range(0, 20_000, 100))
def test_the_same_in_histories_without_end(first: int) -> None:
    print(f"seeds {first} to {first + 99}")
    assert flaws_of(range(first, first + 100)) == []


class CutShort:
    """A chain whose bring-ups are cut short, and that is taken over afterwards.

    Attributes:
        told: what the daemon wanted a person to do.
    """

    def __init__(self, seed: int) -> None:
        self.dice = random.Random(seed)
        self.models = tuple(self.dice.choice(MODELS) for _ in range(self.dice.randint(1, 4)))
        if all(model == "pic-io" for model in self.models):
            self.models = ("ls-182ap", *self.models[1:])
        self.chain = build_chain(ChainSpec(tuple(ModuleSpec(model) for model in self.models), seed=seed))
        config = config_of(self.models, self.dice.choice((19_200, 57_600, 115_200)))
        bus = config.bus[0].model_copy(update={"start": StartPolicy.ADOPT, "adopt_fallback": AdoptFallback.RESET})
        self.starts = config, config.model_copy(update={"bus": (bus,)})
        self.told: list[str] = []

    async def lose_power(self, places: list[int], for_s: float) -> None:
        """Let modules be without power for a time."""
        loop = asyncio.get_running_loop()
        for on in (False, True):
            for place in places:
                self.chain.modules[place].power(on=on, at_s=loop.time())
            await asyncio.sleep(0.0 if on else for_s)

    async def run(self) -> str:
        """Kill daemons while they bring the line up, then let one take it over; return what is wrong."""
        dice, (reset, adopt) = self.dice, self.starts
        if dice.random() < 0.5:
            async with rig_on(self.chain, reset):
                pass
        for _ in range(dice.choice((1, 1, 2))):
            async with rig_on(self.chain, dice.choice(self.starts), up=False) as rig:
                await asyncio.sleep(dice.random())
                await rig.kill()
            if dice.random() < 0.3:
                lost = [place for place in range(len(self.models)) if dice.random() < 0.5]
                await self.lose_power(lost, dice.choice((0.002, 0.3)))
        async with rig_on(self.chain, adopt, up=False) as rig:
            for _ in self.models:
                with contextlib.suppress(TimeoutError):
                    await asyncio.wait_for(rig.daemon.wait_up(), TAKEN_OVER_WITHIN_S)
                    break
                if ALONE not in rig.line.problem:
                    return f"not up: {rig.line.problem}"
                self.told.append(rig.line.problem)
                silent = [place for place, module in enumerate(self.chain.modules, 1) if module.address != place]
                await self.lose_power([silent[0] - 1], 1.0)
        held = [module.address for module in self.chain.modules]
        return "" if held == [*range(1, len(held) + 1)] else f"the modules have the addresses {held}"


def cut_short(seeds: range) -> list[str]:
    """Return what was wrong after bring-ups that were cut short."""
    flaws, told = [], 0
    for seed in seeds:
        history = CutShort(seed)
        with asyncio.Runner(loop_factory=JumpingLoop) as runner:
            if flaw := runner.run(history.run()):
                flaws.append(f"seed {seed}, {history.models}: {flaw}")
        told += bool(history.told)
    print(f"seeds {seeds.start} to {seeds.stop - 1}: {told} times a person had to switch a module off and on")
    return flaws


@pytest.mark.promise("address-only-of-its-place")
@pytest.mark.long
def test_a_line_whose_bring_up_was_cut_short_is_taken_over_or_says_what_to_do() -> None:
    assert cut_short(range(15)) == []


@pytest.mark.soak
@pytest.mark.parametrize("first", range(0, 4000, 100))
def test_the_same_at_more_instants(first: int) -> None:
    assert cut_short(range(first, first + 100)) == []
