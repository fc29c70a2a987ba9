"""`ldcnd doctor`: examine a line before a daemon uses it; opens the port itself and only reads."""

import asyncio
import sys
from collections.abc import AsyncIterator, Callable
from pathlib import Path

import click

from ldcnd.bus.bus import Bus
from ldcnd.config.bus import BusConfig
from ldcnd.config.rig import RigConfig, load_config
from ldcnd.daemon.line import examination
from ldcnd.daemon.line.ldcn_line import build_ldcn_line
from ldcnd.daemon.line.smartstep_line import build_line
from ldcnd.drivers.smartstep.commissioning import examine
from ldcnd.drivers.smartstep.drive import SmartStepAxis
from ldcnd.drivers.smartstep.network import SmartStepNetwork
from ldcnd.errors import BusDown, ConfigError
from ldcnd.log import configure_logging
from ldcnd.model.health import Finding, Verdict

OPEN_TIME_S = 5.0


@click.group()
def command() -> None:
    """Examine a line by reading only; no daemon may use it meanwhile."""


@command.command()
@click.option("--config", type=click.Path(path_type=Path), required=True, help="The rig's configuration (TOML).")
@click.option("--bus", "name", required=True, help="The line to examine.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON lines.")
def ldcn(config: Path, name: str, *, as_json: bool) -> None:
    """Examine adapter, drives and timing of an LDCN or NMC line; exits with 1 when something must be put right."""
    _examine(config, name, "ldcn", as_json=as_json)


@command.command()
@click.option("--config", type=click.Path(path_type=Path), required=True, help="The rig's configuration (TOML).")
@click.option("--bus", "name", required=True, help="The line to examine.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON lines.")
def smartstep(config: Path, name: str, *, as_json: bool) -> None:
    """Examine the SmartSteps of one line, best with RUN off; exits with 1 when something must be put right."""
    _examine(config, name, "smartstep", as_json=as_json)


def _examine(config: Path, name: str, family: str, *, as_json: bool) -> None:
    rig = load_config(config)
    settings = next((bus for bus in rig.bus if bus.name == name and bus.family == family), None)
    if settings is None:
        raise ConfigError(f"{config}: no {family} line {name!r}")
    wrong = False

    def show(finding: Finding) -> None:
        nonlocal wrong
        wrong = wrong or finding.verdict is Verdict.WRONG
        assumption = f"  [{finding.verifies}]" if finding.verifies else ""
        remedy = f"\n{'':31}> {finding.remedy}" if finding.remedy else ""
        text = f"{finding.axis:8} {finding.verdict:5} {finding.what:16} {finding.text}{assumption}{remedy}"
        print(finding.model_dump_json() if as_json else text, flush=True)

    configure_logging(level="error")  # findings say the rest
    asyncio.run(examine_line(rig, settings, show))
    sys.exit(1 if wrong else 0)


async def examine_line(rig: RigConfig, settings: BusConfig, show: Callable[[Finding], None]) -> None:
    """Open a line, examine it and every configured drive on it, and close it.

    Raises:
        BusDown: the port does not open.
    """
    bus: Bus
    if settings.family == "smartstep":
        bus, units = build_line(rig, settings, None, {})
        bus.resync = units.resync
        findings = _smartstep(bus, units)
    else:
        bus, network = build_ldcn_line(rig, settings, {})
        bus.resync = network.resync
        findings = examination.examine(bus, network, _as_configured(settings))
    async with asyncio.TaskGroup() as group:
        owner = group.create_task(bus.run(), name=f"bus {settings.name}")
        try:
            await _opened(bus, settings)
            async for finding in findings:
                show(finding)
        finally:
            owner.cancel()


async def _smartstep(bus: Bus, network: SmartStepNetwork) -> AsyncIterator[Finding]:
    for axis in network.axes.values():
        if isinstance(axis, SmartStepAxis):
            async for finding in examine(bus, axis):
                yield finding


def _as_configured(settings: BusConfig) -> examination.LineAsConfigured:
    return examination.LineAsConfigured(
        settings.name, settings.port, settings.adapter_latency_ms, settings.margin_ms, settings.axis[0].model
    )


async def _opened(bus: Bus, settings: BusConfig) -> None:
    try:
        async with asyncio.timeout(OPEN_TIME_S):
            await bus.wait_opened()
    except TimeoutError:
        raise BusDown(
            f"bus {settings.name}: {bus.loss_reason or f'{settings.port} did not open within {OPEN_TIME_S:g} s'}",
            remedy="end the daemon that has it, or correct the port",
        ) from None
