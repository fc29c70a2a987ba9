"""`ldcnd sim`: a simulated line behind a pseudo-terminal, for any host that speaks to a serial port."""

import json
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Self, TextIO

import click

from ldcnd.config.simulation import FaultPlanConfig, SimulationConfig
from ldcnd.config.toml import read_toml
from ldcnd.drivers.ldcn.packet import HEADER, PacketReader
from ldcnd.drivers.smartstep.config import SimulatedSmartStepsConfig, SimulatedUnitConfig
from ldcnd.drivers.smartstep.packet import HIGHEST_UNIT
from ldcnd.drivers.transcript import describer
from ldcnd.errors import ConfigError
from ldcnd.sim.faults import FaultPlan
from ldcnd.sim.ldcn.chain import MODELS, OLD_NAMES, ChainSpec, ModuleSpec, build_chain
from ldcnd.sim.pty import serve_pty
from ldcnd.sim.smartstep.cable import simulated_units, smartstep_chain
from ldcnd.version import version
from ldcnd.wirelog.capture import CaptureHeader, capture_lines
from ldcnd.wirelog.recorder import WireEvent, WireRecord

DEFAULT_SEED = 1


@click.command()
@click.option("--pty", "link", type=click.Path(path_type=Path), help="Make this symbolic link to the terminal.")
@click.option("--chain", help=f"The modules in daisy-chain order, of: {', '.join(MODELS)}.")
@click.option("--smartstep", help="SmartSteps instead: unit numbers such as 1,2, or a file with their tables (TOML).")
@click.option("--file", type=click.Path(path_type=Path), help="The modules and what happens to them (TOML).")
@click.option("--fault-plan", type=click.Path(path_type=Path), help="What else may go wrong on the wires (TOML).")
@click.option("--baud-check", is_flag=True, help="Bytes at another rate than a module's are garbage to it.")
@click.option("--seed", type=int, help="Of everything that is random: instead of the file's, or of 1.")
@click.option("--wire-log", type=click.Path(path_type=Path), help="Write what the host does to this file (a capture).")
@click.option("--json", "as_json", is_flag=True, help="Print the terminal and the modules as JSON.")
def command(
    link: Path | None,
    chain: str | None,
    smartstep: str | None,
    file: Path | None,
    fault_plan: Path | None,
    seed: int | None,
    wire_log: Path | None,
    *,
    baud_check: bool,
    as_json: bool,
) -> None:
    """Simulate a line of drives in real time until SIGTERM or SIGINT; prints the terminal once it can be opened."""
    if smartstep is not None:
        if chain is not None or file is not None:
            raise click.UsageError("a line has SmartSteps, or the modules of --chain or --file")
        _serve_smartsteps(smartstep, fault_plan, seed, link, as_json=as_json)
        return
    spec = _spec(chain, file, seed)
    spec = replace(spec, baud_check=spec.baud_check or baud_check)
    if fault_plan:
        spec = _with_faults(spec, fault_plan)

    def opened(path: Path) -> None:
        print(_readiness(path, spec) if as_json else path, flush=True)

    with ExitStack() as stack:
        try:
            observer = stack.enter_context(WireLogFile.open(wire_log)) if wire_log else None
        except OSError as error:
            raise click.ClickException(f"no wire log: {error}") from error
        try:
            serve_pty(build_chain(spec), link, baud_check=spec.baud_check, opened=opened, observer=observer)
        except OSError as error:
            raise click.ClickException(f"no terminal: {error}") from error


def _serve_smartsteps(
    described: str, fault_plan: Path | None, seed: int | None, link: Path | None, *, as_json: bool
) -> None:
    """Serve a line of SmartSteps; its rate is always 9600."""
    config = _smartsteps(described)
    faults = read_toml(fault_plan, FaultPlanConfig).fault if fault_plan else ()
    plan = FaultPlan(tuple(fault.spec(0.0) for fault in faults), DEFAULT_SEED if seed is None else seed)
    units = simulated_units(config.unit, 0.0)

    def opened(path: Path) -> None:
        numbers = [unit.number for unit in config.unit]
        print(json.dumps({"terminal": str(path), "units": numbers}) if as_json else path, flush=True)

    try:
        serve_pty(smartstep_chain(units, config.wiring, config.framing, faults=plan), link, opened=opened)
    except OSError as error:
        raise click.ClickException(f"no terminal: {error}") from error


def _smartsteps(described: str) -> SimulatedSmartStepsConfig:
    if not described.replace(",", "").replace(" ", "").isdigit():
        return read_toml(Path(described), SimulatedSmartStepsConfig)
    numbers = [int(number) for number in described.replace(",", " ").split()]
    if len(set(numbers)) < len(numbers) or max(numbers) > HIGHEST_UNIT:
        raise ConfigError(f"--smartstep: {described!r} are not different unit numbers from 0 to {HIGHEST_UNIT}")
    return SimulatedSmartStepsConfig(unit=tuple(SimulatedUnitConfig(number=number) for number in numbers))


class WireLogFile:
    """Writes what passes through the terminal as a capture, record by record, so that a crash loses nothing.

    A record holds one packet of the host with its instant, however the host cut it, or what stood between packets.
    """

    def __init__(self, file: TextIO) -> None:
        self._file = file
        self._describe = describer("ldcn", {})
        self._reader = PacketReader()
        self._pending = bytearray()
        self._baud: int | None = None
        self._at_s = 0.0

    @classmethod
    @contextmanager
    def open(cls, path: Path) -> Iterator[Self]:
        """Create the file and write the header.

        Raises:
            OSError: it cannot be written.
        """
        header = CaptureHeader(
            version=version(),
            bus="simulated",
            family="ldcn",
            port="pty",
            baud=19_200,
            instance="sim",
            zero_ns=time.time_ns(),
            started_s=0.0,
            until_s=0.0,
            first_record=0,
            cause="ldcnd sim --wire-log",
        )
        with path.open("w", encoding="utf-8", buffering=1) as file:
            file.writelines(f"{line}\n" for line in capture_lines(header, (), lambda _: ""))
            log = cls(file)
            yield log
            log.end()

    def sent(self, at_s: float, data: bytes, baud: int | None) -> None:
        """Take bytes of the host."""
        self._at_s = at_s
        if baud is not None and baud != self._baud:
            self._baud = baud
            self._write(WireRecord(at_s, WireEvent.BAUD, note=str(baud)))
        for value in data:
            if value == HEADER and not self._reader.in_packet:
                self._flush(at_s)
            self._pending.append(value)
            if self._reader.feed(value):
                self._flush(at_s)

    def received(self, at_s: float, data: bytes) -> None:
        """Take bytes for the host."""
        self._write(WireRecord(at_s, WireEvent.RECEIVED, data))

    def end(self) -> None:
        """Write what is left of an unfinished packet."""
        self._flush(self._at_s)

    def _flush(self, at_s: float) -> None:
        if self._pending:
            self._write(WireRecord(at_s, WireEvent.SENT, bytes(self._pending)))
            self._pending.clear()

    def _write(self, record: WireRecord) -> None:
        words = self._describe(record)
        self._file.write(f"{record}\n#   {words}\n" if words else f"{record}\n")


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
