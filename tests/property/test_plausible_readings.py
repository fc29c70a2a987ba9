"""Whatever a machine, its line and another host do: a drive that replies is not called silent, and stops reach it.

The simulated shaft is the judge. A history has a machine, a servo rate, a poll rate and a line that are drawn, a
motion, and something that befalls the drive in its course: another host sets its counter, or its gains so that the loop
hunts, or its servo rate; something holds the shaft and lets go; it is turned by hand; or nothing at all.

The tolerance is that of what is promised. On a line that falsifies replies so that they pass their checksum of one
byte, two in a row can show a false place that fits: one has a velocity that the axis may have, and explains the place
in the next one. No gate can tell; the histories allow for it by twice the highest velocity there.
"""

import asyncio
import contextlib
import math
import random
from collections import deque

import pytest
from structlog.testing import capture_logs

from ldcnd.config.rig import RigConfig
from ldcnd.contract.commands import Halt, Home, HomeMethod, MoveAbsolute, MoveVelocity, Power
from ldcnd.contract.errors import LdcndError
from ldcnd.contract.samples import LinkState, Moving, PositionSample, Quality, TelemetryItem
from ldcnd.drives.driver import Gains
from ldcnd.drives.ldcn.received import ResetPosition, SetGain, StopMotor
from ldcnd.sim.faults import FaultKind, FaultPlan, LineFault
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain
from ldcnd.sim.ldcn.power import FaultCondition
from ldcnd.sim.plant import MotorPlant
from ldcnd.testing.jumping_loop import JumpingLoop
from tests.support.chain_rig import ChainRig, drive, rig_on

MODELS = {"ls-182ap": "ls182ap", "pic-servo-v4": "picservo-v4", "pic-servo-sc": "picservo-sc"}
COUNTS, EL, NOISE = 1000, 4000, 16
STABLE = 4
"""With these gains a loop of a longer servo tick hunts by itself."""
GAINS = {"kp": 350, "kd": 3000, "ki": 400, "il": 400, "ol": 250, "el": EL}
AWAY = 60_000
"""Where another drive of the line stands, whose late replies may be taken for those of the axis."""
ROUGH_FROM_S = 2.0
FALSE_COUNTS_PER_S = 2 * 50 * COUNTS
"""The highest velocity of a falsified reply that is believed at once: twice the limit of the axis."""
OPEN_LOOP_COUNTS_PER_S = 8 * 50 * COUNTS
"""A shaft that is turned by hand may be so fast."""
LOOKED_EVERY_S = 0.005
LATE_S = 0.02
"""A poll may come later than planned by commands and other polls."""
LINE_S = 0.04
"""So old is a position at most when it is published."""
STOPPED_WITHIN_S = 0.25
STANDS_WITHIN_S = 1.0
"""The fastest axis decelerates for 0.25 s, and settles."""
UNSTABLE = ("hunts", "rate", "by hand")
"""Deeds after which its loop does not hold an axis."""
LOST_WITHIN_POLLS, PROOFS_S = 5, 0.2
"""Within so many polls, and the proofs of the line between them, a set counter costs the reference."""


def config_of(models: tuple[str, ...], divisor: int, rate_hz: float) -> RigConfig:
    axes = [
        {
            "name": name,
            "address": address,
            "model": model,
            "unit": "mm",
            "counts_per_unit": COUNTS,
            "velocity": 20,
            "acceleration": 200,
            "reference": "at_reset",
            "limits": {"velocity": 50, "acceleration": 1000},
            "gains": GAINS | {"sr": divisor if name == "a" else 1},
            "rates": {"position": rate_hz, "velocity": rate_hz, "adc": 0, "state": 5},
        }
        for address, (name, model) in enumerate(zip("ab", models, strict=False), 1)
    ]
    modules = [{"model": MODELS[model]} for model in models]
    bus = {"name": "line0", "port": "sim:line0", "baud": 115_200, "margin_ms": 5, "axis": axes}
    return RigConfig.model_validate({"rig": "sim", "bus": [bus], "sim": [{"name": "line0", "module": modules}]})


