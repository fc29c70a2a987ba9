"""From settings to Zenoh's own configuration, and what of it is for ldcnd to see to: files and sockets."""

import base64
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import zenoh

from ldcnd.certificate import first_to_end, read_certificates
from ldcnd.contract.errors import SessionError
from ldcnd.contract.health import CertificateHealth
from ldcnd.net import zenoh_failures
from ldcnd.net.zenoh_settings import ZenohSettings

TLS = "transport/link/tls"
FILES = (
    f"{TLS}/root_ca_certificate",
    f"{TLS}/listen_certificate",
    f"{TLS}/listen_private_key",
    f"{TLS}/connect_certificate",
    f"{TLS}/connect_private_key",
    "transport/auth/usrpwd/dictionary_file",
)
"""Settings that name files; Zenoh itself searches for relative ones in the working directory."""

UNIX_SOCKET = "unixsock-stream/"
FOR_THE_GROUP = 0o660
"""Zenoh makes sockets that only the daemon's own user can connect to; its group may, then folder and group decide."""


def zenoh_config(settings: ZenohSettings) -> zenoh.Config:
    """Return the configuration for settings.

    Raises:
        ConfigError: Zenoh does not accept a setting or the configuration file.
    """
    default = zenoh.Config()
    config = default
    if settings.config_file:
        try:
            config = zenoh.Config.from_file(settings.config_file)
        except zenoh.ZError as error:
            raise zenoh_failures.config_file_refused(str(error), settings.config_file) from error
        _resolve_files(config, settings.config_file.parent)
    wanted = settings.required() | {
        path: value
        for path, value in settings.optional().items()
        # a file counts where it says something else than Zenoh says by itself
        if value or not settings.config_file or config.get_json(path) == default.get_json(path)
    }
    for path, value in wanted.items():
        text = json.dumps(value)
        try:
            config.insert_json5(path, text)
        except zenoh.ZError as error:
            raise zenoh_failures.config_refused(str(error), path, text) from error
    return config


def endpoints(config: zenoh.Config, what: Literal["listen", "connect"]) -> tuple[str, ...]:
    """Return where a configuration listens or connects; for each mode alike, as ldcnd and its examples say it."""
    configured = json.loads(config.get_json(f"{what}/endpoints"))
    if not isinstance(configured, list):
        return ()
    return tuple(one if isinstance(one, str) else json.dumps(one) for one in configured)


def root_certificate(config: zenoh.Config) -> str | None:
    """Return the certificates that a configuration trusts, in PEM, as far as they can be read."""
    return _pem(config, "root_ca_certificate")


def certificate_in_use(config: zenoh.Config) -> CertificateHealth | None:
    """Return which certificate of a configuration ends first; None without one, or where none can be read.

    Of several authorities that are trusted the last one counts: it may be the one that has signed.
    """
    own = [first_to_end(_pem(config, name) or "") for name in ("listen_certificate", "connect_certificate")]
    found = [each for each in own if each]
    try:
        authorities = read_certificates(root_certificate(config) or "")
    except ValueError:
        authorities = ()
    if authorities:
        last = max(authorities, key=lambda each: each.ends)
        found.append(last.model_copy(update={"authority": True}))
    return min(found, key=lambda each: each.ends, default=None)


def _pem(config: zenoh.Config, name: str) -> str | None:
    inline = json.loads(config.get_json(f"{TLS}/{name}_base64"))
    try:
        if isinstance(inline, str):
            return base64.b64decode(inline).decode("ascii", errors="replace")
        file = json.loads(config.get_json(f"{TLS}/{name}"))
        return Path(file).read_text(encoding="ascii") if isinstance(file, str) else None
    except (OSError, ValueError):
        return None  # Zenoh complains about it


def share_sockets(listen: Sequence[str]) -> None:
    """Let the group of this program's user connect to the Unix sockets that it listens on.

    Raises:
        SessionError: a socket is not there, or not this program's.
    """
    for endpoint in listen:
        if endpoint.startswith(UNIX_SOCKET):
            try:
                Path(endpoint.removeprefix(UNIX_SOCKET)).chmod(FOR_THE_GROUP)
            except OSError as error:
                raise SessionError(f"{endpoint}: cannot be opened to the group: {error.strerror}") from error


def _resolve_files(config: zenoh.Config, folder: Path) -> None:
    for path in FILES:
        name = json.loads(config.get_json(path))
        if isinstance(name, str):
            config.insert_json5(path, json.dumps(str((folder / name).absolute())))
