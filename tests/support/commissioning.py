"""A checklist of one axis on a whole daemon, on the jumping clock, with a person whose answers a test has written."""

import asyncio
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path

from typing_extensions import override

from ldcnd.bench.commissioning.checklist import Checklist
from ldcnd.bench.person import Left, Person
from ldcnd.client.rig import Rig
from ldcnd.config.rig import load_config
from ldcnd.sim.chain import Chain
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain
from ldcnd.sim.ldcn.drive import SimulatedDrive
from ldcnd.sim.plant import MotorPlant
from tests.support.rig import RunningRig, running_rig

AXIS = "x"
GAINS = {"kp": 350, "kd": 3000, "ki": 400, "il": 400, "ol": 250, "el": 4000}
PLANT = MotorPlant(reverse_limit_counts=-20_000, forward_limit_counts=20_000)
ENDLESS_S = 1e6
NOW = datetime(2026, 11, 23, 12, 0, 0, tzinfo=UTC)
RIG = """rig = "bench"
[[bus]]
name = "line"
port = "sim:line"
baud = 115200

[[bus.axis]]
name = "x" # the slide
model = "{model}"
address = 1
unit = "mm"
counts_per_unit = {counts_per_unit} # as ordered
direction = "{direction}"
velocity = 10
acceleration = 100
limits = {{ position_min = -18, position_max = 18, velocity = 40, acceleration = 400 }}
gains = {{ kp = 350, kd = 3000, ki = 400, il = 400, ol = 250, el = 4000 }}
home = {{ method = "index", velocity = 0.5 }}
rates = {{ position = 20, velocity = 20, adc = 0, state = 20 }}

[[sim]]
name = "line"
module = [{{ model = "{module}" }}]
"""

Answer = str | Callable[[], str]


class ScriptedPerson(Person):
    """Answers by the first words of its script that a question contains.

    Attributes:
        script: answers; what is called may do something first, such as turn the shaft.
        asked: questions so far.
        told: lines so far.
        holds_s: for how long it holds the key each time, seconds.
    """

    def __init__(self, script: Mapping[str, Answer]) -> None:
        self.script = dict(script)
        self.asked: list[str] = []
        self.told: list[str] = []
        self.holds_s = ENDLESS_S

    @override
    def tell(self, *lines: str) -> None:
        self.told += lines

    @override
    async def ask(self, question: str) -> str:
        self.asked.append(question)
        answer = next((each for words, each in self.script.items() if words in question), None)
        if answer is None:
            raise Left(f"no answer to {question!r}")
        return answer if isinstance(answer, str) else answer()

    @override
    @asynccontextmanager
    async def holding(self, what: str) -> AsyncIterator[asyncio.Event]:
        self.told.append(what)
        released = asyncio.Event()
        timer = asyncio.get_running_loop().call_later(self.holds_s, released.set)
        try:
            yield released
        finally:
            timer.cancel()


@dataclass(slots=True)
class CommissioningRig:
    """A daemon with one simulated axis, its configuration on the disk, and the checklist."""

    running: RunningRig
    config: Path
    drive: SimulatedDrive
    chain: Chain
    person: ScriptedPerson
    farthest_counts: list[float] = field(default_factory=list)

    async def checklist(self) -> Checklist:
        """Open the checklist as a new call of the command does."""
        rig = Rig(self.running.client, await self.running.client.daemon())
        checklist = Checklist(rig, self.config, AXIS, self.person, by="ada", now=lambda: NOW)
        self.person.tell(*await checklist.refresh())
        return checklist

    async def registers(self) -> dict[str, int | None]:
        """Return the gains that the drive has, as the daemon knows them."""
        (info,) = await self.running.client.axes()
        return {each.name: each.value for each in info.registers if each.name in GAINS}


def rig_text(model: str = "pic-servo-sc", counts_per_unit: float = 1000, direction: str = "forward") -> str:
    """Return a configuration."""
    module = {"pic-servo-sc": "picservo-sc"}.get(model, model)
    return RIG.format(model=model, module=module, counts_per_unit=counts_per_unit, direction=direction)


@asynccontextmanager
async def commissioning_rig(
    folder: Path,
    script: Mapping[str, Answer] = {},
    *,
    text: str | None = None,
    module: str = "picservo-sc",
    chain: Chain | None = None,
    **plant: object,
) -> AsyncIterator[CommissioningRig]:
    """Run a daemon with a configuration that is written into a folder, unless one is there.

    Args:
        folder: of configuration and record.
        script: of the person.
        text: of the configuration.
        module: simulated model.
        chain: the line as an earlier daemon has left it.
        plant: how the machine differs from a right one.
    """
    config = folder / "rig.toml"
    if text is not None or not config.exists():
        config.write_text(text or rig_text(), encoding="utf-8")
    machine = PLANT.model_copy(update=plant)
    chain = chain or build_chain(ChainSpec((ModuleSpec(module, machine),)))
    drive = chain.modules[0]
    assert isinstance(drive, SimulatedDrive)
    async with running_rig(load_config(config), {"line": chain}) as running:
        yield CommissioningRig(running, config, drive, chain, ScriptedPerson(script))
