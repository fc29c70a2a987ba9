"""`ldcnd pki`: certificates for mutual TLS, and the access rules that go with them."""

import datetime as dt
import json
from collections.abc import Iterable
from pathlib import Path

import click

from ldcnd.cli.main import CommandGroup
from ldcnd.cli.typed import WholeNumber
from ldcnd.contract.commands import Role
from ldcnd.contract.troubles import certificate_end, certificate_troubles
from ldcnd.parts import require

FOLDER = click.argument("folder", type=click.Path(path_type=Path, file_okay=False))
DAYS = click.option("--days", type=WholeNumber(1, 3650), default=730, show_default=True, help="How long it is valid.")


@click.group(cls=CommandGroup)
def command() -> None:
    """Make certificates for mutual TLS, and the access rules that go with them.

    FOLDER belongs to one site. Keep it on one machine: anyone who has ca.key can make operators.
    """


@command.command()
@FOLDER
@click.option("--name", default="ldcnd site", show_default=True, help="Common name of the authority.")
def init(folder: Path, name: str) -> None:
    """Make the site's authority in FOLDER."""
    require("cryptography")
    from ldcnd.ops.pki.site import set_up  # noqa: PLC0415 - needs an optional package

    set_up(folder, name, _now())
    click.echo(f"{folder}: authority made; next: ldcnd pki add {folder} NAME --role daemon --ip ADDRESS")


@command.command()
@FOLDER
@click.argument("name")
@click.option("--role", type=click.Choice([role.value for role in Role]), required=True, help="What it may do.")
@click.option("--host", "hosts", multiple=True, help="Host name at which a daemon or router is found; may be repeated.")
@click.option("--ip", "addresses", multiple=True, help="The same, an IP address.")
@DAYS
def add(folder: Path, name: str, role: str, hosts: tuple[str, ...], addresses: tuple[str, ...], days: int) -> None:
    """Give NAME a login: a certificate and a Zenoh configuration, in one file to hand over."""
    require("cryptography")
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
        _say_restart((other for other in site.listener_files() if other != file), f"{name} is not let in")


@command.command()
@FOLDER
@click.argument("name")
@DAYS
def renew(folder: Path, name: str, days: int) -> None:
    """Give NAME another certificate before its own ends; the old one stays valid until then."""
    require("cryptography")
    from ldcnd.ops.pki.site import Site  # noqa: PLC0415 - needs an optional package

    file = Site(folder).renew(name, _now(), days)
    click.echo(f"{file}: put it in the place of the one before, and restart what uses it")


@command.command("list")
@FOLDER
@click.option("--json", "as_json", is_flag=True, help="Print JSON lines.")
def list_(folder: Path, *, as_json: bool) -> None:
    """Show until when the newest certificates of FOLDER are good, the authority's first; revoked ones are left out.

    What runs may use an older one: `ldcnd list` shows that of a daemon from a month before its end on.
    """
    require("cryptography")
    from ldcnd.ops.pki.site import Site  # noqa: PLC0415 - needs an optional package

    now = _now()
    t = int(now.timestamp()) * 10**9
    for role, certificate in Site(folder).certificates():
        troubles = certificate_troubles(certificate, t)
        if as_json:
            ends = dt.datetime.fromtimestamp(certificate.ends // 10**9, dt.UTC)
            about = {
                "name": certificate.name,
                "role": role,
                "ends": ends.isoformat(),
                "problem": next(iter(troubles), None),
            }
            click.echo(json.dumps(about, separators=(",", ":")))
        else:
            mark = "  !" if troubles else ""
            click.echo(f"{certificate.name:20} {role:10} {certificate_end(certificate, t)}{mark}")


@command.command()
@FOLDER
@click.argument("name")
def revoke(folder: Path, name: str) -> None:
    """Take the rights of a viewer or operator back."""
    require("cryptography")
    from ldcnd.ops.pki.site import Site  # noqa: PLC0415 - needs an optional package

    site = Site(folder)
    site.revoke(name)
    click.echo(f"{name}: revoked")
    _say_restart(site.listener_files(), f"{name} keeps its rights, on links that are open, too")


def _say_restart(files: Iterable[Path], until_then: str) -> None:
    """Say what has to be restarted: daemons and routers judge logins, and read their rules at their start."""
    for file in files:
        click.echo(f"put {file} in the place of the one before, and restart the daemon or router that runs with it;")
        click.echo(f"  a reload does not do; until then {until_then}")


def _now() -> dt.datetime:
    return dt.datetime.now(dt.UTC)
