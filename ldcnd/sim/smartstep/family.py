"""The simulation of SmartStep lines, for rigs and for `ldcnd sim`."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import click
from typing_extensions import override

from ldcnd.contract.errors import ConfigError
from ldcnd.drives.smartstep.config import SmartStepBusConfig
from ldcnd.drives.smartstep.family import BAUD
from ldcnd.drives.smartstep.network import smartstep_opener
from ldcnd.drives.smartstep.packet import HIGHEST_UNIT, CommandCutter
from ldcnd.drives.smartstep.profiles import Echo
from ldcnd.drives.toml import read_toml
from ldcnd.line.transport import Opener
from ldcnd.sim.chain import Chain
from ldcnd.sim.family import ServedLine, SimulatedFamily
from ldcnd.sim.faults import FaultPlan
from ldcnd.sim.line import open_simulated_line
from ldcnd.sim.smartstep.cable import smartstep_chain
from ldcnd.sim.smartstep.simulation import (
    SimulatedSmartStepLineConfig,
    SimulatedSmartStepsConfig,
    SimulatedUnitConfig,
    simulated_units,
)

DEFAULT_SEED = 1


class SimulatedSmartStepLines(SimulatedFamily[SmartStepBusConfig, SimulatedSmartStepLineConfig]):
    """OMRON SmartStep."""

    line_config = SimulatedSmartStepLineConfig
    key = "unit"

    @override
    def chain(self, line: SimulatedSmartStepLineConfig, settings: SmartStepBusConfig, starts_at_s: float) -> Chain:
        profile = settings.profile(settings.axis[0])
        return smartstep_chain(
            simulated_units(line.unit, starts_at_s),
            profile.wiring,
            profile.framing,
            echo=profile.echo is Echo.EXPECT,
            faults=line.faults(starts_at_s),
        )

    @override
    def opener(self, chain: Chain, settings: SmartStepBusConfig) -> Opener:
        return smartstep_opener(lambda: open_simulated_line(chain), settings.profile(settings.axis[0]))

    @override
    def sim_options(self) -> Sequence[click.Option]:
        meaning = "SmartSteps instead: unit numbers such as 1,2, or a file with their tables (TOML)."
        return (click.Option(["--smartstep"], help=meaning),)

    @override
    def served(self, options: Mapping[str, Any], faults: Callable[[int], FaultPlan]) -> ServedLine | None:
        described = options["smartstep"]
        if described is None:
            return None
        config = _described(described)
        plan = faults(DEFAULT_SEED if options["seed"] is None else options["seed"])
        chain = smartstep_chain(simulated_units(config.unit, 0.0), config.wiring, config.framing, faults=plan)
        return ServedLine(chain, {"units": [unit.number for unit in config.unit]}, BAUD, CommandCutter)


SIMULATED_SMARTSTEP = SimulatedSmartStepLines()


def _described(text: str) -> SimulatedSmartStepsConfig:
    if not text.replace(",", "").replace(" ", "").isdigit():
        return read_toml(Path(text), SimulatedSmartStepsConfig)
    numbers = [int(number) for number in text.replace(",", " ").split()]
    if len(set(numbers)) < len(numbers) or max(numbers) > HIGHEST_UNIT:
        raise ConfigError(f"--smartstep: {text!r} are not different unit numbers from 0 to {HIGHEST_UNIT}")
    return SimulatedSmartStepsConfig(unit=tuple(SimulatedUnitConfig(number=number) for number in numbers))
