"""Schedules of clients, daemons, a line and its modules: whatever befalls them, each motion is one that was asked for.

Clients command axes and groups, jog, stop, send again, take control from each other and die; cables are cut, modules
lose power, the process hangs; daemons are killed, ended and joined by rivals. One rig is brought up; each schedule is
lived through in a copy of its process. A schedule that is wrong is shortened to the acts that it takes, and printed:
`pytest -m soak tests/property/test_control_campaign.py --from SEED --count 1` lives through it again.
"""

import asyncio
import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NoReturn

import pytest
from structlog.testing import capture_logs

from ldcnd.client.rig_client import RigClient
from ldcnd.config.rig import RigConfig
from ldcnd.contract.commands import Power
from ldcnd.contract.leases import Acquire, Release
from ldcnd.sim.faults import FaultInjector, FaultPlan
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain
from ldcnd.testing.memory_session import MemoryBroker
from tests.support.copied_state import copy_state
from tests.support.interruptions import CopiedLoop, Interruptions, in_new_loop, own_folder, run_with_copies
from tests.support.schedules import LINE, RIG, Act, Drawing, Play, Rig, all_up, faults_of
from tests.support.shaft_judge import ShaftJudge, now_ns

GROUP_ADDRESS = 0x81
MOST_SHORTENINGS = 60
"""Tries at leaving acts out of a schedule that is wrong."""


@dataclass(frozen=True)
class Machine:
    """The rig that a campaign is about.

    Attributes:
        models: of the drives.
        turning: the axes that turn without an end, by name.
        baud: of the line.
        rest_s: from a stop on a good line until the axis stands.
        keeps: the daemons keep references.
    """

    models: tuple[str, ...]
    turning: tuple[str, ...] = ()
    baud: int = 115_200
    rest_s: float = 0.4
    keeps: bool = False

    @property
    def names(self) -> str:
        return "xyz"[: len(self.models)]

    def _axis(self, address: int, name: str, model: str) -> dict[str, object]:
        turns = name in self.turning
        limits = {"velocity": 30.0, "acceleration": 1000.0}
        return {
            "name": name,
            "address": address,
            "model": model,
            "unit": "deg" if turns else "mm",
            "counts_per_unit": 1000.0,
            "direction": "reverse" if name == "y" else "forward",
            "velocity": 20.0,
            "acceleration": 500.0,
            "jog_horizon_s": 60.0,  # a motion that nobody stops is seen
            "reference": "at_reset",
            **({"modulo": 12.0} if turns else {}),
            "limits": limits if turns else {**limits, "position_min": -30.0, "position_max": 30.0},
            "gains": {"kp": 350, "kd": 3000, "ki": 400, "il": 400, "ol": 250, "el": 4000},
            "rates": {"position": 6, "velocity": 0, "adc": 0, "state": 6},
        }

    def settings(self, start: str) -> RigConfig:
        axes = [
            self._axis(at, name, model) for at, (name, model) in enumerate(zip(self.names, self.models, strict=True), 1)
        ]
        groups = [{"name": "plane", "axes": list(self.names)}] if len(self.names) > 1 else []
        line = {"name": LINE, "port": f"sim:{LINE}", "baud": self.baud, "margin_ms": 5, "start": start}
        if start == "adopt":
            line["adopt_fallback"] = "reset"
        bus = line | {"axis": axes, "group": groups}
        sim = {"name": LINE, "module": [{"model": model} for model in self.models]}
        more = {"state_dir": "state"} if self.keeps else {}
        return RigConfig.model_validate({"rig": RIG, "authority": "leased", "bus": [bus], "sim": [sim], **more})

    def judge(self) -> ShaftJudge:
        chain = build_chain(ChainSpec(tuple(ModuleSpec(model) for model in self.models)))
        addresses = {at: (name,) for at, name in enumerate(self.names, 1)}
        groups = {GROUP_ADDRESS: tuple(self.names)} if len(self.names) > 1 else {}
        return ShaftJudge(chain, addresses | groups, self.settings("reset"))


MACHINES = {
    "one": Machine(("ls-182ap",)),
    "plane": Machine(("pic-servo-sc", "pic-servo-sc")),
    "table": Machine(("pic-servo-sc", "pic-servo-sc"), turning=("y",)),
    "three": Machine(("ls-182ap", "pic-servo-v4", "ls-173ap"), turning=("z",), keeps=True),
    "slow": Machine(("ls-182ap", "pic-servo-sc"), baud=19_200, rest_s=0.8),
}


