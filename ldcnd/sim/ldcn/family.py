"""The simulation of LDCN and NMC lines, for rigs and for `ldcnd sim`."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import click
from typing_extensions import override

from ldcnd.contract.errors import ConfigError
from ldcnd.drives.ldcn.config import LdcnBusConfig
from ldcnd.drives.ldcn.packet import PacketReader
from ldcnd.drives.ldcn.registers import RESET_BAUD, baud_at_reset
from ldcnd.drives.toml import read_toml
from ldcnd.line.transport import Opener
from ldcnd.sim.chain import Chain
from ldcnd.sim.family import ServedLine, SimulatedFamily
from ldcnd.sim.faults import FaultPlan
from ldcnd.sim.ldcn.chain import MODELS, OLD_NAMES, ChainSpec, ModuleSpec, build_chain
from ldcnd.sim.ldcn.simulation import SimulatedLdcnLineConfig, SimulationConfig
from ldcnd.sim.line import open_simulated_line

DEFAULT_SEED = 1


class SimulatedLdcn(SimulatedFamily[LdcnBusConfig, SimulatedLdcnLineConfig]):
    """LDCN (Logosol) and NMC (J R Kerr)."""

    line_config = SimulatedLdcnLineConfig
    key = "module"

    @override
    def chain(self, line: SimulatedLdcnLineConfig, settings: LdcnBusConfig, starts_at_s: float) -> Chain:
        return build_chain(line.spec(starts_at_s=starts_at_s))

    @override
    def opener(self, chain: Chain, settings: LdcnBusConfig) -> Opener:
        return lambda: open_simulated_line(chain, baud_at_reset(settings.clock_hz))

    @override
    def sim_options(self) -> Sequence[click.Option]:
        return (
            click.Option(["--chain"], help=f"The modules in daisy-chain order, of: {', '.join(MODELS)}."),
            click.Option(
                ["--file"], type=click.Path(path_type=Path), help="The modules and what happens to them (TOML)."
            ),
        )

    @override
    def served(self, options: Mapping[str, Any], faults: Callable[[int], FaultPlan]) -> ServedLine | None:
        chain, file = options["chain"], options["file"]
        if chain is None and file is None:
            return None
        if chain is not None and file is not None:
            raise click.UsageError("a line is described either by --chain or by --file")
        spec = _named(chain, options["seed"]) if file is None else _written(file, options["seed"])
        more = (*spec.faults.faults, *faults(spec.seed).faults)
        spec = replace(spec, baud_check=spec.baud_check or options["baud_check"], faults=FaultPlan(more, spec.seed))
        described = {
            "modules": [module.name for module in spec.modules],
            "baud_check": spec.baud_check,
            "seed": spec.seed,
        }
        return ServedLine(build_chain(spec), described, RESET_BAUD, PacketReader, baud_check=spec.baud_check)


SIMULATED_LDCN = SimulatedLdcn()


def _named(chain: str, seed: int | None) -> ChainSpec:
    names = [OLD_NAMES.get(name, name) for name in chain.replace(",", " ").split()]
    unknown = [name for name in names if name not in MODELS]
    if unknown or not names:
        wrong = f"no such module: {', '.join(unknown)}" if unknown else "no module"
        raise ConfigError(f"--chain: {wrong}; known are {', '.join(MODELS)}")
    modules = tuple(ModuleSpec(name) for name in names)
    return ChainSpec(modules, baud_check=False, seed=DEFAULT_SEED if seed is None else seed)


def _written(file: Path, seed: int | None) -> ChainSpec:
    config = read_toml(file, SimulationConfig)
    if seed is not None:
        config = config.model_copy(update={"seed": seed})
    return config.spec(baud_check=config.baud_check, delivery=config.delivery)
