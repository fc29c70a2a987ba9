"""SmartSteps on the bench: what `ldcnd doctor`, `scan` and `accept` do with their lines."""

import json
from collections.abc import AsyncGenerator, Callable, Sequence

import click
from typing_extensions import override

from ldcnd.bench.family import BenchFamily, LineTrial, Scan, ScannedDrive, TrialMove
from ldcnd.bench.smartstep.examination import examine
from ldcnd.bench.smartstep.examination import scan as scan_units
from ldcnd.contract.errors import ConfigError
from ldcnd.contract.health import Finding
from ldcnd.drives.family import UnopenedLine
from ldcnd.drives.smartstep.commands import FLUSH
from ldcnd.drives.smartstep.config import SmartStepBusConfig
from ldcnd.drives.smartstep.drive import SmartStepAxis
from ldcnd.drives.smartstep.family import BAUD, SMARTSTEP, open_smartstep_line
from ldcnd.drives.smartstep.network import smartstep_opener
from ldcnd.drives.smartstep.profiles import Framing, SmartStepProfile
from ldcnd.line.bus import Bus
from ldcnd.line.exchange import Resync
from ldcnd.line.port_url import port_opener
from ldcnd.line.settings import BusSettings
from ldcnd.line.transport import Opener

SOFT_PARITY = SmartStepProfile(framing=Framing.SOFT_PARITY)
"""Parity is made here, so that any adapter will do and wrong parity is seen character by character."""


class SmartStepBench(BenchFamily[SmartStepBusConfig]):
    """OMRON SmartStep."""

    @override
    async def examine(self, line: UnopenedLine, settings: SmartStepBusConfig) -> AsyncGenerator[Finding]:
        for axis in line.network.axes.values():
            if isinstance(axis, SmartStepAxis):
                async for finding in examine(line.bus, axis):
                    yield finding

    @override
    def commands(self) -> Sequence[click.Command]:
        from ldcnd.bench.smartstep import verification  # noqa: PLC0415 - only that command needs them

        return verification.commands()

    @override
    def scan(self, port: str, *, give_addresses: bool, opener: Opener | None = None) -> Scan:
        opener = opener or smartstep_opener(port_opener(port, BAUD, "8n1"), SOFT_PARITY)
        resync = Resync(flush=FLUSH, quiet_s=SOFT_PARITY.gap_s, settle_s=SOFT_PARITY.quiet_s)
        bus = Bus(BusSettings("scan", BAUD, margin_s=0.01, attempts=1), opener, resync)
        drives: list[ScannedDrive] = []

        def found(unit: int, text: str) -> None:
            drives.append(ScannedDrive(unit, SMARTSTEP.name, is_axis=True, baud=BAUD, text=text))

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
    ) -> LineTrial:
        axes = [
            {"name": f"unit{number}", "address": number, "model": SMARTSTEP.name, "unit": "count"} for number in units
        ]
        table = {"name": "accept", "port": port, "family": SMARTSTEP.name, "axis": axes}
        try:
            settings = SmartStepBusConfig.model_validate(table)
        except ValueError as error:
            raise ConfigError(f"{port}, units {units}: {error}") from error
        line = open_smartstep_line(settings, opener)
        return LineTrial(line.bus, self.examine(line, settings), settings)


SMARTSTEP_BENCH = SmartStepBench()
