"""Commands that use a port themselves: find drives, examine them, try them against the documents."""

import asyncio
import json
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import click

from ldcnd.bench.begun import begun_with, scan_port, write
from ldcnd.bench.family import TrialMove
from ldcnd.bench.known import BENCHES, line_of, ports_here, show_findings
from ldcnd.cli.interrupts import run
from ldcnd.cli.main import CommandGroup
from ldcnd.cli.output import end_as_interrupted
from ldcnd.cli.typed import CONFIGURATION, Finite, WholeNumber
from ldcnd.config.rig import RigConfig, load_config
from ldcnd.contract.errors import ConfigError, NotSupported
from ldcnd.contract.health import Finding, Verdict
from ldcnd.contract.number_text import NotANumber, read_whole
from ldcnd.drives.driver import Gains
from ldcnd.drives.known import DEFAULT, FAMILIES
from ldcnd.drives.line_config import BusConfig
from ldcnd.line.bus import Bus
from ldcnd.line.capture import Capture, CaptureHeader, capture_lines
from ldcnd.log import configure_logging
from ldcnd.version import version

NOTHING_FOUND = 1
"""Exit code: no drive answers, or something must be put right first."""


@click.command()
@click.argument("port", required=False)
@click.option("--family", type=click.Choice(list(BENCHES)), help="Search for drives of this family only.")
@click.option(
    "--address",
    "give_addresses",
    is_flag=True,
    help="Reset and address a chain on which nothing can be moving; the motors lose their positions.",
)
@click.option(
    "--write",
    "file",
    type=click.Path(path_type=Path, dir_okay=False),
    help="Add what was found and is not in it yet to a configuration, or begin one.",
)
@click.option("--json", "as_json", is_flag=True, help="Print JSON lines.")
def scan(port: str | None, family: str | None, file: Path | None, *, give_addresses: bool, as_json: bool) -> None:
    """Find out which drives are on PORT, at which rate and in which state; no daemon may use it meanwhile.

    Listens, then probes addresses 1 to 32, or units 0 to F, at every rate: 10 to 20 seconds. It only reads: nothing
    moves, nothing is reset, nothing gets an address, unless --address says so. Exits with 1 when no drive is found.

    Without PORT it opens nothing and lists the serial ports of this machine: the name to write into a configuration,
    the driver, how long it keeps a reply back, who has it, and the adapter.
    """
    if port is None:
        if family or file or give_addresses:
            raise click.UsageError("--family, --write and --address go with a PORT; `ldcnd scan` alone lists the ports")
        sys.exit(0 if _list_ports(as_json=as_json) else NOTHING_FOUND)
    if Path(port).exists():
        port = str(Path(port).absolute())  # as `ldcnd sim --pty` takes it
    configure_logging(level="error")  # findings say the rest
    wrong = False

    def show(finding: Finding) -> None:
        nonlocal wrong
        wrong = wrong or finding.verdict is Verdict.WRONG
        remedy = f"\n{'':28}> {finding.remedy}" if finding.remedy else ""
        text = f"{finding.axis:8} {finding.verdict:5} {finding.what:12} {finding.text}{remedy}"
        print(finding.model_dump_json() if as_json else text, flush=True)

    for name in (family,) if family else BENCHES:
        if not as_json:
            print(f"searching for {name} drives", file=sys.stderr, flush=True)
        wrong = False
        drives = run(partial(scan_port, BENCHES[name], port, show, give_addresses=give_addresses))
        if drives:
            if file:
                print("\n".join(write(begun_with(file, name, port, drives))), file=sys.stderr)
            break
    sys.exit(NOTHING_FOUND if wrong or not drives else 0)


def _list_ports(*, as_json: bool) -> bool:
    """Print the serial ports of this machine; tell whether there are any."""
    found = ports_here()
    width = max((len(each.port) for each in found), default=0)
    for each in found:
        driver = each.adapter.driver if each.adapter else ""
        if as_json:
            row = {"port": each.port, "node": each.node, "driver": driver, "keeps_back": each.keeps_back}
            print(json.dumps(row | {"held_by": each.held_by, "adapter": each.what, "hardware": each.hardware}))
            continue
        held = f"held by {', '.join(each.held_by)}" if each.held_by else "free"
        said = (each.node, driver, each.keeps_back and f"keeps replies back for {each.keeps_back}", held, each.what)
        print(f"{each.port:{width}}  {', '.join(filter(None, said))}")
    if not found and not as_json:
        print("this machine has no serial port: plug an adapter in; `dmesg` shows what becomes of it", file=sys.stderr)
    return bool(found)


