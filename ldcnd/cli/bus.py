"""`ldcnd bus`: show the lines of a running daemon."""

import json
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime
from pathlib import Path
from types import MappingProxyType

import click

from ldcnd.cli.connection import Target, of_options, with_target
from ldcnd.cli.main import CommandGroup
from ldcnd.cli.output import show_lines
from ldcnd.cli.sending import NAME, Shown, derived_question
from ldcnd.cli.typed import Finite, NewFile, force_option, is_file
from ldcnd.client.events import fetch_wire_log
from ldcnd.client.overview import last_bus_health
from ldcnd.client.rig_client import RigClient
from ldcnd.contract.errors import ConfigError
from ldcnd.contract.health import GuestHealth
from ldcnd.contract.leases import GuestSentAway, SendGuestAway
from ldcnd.contract.meta import AxisInfo
from ldcnd.contract.number_text import NotANumber, read_whole
from ldcnd.contract.rig_commands import (
    IoReply,
    OverrideInterlock,
    OverrideReply,
    SetIo,
    SetIoTimer,
    Snapshot,
    SnapshotReply,
    WireLogReply,
)
from ldcnd.daemon.capture import config_of
from ldcnd.drives.known import FAMILIES
from ldcnd.line.capture import Capture, CaptureHeader, capture_lines, parse_capture
from ldcnd.line.flight_recorder import Describe, WireEvent, WireRecord, parse_records

TEXT, WORDS, PCAPNG = FORMATS = ("text", "words", "pcapng")

FORMAT = click.option(
    "--format", "form", type=click.Choice(FORMATS), help="[default: by the suffix of --out, else text]"
)
OUT = click.option("--out", type=NewFile(), help="Write a file instead of printing.")


def _install_dissector(context: click.Context, _option: click.Parameter, wanted: bool) -> None:  # noqa: FBT001 - click's
    if wanted and not context.resilient_parsing:
        from ldcnd.ops.dissector import install  # noqa: PLC0415 - a wing

        click.echo(install(Path.home()))
        context.exit()


DISSECTOR = click.option(
    "--dissector",
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=_install_dissector,
    help="Install the dissector of these lines for Wireshark and tshark of this user, print its file, and end.",
)


@click.group(cls=CommandGroup)
def command() -> None:
    """Show the lines of a running daemon, and what was on them."""


@command.command("set-io")
@click.argument("module")
@click.argument("lines", nargs=-1, metavar="[LINE=LEVEL]...")
@click.option("--pwm1", type=Finite(), help="Share of time for which PWM output 1 is on, 0 to 1.")
@click.option("--pwm2", type=Finite(), help="Likewise output 2.")
@click.option("--lease", envvar="LDCND_LEASE", help="Send it under this lease, as `ldcnd lease hold` prints it.")
@with_target
def set_io(
    target: Target, module: str, lines: tuple[str, ...], pwm1: float | None, pwm2: float | None, lease: str | None
) -> None:
    """Set outputs of the I/O module MODULE: `4=high lock=low 5=input`; what is left out stays as it is."""
    wanted: dict[str, list[int | str]] = {"high": [], "low": [], "input": []}
    for each in lines:
        line, _, level = each.partition("=")
        if level not in wanted:
            raise click.UsageError(f"{each!r} is not LINE=high, LINE=low or LINE=input")
        try:
            wanted[level].append(read_whole(line) if line[:1] in "0123456789" else line)
        except NotANumber as error:
            raise click.UsageError(f"{each!r}: {error}") from None
    given = {"high": wanted["high"], "low": wanted["low"], "inputs": wanted["input"]}
    request = of_options(
        SetIo, module=module, **given, pwm1=pwm1, pwm2=pwm2, lease=lease, client=None if lease else NAME
    )
    target.show(*_shown(target.run(lambda client: client.ask(request))))


