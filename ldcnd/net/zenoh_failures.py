"""Error messages when Zenoh cannot start or answer: endpoints and remedies instead of names of Rust sources.

Source: the messages of Zenoh 1.10.2, as seen; whatever is not recognised is passed on, without its source locations.
"""

import re
from collections.abc import Sequence
from pathlib import Path

from ldcnd.contract.errors import ConfigError, LdcndError, OutcomeUnknown, SessionError

_SOURCE_LOCATION = re.compile(r",? at /\S+\.rs:\d+\.?")


def is_about_connecting(reason: str) -> bool:
    """Tell whether Zenoh has failed to connect, rather than to listen."""
    return "Unable to connect" in reason


def no_answer(key: str, timeout_s: float) -> OutcomeUnknown:
    """Return the error for a query without an answer in time."""
    return OutcomeUnknown(f"{key}: no answer within {timeout_s:g} s; it may be carried out all the same")


def login_refused(refusals: Sequence[str]) -> SessionError:
    """Return the error for a session that the other side did not let in."""
    return SessionError(
        "; ".join(refusals), remedy="check the login in the configuration file (--config), and what the daemon expects"
    )


def opening_failed(reason: str, listen: Sequence[str], connect: Sequence[str]) -> LdcndError:
    """Return the error for a session that could not be opened, given Zenoh's reason."""
    endpoint = _named(reason, listen) or ", ".join(listen)
    if "Address already in use" in reason:
        return SessionError(
            f"cannot listen on {endpoint}: the port is in use",
            value=endpoint,
            remedy="end the other program (another ldcnd or a Zenoh router?) or configure another port to listen on",
        )
    if "Cannot assign requested address" in reason:
        return SessionError(
            f"cannot listen on {endpoint}: this machine has no such address",
            value=endpoint,
            remedy="listen on an address of this machine, or on 127.0.0.1 for this machine only",
        )
    if "Permission denied" in reason:
        return SessionError(
            f"cannot listen on {endpoint}: not permitted",
            value=endpoint,
            remedy="choose a port above 1023, or a socket path that this user may write",
        )
    if "not supported for" in reason:
        endpoint = ", ".join((*listen, *connect))
        return SessionError(
            f"cannot use {endpoint}: {_plain(reason)}",
            value=endpoint,
            remedy="an endpoint is tcp/HOST:PORT, tls/HOST:PORT or unixsock-stream/PATH, for instance",
        )
    if "Can not create a new" in reason:
        return SessionError(f"cannot listen on {endpoint}: {_plain(reason)}", value=endpoint)
    if is_about_connecting(reason) or "No peer specified" in reason:
        endpoint = ", ".join(connect) or "any endpoint: none is configured"
        return SessionError(
            f"cannot connect to {endpoint}",
            value=endpoint,
            remedy="check that the other side runs, and its address",
        )
    return SessionError(f"cannot open the Zenoh session: {_plain(reason)}")


def opening_timed_out(timeout_s: float, listen: Sequence[str], connect: Sequence[str]) -> SessionError:
    """Return the error for a session that does not open in time."""
    return SessionError(
        f"the Zenoh session did not open within {timeout_s:g} s;"
        f" listening on {', '.join(listen) or 'nothing'}, connecting to {', '.join(connect) or 'nothing'}"
    )


def config_refused(reason: str, path: str, value: str) -> ConfigError:
    """Return the error for a setting that Zenoh does not take."""
    return ConfigError(f"Zenoh does not accept {value} as {path}: {_plain(reason)}", value=value)


def config_file_refused(reason: str, file: Path) -> ConfigError:
    """Return the error for a configuration file that Zenoh cannot read."""
    return ConfigError(f"Zenoh cannot use the configuration file {file}: {_plain(reason)}", value=str(file))


def _named(reason: str, endpoints: Sequence[str]) -> str | None:
    return next((endpoint for endpoint in endpoints if endpoint.partition("#")[0] in reason), None)


def _plain(reason: str) -> str:
    return _SOURCE_LOCATION.sub("", reason).strip()