class Examinations(CommandGroup):
    """What else families can examine, beside a line."""

    def list_commands(self, ctx: click.Context) -> list[str]:  # noqa: ARG002 - click's signature
        """Return the names of all commands."""
        return list(self._commands())

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Return the command of that name."""
        self.commands = self._commands()
        return super().get_command(ctx, cmd_name)

    @staticmethod
    def _commands() -> dict[str, click.Command]:
        return {str(each.name): each for family in BENCHES.values() for each in family.commands()}


@click.command(cls=Examinations, invoke_without_command=True)
@click.option("--config", type=CONFIGURATION, help="The rig's configuration (TOML).")
@click.option("--bus", "name", help="The line to examine.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON lines.")
def doctor(config: Path | None, name: str | None, *, as_json: bool) -> None:
    """Examine adapter, drives and timing of a line; only reads by default. No daemon may use it meanwhile.

    A SmartStep line is best examined with RUN off. Exits with 1 when something must be put right.
    """
    if click.get_current_context().invoked_subcommand:
        return
    if config is None or name is None:
        raise click.UsageError("name the configuration with --config and the line with --bus")
    rig = load_config(config)
    settings = next((bus for bus in rig.bus if bus.name == name), None)
    if settings is None:
        lines = ", ".join(bus.name for bus in rig.bus)
        raise ConfigError(f"{config}: no line {name!r}; there are {lines}")
    wrong = False

    def show(finding: Finding) -> None:
        nonlocal wrong
        wrong = wrong or finding.verdict is Verdict.WRONG
        assumption = f"  [{finding.verifies}]" if finding.verifies else ""
        remedy = f"\n{'':31}> {finding.remedy}" if finding.remedy else ""
        text = f"{finding.axis:8} {finding.verdict:5} {finding.what:16} {finding.text}{assumption}{remedy}"
        print(finding.model_dump_json() if as_json else text, flush=True)

    configure_logging(level="error")  # findings say the rest
    run(partial(examine_line, rig, settings, show))
    sys.exit(1 if wrong else 0)


async def examine_line(rig: RigConfig, settings: BusConfig, show: Callable[[Finding], None]) -> None:
    """Open a line, examine it and every configured drive on it, and close it.

    Raises:
        BusDown: the port does not open.
    """
    family = BENCHES.get(settings.family)
    if family is None:
        raise NotSupported(f"bus {settings.name}: lines of family {settings.family} are not examined")
    line = line_of(rig, settings)
    await show_findings(line.bus, settings.port, family.examine(line, settings), show)


HELD_S = 1.0
"""Time without Enter after which the dead-man counts as released, seconds."""
GAINS = "kp,kd,ki,il,ol,el"


@click.command()
@click.argument("port", required=False)
@click.option("--family", type=click.Choice(list(BENCHES)), default=DEFAULT, show_default=True)
@click.option("--units", default="1", show_default=True, help="Unit numbers, as 1,2, of drives that have some.")
@click.option("--out", type=click.Path(path_type=Path, file_okay=False), default=Path("acceptance"), show_default=True)
@click.option("--move", "address", type=WholeNumber(1, 127), help="Let the drive at this address move, too.")
@click.option("--gains", help=f"For the move: {GAINS}.")
@click.option("--counts", type=WholeNumber(), default=2000, show_default=True, help="How far, there and back.")
@click.option("--velocity", type=Finite(1), default=1000.0, show_default=True, help="Counts per second.")
@click.option("--acceleration", type=Finite(1), default=10_000.0, show_default=True, help="Counts per s^2.")
@click.option("--list", "list_only", is_flag=True, help="Print the assumptions and what would confirm them, and end.")
def accept(  # noqa: PLR0917 - click passes them by name
    port: str | None,
    family: str,
    units: str,
    out: Path,
    address: int | None,
    gains: str | None,
    counts: int,
    velocity: float,
    acceleration: float,
    *,
    list_only: bool,
) -> None:
    """Try the drives on PORT, which no daemon may use meanwhile.

    Reads only, unless --move is given. Then you must keep Enter pressed: the drive is stopped when it is released.
    This is no emergency stop; have one within reach. Exits with 1 when an assumption is refuted.
    """
    if list_only:
        _list(family)
        return
    if port is None:
        raise click.UsageError("name the port that the drives are on")
    configure_logging(level="error")
    end_as_interrupted()  # a terminal that goes is a hand that has let go: the drive is stopped first
    move = _move(address, gains, counts, velocity, acceleration)
    findings: list[Finding] = []

    def show(finding: Finding) -> None:
        findings.append(finding)
        refuted = "refuted" if finding.verifies else "open"
        word = {Verdict.FINE: "confirmed", Verdict.LOOK: refuted}.get(finding.verdict, "failed")
        print(f"{finding.axis:8} {word:9} {finding.what:16} {finding.text}", flush=True)

    out.mkdir(parents=True, exist_ok=True)
    run(partial(_try, family, port, _numbers(units), move, out, show))
    report = out / "report.jsonl"
    report.write_text("".join(f"{finding.model_dump_json()}\n" for finding in findings), encoding="utf-8")
    print(report)
    sys.exit(1 if any(_refutes(finding) for finding in findings) else 0)


def _refutes(finding: Finding) -> bool:
    return finding.verdict is Verdict.WRONG or (finding.verdict is Verdict.LOOK and finding.verifies is not None)


def _list(family: str) -> None:
    found = BENCHES[family].assumptions()
    if not found:
        click.echo("a trial confirms nothing that this manual leaves open; see `ldcnd doctor`", err=True)
    for each in found:
        print(json.dumps({"family": family, **each}))


def _numbers(units: str) -> tuple[int, ...]:
    try:
        return tuple(read_whole(number) for number in units.split(","))
    except ValueError:
        raise click.UsageError(f"--units: {units!r} is not like 1,2") from None


def _move(
    address: int | None, gains: str | None, counts: int, velocity: float, acceleration: float
) -> TrialMove | None:
    if address is None:
        return None
    try:
        numbers = [read_whole(number) for number in gains.split(",")] if gains else []
    except NotANumber as error:
        raise click.UsageError(f"--gains: {error}") from None
    if len(numbers) != len(GAINS.split(",")):
        raise click.UsageError(f"--move needs --gains {GAINS}, as in the configuration of the axis")
    if not sys.stdin.isatty():
        raise click.UsageError("--move needs a terminal: Enter is the dead-man")
    kp, kd, ki, il, ol, el = numbers
    chosen = Gains(kp=kp, kd=kd, ki=ki, il=il, ol=ol, el=el, cl=0, sr=1, deadband=0)
    return TrialMove(address, chosen, counts, velocity, acceleration)


async def _try(
    family: str,
    port: str,
    units: tuple[int, ...],
    move: TrialMove | None,
    out: Path,
    show: Callable[[Finding], None],
) -> None:
    zero_ns = time.time_ns() - round(asyncio.get_running_loop().time() * 1e9)
    if move:
        print(
            f"Keep Enter pressed: the drive at address {move.address} moves {move.counts} counts and back.", flush=True
        )
    with _dead_man(wanted=move is not None) as held:
        trial = BENCHES[family].trial(port, units, move, held)
        await show_findings(trial.bus, port, trial.findings, show)
    config = RigConfig(rig="accept", bus=(trial.settings,)) if trial.settings else None
    capture = capture_of(trial.bus, family, port, zero_ns, config)
    text = "\n".join(capture_lines(capture.header, capture.records, FAMILIES[family].describe({})))
    (out / "line.capture").write_text(f"{text}\n", encoding="utf-8")


def capture_of(bus: Bus, family: str, port: str, zero_ns: int, config: RigConfig | None = None) -> Capture:
    """Return what was on the line from its opening on.

    Args:
        bus: after the sequence.
        family: of the drives on it.
        port: where it was.
        zero_ns: the wall time at which the loop's clock was 0.
        config: of drives that are not found by themselves.
    """
    records = tuple(bus.wire_log.records())
    header = CaptureHeader(
        version=version(),
        bus=bus.settings.name,
        family=family,
        port=port,
        baud=bus.baud,
        instance="accept",
        zero_ns=zero_ns,
        started_s=records[0].at_s,
        until_s=records[-1].at_s + 1.0,
        first_record=0,
        cause="acceptance of drives",
        config=config.model_dump(mode="json", exclude_defaults=True) if config else None,
    )
    return Capture(header, records)


@contextmanager
def _dead_man(*, wanted: bool) -> Iterator[Callable[[], bool]]:
    """Tell, for as long as the context lasts, whether Enter was pressed just now."""
    loop = asyncio.get_running_loop()
    pressed_at_s = -HELD_S

    def pressed() -> None:
        nonlocal pressed_at_s
        # at its end there is no hand
        pressed_at_s = loop.time() if sys.stdin.readline() else -HELD_S

    if wanted:
        loop.add_reader(sys.stdin, pressed)
    try:
        yield lambda: loop.time() - pressed_at_s < HELD_S
    finally:
        if wanted:
            loop.remove_reader(sys.stdin)