class Campaign:
    """Schedules on one machine."""

    def __init__(self, machine: Machine, seeds: Sequence[int]) -> None:
        self.machine = machine
        self.seeds = seeds
        self.judge = machine.judge()
        self.schedules = 0
        self.shortened: list[str] = []

    async def scenario(self) -> None:
        """Bring the rig up, then live through every schedule in a copy."""
        loop, judge, machine = asyncio.get_running_loop(), self.judge, self.machine
        assert isinstance(loop, CopiedLoop)
        broker = MemoryBroker()
        rig = Rig(machine.settings, judge, broker)
        async with rig.watched(), broker.session() as session:
            daemon = await rig.start("reset")
            await all_up(daemon)
            judge.came_up(daemon)
            client = RigClient(session, RIG)
            lease = (await client.ask(Acquire(client="first", lease_s=5.0))).lease
            for name in machine.names:
                await client.command(name, Power(on=True, lease=lease))
            await client.ask(Release(lease=lease))
            await asyncio.sleep(1.0)
            for seed in self.seeds:
                acts = Drawing(seed, machine.settings("reset"), now_ns()).schedule()
                if await self._lives(loop, rig, seed, acts):
                    self.shortened.append(await self._shorten(loop, rig, seed, acts))
            await rig.end(daemon)

    async def _lives(self, loop: CopiedLoop, rig: Rig, seed: int, acts: tuple[Act, ...]) -> str:
        """Live through a schedule in a copy; return the first thing that is wrong."""
        self.schedules += 1
        before = len(loop.came.wrong)
        if self.machine.keeps:  # what daemons keep is of this copy alone
            shutil.rmtree("copy", ignore_errors=True)
            Path("copy").mkdir()
            copy_state(Path("state"), Path("copy/state"))
        if loop.copy(f"seed {seed}"):
            if self.machine.keeps:
                os.chdir("copy")
            await self.play(loop, rig, seed, acts)
        return loop.came.wrong[before] if len(loop.came.wrong) > before else ""

    async def _shorten(self, loop: CopiedLoop, rig: Rig, seed: int, acts: tuple[Act, ...]) -> str:
        """Leave acts out as long as something is wrong; return what is left, as it is printed."""
        counted, wrong = loop.came.counted, list(loop.came.wrong)
        size, tries = max(1, len(acts) // 2), 0
        last = wrong[-1]
        while size and tries < MOST_SHORTENINGS:
            for at in range(0, len(acts), size):
                fewer = acts[:at] + acts[at + size :]
                tries += 1
                if found := await self._lives(loop, rig, seed, fewer):
                    acts, last = fewer, found
                    break
            else:
                size //= 2
        loop.came.counted, loop.came.wrong = counted, wrong
        return "\n".join([f"seed {seed}, shortened: {last}", *(f"    {act}" for act in acts)])

    async def play(self, loop: CopiedLoop, rig: Rig, seed: int, acts: tuple[Act, ...]) -> None:
        """Live through one schedule, in a copy."""
        judge = self.judge
        faults = faults_of(seed, loop.time())
        judge.chain.injector = FaultInjector(FaultPlan(faults, seed))

        def kill(before: Play, at: int, zero_s: float) -> NoReturn:
            act, now_s = acts[at], asyncio.get_running_loop().time()
            judge.daemon = None
            judge.out_of_reach.append((now_s, now_s + act.for_s))

            async def next_life() -> None:
                again = replace(before, rig=Rig(self.machine.settings, judge, MemoryBroker()), clients={}, leases={})
                again.disturbed_s = [*before.disturbed_s, now_s, now_s + act.for_s]
                await again.rig.start(act.who)
                await lives(again, at + 1, zero_s + act.for_s)

            in_new_loop(next_life, now_s + act.for_s)
            raise AssertionError("a copy has come back")

        async def lives(play: Play, from_act: int, zero_s: float) -> NoReturn:
            wrong: list[str] = []
            try:
                await play.run(from_act, zero_s)
            except BaseException as error:  # noqa: BLE001 - nothing of a copy may be lost
                wrong = [f"{type(error).__name__}: {error}"]
            loop.leave([*judge.wrong, *wrong], judge.motions)

        await lives(Play(acts, judge, rig, not faults, self.machine.rest_s, kill), 0, loop.time())


def campaign(seeds: Sequence[int], machine: str) -> Interruptions:
    """Live through schedules; print how many, and how many motions they made."""
    it = Campaign(MACHINES[machine], seeds)
    with capture_logs(), own_folder():
        came = run_with_copies(it.scenario)
    print(f"{machine}, seeds {seeds[0]} to {seeds[-1]}: {came.counted} motions, {len(came.wrong)} wrong")
    assert not came.wrong, "\n".join([*came.wrong[:40], *it.shortened])
    return came


@pytest.mark.promise("kill-moves-nothing-twice")
@pytest.mark.timeout(600)
@pytest.mark.parametrize("machine", MACHINES)
@pytest.mark.sweep(5)
def test_every_motion_of_every_schedule_is_one_that_was_asked_for(machine):
    campaign(range(8), machine)


@pytest.mark.soak  # as many as a day allows: see --from and --count
@pytest.mark.timeout(3600 * 6)
@pytest.mark.parametrize("machine", MACHINES)
def test_every_motion_of_every_schedule_ever_is_one_that_was_asked_for(machine, seeds):
    campaign(seeds, machine)


@pytest.mark.long
def test_a_schedule_that_is_wrong_is_shortened_to_what_it_takes(monkeypatch):
    """A judge that takes any stop for wrong finds the one that is left."""

    def stopped(judge: ShaftJudge, axis: str) -> None:
        judge.wrong.append(f"{axis} was stopped")

    monkeypatch.setattr(ShaftJudge, "stopped", stopped)
    settings = MACHINES["one"].settings("reset")
    seed = next(seed for seed in range(50) if any(act.what == "stop" for act in Drawing(seed, settings, 0).schedule()))

    with pytest.raises(AssertionError, match="x was stopped") as failed:
        campaign([seed], "one")

    assert str(failed.value).count("Act(") == 1
