"""LDCN and NMC drives on the bench: what `ldcnd doctor`, `scan` and `accept` do with their lines."""

from collections.abc import AsyncGenerator, Callable, Mapping, Sequence

from typing_extensions import override

from ldcnd.bench.family import BenchFamily, LineTrial, Scan, ScannedDrive, TrialMove
from ldcnd.bench.ldcn import acceptance, examination, scan
from ldcnd.contract.health import Finding
from ldcnd.drives.family import UnopenedLine
from ldcnd.drives.ldcn.config import LdcnBusConfig
from ldcnd.drives.ldcn.network import LdcnNetwork
from ldcnd.drives.ldcn.registers import RESET_BAUD
from ldcnd.line.port_url import port_opener
from ldcnd.line.transport import Opener


class LdcnBench(BenchFamily[LdcnBusConfig]):
    """LDCN (Logosol) and NMC (J R Kerr)."""

    is_tuned_by_host = True

    @override
    def examine(self, line: UnopenedLine, settings: LdcnBusConfig) -> AsyncGenerator[Finding]:
        if not isinstance(line.network, LdcnNetwork):
            raise TypeError(f"{settings.name} is no line of this family")
        configured = examination.LineAsConfigured(
            settings.name, settings.port, settings.adapter_latency_ms, settings.margin_ms, settings.axis[0].model
        )
        return examination.examine(line.bus, line.network, configured)

    @override
    def scan(self, port: str, *, give_addresses: bool, opener: Opener | None = None) -> Scan:
        bus = acceptance.trial_bus(opener or port_opener(port, RESET_BAUD))
        look = scan.LineScan(bus, port, give_addresses=give_addresses)
        return Scan(bus, look.findings(), look.drives)

    @override
    def configured_line(self, name: str, port: str, drives: Sequence[ScannedDrive]) -> str:
        return scan.configured_line(name, port, drives)

    @override
    def configured_drive(self, name: str, drive: ScannedDrive) -> str:
        return scan.configured_drive(name, drive)

    @override
    def assumptions(self) -> Sequence[Mapping[str, str]]:
        return [
            {"key": each.key, "says": each.says, "confirmed_by": each.confirmed_by} for each in acceptance.ASSUMPTIONS
        ]

    @override
    def trial(
        self,
        port: str,
        units: Sequence[int],
        move: TrialMove | None,
        held: Callable[[], bool],
        opener: Opener | None = None,
    ) -> LineTrial:
        bus = acceptance.trial_bus(opener or port_opener(port, RESET_BAUD))
        return LineTrial(bus, acceptance.accept(bus, move, held))


LDCN_BENCH = LdcnBench()
