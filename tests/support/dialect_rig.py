"""A whole daemon with one simulated drive of any LDCN/NMC dialect, and the drive itself to look at and to hurt."""

import asyncio
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import asynccontextmanager
from dataclasses import dataclass
from types import MappingProxyType
from typing import TypeVar

from ldcnd.config.rig import RigConfig
from ldcnd.contract.commands import AxisCommand, CommandReply, Power
from ldcnd.contract.samples import AxisState, FaultSample, StateSample, TelemetryItem
from ldcnd.sim.chain import Chain
from ldcnd.sim.faults import FaultPlan
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain, model
from ldcnd.sim.ldcn.drive import SimulatedDrive
from ldcnd.sim.ldcn.power import FaultCondition
from ldcnd.sim.ldcn.quirks import ModuleSettings
from ldcnd.sim.plant import MotorPlant
from tests.support.rig import RunningRig, running_rig

AXIS = "x"
COUNTS_PER_MM = 1000
GAINS = {"kp": 350, "kd": 3000, "ki": 400, "il": 400, "ol": 250, "el": 4000}
PLANT = MotorPlant(reverse_limit_counts=-20_000, forward_limit_counts=20_000, pot_span_counts=(-25_000, 25_000))

ReplyT = TypeVar("ReplyT", bound=CommandReply)


@dataclass(frozen=True, slots=True)
class Dialect:
    """A device that the daemon speaks with: the profile of the configuration, the simulated module, its version."""

    profile: str
    module: str
    version: int

    @property
    def name(self) -> str:
        """Name in test ids."""
        return f"{self.profile}@{self.version}"


V1 = Dialect("pic-servo-v1", "picservo-v1", 1)
V2 = Dialect("pic-servo-v2", "picservo-v2", 2)
V3 = Dialect("pic-servo-v3", "picservo-v3", 3)
V4 = Dialect("pic-servo-v4", "picservo-v4", 4)
CMC = Dialect("pic-servo-cmc", "pic-servo-cmc", 5)
SC = Dialect("pic-servo-sc", "picservo-sc", 10)
LS_173AP = Dialect("ls-173ap", "ls173ap", 1)
LS_182AP = Dialect("ls-182ap", "ls182ap", 20)
LS_182AP_22 = Dialect("ls-182ap", "ls182ap", 22)
DIALECTS = (V1, V2, V3, V4, CMC, SC, LS_173AP, LS_182AP, LS_182AP_22)


@dataclass(frozen=True, slots=True)
class DialectRig:
    """The daemon, a client, and the drive behind them."""

    rig: RunningRig
    chain: Chain
    drive: SimulatedDrive

    async def send(self, command: AxisCommand[ReplyT]) -> ReplyT:
        """Send a command to the axis."""
        return await self.rig.client.command(AXIS, command)

    async def done(self, command: AxisCommand[CommandReply]) -> StateSample:
        """Send a command, wait until it is over, and return the state after it."""
        reply = await self.send(command)
        return await self.rig.client.wait_for_end(AXIS, reply.command_id)

    async def power_on(self) -> None:
        """Close the loop."""
        await self.until(lambda state: state.state is AxisState.DISABLED)
        await self.send(Power(on=True))

    async def until(self, wanted: Callable[[StateSample], bool]) -> StateSample:
        """Wait for a state of the axis."""
        return await self.rig.until(AXIS, wanted)

    async def until_fault(self, wanted: Callable[[FaultSample], bool]) -> FaultSample:
        """Wait for a sample on the fault topic."""
        async with asyncio.timeout(60.0):
            async with self.rig.client.samples(AXIS, TelemetryItem.FAULT) as faults:
                sample = await self.rig.client.last(AXIS, TelemetryItem.FAULT)
                while not isinstance(sample, FaultSample) or not wanted(sample):
                    _, sample = await anext(faults)
                return sample

    def condition(self, condition: FaultCondition, *, present: bool = True) -> None:
        """Let something go wrong around the drive, or be right again."""
        self.drive.set_condition(condition, present=present, at_s=asyncio.get_running_loop().time())

    @property
    def position_mm(self) -> float:
        """Where the shaft really is, from where it was at power-up."""
        return self.drive.shaft.position_counts / COUNTS_PER_MM


@asynccontextmanager
async def dialect_rig(
    dialect: Dialect,
    plant: MotorPlant = PLANT,
    start_counts: float = 0.0,
    faults: FaultPlan = FaultPlan(),  # noqa: B008 - immutable
    line: Mapping[str, object] = MappingProxyType({}),
    settings: ModuleSettings | None = None,
    **axis: object,
) -> AsyncIterator[DialectRig]:
    """Run a daemon with one axis of this dialect.

    Args:
        dialect: of the drive.
        plant: the machine on its shaft.
        start_counts: where the shaft stands at power-up; the drive counts from 0 there.
        faults: of the line.
        line: overrides and additions to the configuration of the line.
        settings: quirks of the simulated drive; those of the model when missing.
        axis: overrides and additions to the axis's configuration.
    """
    settings = settings or model(dialect.module)[1].model_copy(update={"version": dialect.version})
    chain = build_chain(ChainSpec((ModuleSpec(dialect.module, plant, settings),), faults=faults))
    drive = chain.modules[0]
    assert isinstance(drive, SimulatedDrive)
    drive.shaft.position_counts = start_counts
    drive.restart()
    async with running_rig(_config(dialect, axis, line=line), {"line": chain}) as rig:
        yield DialectRig(rig, chain, drive)


@asynccontextmanager
async def adopting_rig(dialect: Dialect, before: DialectRig, **axis: object) -> AsyncIterator[DialectRig]:
    """Run a new daemon that takes the line of an earlier one over as it is."""
    config = _config(dialect, axis, start="adopt")
    async with running_rig(config, {"line": before.chain}) as rig:
        yield DialectRig(rig, before.chain, before.drive)


def _config(
    dialect: Dialect,
    axis: dict[str, object],
    start: str = "reset",
    line: Mapping[str, object] = MappingProxyType({}),
) -> RigConfig:
    return RigConfig.model_validate(
        {
            "rig": "dialect",
            "sim": [{"name": "line", "module": [{"model": dialect.module}]}],
            "bus": [
                {
                    "name": "line",
                    "port": "sim:line",
                    "baud": 115_200,
                    "start": start,
                    "axis": [
                        {
                            "name": AXIS,
                            "address": 1,
                            "model": dialect.profile,
                            "unit": "mm",
                            "counts_per_unit": COUNTS_PER_MM,
                            "velocity": 20,
                            "acceleration": 200,
                            "reference": "at_reset",
                            "gains": GAINS,
                            "rates": {"position": 20, "velocity": 20, "adc": 5, "state": 20},
                        }
                        | axis
                    ],
                }
                | dict(line)
            ],
        }
    )
