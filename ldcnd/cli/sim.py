"""`ldcnd sim`: a simulated line behind a pseudo-terminal, for any host that speaks to a serial port."""

import json
from dataclasses import replace
from pathlib import Path

import click

from ldcnd.config.simulation import FaultPlanConfig, SimulationConfig
from ldcnd.config.toml import read_toml
from ldcnd.errors import ConfigError
from ldcnd.sim.faults import FaultPlan
from ldcnd.sim.ldcn.chain import MODELS, OLD_NAMES, ChainSpec, ModuleSpec, build_chain
from ldcnd.sim.pty import serve_pty

DEFAULT_SEED = 1


@click.command()
@click.option("--pty", "link", type=click.Path(path_type=Path), help="Make this symbolic link to the terminal.")
@click.option("--chain", help=f"The modules in daisy-chain order, of: {', '.join(MODELS)}.")
@click.option("--file", type=click.Path(path_type=Path), help="The modules and what happens to them (TOML).")
@click.option("--fault-plan", type=click.Path(path_type=Path), help="What else may go wrong on the wires (TOML).")
@click.option("--baud-check", is_flag=True, help="Bytes at another rate than a module's are garbage to it.")
@click.option("--seed", type=int, help="Of everything that is drawn by lot: instead of the file's, or of 1.")
@click.option("--json", "as_json", is_flag=True, help="Print the terminal and the modules as JSON.")
def command(
    link: Path | None,
    chain: str | None,
    file: Path | None,
    fault_plan: Path | None,
    seed: int | None,
    *,
    baud_check: bool,
    as_json: bool,
) -> None:
    """Simulate a line of drives in real time until SIGTERM or SIGINT; prints the terminal once it can be opened."""
    spec = _spec(chain, file, seed)
    spec = replace(spec, baud_check=spec.baud_check or baud_check)
    if fault_plan:
        spec = _with_faults(spec, fault_plan)

    def opened(path: Path) -> None:
        print(_readiness(path, spec) if as_json else path, flush=True)

    try:
        serve_pty(build_chain(spec), link, baud_check=spec.baud_check, opened=opened)
    except OSError as error:
        raise click.ClickException(f"no terminal: {error}") from error


def _spec(chain: str | None, file: Path | None, seed: int | None) -> ChainSpec:
    if chain is not None and file is None:
        return _spec_of_names(chain, seed)
    if file is not None and chain is None:
        return _spec_of_file(file, seed)
    raise click.UsageError("a line is described either by --chain or by --file")


def _spec_of_names(chain: str, seed: int | None) -> ChainSpec:
    names = [OLD_NAMES.get(name, name) for name in chain.replace(",", " ").split()]
    unknown = [name for name in names if name not in MODELS]
    if unknown or not names:
        wrong = f"no such module: {', '.join(unknown)}" if unknown else "no module"
        raise ConfigError(f"--chain: {wrong}; known are {', '.join(MODELS)}")
    modules = tuple(ModuleSpec(name) for name in names)
    return ChainSpec(modules, baud_check=False, seed=DEFAULT_SEED if seed is None else seed)


def _spec_of_file(file: Path, seed: int | None) -> ChainSpec:
    config = read_toml(file, SimulationConfig)
    if seed is not None:
        config = config.model_copy(update={"seed": seed})
    return config.spec(baud_check=config.baud_check, delivery=config.delivery)


def _with_faults(spec: ChainSpec, file: Path) -> ChainSpec:
    """Add the faults of a file to those of the line."""
    plan = read_toml(file, FaultPlanConfig)
    faults = (*spec.faults.faults, *(fault.spec(0.0) for fault in plan.fault))
    return replace(spec, faults=FaultPlan(faults, spec.seed))


def _readiness(path: Path, spec: ChainSpec) -> str:
    return json.dumps(
        {
            "terminal": str(path),
            "modules": [module.name for module in spec.modules],
            "baud_check": spec.baud_check,
            "seed": spec.seed,
        }
    )
