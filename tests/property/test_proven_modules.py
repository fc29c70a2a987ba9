"""Only a module that is proven to be what is configured takes what changes anything, whatever is commanded.

Random lines (as configured, a wrong module, two exchanged, one missing, set up by another host, exchanged for another
one while the daemon serves), random commands of axes, groups, I/O modules and the rig. The simulated modules tell what
they have executed; motors and outputs of the wrong ones are looked at besides.
"""

import asyncio
import contextlib
import random
from dataclasses import dataclass, field

import pytest
from structlog.testing import capture_logs

from ldcnd.config.rig import RigConfig
from ldcnd.contract.commands import (
    Halt,
    Home,
    Jog,
    MoveAbsolute,
    MoveRelative,
    MoveVelocity,
    Power,
    QuickStop,
    Reset,
    SetGains,
    SetOutputs,
    SetPosition,
    SetPwm,
    Stop,
    Track,
)
from ldcnd.contract.errors import LdcndError
from ldcnd.contract.rig_commands import AxisMove, MoveTogether, Rehearse, SetIo, SetIoTimer, SetSpeedOverride, Snapshot
from ldcnd.drives.ldcn.packet import CommandCode, Packet, StatusItem
from ldcnd.sim.chain import Chain
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain
from ldcnd.sim.ldcn.drive import SimulatedDrive
from ldcnd.sim.ldcn.io import SimulatedIo
from ldcnd.sim.ldcn.module import SimulatedModule
from tests.support.chain_rig import ChainRig, rig_on
from tests.support.dialect_rig import GAINS

SERVOS = ("pic-servo-v4", "ls-182ap", "ls-173ap", "pic-servo-sc", "pic-servo-v2")
MODULES = (*SERVOS, "pic-io")
READING = {CommandCode.NO_OPERATION, CommandCode.READ_STATUS}
ARRANGING = {CommandCode.SET_ADDRESS, CommandCode.SET_BAUD_RATE, CommandCode.HARD_RESET}
STOPS = {bytes([control]) for control in (0x00, 0x02, 0x04, 0x08, 0x05, 0x09)}
"""Stop Motor that stops a motor or switches it off."""
LINES = ("as configured", "wrong", "exchanged", "missing", "of another host", "replaced")
STILL_COUNTS = 5.0


@dataclass
class Line:
    """A line, what is configured on it, and what its modules have executed.

    Attributes:
        kind: one of `LINES`.
        configured: the models, in the order of the chain.
        chain: what is there.
        resets: the daemon may reset it to bring it up.
        wrong: modules that must take only what reads, stops or, where that is allowed, arranges.
        broken: what they have taken that they must not.
    """

    kind: str
    configured: tuple[str, ...]
    chain: Chain
    resets: bool
    wrong: set[int] = field(default_factory=set)
    broken: list[str] = field(default_factory=list)

    def executed(self, module: SimulatedModule, packet: Packet) -> None:
        """Judge a packet that a module executes."""
        if id(module) not in self.wrong or packet.command in READING:
            return
        if packet.command == CommandCode.STOP_MOTOR and bytes(packet.data) in STOPS:
            return
        if packet.command in ARRANGING and self.resets:
            return
        self.broken.append(f"{module.profile.name} at {module.address} took {packet}")

    def distrust(self) -> None:
        """From now on no module is the one that is configured, on a line that was taken over."""
        self.wrong = {id(module) for module in self.chain.modules}


def drawn(dice: random.Random) -> Line:
    kind = dice.choice(LINES)
    configured = (dice.choice(SERVOS), *(dice.choice(MODULES) for _ in range(dice.randrange(1, 3))))
    there = list(configured)
    if kind == "wrong":
        place = dice.randrange(len(there))
        there[place] = dice.choice([each for each in MODULES if each != there[place]])
    elif kind == "exchanged":
        there.append(there.pop(0))
    elif kind == "missing":
        there.pop()
    elif kind == "of another host":
        there.append("pic-io")  # on its line is one module more
    chain = build_chain(ChainSpec(tuple(ModuleSpec(name) for name in there), seed=dice.randrange(1000)))
    line = Line(kind, configured, chain, resets=kind != "of another host" and dice.random() < 0.7)
    if kind == "of another host":
        for address, module in enumerate(chain.modules, 1):
            module.address, module.address_out, module.items = address, True, StatusItem.POSITION
            if isinstance(module, SimulatedIo):
                module.items = StatusItem.AUX
    if kind == "of another host" or there != list(configured):
        line.distrust()
    return line


def config_of(line: Line) -> RigConfig:
    axes, modules = [], []
    for address, model in enumerate(line.configured, 1):
        if model == "pic-io":
            modules.append({"name": f"io{address}", "address": address, "model": model, "outputs": [1, 4], "rate": 5})
        else:
            axis = {"name": f"a{address}", "address": address, "model": model, "velocity": 20_000, "pwm": PWM}
            axes.append(axis | {"acceleration": 100_000, "gains": GAINS, "tracking": {"step": 100, "rate": 20}})
    start = "reset" if line.resets else "adopt"
    bus = {"name": "line", "port": "sim:line", "baud": 115_200, "start": start, "axis": axes, "module": modules}
    if len(axes) > 1:
        bus["group"] = [{"name": "all", "axes": [axis["name"] for axis in axes]}]
    sim = {"name": "line", "module": [{"model": model} for model in line.configured]}
    return RigConfig.model_validate({"rig": "proven", "sim": [sim], "bus": [bus]})


