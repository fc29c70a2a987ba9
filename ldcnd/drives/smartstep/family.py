"""The family of SmartSteps: from the configuration of a line to its bus, its plan, its simulator, its tools."""

import json
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import click
from typing_extensions import override

from ldcnd.contract.errors import ConfigError
from ldcnd.contract.health import Finding
from ldcnd.drives.cost import Cost, LineTiming, cost_of
from ldcnd.drives.driver import AxisSpec
from ldcnd.drives.family import (
    ConfigFiles,
    Demand,
    Examines,
    Family,
    HasParameters,
    Line,
    OpenLine,
    Scan,
    ScannedDrive,
    Scans,
    ServedLine,
    ServesLines,
    Trial,
    TrialMove,
    Tries,
    bus_settings,
)
from ldcnd.drives.line_plan import Poll, Urgent
from ldcnd.drives.smartstep.commands import FLUSH
from ldcnd.drives.smartstep.commissioning import examine
from ldcnd.drives.smartstep.commissioning import scan as scan_units
from ldcnd.drives.smartstep.config import (
    SimulatedSmartStepLineConfig,
    SimulatedSmartStepsConfig,
    SimulatedUnitConfig,
    SmartStepAxisConfig,
    SmartStepBusConfig,
    simulated_units,
)
from ldcnd.drives.smartstep.costs import BAUD, price_list, words_of
from ldcnd.drives.smartstep.drive import SmartStepAxis, UnitSpec
from ldcnd.drives.smartstep.ledger import EepromLedger
from ldcnd.drives.smartstep.monitors import HISTORY_LENGTH
from ldcnd.drives.smartstep.network import SmartStepNetwork, smartstep_opener
from ldcnd.drives.smartstep.packet import HIGHEST_UNIT, CommandCutter, SmartStepTranscript
from ldcnd.drives.smartstep.parameter_store import EepromRules
from ldcnd.drives.smartstep.parameters import PARAMETERS, digit_texts
from ldcnd.drives.smartstep.poller import Basic, Item
from ldcnd.drives.smartstep.profiles import SMARTSTEP as PROFILE
from ldcnd.drives.smartstep.profiles import Echo, Framing, SmartStepProfile
from ldcnd.drives.smartstep.transfer import check_values, listed
from ldcnd.drives.toml import read_toml
from ldcnd.drives.transcript import Describe
from ldcnd.line.bus import Bus
from ldcnd.line.port_url import port_opener
from ldcnd.line.resync import Resync
from ldcnd.line.serial_port import Framing as SerialFraming
from ldcnd.line.settings import BusSettings
from ldcnd.line.transport import Opener
from ldcnd.sim.chain import Chain
from ldcnd.sim.faults import FaultPlan
from ldcnd.sim.line import open_simulated_line
from ldcnd.sim.smartstep.cable import smartstep_chain

LEDGER_FILE = "eeprom-writes.json"
DEFAULT_SEED = 1
SOFT_PARITY = SmartStepProfile(framing=Framing.SOFT_PARITY)
"""Parity is made here, so that any adapter will do and wrong parity is seen character by character."""
ALARM_HISTORY_HZ = HISTORY_LENGTH / 60
"""One word a turn: an alarm that came and went between two readings of the state is found within a minute."""


