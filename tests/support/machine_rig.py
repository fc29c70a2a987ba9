"""A small machine: a rotor and a table on one line, a door with two contacts and its lock on a PIC-I/O."""

import asyncio
import math
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager

from ldcnd.config.rig import RigConfig
from ldcnd.contract.samples import IoSample, LinkState, TelemetryItem
from ldcnd.sim.chain import Chain
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain
from ldcnd.sim.ldcn.drive import SimulatedDrive
from ldcnd.sim.ldcn.io import SimulatedIo
from ldcnd.sim.plant import MotorPlant
from tests.support.rig import RunningRig, running_rig

MODEL = "pic-servo-sc"
CLOSED, OPEN = 3, 4
"""Lines of the door's contacts: high while it is closed, and high while it is open."""
LOCK = 10
SAFE = 1.0
"""Speed above which the door must be shut, in revolutions a second."""
COUNTS = 1000.0
GAINS = {"kp": 60, "kd": 600, "ki": 0, "il": 0, "ol": 250, "el": 8000}
ENDLESS = MotorPlant(reverse_limit_counts=-(10**9), forward_limit_counts=10**9)
INPUTS = {"door_closed": {"line": CLOSED}, "door_open": {"line": OPEN}}
OUTPUTS = {"lock": {"line": LOCK}}
DOOR_SHUT = {
    "name": "door_shut",
    "of": "rotor",
    "above": SAFE,
    "requires": [{"input": "door_closed"}, {"input": "door_open", "value": False}, {"output": "lock"}],
}
DOOR_OPENS = {"name": "door_opens", "of": "lock", "kind": ["low"], "requires": [{"axis": "rotor", "below": SAFE}]}


def machine(
    *rules: dict[str, object],
    axis: dict[str, object] | None = None,
    module: dict[str, object] | None = None,
    more: Sequence[dict[str, object]] = (),
    **bus: object,
) -> RigConfig:
    """Return its configuration with these interlocks, more modules and other settings."""
    axes = [
        {"name": name, "address": place, "model": MODEL, "unit": "rev", "counts_per_unit": COUNTS, "gains": GAINS}
        | {"velocity": 10.0, "acceleration": 20.0, "rates": {"position": 20, "velocity": 20, "adc": 0, "state": 20}}
        | (axis or {})
        for place, name in ((1, "rotor"), (2, "table"))
    ]
    cabinet = {"name": "cabinet", "address": 3, "model": "pic-io", "rate": 50, "inputs": INPUTS, "outputs": OUTPUTS}
    line = {
        "name": "line",
        "port": "sim:line",
        "baud": 115_200,
        "axis": axes,
        "module": [cabinet | (module or {}), *more],
    }
    modules = [{"model": MODEL}, {"model": MODEL}, {"model": "pic-io"}, *({"model": each["model"]} for each in more)]
    return RigConfig.model_validate(
        {
            "rig": "machine",
            "sim": [{"name": "line", "module": modules}],
            "bus": [line | bus],
            "interlock": list(rules),
        }
    )


def chain_of_machine(model: str = MODEL, plant: MotorPlant = ENDLESS) -> Chain:
    """Return its modules, with the door shut, and a lock that is open unless it is driven."""
    rotor, table = ModuleSpec(model, plant=plant), ModuleSpec(model)
    chain = build_chain(ChainSpec((rotor, table, ModuleSpec("pic-io"))))
    io = chain.modules[2]
    assert isinstance(io, SimulatedIo)
    io.drive_line(CLOSED, high=True, at_s=0.0)
    io.drive_line(OPEN, high=False, at_s=0.0)
    io.drive_line(LOCK, high=False, at_s=0.0)
    return chain


class Machine(RunningRig):
    """The running machine."""

    chain: Chain

    @property
    def io(self) -> SimulatedIo:
        """Return its PIC-I/O."""
        found = self.chain.modules[2]
        assert isinstance(found, SimulatedIo)
        return found

    def speed(self, place: int = 1) -> float:
        """Return how fast the shaft of a drive turns, in revolutions a second: the simulated shaft says so."""
        found = self.chain.modules[place - 1]
        assert isinstance(found, SimulatedDrive)
        found.catch_up(asyncio.get_running_loop().time())
        return abs(found.shaft.velocity_counts) / found.profile.servo_cycle_s / COUNTS

    async def until_speed(self, *, above: float = -1.0, below: float = math.inf, within_s: float = 5.0) -> None:
        """Wait until the rotor turns faster than one speed and slower than another, in revolutions a second."""
        async with asyncio.timeout(within_s):
            while not above <= self.speed() <= below:
                await asyncio.sleep(0.01)

    def door(self, *, closed: bool) -> None:
        """Move the door: both contacts follow."""
        now_s = asyncio.get_running_loop().time()
        self.io.drive_line(CLOSED, high=closed, at_s=now_s)
        self.io.drive_line(OPEN, high=not closed, at_s=now_s)

    async def named(self, **wanted: bool | None) -> IoSample:
        """Wait until the named lines have these values."""
        async with asyncio.timeout(5.0), self.client.samples("cabinet", TelemetryItem.IO) as samples:
            async for _, found in samples:
                assert isinstance(found, IoSample)
                if all(found.named[name] is value for name, value in wanted.items()):
                    return found
        raise AssertionError


@asynccontextmanager
async def running_machine(config: RigConfig, chain: Chain | None = None) -> AsyncIterator[Machine]:
    """Run it until the context ends."""
    chain = chain or chain_of_machine()
    async with running_rig(config, {"line": chain}) as rig:
        for axis in rig.daemon.rig.axes:
            await rig.until(axis, lambda state: state.link is LinkState.UP)
        found = Machine(rig.daemon, rig.client, rig.session, rig.broker, lives=rig.lives)
        object.__setattr__(found, "chain", chain)
        async with asyncio.timeout(5.0):
            rotor, cabinet = rig.daemon.rig.axes["rotor"].tracker, rig.daemon.rig.modules["cabinet"]
            while cabinet.read_at_s < 0 or rotor.earlier[0] is None:  # two readings tell how slow it is
                await asyncio.sleep(0.01)
        yield found
