"""Certificates: an authority that signs for one site, and what it signs; the only module that uses cryptography.

A viewer's or operator's certificate is good for connecting only, so it cannot be used to pose as a daemon. There are no
revocation lists, because Zenoh reads none: the policy decides who may do what, by common name.
"""

import datetime as dt
import ipaddress
from collections.abc import Sequence
from dataclasses import dataclass

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

AUTHORITY_DAYS = 3650
BACKDATED = dt.timedelta(hours=1)
"""Clocks of a site differ; a certificate that is valid from now on is not yet valid on half of its machines."""


@dataclass(frozen=True, slots=True)
class Credentials:
    """A certificate and its private key, both in PEM."""

    certificate: bytes
    key: bytes


def new_authority(name: str, now: dt.datetime) -> Credentials:
    """Return a new authority; the holder of its key can make operators."""
    key = ec.generate_private_key(ec.SECP256R1())
    subject = _name(name)
    certificate = (
        _builder(subject, subject, key.public_key(), now, AUTHORITY_DAYS)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(_usage(signs=True), critical=True)
        .sign(key, hashes.SHA256())
    )
    return Credentials(certificate.public_bytes(serialization.Encoding.PEM), _pem(key))


def issue_client(authority: Credentials, name: str, now: dt.datetime, days: int) -> Credentials:
    """Return credentials with which `name` can connect, and cannot listen."""
    return _issue(authority, name, now, days, (), (ExtendedKeyUsageOID.CLIENT_AUTH,))


def issue_daemon(authority: Credentials, name: str, hosts: Sequence[str], now: dt.datetime, days: int) -> Credentials:
    """Return credentials with which `name` can listen on hosts, and connect.

    Args:
        authority: who signs.
        name: the common name.
        hosts: host names and IP addresses under which clients find it; at least one.
        now: the present.
        days: for how long it is valid.
    """
    usage = (ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH)
    return _issue(authority, name, now, days, hosts, usage)


def _issue(
    authority: Credentials,
    name: str,
    now: dt.datetime,
    days: int,
    hosts: Sequence[str],
    usage: Sequence[x509.ObjectIdentifier],
) -> Credentials:
    signer = x509.load_pem_x509_certificate(authority.certificate)
    signing_key = serialization.load_pem_private_key(authority.key, password=None)
    if not isinstance(signing_key, ec.EllipticCurvePrivateKey):
        raise TypeError("the authority's key is not one that ldcnd makes")
    key = ec.generate_private_key(ec.SECP256R1())
    builder = (
        _builder(_name(name), signer.subject, key.public_key(), now, days)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(_usage(signs=False), critical=True)
        .add_extension(x509.ExtendedKeyUsage(usage), critical=False)
    )
    if hosts:
        builder = builder.add_extension(x509.SubjectAlternativeName([_host(host) for host in hosts]), critical=False)
    certificate = builder.sign(signing_key, hashes.SHA256())
    return Credentials(certificate.public_bytes(serialization.Encoding.PEM), _pem(key))


def _builder(
    subject: x509.Name, issuer: x509.Name, key: ec.EllipticCurvePublicKey, now: dt.datetime, days: int
) -> x509.CertificateBuilder:
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key)
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - BACKDATED)
        .not_valid_after(now + dt.timedelta(days=days))
    )


def _name(common_name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common_name)])


def _host(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        return x509.DNSName(host)


def _usage(*, signs: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not signs,
        key_cert_sign=signs,
        crl_sign=signs,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        encipher_only=False,
        decipher_only=False,
    )


def _pem(key: ec.EllipticCurvePrivateKey) -> bytes:
    return key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