class SmartStepFamily(
    Family[SmartStepBusConfig, SimulatedSmartStepLineConfig],
    Examines[SmartStepBusConfig],
    Tries,
    HasParameters,
    Scans,
    ServesLines,
):
    """OMRON SmartStep."""

    name = "smartstep"
    bus_config = SmartStepBusConfig
    simulated_line = SimulatedSmartStepLineConfig
    simulated_key = "unit"
    examination = (
        "Examine the SmartSteps of one line, best with RUN off; exits with 1 when something must be put right."
    )

    @override
    def open_lines(self, state_dir: Path | None) -> OpenLine[SmartStepBusConfig]:
        ledger = EepromLedger(state_dir / LEDGER_FILE) if state_dir else None
        return partial(open_smartstep_line, ledger=ledger)

    @override
    def plan(self, settings: SmartStepBusConfig) -> Demand:
        timing = LineTiming(BAUD, BAUD, adapter_latency_s=settings.adapter_latency_ms / 1000)
        # the silence before each command counts as the host's
        timing = replace(timing, turnaround_s=max(timing.turnaround_s, PROFILE.quiet_s))
        return Demand(timing, _polls(settings, timing), _urgent(settings, timing), by_deadline=False)

    @override
    def describe(self, models: Mapping[int, str]) -> Describe:
        return SmartStepTranscript().describe

    @override
    def simulate(self, line: SimulatedSmartStepLineConfig, settings: SmartStepBusConfig, starts_at_s: float) -> Chain:
        profile = settings.profile(settings.axis[0])
        return smartstep_chain(
            simulated_units(line.unit, starts_at_s),
            profile.wiring,
            profile.framing,
            echo=profile.echo is Echo.EXPECT,
            faults=line.faults(starts_at_s),
        )

    @override
    async def examine(self, line: Line, settings: SmartStepBusConfig) -> AsyncIterator[Finding]:
        for axis in line.network.axes.values():
            if isinstance(axis, SmartStepAxis):
                async for finding in examine(line.bus, axis):
                    yield finding

    @override
    def commands(self, files: ConfigFiles) -> Sequence[click.Command]:
        from ldcnd.drives.smartstep import tools  # noqa: PLC0415 - only that command needs them

        return tools.commands(files)

    @override
    def scan(self, port: str, *, give_addresses: bool, opener: Opener | None = None) -> Scan:
        opener = opener or smartstep_opener(port_opener(port, BAUD, "8n1"), SOFT_PARITY)
        bus = Bus(BusSettings("scan", BAUD, margin_s=0.01, attempts=1), opener)
        bus.resync = Resync(flush=FLUSH, quiet_s=SOFT_PARITY.gap_s, settle_s=SOFT_PARITY.quiet_s, probe=lambda _: None)
        drives: list[ScannedDrive] = []

        def found(unit: int, text: str) -> None:
            drives.append(ScannedDrive(unit, self.name, is_axis=True, baud=BAUD, text=text))

        return Scan(bus, scan_units(bus, SOFT_PARITY, found), drives)

    @override
    def configured_line(self, name: str, port: str, drives: Sequence[ScannedDrive]) -> str:
        return f"""
[[bus]]
name = "{name}"
port = {json.dumps(port)}
family = "smartstep"
smartstep = {{ framing = "8n1-soft-parity" }}  # as the scan used it; "7e1" where the adapter makes parity itself
"""

    @override
    def configured_drive(self, name: str, drive: ScannedDrive) -> str:
        return f"""
[[bus.axis]]  # {drive.text}
name = "{name}"
address = {drive.address}
model = "{drive.model}"
unit = "count"  # your unit, and counts_per_unit = counts of one of it
rates = {{ position = 0.5, velocity = 1, state = 1 }}
"""

    @override
    def trial(
        self,
        port: str,
        units: Sequence[int],
        move: TrialMove | None,
        held: Callable[[], bool],
        opener: Opener | None = None,
    ) -> Trial:
        axes = [{"name": f"unit{number}", "address": number, "model": self.name, "unit": "count"} for number in units]
        table = {"name": "accept", "port": port, "family": self.name, "axis": axes}
        try:
            settings = SmartStepBusConfig.model_validate(table)
        except ValueError as error:
            raise ConfigError(f"{port}, units {units}: {error}") from error
        line = open_smartstep_line(settings, opener)
        line.bus.resync = line.network.resync
        return Trial(line.bus, self.examine(line, settings), settings)

    @override
    def check_parameters(self, values: Mapping[str, int]) -> tuple[tuple[str, ...], tuple[str, ...]]:
        return check_values(values)

    @override
    def parameter(self, name: str, value: int) -> tuple[str, str, Sequence[str]]:
        parameter = listed(name)
        if parameter is None:
            return name, str(value), ()
        return (
            parameter.label,
            f"0x{value:04X}" if parameter.nibbles else str(value),
            digit_texts(parameter, value),
        )

    @override
    def sim_options(self) -> Sequence[click.Option]:
        meaning = "SmartSteps instead: unit numbers such as 1,2, or a file with their tables (TOML)."
        return (click.Option([f"--{self.name}"], help=meaning),)

    @override
    def served(self, options: Mapping[str, Any], faults: Callable[[int], FaultPlan]) -> ServedLine | None:
        described = options[self.name]
        if described is None:
            return None
        config = _described(described)
        plan = faults(DEFAULT_SEED if options["seed"] is None else options["seed"])
        chain = smartstep_chain(simulated_units(config.unit, 0.0), config.wiring, config.framing, faults=plan)
        return ServedLine(chain, {"units": [unit.number for unit in config.unit]}, BAUD, CommandCutter)


SMARTSTEP = SmartStepFamily()


