"""A site's folder: authority, roster, and one Zenoh configuration for each login, ready to be handed over.

Each configuration holds its certificate and key, so it is one file, for any Zenoh program, and it is a secret. Those of
the daemons hold the access rules as well; they are written anew whenever the roster changes.
"""

import base64
import datetime as dt
import json
import os
from pathlib import Path

from pydantic import ValidationError

from ldcnd.errors import ConfigError
from ldcnd.pki.access import Role, Subject, access_control
from ldcnd.pki.certificates import Credentials, issue_client, issue_daemon, new_authority
from ldcnd.pki.roster import FILE, RESERVED, Login, Roster, read_roster

PORT = 7447
AUTHORITY = "ca"
PRIVATE = 0o600


class Site:
    """The folder of a site that has been set up."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._roster = read_roster(folder)
        self._authority = self._credentials(AUTHORITY)

    def add(self, login: Login, now: dt.datetime, days: int) -> Path:
        """Give somebody a login, and return the Zenoh configuration to hand over.

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
            raise ConfigError(f"{login.name}: this login {why}; choose another name")
        if login.role is Role.DAEMON and not login.hosts:
            raise ConfigError(f"{login.name}: a daemon needs a host name or an IP address at which clients find it")
        if login.role is Role.DAEMON:
            made = issue_daemon(self._authority, login.name, login.hosts, now, days)
        else:
            made = issue_client(self._authority, login.name, now, days)
        _write(self._folder / f"{login.name}.pem", made.certificate)
        _write(self._folder / f"{login.name}.key", made.key)
        self._keep(self._roster.with_login(login))
        if login.role is not Role.DAEMON:
            self._write_configuration(login.name, self._client(made))
        return self._folder / f"{login.name}.json5"

    def revoke(self, name: str) -> None:
        """Take a viewer's or operator's rights back; daemons learn of it when they are restarted with their new file.

        Raises:
            ConfigError: there is no such login, or it is a daemon, whose certificate clients would trust all the same.
        """
        login = self._roster.find(name)
        if login is None or login.revoked:
            raise ConfigError(f"{name}: there is no such login; there are: {', '.join(self._present()) or 'none'}")
        if login.role is Role.DAEMON:
            raise ConfigError(
                f"{name}: a daemon cannot be revoked, clients trust its certificate until it ends; set up a new site"
            )
        self._keep(self._roster.with_login(login.model_copy(update={"revoked": True})))
        for suffix in ("json5", "pem", "key"):
            (self._folder / f"{name}.{suffix}").unlink(missing_ok=True)

    def daemon_files(self) -> tuple[Path, ...]:
        """Return the configurations of the daemons."""
        return tuple(self._folder / f"{name}.json5" for name in self._roster.names(Role.DAEMON))

    def _present(self) -> tuple[str, ...]:
        return tuple(login.name for login in self._roster.logins if not login.revoked)

    def _keep(self, roster: Roster) -> None:
        """Write the roster, and the access rules that follow from it."""
        _write(self._folder / FILE, roster.model_dump_json(indent=2).encode())
        self._roster = roster
        for name in roster.names(Role.DAEMON):
            self._write_configuration(name, self._daemon(self._credentials(name)))

    def _daemon(self, own: Credentials) -> dict[str, object]:
        logins = {role: self._roster.names(role) for role in (Role.VIEWER, Role.OPERATOR)}
        return {
            "mode": "peer",
            "listen": {"endpoints": [f"tls/[::]:{PORT}"]},
            **self._transport(own, listens=True),
            "access_control": access_control(Subject.CERTIFICATES, logins),
        }

    def _client(self, own: Credentials) -> dict[str, object]:
        daemons = (login for login in self._roster.logins if login.role is Role.DAEMON and not login.revoked)
        return {
            "mode": "client",
            "connect": {"endpoints": [f"tls/{_bracketed(login.hosts[0])}:{PORT}" for login in daemons]},
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
            "transport": {"link": {"protocols": ["tls"], "tls": tls}},
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
