"""`ldcnd accept`: try real drives against what the documents say; keeps a report and a capture to send."""

import asyncio
import json
import sys
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import click

from ldcnd.bus.bus import Bus
from ldcnd.daemon.line import acceptance
from ldcnd.drivers.driver import Gains
from ldcnd.drivers.ldcn.registers import RESET_BAUD
from ldcnd.drivers.smartstep.profiles import ASSUMPTIONS as SMARTSTEP_ASSUMPTIONS
from ldcnd.drivers.transcript import describer
from ldcnd.errors import BusDown, ConfigError
from ldcnd.log import configure_logging
from ldcnd.model.health import Finding, Verdict
from ldcnd.transport.port_url import port_opener
from ldcnd.wirelog.capture import Capture, capture_lines

OPEN_TIME_S = 5.0
HELD_S = 1.0
"""The dead-man counts as released when Enter was not pressed for so long."""
GAINS = "kp,kd,ki,il,ol,el"


@click.command()
@click.argument("port", required=False)
@click.option("--family", type=click.Choice(["ldcn", "smartstep"]), default="ldcn", show_default=True)
@click.option("--units", default="1", show_default=True, help="Unit numbers of the SmartSteps, as 1,2.")
@click.option("--out", type=click.Path(path_type=Path, file_okay=False), default=Path("acceptance"), show_default=True)
@click.option("--move", "address", type=click.IntRange(1, 127), help="Let the drive at this address move, too.")
@click.option("--gains", help=f"For the move: {GAINS}.")
@click.option("--counts", type=int, default=2000, show_default=True, help="How far, there and back.")
@click.option("--velocity", type=click.FloatRange(1), default=1000.0, show_default=True, help="Counts per second.")
@click.option("--acceleration", type=click.FloatRange(1), default=10_000.0, show_default=True, help="Counts per s^2.")
@click.option("--list", "list_only", is_flag=True, help="Print the assumptions and what would confirm them, and end.")
def command(  # noqa: PLR0917 - click passes them by name
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

    Reads only, unless --move is given. Then somebody must keep Enter pressed: the drive is stopped when it is released.
    This is no emergency stop; have one within reach. Exits with 1 when an assumption is refuted.
    """
    if list_only:
        _list()
        return
    if port is None:
        raise click.UsageError("name the port that the drives are on")
    configure_logging(level="error")
    move = _move(address, gains, counts, velocity, acceleration)
    findings: list[Finding] = []

    def show(finding: Finding) -> None:
        findings.append(finding)
        refuted = "refuted" if finding.verifies else "open"
        word = {Verdict.FINE: "confirmed", Verdict.LOOK: refuted}.get(finding.verdict, "failed")
        print(f"{finding.axis:8} {word:9} {finding.what:16} {finding.text}", flush=True)

    out.mkdir(parents=True, exist_ok=True)
    if family == "smartstep":
        asyncio.run(_smartstep(port, units, out, show))
    else:
        asyncio.run(_ldcn(port, move, out, show))
    report = out / "report.jsonl"
    report.write_text("".join(f"{finding.model_dump_json()}\n" for finding in findings), encoding="utf-8")
    print(report)
    sys.exit(1 if any(_refutes(finding) for finding in findings) else 0)


def _refutes(finding: Finding) -> bool:
    return finding.verdict is Verdict.WRONG or (finding.verdict is Verdict.LOOK and finding.verifies is not None)


def _list() -> None:
    for each in acceptance.ASSUMPTIONS:
        print(json.dumps({"family": "ldcn", "key": each.key, "says": each.says, "confirmed_by": each.confirmed_by}))
    for doubt in SMARTSTEP_ASSUMPTIONS:
        print(json.dumps({"family": "smartstep", "key": doubt.key, "says": doubt.question}))


def _move(
    address: int | None, gains: str | None, counts: int, velocity: float, acceleration: float
) -> acceptance.TrialMove | None:
    if address is None:
        return None
    numbers = [int(number) for number in (gains or "").split(",") if number.strip().isdigit()]
    if len(numbers) != len(GAINS.split(",")):
        raise click.UsageError(f"--move needs --gains {GAINS}, as in the configuration of the axis")
    if not sys.stdin.isatty():
        raise click.UsageError("--move needs a terminal: Enter is the dead-man")
    kp, kd, ki, il, ol, el = numbers
    chosen = Gains(kp=kp, kd=kd, ki=ki, il=il, ol=ol, el=el, cl=0, sr=1, deadband=0)
    return acceptance.TrialMove(address, chosen, counts, velocity, acceleration)


async def _ldcn(port: str, move: acceptance.TrialMove | None, out: Path, show: Callable[[Finding], None]) -> None:
    bus = acceptance.trial_bus(port_opener(port, RESET_BAUD))
    zero_ns = acceptance.zero_ns()
    if move:
        print(
            f"Keep Enter pressed: the drive at address {move.address} moves {move.counts} counts and back.", flush=True
        )
    with _dead_man(wanted=move is not None) as held:
        await _run(bus, port, acceptance.accept(bus, move, held), show)
    _keep(acceptance.capture_of(bus, port, zero_ns), out)


def _keep(capture: Capture, out: Path) -> None:
    text = "\n".join(capture_lines(capture.header, capture.records, describer(capture.header.family, {})))
    (out / "line.capture").write_text(f"{text}\n", encoding="utf-8")


async def _smartstep(port: str, units: str, out: Path, show: Callable[[Finding], None]) -> None:
    try:
        numbers = [int(number) for number in units.split(",")]
    except ValueError:
        raise click.UsageError(f"--units: {units!r} is not like 1,2") from None
    try:
        rig = acceptance.smartstep_rig(port, numbers)
    except ValueError as error:
        raise ConfigError(f"{port}, units {units}: {error}") from error
    zero_ns = acceptance.zero_ns()
    bus, findings = acceptance.accept_smartsteps(rig)
    await _run(bus, port, findings, show)
    _keep(acceptance.capture_of(bus, port, zero_ns, rig), out)


async def _run(bus: Bus, port: str, findings: AsyncIterator[Finding], show: Callable[[Finding], None]) -> None:
    async with asyncio.TaskGroup() as group:
        owner = group.create_task(bus.run(), name="bus accept")
        try:
            async with asyncio.timeout(OPEN_TIME_S):
                await bus.wait_opened()
            async for finding in findings:
                show(finding)
        except TimeoutError:
            why = bus.loss_reason or f"{port} did not open within {OPEN_TIME_S:g} s"
            raise BusDown(why, remedy="end the daemon that has it, or correct the port") from None
        finally:
            owner.cancel()


@contextmanager
def _dead_man(*, wanted: bool) -> Iterator[Callable[[], bool]]:
    """Tell, for as long as the context lasts, whether Enter was pressed just now."""
    loop = asyncio.get_running_loop()
    pressed_at_s = -HELD_S

    def pressed() -> None:
        nonlocal pressed_at_s
        sys.stdin.readline()
        pressed_at_s = loop.time()

    if wanted:
        loop.add_reader(sys.stdin, pressed)
    try:
        yield lambda: loop.time() - pressed_at_s < HELD_S
    finally:
        if wanted:
            loop.remove_reader(sys.stdin)