def open_smartstep_line(
    settings: SmartStepBusConfig,
    opener: Opener | None = None,
    chain: Chain | None = None,
    *,
    ledger: EepromLedger | None = None,
) -> Line:
    """Return a line that is not open yet; what concerns the line is the same for all of its drives.

    Args:
        settings: the line.
        opener: opens the line, its framing included, instead of its port.
        chain: that it is, when it is simulated.
        ledger: counts EEPROM writes.
    """
    profile = settings.profile(settings.axis[0])
    bus = Bus(
        bus_settings(
            settings, BAUD, margin_s=profile.quiet_s, attempts=profile.attempts, echo=profile.echo is Echo.EXPECT
        ),
        opener or smartstep_opener(_opener(settings, profile, chain), profile),
    )
    specs = tuple(
        UnitSpec(
            AxisSpec(axis.name, axis.address, axis.model, None),
            settings.profile(axis),
            rates_hz(axis),
            EepromRules(ledger, axis.smartstep.eeprom_budget),
        )
        for axis in settings.axis
    )
    return Line(bus, SmartStepNetwork(bus, specs))


def _opener(settings: SmartStepBusConfig, profile: SmartStepProfile, chain: Chain | None) -> Opener:
    if chain is not None:
        return lambda: open_simulated_line(chain)
    framing: SerialFraming = "7e1" if profile.framing is Framing.SEVEN_EVEN else "8n1"
    return port_opener(settings.port, BAUD, framing, rs485=settings.transmitter)


def _described(text: str) -> SimulatedSmartStepsConfig:
    if not text.replace(",", "").replace(" ", "").isdigit():
        return read_toml(Path(text), SimulatedSmartStepsConfig)
    numbers = [int(number) for number in text.replace(",", " ").split()]
    if len(set(numbers)) < len(numbers) or max(numbers) > HIGHEST_UNIT:
        raise ConfigError(f"--smartstep: {text!r} are not different unit numbers from 0 to {HIGHEST_UNIT}")
    return SimulatedSmartStepsConfig(unit=tuple(SimulatedUnitConfig(number=number) for number in numbers))


# -- the load of a line: items are read word by word, and the words of all its units take turns -------------


def rates_hz(axis: SmartStepAxisConfig) -> Mapping[Item, float]:
    """Return what is read of a unit and how often."""
    rates = axis.rates
    wanted: dict[Item, float] = {
        Basic.STATE: rates.state,
        Basic.VELOCITY: rates.velocity or rates.state,  # whether it moves is part of the state
        Basic.POSITION: rates.position or rates.state / 10,
    }
    wanted[Basic.ALARM_HISTORY] = ALARM_HISTORY_HZ
    audit_s = axis.smartstep.audit_s
    wanted[Basic.PARAMETERS] = len(PARAMETERS) / audit_s if audit_s else 0.0
    wanted.update(axis.smartstep.monitors.items())
    return wanted


def _polls(bus: SmartStepBusConfig, timing: LineTiming) -> list[Poll]:
    """Return every item of every unit with what all its words take together."""
    polls = []
    for axis in bus.axis:
        word = price_list(_planned(axis)).reading(frozenset())
        cost = cost_of(word, timing)
        for item, rate_hz in rates_hz(axis).items():
            if rate_hz > 0:
                words = words_of(item)
                polls.append(
                    Poll(
                        axis=axis.name,
                        items=(item.value,),
                        rate_hz=rate_hz,
                        cost=_times(words, cost),
                        mean_s=words * cost.longest_s,
                        request_bytes=words * len(word.request),
                        reply_bytes=words * word.reply_bytes,
                        exchanges=words,
                    )
                )
    return polls


def _urgent(bus: SmartStepBusConfig, timing: LineTiming) -> Urgent:
    """Return what goes before polls: the exchanges of commissioning and traces; nothing on this line stops a motor."""
    prices = [price_list(_planned(axis)) for axis in bus.axis]
    commands = [cost_of(exchange, timing) for price in prices for exchange in price.commands.values()]
    flush_s = len(prices[0].flush) * timing.bits_per_byte / timing.host_baud
    return Urgent(
        command_s=max(command.longest_s for command in commands),
        stop_s=0.0,
        recovery_s=flush_s + prices[0].settle_s,
        margin_s=bus.margin_ms / 1000,
    )


def _planned(axis: SmartStepAxisConfig) -> SmartStepProfile:
    return replace(PROFILE, first_character_s=axis.smartstep.planned_response_s)


def _times(words: int, cost: Cost) -> Cost:
    return Cost(
        request_s=words * cost.request_s,
        wait_s=words * cost.wait_s,
        reply_s=words * cost.reply_s,
        overhead_s=words * cost.overhead_s,
        ends_early=False,
    )
