"""`ldcnd doctor verify`: comparing what the manual of a SmartStep leaves open about traces with the drive."""

import asyncio
import sys
from collections.abc import Awaitable, Callable, Sequence
from pathlib import Path

import click

from ldcnd.bench.known import line_of
from ldcnd.bench.opened import with_line
from ldcnd.bench.smartstep.verification import KEYS, Verified, verify_traces
from ldcnd.config.edit import set_for_axis
from ldcnd.config.rig import RigConfig, load_config
from ldcnd.contract.errors import ConfigError
from ldcnd.drives.smartstep.config import SmartStepBusConfig
from ldcnd.drives.smartstep.drive import SmartStepAxis
from ldcnd.line.bus import Bus
from ldcnd.log import configure_logging


def commands() -> tuple[click.Command, ...]:
    """Return the commands."""

    @click.command()
    @click.option("--config", type=click.Path(path_type=Path), required=True, help="The rig's configuration (TOML).")
    @click.option("--bus", "name", required=True, help="The line.")
    @click.option("--axis", required=True, help="The SmartStep; RUN must be off.")
    @click.option("--write", is_flag=True, help="Write what was verified into the configuration.")
    def verify(config: Path, name: str, axis: str, *, write: bool) -> None:
        """Verify the layout of a SmartStep's traces; prompts to send command pulses.

        The values of its traces are uncertain until the configuration says `verified`, which --write does when nothing
        stays open. Exits with 1 when something stays open.
        """
        found: list[Verified] = []

        async def work(bus: Bus, unit: SmartStepAxis) -> None:
            async for each in verify_traces(bus, unit.words, unit.profile, _act):
                found.append(each)
                state = "open" if each.setting is None else "verified"
                click.echo(f"{each.key:22} {state:8} {each.text}")

        asyncio.run(_with_drive(config, name, axis, work))
        if write:
            set_for_axis(config, axis, {"smartstep.trace": verified_keys(found)})
            click.echo(f"written to {config}")
        sys.exit(1 if any(each.setting is None for each in found) else 0)

    return (verify,)


def verified_keys(found: Sequence[Verified]) -> dict[str, str]:
    """Return the keys of the configuration's table `smartstep.trace` that say what was verified."""
    settings = {each.key: each.setting for each in found if each.setting is not None}
    keys = {
        key.removeprefix("trace_"): str(setting) if isinstance(setting, int) else f'"{setting}"'
        for key, setting in settings.items()
    }
    if settings.keys() >= set(KEYS):
        keys["verified"] = "true"
    return keys


async def _act(request: str) -> None:
    await asyncio.to_thread(click.prompt, f"{request}; Enter", default="", show_default=False, err=True)


def _line_of(rig: RigConfig, config: Path, name: str, axis: str) -> SmartStepBusConfig:
    for line in rig.bus:
        if line.name == name and isinstance(line, SmartStepBusConfig) and axis in [each.name for each in line.axis]:
            return line
    raise ConfigError(f"{config}: no smartstep line {name!r} with an axis {axis!r}")


async def _with_drive(
    config: Path, name: str, axis: str, work: Callable[[Bus, SmartStepAxis], Awaitable[None]]
) -> None:
    """Open the line of a SmartStep, do something with the drive, and close it.

    Raises:
        BusDown: the port does not open.
    """
    configure_logging(level="error")
    rig = load_config(config)
    settings = _line_of(rig, config, name, axis)
    line = line_of(rig, settings)
    unit = line.network.axes[axis]
    if not isinstance(unit, SmartStepAxis):
        raise ConfigError(f"{axis} is no SmartStep")
    await with_line(line.bus, settings.port, lambda: work(line.bus, unit))
