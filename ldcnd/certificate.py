"""Certificates: until when they are good, and the word that is due before they end.

Read without the packages that make certificates: a daemon runs without these.
Source: RFC 5280, section 4.1 for the parts of a certificate; ITU-T X.690 for their bytes.
"""

import asyncio
import datetime as dt
import re
import ssl
import time
from collections.abc import Callable, Iterator

from ldcnd.contract.health import CertificateHealth
from ldcnd.contract.troubles import certificate_soon_ns, certificate_troubles

_CERTIFICATE = re.compile(r"-----BEGIN CERTIFICATE-----.+?-----END CERTIFICATE-----", re.DOTALL)
_VERSION, _UTC_TIME, _LONG = 0xA0, 0x17, 0x80
_COMMON_NAME = bytes((0x55, 0x04, 0x03))
_LATEST_NS = 2**63 - 1
"""An instant of the contract has 64 bits; a certificate may have the year 9999 for "no end"."""

LOOK_S = 60.0
"""A clock may be set: it is asked this often when the next word is due, seconds."""
DAY_NS = 86_400 * 10**9


def read_certificates(pem: str) -> tuple[CertificateHealth, ...]:
    """Return name and end of each certificate in a text, in its order.

    Raises:
        ValueError: something between the marks is no certificate.
    """
    try:
        return tuple(_read(ssl.PEM_cert_to_DER_cert(each.group())) for each in _CERTIFICATE.finditer(pem))
    except (IndexError, StopIteration) as error:
        raise ValueError("no certificate") from error


def first_to_end(pem: str) -> CertificateHealth | None:
    """Return the one of a chain of certificates that ends first; None when nothing in the text is one."""
    try:
        return min(read_certificates(pem), key=lambda each: each.ends, default=None)
    except ValueError:
        return None


async def watch_certificate(
    certificate: CertificateHealth | None,
    tell: Callable[[str | None], None],
    now_ns: Callable[[], int] = time.time_ns,
    remedy: str | None = None,
) -> None:
    """Say what is the matter with a certificate: when it ends soon, when it has ended, and once a day meanwhile.

    Args:
        certificate: whose end is watched; there is nothing to say without one.
        tell: takes what is to be said; None when it is no longer true, as after a clock was set.
        now_ns: the wall clock, UTC in ns since 1970.
        remedy: what to do, unless it is what `certificate_troubles` says.
    """
    if certificate is None:
        return
    turns = (certificate_soon_ns(certificate), certificate.ends)
    told, told_at_ns = 0, 0  # how many of the turns have come
    while True:
        now = now_ns()
        come = sum(turn <= now for turn in turns)
        if come != told or (come and not 0 <= now - told_at_ns < DAY_NS):
            tell(next(iter(certificate_troubles(certificate, now, remedy)), None))
            told, told_at_ns = come, now
        due = [turn - now for turn in turns if turn > now]
        await asyncio.sleep(min([LOOK_S, *(each / 1e9 for each in due)]))


def _read(der: bytes) -> CertificateHealth:
    ((_, whole),) = _parts(der)
    (_, signed), *_ = _parts(whole)
    fields = [content for tag, content in _parts(signed) if tag != _VERSION]
    _serial, _algorithm, _issuer, validity, subject, *_ = fields
    _, (tag, ends) = _parts(validity)
    return CertificateHealth(name=_common_name(subject), ends=_instant(tag, ends.decode("ascii")))


def _common_name(subject: bytes) -> str:
    for _, relative in _parts(subject):
        for _, attribute in _parts(relative):
            (_, kind), (_, value) = _parts(attribute)
            if kind == _COMMON_NAME:
                return value.decode(errors="replace")
    return ""


def _instant(tag: int, text: str) -> int:
    """Return an instant, UTC in ns since 1970; of a year with two digits those below 50 are of this century."""
    if tag == _UTC_TIME:
        text = f"{'20' if text < '50' else '19'}{text}"
    instant = dt.datetime.strptime(text, "%Y%m%d%H%M%SZ").replace(tzinfo=dt.UTC)
    return min(int(instant.timestamp()) * 10**9, _LATEST_NS)


def _parts(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield tag and content of each element."""
    at = 0
    while at < len(data):
        tag, length, at = data[at], data[at + 1], at + 2
        if length & _LONG:
            size = length & ~_LONG
            length, at = int.from_bytes(data[at : at + size]), at + size
        if at + length > len(data):
            raise ValueError("no certificate")
        yield tag, data[at : at + length]
        at += length
