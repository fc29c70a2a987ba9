"""`ldcnd sim`: a simulated line behind a pseudo-terminal, for any host that speaks to a serial port."""

import json
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, Self, TextIO

import click

from ldcnd.cli.typed import CONFIGURATION, ForceOption, NewFile, WholeNumber
from ldcnd.drives.known import FAMILIES
from ldcnd.drives.toml import read_toml
from ldcnd.line.capture import CaptureHeader, capture_lines
from ldcnd.line.flight_recorder import WireEvent, WireRecord
from ldcnd.sim.family import PacketCutter, ServedLine
from ldcnd.sim.faults import FaultPlan
from ldcnd.sim.known import SIMULATED
from ldcnd.sim.line_config import FaultPlanConfig
from ldcnd.version import version


def _serve(
    link: Path | None,
    fault_plan: Path | None,
    wire_log: Path | None,
    *,
    as_json: bool,
    **options: Any,  # noqa: ANN401
) -> None:
    """Simulate a line of drives in real time until SIGTERM or SIGINT; prints the terminal once it can be opened."""

    def faults(seed: int) -> FaultPlan:
        plan = read_toml(fault_plan, FaultPlanConfig).fault if fault_plan else ()
        return FaultPlan(tuple(fault.spec(0.0) for fault in plan), seed)

    # the options of a line are shown everywhere; terminals are a part of POSIX
    from ldcnd.sim.pty import serve_pty  # noqa: PLC0415

    family, line = _served(options, faults)

    def opened(path: Path) -> None:
        print(json.dumps({"terminal": str(path), **line.described}) if as_json else path, flush=True)

    with ExitStack() as stack:
        observer = None
        if wire_log:
            try:
                observer = stack.enter_context(WireLogFile.open(wire_log, family, line.cutter(), line.baud))
            except OSError as error:
                raise click.ClickException(f"no wire log: {error}") from error
        try:
            serve_pty(line.chain, link, baud_check=line.baud_check, opened=opened, observer=observer)
        except OSError as error:
            raise click.ClickException(f"no terminal: {error}") from error


def _served(options: Mapping[str, Any], faults: Callable[[int], FaultPlan]) -> tuple[str, ServedLine]:
    found = [(name, line) for name, family in SIMULATED.items() if (line := family.served(options, faults)) is not None]
    if len(found) != 1:
        names = [option.opts[0] for family in SIMULATED.values() for option in family.sim_options()]
        raise click.UsageError(f"a line is described either by {' or by '.join(names)}")
    return found[0]


command = click.Command(
    "sim",
    callback=_serve,
    help=_serve.__doc__,
    params=[
        click.Option(
            ["--pty", "link"], type=click.Path(path_type=Path), help="Make this symbolic link to the terminal."
        ),
        *(option for family in SIMULATED.values() for option in family.sim_options()),
        click.Option(["--fault-plan"], type=CONFIGURATION, help="What else may go wrong on the wires (TOML)."),
        click.Option(["--baud-check"], is_flag=True, help="Bytes at another rate than a module's are garbage to it."),
        click.Option(
            ["--seed"], type=WholeNumber(), help="Of everything that is random: instead of the file's, or of 1."
        ),
        click.Option(
            ["--wire-log"],
            type=NewFile(),
            help="Write what the host does to this file (a capture).",
        ),
        ForceOption(),
        click.Option(["--json", "as_json"], is_flag=True, help="Print the terminal and the modules as JSON."),
    ],
)


class WireLogFile:
    """Writes what passes through the terminal as a capture, record by record, so that a crash loses nothing.

    A record holds one packet of the host with its instant, however the host cut it, or what stood between packets.
    """

    def __init__(self, file: TextIO, family: str, cutter: PacketCutter) -> None:
        self._file = file
        self._describe = FAMILIES[family].describe({})
        self._cutter = cutter
        self._pending = bytearray()
        self._baud: int | None = None
        self._at_s = 0.0

    @classmethod
    @contextmanager
    def open(cls, path: Path, family: str, cutter: PacketCutter, baud: int) -> Iterator[Self]:
        """Create the file and write the header.

        Raises:
            OSError: it cannot be written.
        """
        header = CaptureHeader(
            version=version(),
            bus="simulated",
            family=family,
            port="pty",
            baud=baud,
            instance="sim",
            zero_ns=time.time_ns(),
            started_s=0.0,
            until_s=0.0,
            first_record=0,
            cause="ldcnd sim --wire-log",
        )
        with path.open("w", encoding="utf-8", buffering=1) as file:
            file.writelines(f"{line}\n" for line in capture_lines(header, (), lambda _: ""))
            log = cls(file, family, cutter)
            yield log
            log.end()

    def sent(self, at_s: float, data: bytes, baud: int | None) -> None:
        """Take bytes of the host."""
        self._at_s = at_s
        if baud is not None and baud != self._baud:
            self._baud = baud
            self._write(WireRecord(at_s, WireEvent.BAUD, note=str(baud)))
        for value in data:
            if self._cutter.begins(value):
                self._flush(at_s)
            self._pending.append(value)
            if self._cutter.feed(value):
                self._flush(at_s)

    def received(self, at_s: float, data: bytes) -> None:
        """Take bytes for the host."""
        self._write(WireRecord(at_s, WireEvent.RECEIVED, data))

    def remarked(self, text: str) -> None:
        """Take what a module makes of the host's bytes where no reply shows it, as a comment."""
        self._file.write(f"#   {text}\n")

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