class Story:
    """One axis, what befalls it, and what is published of it.

    Attributes:
        flaws: what must not happen and has happened.
    """

    def __init__(
        self,
        model: str = "ls-182ap",
        speed: float = 20.0,
        divisor: int = 1,
        rate_hz: float = 20.0,
        plant: MotorPlant | None = None,
        faults: tuple[LineFault, ...] = (),
        seed: int = 1,
    ) -> None:
        models = (model, "ls-182ap") if faults else (model,)
        self.speed, self.divisor, self.rate_hz, self.faults = speed, divisor, rate_hz, faults
        self.config = config_of(models, divisor, rate_hz)
        modules = (ModuleSpec(MODELS[model], plant or MotorPlant()), *(ModuleSpec(MODELS[each]) for each in models[1:]))
        self.chain = build_chain(ChainSpec(modules, faults=FaultPlan(faults, seed), seed=seed))
        self.flaws: list[str] = []
        self.tolerance = self.allowed = self.fastest = 0.0
        self.seen: deque[tuple[float, float, int]] = deque(maxlen=1000)
        self.stops: list[float] = []
        self.open_at_s = 0.0
        self.set_by = 0
        self.judged = 0

    # -- the truth ---------------------------------------------------------------------------------------------------

    @property
    def shaft(self) -> float:
        return drive(self.chain, 1).shaft.position_counts

    def _look(self, now_s: float) -> None:
        one = drive(self.chain, 1)
        self.seen.append((now_s, one.shaft.position_counts, one.loop.position))
        speed = abs(one.shaft.velocity_counts) / one.profile.servo_cycle_s
        shown = FALSE_COUNTS_PER_S if any(each.kind is FaultKind.REPLY_FALSIFIED for each in self.faults) else 0.0
        self.fastest = max(self.fastest, speed, self.speed * COUNTS, shown)
        tick_s = one.profile.servo_cycle_s * self.divisor
        gap_s = 1 / self.rate_hz + LATE_S + 2 * tick_s
        self.tolerance = NOISE + EL / 8 + (self.fastest + 1 / tick_s) * gap_s
        if not one.loop.servo_on:
            self.open_at_s = now_s
        if now_s - self.open_at_s <= gap_s:
            self.tolerance += OPEN_LOOP_COUNTS_PER_S * gap_s

    async def look(self) -> None:
        loop = asyncio.get_running_loop()
        while True:
            self._look(loop.time())
            await asyncio.sleep(LOOKED_EVERY_S)

    async def judge(self, rig: ChainRig) -> None:
        """Compare each good position with the places of the shaft shortly before."""
        async with rig.client.samples("a", TelemetryItem.POSITION) as samples:
            async for _, sample in samples:
                if not isinstance(sample, PositionSample) or sample.quality is not Quality.GOOD:
                    continue
                now_s = asyncio.get_running_loop().time()
                self._look(now_s)
                known = rig.daemon.rig.axes["a"].tracker.status.referenced  # without one it is what the counter shows
                places = [shaft if known else counter for at_s, shaft, counter in self.seen if at_s > now_s - LINE_S]
                self.judged += 1
                if not min(places) - self.tolerance <= sample.counts <= max(places) + self.tolerance:
                    self.flaws.append(
                        f"{sample.counts} is {places[-1]:.0f}, more than {self.tolerance:.0f} off, at {now_s:.3f} s"
                    )

    async def watch_link(self, rig: ChainRig) -> None:
        async with rig.client.samples("a", "state") as states:
            async for _, state in states:
                if state.link is LinkState.DOWN:
                    self.flaws.append("the link is down though the drive replies")

    def codes(self, rig: ChainRig) -> set[str]:
        return {fault.code for fault in rig.daemon.rig.axes["a"].tracker.status.active_faults} - {"stop_unconfirmed"}

    # -- what happens ------------------------------------------------------------------------------------------------

    async def play(self, motion: str, deed: str, at_s: float, last: str, by: int = 0) -> None:
        async with rig_on(self.chain, self.config) as rig, asyncio.TaskGroup() as group:
            one = drive(self.chain, 1)
            self._listen(one)
            tasks = [group.create_task(self.look())]
            await self._begin(rig)
            tasks.append(group.create_task(self.judge(rig)))
            if not self.faults:
                tasks.append(group.create_task(self.watch_link(rig)))
            await self._move(rig, motion)
            await asyncio.sleep(at_s)
            if deed == "by hand":
                await self._send(rig, Power(on=False))
            was_stopped = bool(self.codes(rig))
            await self._befall(deed, by)
            await asyncio.sleep(LOST_WITHIN_POLLS / self.rate_hz + PROOFS_S)
            await self._check(rig, deed, was_stopped=was_stopped)
            await self._end(rig, deed, last)
            for task in tasks:
                task.cancel()

    def _listen(self, one) -> None:
        execute = one.execute

        def heard(command) -> None:
            if isinstance(command, StopMotor):
                self.stops.append(asyncio.get_running_loop().time())
            execute(command)

        one.execute = heard

    async def _send(self, rig: ChainRig, command, name: str = "a") -> None:
        """Send a command, which may fail on a line that loses replies."""
        with contextlib.suppress(*(LdcndError,) if self.faults else ()):
            await rig.client.command(name, command)

    async def _begin(self, rig: ChainRig) -> None:
        for name in [each.name for each in self.config.bus[0].axis]:
            await rig.until(name, lambda state: state.link is LinkState.UP and state.moving is Moving.NO)
            await self._send(rig, Power(on=True), name)
        if self.faults:
            drive(self.chain, 2).execute(ResetPosition(AWAY))
            now_s = asyncio.get_running_loop().time()
            assert now_s < ROUGH_FROM_S
            await asyncio.sleep(ROUGH_FROM_S - now_s)

    async def _move(self, rig: ChainRig, motion: str) -> None:
        match motion:
            case "move":
                await self._send(rig, MoveAbsolute(position=90.0, velocity=self.speed))
            case "jog" | "slow down":
                await self._send(rig, MoveVelocity(velocity=self.speed))
            case "home":
                await self._send(rig, Home(method=HomeMethod.FORWARD_LIMIT, velocity=self.speed, position=0.0))
        if motion == "slow down":
            await asyncio.sleep(0.4)
            await self._send(rig, Halt())

    async def _befall(self, deed: str, by: int) -> None:
        one, loop = drive(self.chain, 1), asyncio.get_running_loop()
        self._look(loop.time())
        self.allowed = self.tolerance
        self.stops.clear()
        match deed:
            case "set":
                self.set_by = by
                one.execute(ResetPosition(one.loop.position + by))
            case "beyond":
                self.set_by = round(math.copysign(self.allowed + 100, by))
                one.execute(ResetPosition(one.loop.position + self.set_by))
            case "zero":
                self.set_by = -one.loop.position
                one.execute(ResetPosition())
            case "hunts":
                one.execute(SetGain(Gains(110, 5000, 400, 400, 250, 0, EL, self.divisor)))
            case "rate":
                one.execute(SetGain(Gains(350, 3000, 400, 400, 250, 0, EL, max(1, self.divisor // 10))))
            case "jam":
                one.set_condition(FaultCondition.STALLED, present=True, at_s=loop.time())
                await asyncio.sleep(by / 1e6)
                drive(self.chain, 1).set_condition(FaultCondition.STALLED, present=False, at_s=loop.time())
            case "by hand":
                one.shaft.velocity_counts = by / 10 * one.profile.servo_cycle_s

    async def _check(self, rig: ChainRig, deed: str, *, was_stopped: bool) -> None:
        state = await rig.client.state("a")
        assert state
        codes = self.codes(rig)
        if abs(self.set_by) > self.allowed:
            if state.referenced:
                self.flaws.append(f"referenced after its counter was set by {self.set_by}, {self.allowed:.0f} allowed")
            # on a line that loses replies it may have been out of reach, which costs the reference as well
            if not self.faults and not codes & {"position_jump", "drive_reset", "readings_contradict"}:
                self.flaws.append(f"no fault after its counter was set: {codes}")
            if not (self.stops or was_stopped or self.faults) and drive(self.chain, 1).loop.servo_on:
                self.flaws.append("not stopped after its counter was set")
        if deed == "nothing" and self.divisor <= STABLE and not self.faults and codes:
            self.flaws.append(f"{codes} though nothing was wrong")

    async def _end(self, rig: ChainRig, deed: str, last: str) -> None:
        loop = asyncio.get_running_loop()
        before, began_s = len(self.stops), loop.time()
        if last == "stop":
            await rig.client.stop("a", timeout_s=5.0)  # says whether the drive has confirmed it
        else:
            await self._send(rig, Halt() if last == "halt" else Power(on=False))
        if self.faults:
            await asyncio.sleep(4 * STOPPED_WITHIN_S)
        if len(self.stops) == before:
            self.flaws.append(f"{last} did not reach the drive")
        elif not self.faults and self.stops[before] - began_s > min(STOPPED_WITHIN_S, 2 / self.rate_hz + LATE_S):
            self.flaws.append(f"{last} took {self.stops[before] - began_s:.3f} s")
        if not self.faults and last != "off" and self.divisor <= STABLE and deed not in UNSTABLE:
            await asyncio.sleep(STANDS_WITHIN_S)
            here = self.shaft
            await asyncio.sleep(STOPPED_WITHIN_S)
            if abs(self.shaft - here) > EL / 40:
                self.flaws.append(f"{self.shaft - here:.0f} counts on, {STANDS_WITHIN_S} s after {last}")
        if last == "off" and drive(self.chain, 1).loop.servo_on:
            self.flaws.append("the loop is closed after power off")


def play(story: Story, *args, **values) -> Story:
    with asyncio.Runner(loop_factory=JumpingLoop) as runner, capture_logs():
        runner.run(story.play(*args, **values))
    return story


def by_lot(seed: int) -> str:
    """Play the history of a seed; return what was wrong with it."""
    dice = random.Random(seed)
    speed = dice.choice((1.0, 2.0, 5.0, 20.0, 50.0))
    plant = MotorPlant(
        inertia_kg_m2=5e-5 * dice.choice((0.5, 1, 1, 3)),
        friction_nm=dice.choice((0.001, 0.004, 0.02)),
        backlash_counts=dice.choice((0.0, 0.0, 8.0)),
    )
    deed = dice.choice(("set", "beyond", "zero", "hunts", "rate", "jam", "by hand", "nothing"))
    stable = deed in ("set", "beyond", "zero", "nothing") and dice.random() < 0.7
    divisor = dice.choice((1, 1, 2, 4)) if stable else dice.randint(1, 255)
    kind = dice.choice((None, None, FaultKind.REPLY_DELAYED, FaultKind.REPLY_FALSIFIED))
    faults = (LineFault(kind, 0.1, from_s=ROUGH_FROM_S, longest_s=0.1),) if kind else ()
    rate_hz = dice.choice((8.0, 20.0, 50.0, 100.0))
    model = dice.choice(tuple(MODELS))
    motion = dice.choice(("move", "jog", "slow down", "home", "stand"))
    by = round(dice.choice((-1, 1)) * 10 ** dice.uniform(2, 6))
    if deed == "jam":
        by = round(10 ** dice.uniform(4, 5.3))
    story = Story(model, speed, divisor, rate_hz, plant, faults, seed)
    last = dice.choice(("stop", "halt", "off"))
    play(story, motion, deed, dice.uniform(0.02, 1.0), last, by)
    told = f"{seed}: {model} sr {divisor} {speed} mm/s {rate_hz} Hz {motion} {deed} {by} {kind} {last}"
    return f"{told}: {story.flaws[:3]}" if story.flaws else ""


MOTIONS = ("move", "jog", "slow down", "home")


@pytest.mark.promise("contradiction-stops")
@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("speed", [2.0, 20.0])
@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.sweep(15)
def test_a_counter_that_another_host_sets_in_mid_motion_costs_the_reference_and_stops_the_axis(model, speed, motion):
    """To 0, and to places on either side that are just farther away than what is promised."""
    for deed, by in (("zero", 0), ("beyond", 1), ("beyond", -1), ("set", 500_000)):
        at_s = 1.2 if motion != "slow down" else 0.01
        story = play(Story(model, speed), motion, deed, at_s, "halt", by)
        assert story.flaws == [], (deed, by)
        assert story.judged >= 5


@pytest.mark.promise("contradiction-stops")
@pytest.mark.parametrize("last", ["stop", "halt", "off"])
@pytest.mark.parametrize(
    ("deed", "values"),
    [
        ("nothing", {"divisor": 255, "model": "pic-servo-v4"}),
        ("hunts", {"plant": MotorPlant(inertia_kg_m2=1e-5)}),
        ("hunts", {"plant": MotorPlant(inertia_kg_m2=1e-5), "rate_hz": 100.0}),
        ("jam", {}),
        ("rate", {"divisor": 10}),
        ("nothing", {"speed": 50.0, "rate_hz": 8.0}),
    ],
    ids=["slow servo rate", "hunts", "hunts at 100 polls", "breaks free", "wrong divisor", "fast"],
)
@pytest.mark.sweep(3)
def test_a_motion_that_is_not_understood_neither_counts_as_silence_nor_keeps_a_stop_back(deed, values, last):
    story = play(Story(**values), "move", deed, 0.8, last, 90_000)

    assert story.flaws == []


@pytest.mark.parametrize("part", range(4))
def test_no_history_shows_a_drive_as_silent_or_a_false_place_as_good_or_keeps_a_stop_back(part):
    assert [flaw for seed in range(part * 12, part * 12 + 6) if (flaw := by_lot(seed))] == []


def test_a_false_velocity_that_no_axis_has_explains_no_false_place_in_the_next_reply():
    assert by_lot(5677) == ""


@pytest.mark.soak
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("part", range(100))
def test_no_history_of_twenty_thousand_does(part):
    assert [flaw for seed in range(1000 + part * 200, 1200 + part * 200) if (flaw := by_lot(seed))] == []
