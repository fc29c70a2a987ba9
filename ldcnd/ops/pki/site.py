"""A site's folder: authority, roster, and one Zenoh configuration for each login, ready to be handed over.

Each configuration holds its certificate and key, so it is one file, for any Zenoh program, and it is a secret. Those of
daemons and routers hold the access rules as well; they are rewritten whenever the roster changes.
"""

import base64
import datetime as dt
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

from pydantic import Field, ValidationError

from ldcnd.certificate import first_to_end
from ldcnd.client.network import LEASE_MS, RETRY_MS
from ldcnd.contract.commands import Role
from ldcnd.contract.errors import ConfigError
from ldcnd.contract.frozen import Frozen
from ldcnd.contract.health import CertificateHealth
from ldcnd.ops.pki.access import PERMITTED_AT_ROUTER, PERMITTED_BEHIND_ROUTER, Rule, Subject, access_control
from ldcnd.ops.pki.certificates import Credentials, issue_client, issue_daemon, new_authority

FILE = "roster.json"
RESERVED = frozenset({"ca", "roster"})
"""Names of the files beside those of the logins."""

LoginName = Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9_.-]{0,62}$")]


class Login(Frozen):
    """One login of a site."""

    name: LoginName
    """The common name of its certificate, and of its files."""
    role: Role
    """Its permissions."""
    hosts: tuple[str, ...] = ()
    """Where a daemon or a router can be found: host names and IP addresses."""
    revoked: bool = False
    """It may do nothing any more. It stays on the roster, because its certificate is valid: a second login of this name
    would give the old certificate its rights back."""


class Roster(Frozen):
    """All logins that a site ever had."""

    logins: tuple[Login, ...] = ()

    def names(self, role: Role) -> tuple[str, ...]:
        """Return who has a role now."""
        return tuple(login.name for login in self.logins if login.role is role and not login.revoked)

    def find(self, name: str) -> Login | None:
        """Return the login of that name, revoked or not."""
        return next((login for login in self.logins if login.name == name), None)

    def with_login(self, login: Login) -> "Roster":
        """Return the roster with one more login, or with that login changed."""
        others = tuple(other for other in self.logins if other.name != login.name)
        return Roster(logins=(*others, login))


def read_roster(folder: Path) -> Roster:
    """Return the roster of a site.

    Raises:
        ConfigError: the folder has none, or it cannot be understood.
    """
    file = folder / FILE
    try:
        return Roster.model_validate_json(file.read_bytes())
    except OSError as error:
        raise ConfigError(f"{file}: cannot be read: {error.strerror}; `ldcnd pki init {folder}` makes one") from error
    except ValidationError as error:
        raise ConfigError(f"{file}: is no roster: {error.errors()[0]['msg']}") from error


PORT = 7447
AUTHORITY = "ca"
PRIVATE = 0o600
LISTENERS = (Role.DAEMON, Role.ROUTER)