PWM = {"duty": 0.5, "duration_s": 5.0}


def command_of(dice: random.Random, rig: ChainRig):
    """Return a call of a random command."""
    axes, client = list(rig.daemon.rig.axes), rig.client
    modules = list(rig.daemon.rig.modules)
    axis = dice.choice(axes)
    far = dice.choice((-1, 1)) * dice.choice((10.0, 20_000.0))
    of_rig = [
        Snapshot(bus="line"),
        Rehearse(axis=axis, kind="bus_loss"),
        SetSpeedOverride(percent=dice.choice((0.0, 50.0, 100.0))),
    ]
    if len(axes) > 1:
        of_rig.append(MoveTogether(moves=tuple(AxisMove(axis=each, position=far) for each in axes)))
    for module in modules:
        of_rig += [SetIo(module=module, high=(1, 4), pwm1=0.6), SetIoTimer(module=module, mode="counter")] * 3
    of_axis = [
        *[Power(on=True)] * 4, Power(on=False), *[Reset()] * 4, Stop(), Stop(), QuickStop(), Halt(),
        MoveAbsolute(position=far), MoveRelative(distance=far), MoveVelocity(velocity=far / 10), Jog(velocity=far / 10),
        Home(method="index", velocity=100.0), SetPosition(position=0.0), SetGains(kp=100, el=1000), SetPwm(duty=0.3,
        duration_s=0.5), Track(position=far / 1000), SetOutputs(limit1="high"),
    ]  # fmt: skip
    if dice.random() < 0.35:
        return client.ask(dice.choice(of_rig))
    return client.command(axis, dice.choice(of_axis))


async def replace_one(line: Line, dice: random.Random) -> None:
    """Exchange a module for another model, at the same address, while the daemon is at work."""
    now_s = asyncio.get_running_loop().time()
    place = dice.randrange(len(line.chain.modules))
    before = line.chain.modules[place]
    before.power(on=False, at_s=now_s)
    line.wrong.add(id(before))
    await asyncio.sleep(dice.uniform(1.5, 3.0))
    other = dice.choice([name for name in MODULES if name != line.configured[place]])
    module = build_chain(ChainSpec((ModuleSpec(other),), seed=1)).modules[0]
    module.catch_up(asyncio.get_running_loop().time())
    module.address, module.address_out, module.baud = place + 1, True, dice.choice((before.baud, 115_200.0))
    line.wrong.add(id(module))
    line.chain.modules = (*line.chain.modules[:place], module, *line.chain.modules[place + 1 :])


def disturbed(chain: Chain) -> list[str]:
    """Return the motors that have turned and the outputs that are driven."""
    found = []
    for module in chain.modules:
        if isinstance(module, SimulatedDrive) and abs(module.shaft.position_counts) > STILL_COUNTS:
            found.append(f"{module.profile.name} has turned to {module.shaft.position_counts:.0f}")
        if isinstance(module, SimulatedIo) and (module.outputs or any(module.pwm)):
            found.append(f"{module.profile.name} drives {module.outputs:03x}, PWM {module.pwm}")
    return found


async def history(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    dice = random.Random(seed)
    line = drawn(dice)
    obey = SimulatedModule._obey

    def observed(module: SimulatedModule, packet: Packet, at_s: float) -> bytes | None:
        line.executed(module, packet)
        return obey(module, packet, at_s)

    with monkeypatch.context() as patched:
        patched.setattr(SimulatedModule, "_obey", observed)
        async with rig_on(line.chain, config_of(line), up=False) as rig:
            await asyncio.sleep(dice.choice((0.0, 0.3, 3.0)))
            replacing = dice.randrange(4) if line.kind == "replaced" else None
            for number in range(dice.randrange(4, 12)):
                if number == replacing:
                    await replace_one(line, dice)
                with contextlib.suppress(LdcndError, TimeoutError):
                    async with asyncio.timeout(3.0):
                        await command_of(dice, rig)
                await asyncio.sleep(dice.choice((0.0, 0.01, 0.1, 0.5)))
    said = f"seed {seed}, {line.kind}: {line.configured}, there {[each.profile.name for each in line.chain.modules]}"
    assert line.broken == [], said
    if all(id(module) in line.wrong for module in line.chain.modules):
        assert disturbed(line.chain) == [], said


@pytest.mark.promise("proven-before-changed")
@pytest.mark.parametrize(("first", "histories"), [(0, 100), pytest.param(100, 20_000, marks=pytest.mark.soak)])
async def test_only_proven_modules_take_what_changes_anything(first, histories, monkeypatch):
    for seed in range(first, first + histories):
        with capture_logs():
            await history(seed, monkeypatch)