def _shown(reply: IoReply) -> tuple[IoReply, str]:
    names = {line: name for name, line in reply.names.items()}
    known = None if reply.outputs is None else ", ".join(names.get(line, str(line)) for line in reply.outputs)
    outputs = "not known" if known is None else known or "none"
    return reply, f"{reply.module}: {_levels(reply.levels, names)}; outputs: {outputs}"


def _levels(levels: tuple[bool, ...], names: Mapping[int, str] = MappingProxyType({})) -> str:
    levelled = enumerate(("high" if level else "low" for level in levels), 1)
    return " ".join(f"{names.get(line, line)}={level}" for line, level in levelled)


def _counted(reply: IoReply, _axis: AxisInfo | None) -> Shown:
    yield reply, _shown(reply)[1:]


def _snapshot(reply: SnapshotReply, _axis: AxisInfo | None) -> Shown:
    lines = [
        f"{each.axis:8} {each.position:14.6f} {each.unit:8} {each.counts:12d} counts"
        f"{'' if each.referenced else '  not homed'}"
        for each in reply.positions
    ]
    lines += [
        f"{each.module:8} {_levels(each.levels)}; count {each.counter}{'' if each.proven else '  not proven'}"
        for each in reply.io
    ]
    yield reply, [*lines, f"all within {reply.t_error_ns / 1e6:.2f} ms of {reply.t / 1e9:.6f} s UTC"]


def _overridden(reply: OverrideReply, _axis: AxisInfo | None) -> Shown:
    yield reply, [f"interlock {reply.interlock} is overridden for {reply.seconds:g} s by {reply.client}"]


def _sent_away(reply: GuestSentAway, _axis: AxisInfo | None) -> Shown:
    controlled = f"; it controlled {', '.join(reply.axes)}" if reply.axes else ""
    yield reply, [f"the program at {reply.port} was sent away{controlled}"]


command.add_command(derived_question("override-interlock", OverrideInterlock, "interlock", shows=_overridden))
command.add_command(derived_question("send-away", SendGuestAway, "port", shows=_sent_away))
command.add_command(derived_question("set-io-timer", SetIoTimer, "module", "mode", shows=_counted))
command.add_command(derived_question("snapshot", Snapshot, "bus", shows=_snapshot))


@command.command("list")
@click.option("--guests", is_flag=True, help="Show every port instead, the program at it, and what it controls.")
@with_target
def list_buses(target: Target, *, guests: bool) -> None:
    """Show every line: rate, counters, latencies."""
    if guests:
        _list_guests(target)
        return
    for bus in target.run(lambda client: client.buses()):
        health = f"up; {bus.problem}".rstrip("; ") if bus.up else f"down: {bus.problem}"
        losses = f"{bus.timeouts} timeouts, {bus.corrupt_replies} corrupt, {bus.resent} resent"
        target.show(
            bus,
            f"{bus.bus:10} {bus.port:20} {bus.baud:7d} baud  {health}",
            f"           {bus.exchanges} exchanges, {losses}; 99 % of polls within {bus.poll_p99_s * 1e3:.2f} ms",
        )


def _list_guests(target: Target) -> None:
    reports = target.run(last_bus_health)
    for bus in reports:
        for guest in bus.guests:
            target.show(guest, f"{guest.port:10} {bus.bus:10} {_doing(guest)}; {guest.refused} refused")
    if not (target.as_json or any(bus.guests for bus in reports)):
        show_lines("no port is served", err=True)


def _doing(guest: GuestHealth) -> str:
    if guest.problem or guest.since is None:
        return guest.problem or "no program"
    holds = f"controls {', '.join(guest.axes)}" if guest.axes else "controls nothing"
    since = datetime.fromtimestamp(guest.since / 1e9, UTC).isoformat(timespec="seconds")
    return f"since {since}; {holds}; {guest.packets_hz:.1f} packets/s"


@command.command("wire-log")
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
def wire_log(target: Target, what: str, seconds: float, form: str | None, out: Path | None) -> None:
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
        from ldcnd.ops.pcapng import encode_pcapng  # noqa: PLC0415 - a wing

        out.write_bytes(encode_pcapng(records, header.bus, header.zero_ns))
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
