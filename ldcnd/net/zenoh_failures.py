"""Error messages when Zenoh cannot start or answer: endpoints and remedies instead of names of Rust sources.

Source: the messages of Zenoh 1.10.2, as seen; whatever is not recognised is passed on, without its source locations.
"""

import re
from collections.abc import Sequence
from pathlib import Path

from ldcnd.contract.errors import ConfigError, LdcndError, OutcomeUnknown, SessionError
from ldcnd.contract.health import CertificateHealth
from ldcnd.contract.troubles import certificate_troubles

_SOURCE_LOCATION = re.compile(r",? at /\S+\.rs:\d+\.?")


UNKNOWN_NAME = "correct the name, enter it in /etc/hosts or with the name server, or write the address instead"


def is_about_connecting(reason: str) -> bool:
    """Tell whether Zenoh has failed to connect, rather than to listen."""
    return "Unable to connect" in reason


def no_answer(key: str, timeout_s: float) -> OutcomeUnknown:
    """Return the error for a query without an answer in time."""
    return OutcomeUnknown(f"{key}: no answer within {timeout_s:g} s; it may be carried out all the same")


def login_refused(refusals: Sequence[str], certificate: CertificateHealth | None, t: int) -> SessionError:
    """Return the error for a session that the other side did not let in.

    Args:
        refusals: what is known of why, by endpoint.
        certificate: the login's own; None where there is none.
        t: the present, UTC in ns since 1970.
    """
    reason = "; ".join(refusals)
    if certificate and certificate.ends <= t:
        (trouble,) = certificate_troubles(certificate, t)
        ended, _, remedy = trouble.partition(": ")
        return SessionError(f"{reason}: {ended}", remedy=remedy)
    if "expired" in reason:
        return SessionError(
            reason, remedy="renew the certificate that has ended, this login's or the daemon's: pki renew"
        )
    return SessionError(
        reason, remedy="check the login in the configuration file (--config), and what the daemon expects"
    )


def opening_failed(
    reason: str, listen: Sequence[str], connect: Sequence[str], unresolved: Sequence[str] = ()
) -> LdcndError:
    """Return the error for a session that could not be opened, given Zenoh's reason, and the names of unknown hosts."""
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
    if "Unable to open lock file" in reason:
        folder = Path(endpoint.partition("/")[2]).parent
        return ConfigError(
            f"cannot listen on {endpoint}: there is no folder {folder}",
            value=endpoint,
            remedy="make it, or name one that is there: the service has /run/ldcnd, the rig NAME /run/ldcnd/NAME",
        )
    if "failed to lookup address" in reason:
        return SessionError(
            f"cannot listen on {endpoint}: its host name does not resolve", value=endpoint, remedy=UNKNOWN_NAME
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
        names = f": the name {', '.join(unresolved)} does not resolve" if unresolved else ""
        return SessionError(
            f"cannot connect to {endpoint}{names}",
            value=endpoint,
            remedy=UNKNOWN_NAME if unresolved else "check that the other side runs, and its address",
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
