"""`ldcnd bus`: show the lines of a running daemon."""

from collections.abc import Mapping
from datetime import UTC, datetime
from types import MappingProxyType

import click

from ldcnd.cli.connection import Target, of_options, with_target
from ldcnd.cli.halting import NAME
from ldcnd.cli.main import CommandGroup
from ldcnd.cli.output import show_lines
from ldcnd.cli.sending import Shown, derived_question
from ldcnd.cli.typed import Finite
from ldcnd.client.overview import last_bus_health
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
)


@click.group(cls=CommandGroup, homes={"wire-log": "ldcnd.cli.wire_log"})
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
    # the level of a pin is not the value of an input, which may be inverted and debounced: topics have that
    names = {line: name for name, line in reply.names.items() if line in (reply.outputs or ())}
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
    how = f"is overridden for {reply.seconds:g} s by {reply.client}" if reply.seconds else "binds"
    yield reply, [f"interlock {reply.interlock} {how}"]


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
            f"           {bus.exchanges} exchanges, {losses}",
            f"           99 % of polls within {bus.poll_p99_s * 1e3:.2f} ms",
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
