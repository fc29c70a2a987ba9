"""`ldcnd doctor`: examine a line before a daemon uses it; opens the port itself, reads unless told otherwise."""

import asyncio
import sys
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from enum import StrEnum
from pathlib import Path
from typing import Any, TypeVar

import click

from ldcnd.bus.bus import Bus
from ldcnd.bus.resync import Resync
from ldcnd.bus.settings import BusSettings
from ldcnd.config.bus import BusConfig
from ldcnd.config.edit import set_for_axis
from ldcnd.config.rig import RigConfig, load_config
from ldcnd.daemon.line import examination
from ldcnd.daemon.line.ldcn_line import build_ldcn_line
from ldcnd.daemon.line.smartstep_line import build_line
from ldcnd.drivers.smartstep.commands import FLUSH
from ldcnd.drivers.smartstep.commissioning import examine
from ldcnd.drivers.smartstep.commissioning import scan as scan_units
from ldcnd.drivers.smartstep.config import SmartStepTraceConfig
from ldcnd.drivers.smartstep.drive import SmartStepAxis
from ldcnd.drivers.smartstep.network import BAUD, SmartStepNetwork, smartstep_opener
from ldcnd.drivers.smartstep.profiles import Framing, SmartStepProfile, TriggerMap, Verification
from ldcnd.drivers.smartstep.trigger_search import find_trigger_map
from ldcnd.drivers.smartstep.verification import Verified, verify_traces
from ldcnd.errors import BusDown, ConfigError
from ldcnd.log import configure_logging
from ldcnd.model.health import Finding, Verdict
from ldcnd.transport.port_url import port_opener
from ldcnd.transport.transport import Opener

ResultT = TypeVar("ResultT")
CommandT = TypeVar("CommandT", bound=Callable[..., Any])
OPEN_TIME_S = 5.0
SOFT_PARITY = SmartStepProfile(framing=Framing.SOFT_PARITY)
"""Parity is made here, so that any adapter will do and wrong parity is seen character by character."""


@click.group()
def command() -> None:
    """Examine a line, by reading unless told otherwise; no daemon may use it meanwhile."""


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


@command.command()
@click.argument("port")
@click.option("--json", "as_json", is_flag=True, help="Print JSON lines.")
def scan(port: str, *, as_json: bool) -> None:
    """Look for SmartSteps on PORT, units 0 to F, and say what is wrong with the wires; exits with 1 without any."""
    found: list[Finding] = []

    def show(finding: Finding) -> None:
        found.append(finding)
        text = f"{finding.axis:8} {finding.verdict:5} {finding.text}"
        print(finding.model_dump_json() if as_json else text, flush=True)

    configure_logging(level="error")
    asyncio.run(scan_line(smartstep_opener(port_opener(port, BAUD, "8n1"), SOFT_PARITY), port, show))
    sys.exit(1 if any(each.verdict is Verdict.WRONG for each in found) else 0)


async def scan_line(opener: Opener, port: str, show: Callable[[Finding], None]) -> None:
    """Open a line, look for SmartSteps on it, and close it.

    Raises:
        BusDown: the port does not open.
    """
    bus = Bus(BusSettings("scan", BAUD, margin_s=0.01, attempts=1), opener)
    bus.resync = Resync(flush=FLUSH, quiet_s=SOFT_PARITY.gap_s, settle_s=SOFT_PARITY.quiet_s, probe=lambda _: None)
    async with asyncio.TaskGroup() as group:
        owner = group.create_task(bus.run(), name="bus scan")
        try:
            await _opened(bus, port)
            async for finding in scan_units(bus, SOFT_PARITY):
                show(finding)
        finally:
            owner.cancel()


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


@command.command("trigger-bits")
@_one_drive
@click.option("--write", is_flag=True, help="Write the bits into the configuration.")
def trigger_bits(config: Path, name: str, axis: str, *, write: bool) -> None:
    """Find the trigger bits of a SmartStep by trying words; asks for the shaft to be turned and RESET to be pressed."""
    found = asyncio.run(_with_drive(config, name, axis, lambda _bus, unit: find_trigger_map(unit.words, _act)))
    table = {key: f"0x{getattr(found, key):04X}" for key in TriggerMap.__slots__}
    print("\n".join(f"{key} = {literal}" for key, literal in table.items()))
    if write:
        set_for_axis(config, axis, {"smartstep.trace.trigger_map": table})
        print(f"written to {config}")


@command.command()
@_one_drive
@click.option("--write", is_flag=True, help="Write what was verified into the configuration.")
def verify(config: Path, name: str, axis: str, *, write: bool) -> None:
    """Verify what a SmartStep's traces look like: strings, words, gear; asks for the shaft to be turned and for pulses.

    Exits with 1 when something stays open.
    """
    found: list[Verified] = []

    async def work(bus: Bus, unit: SmartStepAxis) -> None:
        async for each in verify_traces(bus, unit.words, unit.profile, _act):
            found.append(each)
            state = "open" if each.setting is None else "verified"
            print(f"{each.key:22} {state:8} {each.text}", flush=True)

    asyncio.run(_with_drive(config, name, axis, work))
    if write:
        set_for_axis(config, axis, verified_tables(found))
        print(f"written to {config}")
    sys.exit(1 if any(each.setting is None for each in found) else 0)


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


async def _with_drive(
    config: Path, name: str, axis: str, work: Callable[[Bus, SmartStepAxis], Awaitable[ResultT]]
) -> ResultT:
    """Open the line of a SmartStep, do something with the drive, and close it.

    Raises:
        ConfigError: there is no such line or axis.
        BusDown: the port does not open.
    """
    rig = load_config(config)
    settings = next((bus for bus in rig.bus if bus.name == name and bus.family == "smartstep"), None)
    if settings is None or axis not in [each.name for each in settings.axis]:
        raise ConfigError(f"{config}: no smartstep line {name!r} with an axis {axis!r}")
    configure_logging(level="error")
    bus, units = build_line(rig, settings, None, {})
    bus.resync = units.resync
    unit = units.axes[axis]
    if not isinstance(unit, SmartStepAxis):
        raise ConfigError(f"{axis} is no SmartStep")
    async with asyncio.TaskGroup() as group:
        owner = group.create_task(bus.run(), name=f"bus {settings.name}")
        try:
            await _opened(bus, settings.port)
            return await work(bus, unit)
        finally:
            owner.cancel()


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
            await _opened(bus, settings.port)
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


async def _opened(bus: Bus, port: str) -> None:
    try:
        async with asyncio.timeout(OPEN_TIME_S):
            await bus.wait_opened()
    except TimeoutError:
        raise BusDown(
            f"bus {bus.settings.name}: {bus.loss_reason or f'{port} did not open within {OPEN_TIME_S:g} s'}",
            remedy="end the daemon that has it, or correct the port",
        ) from None
