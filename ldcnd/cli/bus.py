"""`ldcnd bus`: look at the lines of a running daemon."""

from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

import click

from ldcnd.bus.pcapng import encode_pcapng
from ldcnd.bus.wire_log import WireRecord, parse_records
from ldcnd.cli.connection import Target, with_target
from ldcnd.client.rig_client import RigClient
from ldcnd.client.wire_log import FetchedWireLog, fetch_wire_log
from ldcnd.drivers.ldcn.profiles import PROFILES
from ldcnd.drivers.transcript import Describe, LdcnTranscript, describe_smartstep
from ldcnd.model.axes import AxisInfo


@click.group()
def command() -> None:
    """Look at the lines of a running daemon."""


@command.command("list")
@with_target
def list_buses(target: Target) -> None:
    """Show every line: rate, counters, latencies."""
    for bus in target.run(lambda client: client.buses()):
        health = "up" if bus.up else f"down: {bus.problem}"
        losses = f"{bus.timeouts} timeouts, {bus.corrupt_replies} corrupt, {bus.resent} resent"
        target.show(
            bus,
            f"{bus.bus:10} {bus.port:20} {bus.baud:7d} baud  {health}\n"
            f"           {bus.exchanges} exchanges, {losses}; 99 % of polls within {bus.poll_p99_s * 1e3:.2f} ms",
        )


@command.command("wire-log")
@click.argument("bus")
@click.option(
    "--seconds",
    type=click.FloatRange(0, 3600, min_open=True),
    default=10.0,
    show_default=True,
    help="How far back.",
)
@click.option("--decode", is_flag=True, help="Say in words what each packet means.")
@click.option("--out", type=click.Path(path_type=Path, dir_okay=False), help="Text file, or pcapng by that suffix.")
@with_target
def wire_log(target: Target, bus: str, seconds: float, *, decode: bool, out: Path | None) -> None:
    """Show what was on the line BUS in the last seconds, or write it to a file."""

    async def fetch(client: RigClient) -> tuple[FetchedWireLog, list[AxisInfo]]:
        return await fetch_wire_log(client, bus, seconds), list(await client.axes())

    log, axes = target.run(fetch)
    records = parse_records(log.lines)
    if out and out.suffix == ".pcapng":
        out.write_bytes(encode_pcapng(records, log.bus, log.zero_ns))
    else:
        text = "\n".join((*_heading(log), *(_described(records, _describer(log, axes)) if decode else log.lines)))
        if out:
            out.write_text(f"{text}\n", encoding="utf-8")
        else:
            click.echo(text)
    if log.lost:
        click.echo(f"{log.lost} records were overwritten while they were fetched", err=True)


def _heading(log: FetchedWireLog) -> tuple[str, ...]:
    zero = datetime.fromtimestamp(log.zero_ns / 1e9, UTC).isoformat(timespec="microseconds")
    return (f"# ldcnd wire log: bus {log.bus}, family {log.family}", f"# seconds since {zero}")


def _describer(log: FetchedWireLog, axes: list[AxisInfo]) -> Describe:
    if log.family == "smartstep":
        return describe_smartstep
    here = [axis for axis in axes if axis.bus == log.bus and axis.model in PROFILES]
    return LdcnTranscript({axis.address: PROFILES[axis.model] for axis in here}).describe


def _described(records: tuple[WireRecord, ...], describe: Describe) -> Iterator[str]:
    """Yield each record and, in a comment behind it, what it means: the text still loads back."""
    for record in records:
        yield str(record)
        if words := describe(record):
            yield f"#   {words}"
