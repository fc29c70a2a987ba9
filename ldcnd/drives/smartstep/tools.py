"""Tools for SmartSteps: finding out what their manual leaves open."""

import asyncio
import sys
from collections.abc import Awaitable, Callable, Sequence
from enum import StrEnum
from pathlib import Path
from typing import Any, TypeVar

import click

from ldcnd.contract.errors import ConfigError
from ldcnd.drives.family import ConfigFiles
from ldcnd.drives.line_config import BusConfig
from ldcnd.drives.opened import with_line
from ldcnd.drives.smartstep.config import SmartStepBusConfig, SmartStepTraceConfig
from ldcnd.drives.smartstep.drive import SmartStepAxis
from ldcnd.drives.smartstep.family import open_smartstep_line
from ldcnd.drives.smartstep.profiles import TriggerMap, Verification
from ldcnd.drives.smartstep.trigger_search import find_trigger_map
from ldcnd.drives.smartstep.verification import Verified, verify_traces
from ldcnd.line.bus import Bus
from ldcnd.log import configure_logging
from ldcnd.sim.chain import Chain

ResultT = TypeVar("ResultT")
CommandT = TypeVar("CommandT", bound=Callable[..., Any])


def _one_drive(function: CommandT) -> CommandT:
    """Give a command the options that name one SmartStep."""
    options = (
        click.option(
            "--config", type=click.Path(path_type=Path), required=True, help="The rig's configuration (TOML)."
        ),
        click.option("--bus", "name", required=True, help="The line."),
        click.option("--axis", required=True, help="The SmartStep; RUN must be off."),
    )
    for option in reversed(options):
        function = option(function)
    return function


def commands(files: ConfigFiles) -> tuple[click.Command, ...]:
    """Return the commands, which read and write the configuration by `files`."""

    @click.command("trigger-bits")
    @_one_drive
    @click.option("--write", is_flag=True, help="Write the bits into the configuration.")
    def trigger_bits(config: Path, name: str, axis: str, *, write: bool) -> None:
        """Find the trigger bits of a SmartStep by trying words; prompts to turn the shaft and to press RESET."""
        settings = _line_of(files.lines(config), config, name, axis)
        found = asyncio.run(
            _with_drive(
                settings,
                axis,
                lambda _bus, unit: find_trigger_map(unit.words, _act),
                lambda: files.chain(config, settings),
            )
        )
        table = {key: f"0x{getattr(found, key):04X}" for key in TriggerMap.__slots__}
        click.echo("\n".join(f"{key} = {literal}" for key, literal in table.items()))
        if write:
            files.set_for_axis(config, axis, {"smartstep.trace.trigger_map": table})
            click.echo(f"written to {config}")

    @click.command()
    @_one_drive
    @click.option("--write", is_flag=True, help="Write what was verified into the configuration.")
    def verify(config: Path, name: str, axis: str, *, write: bool) -> None:
        """Verify the layout of a SmartStep's traces; prompts to turn the shaft and to send pulses.

        Exits with 1 when something stays open.
        """
        found: list[Verified] = []

        async def work(bus: Bus, unit: SmartStepAxis) -> None:
            async for each in verify_traces(bus, unit.words, unit.profile, _act):
                found.append(each)
                state = "open" if each.setting is None else "verified"
                click.echo(f"{each.key:22} {state:8} {each.text}")

        settings = _line_of(files.lines(config), config, name, axis)
        asyncio.run(_with_drive(settings, axis, work, lambda: files.chain(config, settings)))
        if write:
            files.set_for_axis(config, axis, verified_tables(found))
            click.echo(f"written to {config}")
        sys.exit(1 if any(each.setting is None for each in found) else 0)

    return trigger_bits, verify


def verified_tables(found: Sequence[Verified]) -> dict[str, dict[str, str]]:
    """Return the tables of the configuration that say what was verified."""
    tables: dict[str, dict[str, str]] = {"smartstep": {}, "smartstep.trace": {}, "smartstep.verified": {}}
    for each in found:
        if each.setting is None:
            continue
        key = each.key.removeprefix("trace_")
        table = "smartstep.trace" if key in SmartStepTraceConfig.model_fields else "smartstep"
        tables[table][key] = str(each.setting) if isinstance(each.setting, int) else f'"{each.setting}"'
        tables["smartstep.verified"][each.key] = f'"{Verification.VERIFIED.value}"'
    return {name: values for name, values in tables.items() if values}


async def _act(stimulus: StrEnum) -> None:
    await asyncio.to_thread(click.prompt, f"{stimulus.value}; Enter", default="", show_default=False, err=True)


def _line_of(lines: Sequence[BusConfig], config: Path, name: str, axis: str) -> SmartStepBusConfig:
    for line in lines:
        if line.name == name and isinstance(line, SmartStepBusConfig) and axis in [each.name for each in line.axis]:
            return line
    raise ConfigError(f"{config}: no smartstep line {name!r} with an axis {axis!r}")


async def _with_drive(
    settings: SmartStepBusConfig,
    axis: str,
    work: Callable[[Bus, SmartStepAxis], Awaitable[ResultT]],
    chain: Callable[[], Chain | None],
) -> ResultT:
    """Open the line of a SmartStep, do something with the drive, and close it.

    Raises:
        BusDown: the port does not open.
    """
    configure_logging(level="error")
    line = open_smartstep_line(settings, chain=chain())
    line.bus.resync = line.network.resync
    unit = line.network.axes[axis]
    if not isinstance(unit, SmartStepAxis):
        raise ConfigError(f"{axis} is no SmartStep")
    return await with_line(line.bus, settings.port, lambda: work(line.bus, unit))
