"""Commands that need neither daemon nor hardware: check and plan a configuration, schemas, certificates."""

import datetime as dt
import json
import sys
from collections.abc import Iterable
from pathlib import Path

import click

from ldcnd.cli.typed import Whole
from ldcnd.config.plan import plan_rig, require_plan
from ldcnd.config.rig import load_config
from ldcnd.contract.errors import ConfigError
from ldcnd.contract.plan import BusPlan
from ldcnd.daemon.assembly import session_settings
from ldcnd.daemon.contract import write_schemas
from ldcnd.net.zenoh_config import zenoh_config
from ldcnd.ops.pki.access import Role


@click.command()
@click.argument("config", type=click.Path(path_type=Path))
@click.option("--json", "as_json", is_flag=True, help="Print the result as JSON.")
def check_config(config: Path, *, as_json: bool) -> None:
    """Validate CONFIG whole, without opening anything; exits with 78 when it cannot work."""
    try:
        rig = load_config(config)
        require_plan(rig)
        zenoh_config(session_settings(rig))
    except ConfigError as error:
        if not as_json:
            raise
        print(json.dumps({"valid": False, "errors": error.message.splitlines()}))
        sys.exit(78)
    axes = [axis.name for bus in rig.bus for axis in bus.axis]
    if as_json:
        print(json.dumps({"valid": True, "rig": rig.rig, "buses": [bus.name for bus in rig.bus], "axes": axes}))
    else:
        print(f"{config}: rig {rig.rig}, {len(rig.bus)} bus(es), axes {', '.join(axes)}: valid")


EXIT_OVERFULL = 1


@click.command()
@click.argument("config", type=click.Path(path_type=Path))
@click.option("--json", "as_json", is_flag=True, help="Print the plan as JSON.")
def plan(config: Path, *, as_json: bool) -> None:
    """Show how much of each line CONFIG uses and how late polls and stops can be; exits with 1 when it cannot hold."""
    plan = plan_rig(load_config(config))
    if as_json:
        print(plan.model_dump_json())
    else:
        print("\n\n".join(_table(bus) for bus in plan.buses))
    if not plan.holds:
        sys.exit(EXIT_OVERFULL)


def _table(bus: BusPlan) -> str:
    assumed = f"{_ms(bus.turnaround_s)} host, {_ms(bus.adapter_latency_s)} adapter, for each exchange"
    stops = [
        f"  stop         {_ms(bus.stop_wait_s)} to its first bit, {_ms(bus.stop_s)} to the drive's answer",
        f"               {_ms(bus.stop_after_loss_s)} to the answer after a lost reply",
    ]
    lines = [
        f"bus {bus.bus}, {bus.baud} baud (drives: {bus.node_baud:.0f}): {'holds' if bus.holds else 'CANNOT HOLD'}",
        f"  load         {bus.load:6.1%} at worst, {bus.mean_load:.1%} on average",
        f"  commands     {bus.commands_per_s:6.0f} /s before a poll misses its turn",
        *(stops if bus.stops else ["  stop         nothing on this line can move or stop a drive"]),
        f"  assumed      {assumed}",
        f"  {'axis':12} {'item':20} {'rate':>8} {'bytes':>7} {'on line':>10} {'read within':>12}",
    ]
    for poll in bus.polls:
        size = f"{poll.request_bytes}/{poll.reply_bytes}"
        remarks = f"{'' if poll.priority == 'normal' else f'  {poll.priority}'}{'' if poll.holds else '  late'}"
        lines += [
            f"  {poll.axis:12} {item.item:20} {item.rate_hz:5g} Hz {size:>7} {_ms(poll.longest_s):>10}"
            f" {_ms(item.response_s):>12}{remarks}"
            for item in poll.items
        ]
    if bus.remedies:
        lines += ["  would hold with any of:", *(f"    {remedy}" for remedy in bus.remedies)]
    return "\n".join(lines)


def _ms(seconds: float | None) -> str:
    return "unbounded" if seconds is None else f"{seconds * 1e3:.2f} ms"


@click.command()
@click.argument("folder", type=click.Path(path_type=Path, file_okay=False), default=Path("schemas"))
def schema(folder: Path) -> None:
    """Write the JSON Schemas of all that crosses the network, and of the configuration, into FOLDER.

    Schemas in it whose models are gone are removed.
    """
    click.echo(f"{write_schemas(folder)} schemas in {folder}")


FOLDER = click.argument("folder", type=click.Path(path_type=Path, file_okay=False))
DAYS = 730


@click.group()
def pki() -> None:
    """Make certificates for mutual TLS, and the access rules that go with them.

    FOLDER belongs to one site. Keep it on one machine: anyone who has ca.key can make operators.
    """


@pki.command()
@FOLDER
@click.option("--name", default="ldcnd site", show_default=True, help="Common name of the authority.")
def init(folder: Path, name: str) -> None:
    """Make the site's authority in FOLDER."""
    _require_cryptography()
    from ldcnd.ops.pki.site import set_up  # noqa: PLC0415 - needs an optional package

    set_up(folder, name, _now())
    click.echo(f"{folder}: authority made; next: ldcnd pki add {folder} NAME --role daemon --ip ADDRESS")


@pki.command()
@FOLDER
@click.argument("name")
@click.option("--role", type=click.Choice([role.value for role in Role]), required=True, help="What it may do.")
@click.option("--host", "hosts", multiple=True, help="Host name at which a daemon or router is found; may be repeated.")
@click.option("--ip", "addresses", multiple=True, help="The same, an IP address.")
@click.option("--days", type=Whole(1, 3650), default=DAYS, show_default=True, help="How long it is valid.")
def add(folder: Path, name: str, role: str, hosts: tuple[str, ...], addresses: tuple[str, ...], days: int) -> None:
    """Give NAME a login: a certificate and a Zenoh configuration, in one file to hand over."""
    _require_cryptography()
    from ldcnd.ops.pki.site import Site, new_login  # noqa: PLC0415 - needs an optional package

    login = new_login(name, Role(role), (*hosts, *addresses))
    site = Site(folder)
    file = site.add(login, _now(), days)
    if login.role is Role.DAEMON:
        click.echo(f'{file}: in the rig\'s configuration, [zenoh] config_file = "{file.resolve()}"')
    elif login.role is Role.ROUTER:
        click.echo(f"{file}: start the router with it, `zenohd --config {file.name}`")
    else:
        click.echo(f"{file}: hand it over on a safe way; use it as --config {file.name}")
    if login.role is not Role.DAEMON:
        _say_restart(other for other in site.listener_files() if other != file)


@pki.command()
@FOLDER
@click.argument("name")
def revoke(folder: Path, name: str) -> None:
    """Take the rights of a viewer or operator back."""
    _require_cryptography()
    from ldcnd.ops.pki.site import Site  # noqa: PLC0415 - needs an optional package

    site = Site(folder)
    site.revoke(name)
    click.echo(f"{name}: revoked")
    _say_restart(site.listener_files())


def _require_cryptography() -> None:
    try:
        import cryptography  # noqa: F401, PLC0415 - an optional package
    except ImportError as error:
        raise ConfigError("cryptography is not installed: pip install 'ldcnd[pki]'") from error


def _say_restart(files: Iterable[Path]) -> None:
    for file in files:
        click.echo(f"restart what runs with {file}: rules are read at its start")


def _now() -> dt.datetime:
    return dt.datetime.now(dt.UTC)
