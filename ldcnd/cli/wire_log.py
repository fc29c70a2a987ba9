"""`ldcnd bus wire-log`: what was on a line, from a running daemon or a capture, in each of its forms."""

import json
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

import click

from ldcnd.cli.connection import Target, with_target
from ldcnd.cli.typed import Finite, NewFile, force_option, is_file
from ldcnd.client.events import fetch_wire_log
from ldcnd.client.rig_client import RigClient
from ldcnd.contract.errors import ConfigError
from ldcnd.contract.rig_commands import WireLogReply
from ldcnd.daemon.capture import config_of
from ldcnd.drives.known import FAMILIES
from ldcnd.line.capture import Capture, CaptureHeader, capture_lines, parse_capture
from ldcnd.line.flight_recorder import Describe, WireEvent, WireRecord, parse_records

FOR_WIRESHARK = "ldcnd.ops"
"""It is named, as in `names.COMMANDS`: every other form does without the wing."""
TEXT, WORDS, PCAPNG = FORMATS = ("text", "words", "pcapng")

FORMAT = click.option(
    "--format", "form", type=click.Choice(FORMATS), help="[default: by the suffix of --out, else text]"
)
OUT = click.option("--out", type=NewFile(), help="Write a file instead of printing.")


def _install_dissector(context: click.Context, _option: click.Parameter, wanted: bool) -> None:  # noqa: FBT001 - click's
    if wanted and not context.resilient_parsing:
        click.echo(import_module(f"{FOR_WIRESHARK}.dissector").install(Path.home()))
        context.exit()


DISSECTOR = click.option(
    "--dissector",
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=_install_dissector,
    help="Install the dissector of these lines for Wireshark and tshark of this user, print its file, and end.",
)


@click.command()
@click.argument("what", metavar="WHAT")
@click.option(
    "--seconds",
    type=Finite(0, 86_400, min_open=True),
    default=10.0,
    show_default=True,
    help="How far back.",
)
@FORMAT
@OUT
@force_option
@DISSECTOR
@with_target
def command(target: Target, what: str, seconds: float, form: str | None, out: Path | None) -> None:
    """Show what was on the line WHAT in the last seconds, or what is in the capture WHAT, or write it to a file.

    A name with a dot or a slash is a capture, which is shown whole.

    text is a capture: bytes, with their meaning as comments. words has the meaning alone. pcapng is for Wireshark with
    the plugin of --dissector. --json prints or writes one object a record instead.
    """
    if is_file(what):
        capture, describe = _captured(Path(what))
        _render(capture, describe, form, out, as_json=target.as_json)
        return
    log, header, describe = target.run(lambda client: _fetch(client, what, seconds))
    _render(Capture(header, parse_records(log.lines)), describe, form, out, as_json=target.as_json)
    if lost := log.next_record - log.first_record - len(log.lines):
        click.echo(f"{lost} records were overwritten while they were fetched", err=True)


def _captured(file: Path) -> tuple[Capture, Describe]:
    try:
        text = file.read_text(encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{file}: cannot be read: {error.strerror}") from error
    capture = parse_capture(text)
    models: dict[int, str] = {}
    if capture.header.config:
        (line,) = config_of(capture.header).bus
        models = {each.address: each.model for each in (*line.axis, *getattr(line, "module", ()))}
    return capture, FAMILIES[capture.header.family].describe(models)


def _render(capture: Capture, describe: Describe, form: str | None, out: Path | None, *, as_json: bool) -> None:
    header, records = capture.header, capture.records
    form = form or (PCAPNG if out and out.suffix == ".pcapng" else TEXT)
    if form == PCAPNG and not as_json:
        if out is None:
            raise click.UsageError("pcapng is not for a terminal: name a file with --out")
        out.write_bytes(import_module(f"{FOR_WIRESHARK}.pcapng").encode_pcapng(records, header.bus, header.zero_ns))
        return
    make = _json_lines if as_json else capture_lines if form == TEXT else _word_lines
    text = "\n".join(make(header, records, describe))
    if out:
        out.write_text(f"{text}\n", encoding="utf-8")
    else:
        click.echo(text)


async def _fetch(client: RigClient, bus: str, seconds: float) -> tuple[WireLogReply, CaptureHeader, Describe]:
    log = await fetch_wire_log(client, bus, seconds)
    daemon = await client.daemon()
    line = next(line for line in await client.buses() if line.bus == bus)
    header = CaptureHeader(
        version=daemon.version,
        bus=bus,
        family=log.family,
        port=line.port,
        baud=line.baud,
        instance=daemon.instance,
        zero_ns=log.zero,
        started_s=log.started,
        until_s=log.now,
        first_record=log.first_record,
    )
    models = {axis.address: axis.model for axis in await client.axes() if axis.bus == bus}
    models |= {module.address: module.model for module in line.modules if module.model}
    return log, header, FAMILIES[log.family].describe(models)


def _word_lines(_header: CaptureHeader, records: tuple[WireRecord, ...], describe: Describe) -> Iterator[str]:
    for record in records:
        words = record.data.decode() if record.event is WireEvent.COMMAND else describe(record)
        guest = f" for {record.guest}" if record.guest and words else ""
        yield f"{record.at_s:.6f} {record.event:<8} {words or record.note}{guest}".rstrip()


def _json_lines(_header: CaptureHeader, records: tuple[WireRecord, ...], describe: Describe) -> Iterator[str]:
    for record in records:
        is_text = record.event is WireEvent.COMMAND
        yield json.dumps(
            {
                "at_s": record.at_s,
                "event": record.event,
                "data": record.data.decode() if is_text else record.data.hex(),
                "note": record.note,
                "words": describe(record),
            }
        )
