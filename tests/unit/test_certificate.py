"""Until when a certificate is good, as it is read and as it is told."""

import asyncio
import datetime as dt
from collections.abc import Callable
from itertools import pairwise

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec, rsa
from cryptography.x509.oid import NameOID

from ldcnd.certificate import first_to_end, read_certificates, watch_certificate
from ldcnd.contract.health import CertificateHealth, DaemonHealth
from ldcnd.contract.troubles import certificate_end, certificate_troubles, daemon_troubles

NOW = dt.datetime(2026, 5, 1, 12, tzinfo=dt.UTC)
DAY_NS = 86_400 * 10**9


def ns(instant: dt.datetime) -> int:
    return int(instant.timestamp()) * 10**9


def made(name: str | None, ends: dt.datetime, key: ec.EllipticCurvePrivateKey | rsa.RSAPrivateKey) -> str:
    """Return a certificate in PEM, with more in its subject than a name."""
    parts = [x509.NameAttribute(NameOID.ORGANIZATION_NAME, "Plant " * 10)]
    parts += [x509.NameAttribute(NameOID.COMMON_NAME, name)] if name is not None else []
    builder = x509.CertificateBuilder().subject_name(x509.Name(parts)).issuer_name(x509.Name(parts))
    builder = builder.public_key(key.public_key()).serial_number(x509.random_serial_number())
    builder = builder.not_valid_before(dt.datetime(1960, 1, 1, tzinfo=dt.UTC)).not_valid_after(ends)
    return builder.sign(key, hashes.SHA256()).public_bytes(serialization.Encoding.PEM).decode()


@pytest.mark.parametrize("ends", [dt.datetime(year, 2, 3, 4, 5, 6, tzinfo=dt.UTC) for year in (1999, 2026, 2049, 2051)])
@pytest.mark.parametrize(
    "make", [lambda: ec.generate_private_key(ec.SECP256R1()), lambda: rsa.generate_private_key(65537, 2048)]
)
def test_name_and_end_are_those_of_the_certificate(
    make: Callable[[], ec.EllipticCurvePrivateKey | rsa.RSAPrivateKey], ends: dt.datetime
) -> None:
    assert read_certificates(made("bänk", ends, make())) == (CertificateHealth(name="bänk", ends=ns(ends)),)


def test_of_a_chain_the_one_that_ends_first_counts_and_keys_beside_it_do_not() -> None:
    key = ec.generate_private_key(ec.SECP256R1())
    secret = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    ).decode()
    years = {"own": 2031, "between": 2029, "root": 2040}
    chain = [made(name, dt.datetime(year, 1, 1, tzinfo=dt.UTC), key) for name, year in years.items()]

    found = first_to_end(secret + "".join(chain))
    assert found
    assert found.name == "between"
    assert first_to_end(secret) is None


def test_no_end_and_no_name_are_taken_and_rubbish_is_none() -> None:
    key = ec.generate_private_key(ec.SECP256R1())
    endless = made(None, dt.datetime(9999, 12, 31, 23, 59, 59, tzinfo=dt.UTC), key)

    (found,) = read_certificates(endless)
    assert found == CertificateHealth(name="", ends=2**63 - 1)
    assert "2262" in certificate_end(found, ns(NOW))
    lines = endless.splitlines()
    assert first_to_end("\n".join((lines[0], *lines[2:]))) is None
    assert first_to_end(f"{lines[0]}\nQUJD\n{lines[-1]}") is None


@pytest.mark.parametrize(
    ("days", "words"),
    [
        (31, None),
        (29.5, "the certificate of bench ends on 2026-05-31 00:00 UTC, within 30 days: `ldcnd pki renew SITE bench`"),
        (0.5, "ends on 2026-05-02 00:00 UTC, within a day: "),
        (
            0,
            "the certificate of bench has ended on 2026-05-01 12:00 UTC, and what connects anew is refused: `ldcnd pki",
        ),
    ],
)
def test_what_is_told_of_an_end_before_and_after(days: float, words: str | None) -> None:
    health = DaemonHealth(
        t=ns(NOW),
        seq=0,
        loop_lag_s=0,
        published=0,
        missed_reports=0,
        certificate=CertificateHealth(name="bench", ends=ns(NOW) + int(days * DAY_NS)),
    )
    told = daemon_troubles(health)
    assert [words in each for each in told if words] == [True] * bool(words)
    assert bool(told) is bool(words)


def test_an_authority_cannot_be_renewed() -> None:
    (told,) = certificate_troubles(CertificateHealth(name="site", ends=0, authority=True), 1)
    assert told.startswith("the authority site has ended")
    assert "pki init" in told
    assert "renew" not in told


async def test_a_watched_certificate_is_told_at_its_turns_and_once_a_day() -> None:
    time_s = asyncio.get_running_loop().time
    began_s = time_s()
    told: list[tuple[float, str | None]] = []
    watching = asyncio.create_task(
        watch_certificate(
            CertificateHealth(name="bench", ends=33 * DAY_NS),
            lambda problem: told.append(((time_s() - began_s) / 86_400, problem)),
            lambda: int((time_s() - began_s) * 1e9),
        )
    )
    await asyncio.sleep(35.5 * 86_400)
    watching.cancel()

    days = [day for day, _ in told]
    over = [day for day, problem in told if "has ended" in str(problem)]
    assert days[0] == pytest.approx(3, abs=1e-3)
    assert over[0] == pytest.approx(33, abs=1e-3)
    assert [later - before < 1.01 for before, later in pairwise(days)] == [True] * (len(days) - 1)
    assert len(days) == 30 + 3
    assert len(over) == 3


async def test_a_clock_that_is_set_right_takes_it_back() -> None:
    now_ns = 40 * DAY_NS
    told: list[str | None] = []
    certificate = CertificateHealth(name="bench", ends=35 * DAY_NS)
    watching = asyncio.create_task(watch_certificate(certificate, told.append, lambda: now_ns))
    await asyncio.sleep(3600)
    now_ns = 0
    await asyncio.sleep(3600)
    watching.cancel()

    assert [bool(each) for each in told] == [True, False]