class Site:
    """The folder of a site that has been set up."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._roster = read_roster(folder)
        self._authority = self._credentials(AUTHORITY)

    def add(self, login: Login, now: dt.datetime, days: int) -> Path:
        """Make a login, and return the Zenoh configuration to hand over.

        Args:
            login: who, and in which role.
            now: the present.
            days: for how long its certificate is valid.

        Raises:
            ConfigError: the name is or was taken, or a daemon has no host.
        """
        if login.name in RESERVED:
            raise ConfigError(f"{login.name}: this name is reserved; choose another one")
        if known := self._roster.find(login.name):
            why = (
                "was revoked, and a new certificate of this name would revive the old one"
                if known.revoked
                else "exists"
            )
            remedy = None if known.revoked else f"ldcnd pki renew {self._folder} {login.name}, for another certificate"
            raise ConfigError(f"{login.name}: this login {why}; choose another name", remedy=remedy)
        if login.role in LISTENERS and not login.hosts:
            raise ConfigError(
                f"{login.name}: a {login.role} needs a host name or an IP address at which clients find it"
            )
        return self._issue(login, now, days)

    def renew(self, name: str, now: dt.datetime, days: int) -> Path:
        """Give a login another certificate, and return the Zenoh configuration to hand over; the old one stays valid.

        Args:
            name: whose.
            now: the present.
            days: for how long the new certificate is valid.

        Raises:
            ConfigError: there is no such login.
        """
        return self._issue(self._living(name), now, days)

    def _issue(self, login: Login, now: dt.datetime, days: int) -> Path:
        if login.role in LISTENERS:
            made = issue_daemon(self._authority, login.name, login.hosts, now, days)
        else:
            made = issue_client(self._authority, login.name, now, days)
        _write(self._folder / f"{login.name}.pem", made.certificate)
        _write(self._folder / f"{login.name}.key", made.key)
        self._keep(self._roster.with_login(login))
        if login.role not in LISTENERS:
            self._write_configuration(login.name, self._client(made))
        return self._folder / f"{login.name}.json5"

    def _living(self, name: str) -> Login:
        login = self._roster.find(name)
        if login is None or login.revoked:
            raise ConfigError(f"{name}: there is no such login; there are: {', '.join(self._present()) or 'none'}")
        return login

    def revoke(self, name: str) -> None:
        """Take a viewer's or operator's rights back; who listens learns of it when restarted with the new file.

        Raises:
            ConfigError: there is no such login, or it listens, and clients would trust its certificate all the same.
        """
        login = self._living(name)
        if login.role in LISTENERS:
            raise ConfigError(
                f"{name}: a {login.role} cannot be revoked, clients trust its certificate until it ends;"
                " set up a new site"
            )
        self._keep(self._roster.with_login(login.model_copy(update={"revoked": True})))
        for suffix in ("json5", "pem", "key"):
            (self._folder / f"{name}.{suffix}").unlink(missing_ok=True)

    def certificates(self) -> tuple[tuple[str, CertificateHealth], ...]:
        """Return the newest certificate of the authority and of each login that is not revoked, each after its role.

        Raises:
            ConfigError: a file is gone, or is no certificate.
        """
        authority = self._certificate(AUTHORITY).model_copy(update={"authority": True})
        present = (login for login in self._roster.logins if not login.revoked)
        logins = tuple((login.role.value, self._certificate(login.name)) for login in present)
        return (("authority", authority), *logins)

    def _certificate(self, name: str) -> CertificateHealth:
        found = first_to_end(self._credentials(name).certificate.decode(errors="replace"))
        if found is None:
            raise ConfigError(f"{self._folder / name}.pem: is no certificate")
        return found

    def listener_files(self) -> tuple[Path, ...]:
        """Return the configurations of the daemons and routers, which hold the access rules."""
        names = (name for role in LISTENERS for name in self._roster.names(role))
        return tuple(self._folder / f"{name}.json5" for name in names)

    def _present(self) -> tuple[str, ...]:
        return tuple(login.name for login in self._roster.logins if not login.revoked)

    def _keep(self, roster: Roster) -> None:
        """Write the roster, and the access rules that follow from it."""
        _write(self._folder / FILE, roster.model_dump_json(indent=2).encode())
        self._roster = roster
        for name in roster.names(Role.DAEMON):
            self._write_configuration(name, self._daemon(self._credentials(name)))
        for name in roster.names(Role.ROUTER):
            self._write_configuration(name, self._router(self._credentials(name)))

    def _daemon(self, own: Credentials) -> dict[str, object]:
        return self._listener(own, "peer", PERMITTED_BEHIND_ROUTER)

    def _router(self, own: Credentials) -> dict[str, object]:
        """Return what a Zenoh router starts with; the operator adds which other routers it connects to."""
        return {
            **self._listener(own, "router", PERMITTED_AT_ROUTER),
            "connect": {"retry": {"period_init_ms": RETRY_MS[0], "period_max_ms": RETRY_MS[1]}},
        }

    def _listener(self, own: Credentials, mode: str, permitted: Mapping[Role, tuple[Rule, ...]]) -> dict[str, object]:
        logins = {role: self._roster.names(role) for role in Role}
        return {
            "mode": mode,
            "listen": {"endpoints": [f"tls/[::]:{PORT}"]},
            **self._transport(own, listens=True),
            "access_control": access_control(Subject.CERTIFICATES, logins, permitted),
        }

    def _client(self, own: Credentials) -> dict[str, object]:
        present = [login for login in self._roster.logins if not login.revoked]
        listeners = [login for role in (Role.ROUTER, Role.DAEMON) for login in present if login.role is role]
        return {
            "mode": "client",
            "connect": {"endpoints": [f"tls/{_bracketed(login.hosts[0])}:{PORT}" for login in listeners]},
            **self._transport(own, listens=False),
        }

    def _transport(self, own: Credentials, *, listens: bool) -> dict[str, object]:
        tls: dict[str, object] = {
            "enable_mtls": True,
            "verify_name_on_connect": True,
            "close_link_on_expiration": True,
            "root_ca_certificate_base64": _base64(self._authority.certificate),
            "connect_certificate_base64": _base64(own.certificate),
            "connect_private_key_base64": _base64(own.key),
        }
        if listens:
            tls["listen_certificate_base64"] = _base64(own.certificate)
            tls["listen_private_key_base64"] = _base64(own.key)
        return {
            "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
            "transport": {"link": {"protocols": ["tls"], "tls": tls, "tx": {"lease": LEASE_MS}}},
        }

    def _credentials(self, name: str) -> Credentials:
        try:
            return Credentials((self._folder / f"{name}.pem").read_bytes(), (self._folder / f"{name}.key").read_bytes())
        except OSError as error:
            raise ConfigError(f"{error.filename}: cannot be read: {error.strerror}") from error

    def _write_configuration(self, name: str, configuration: dict[str, object]) -> None:
        _write(self._folder / f"{name}.json5", json.dumps(configuration, indent=2).encode())


def set_up(folder: Path, name: str, now: dt.datetime) -> Site:
    """Make a new site with an authority of its own.

    Raises:
        ConfigError: the folder holds a site already, or cannot be written.
    """
    if (folder / FILE).exists():
        raise ConfigError(f"{folder}: there is a site already; a second authority would shut out all of its logins")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"{folder}: cannot be made: {error.strerror}") from error
    authority = new_authority(name, now)
    _write(folder / f"{AUTHORITY}.key", authority.key)
    _write(folder / f"{AUTHORITY}.pem", authority.certificate)
    _write(folder / FILE, Roster().model_dump_json(indent=2).encode())
    return Site(folder)


def new_login(name: str, role: Role, hosts: tuple[str, ...]) -> Login:
    """Return a login.

    Raises:
        ConfigError: the name cannot be used.
    """
    try:
        return Login(name=name, role=role, hosts=hosts)
    except ValidationError:
        raise ConfigError(
            f"{name!r} cannot be a login: lower-case letters, digits, dots, hyphens and underscores, at most 63"
        ) from None


def _write(path: Path, content: bytes) -> None:
    """Write a file that only its owner can read, whole or not at all."""
    fresh = path.with_name(f".{path.name}.new")
    try:
        fresh.unlink(missing_ok=True)
        with os.fdopen(os.open(fresh, os.O_WRONLY | os.O_CREAT | os.O_EXCL, PRIVATE), "wb") as file:
            file.write(content)
        fresh.replace(path)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written: {error.strerror}") from error


def _base64(pem: bytes) -> str:
    return base64.b64encode(pem).decode()


def _bracketed(host: str) -> str:
    return f"[{host}]" if ":" in host else host
