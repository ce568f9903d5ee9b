"""The fleet's certificate authority and the certificates of its members, for mutual TLS.

A drone's common name is ``{fleet}.agent.001``, which access control goes by, and its certificate names the addresses
that it listens on. Curve P-256: what every TLS library speaks. Times are Unix seconds.
"""

from __future__ import annotations

import datetime
import ipaddress
import os
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from transport.errors import KeyFileError
from transport.link.streams import check_fleet_name
from transport.security.certificate_files import Member, authority_key_path, authority_path
from transport.security.key_files import (
    OTHERS,
    OTHERS_WRITE,
    PRIVATE,
    PUBLIC,
    check_directory,
    check_mode,
    read_text,
    write_text,
)

LEAF_DAYS, AUTHORITY_DAYS = 90, 730
BACKDATE_S = 86_400.0
"""Valid from a day before they are made: clocks of drones differ."""
DAY_S = 86_400.0
USAGES = (ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH)


@dataclass(frozen=True, slots=True)
class CertificateInfo:
    """What is shown of a certificate."""

    common_name: str
    from_unix_s: float
    until_unix_s: float
    hosts: tuple[str, ...]


def make_authority(directory: Path, fleet: str, *, unix_s: float, days: float = AUTHORITY_DAYS) -> None:
    """Make the fleet's authority; raises `KeyFileError` if there is one."""
    check_directory(directory)
    for path in (authority_path(directory), authority_key_path(directory)):
        if os.path.exists(path):
            raise KeyFileError(f"{path} exists already; a new authority needs a new key folder")
    key = ec.generate_private_key(ec.SECP256R1())
    name = _name(f"{check_fleet_name(fleet)}.authority")
    usage = x509.KeyUsage(
        digital_signature=False, content_commitment=False, key_encipherment=False, data_encipherment=False,
        key_agreement=False, key_cert_sign=True, crl_sign=True, encipher_only=False, decipher_only=False,
    )  # fmt: skip
    certificate = (
        _builder(name, name, key, unix_s, days)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(usage, critical=True)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
        .sign(key, hashes.SHA256())
    )
    write_text(authority_key_path(directory), _pem(key), PRIVATE)
    write_text(authority_path(directory), _certificate_pem(certificate), PUBLIC)


def issue(
    directory: Path, member: Member, hosts: Iterable[str] = (), *, unix_s: float, days: float = LEAF_DAYS
) -> CertificateInfo:
    """Give a member a new private key and certificate for ``hosts`` (addresses or names).

    The certificate that it had stays valid until it expires. Raises `KeyFileError` if the authority is not here.
    """
    authority = read_certificate(authority_path(directory))
    signer = _read_private_key(authority_key_path(directory))
    key = ec.generate_private_key(ec.SECP256R1())
    name = member.common_name
    names = [*(_general_name(host) for host in sorted(set(hosts))), x509.DNSName(name)]
    # an authority that ends earlier ends its members too
    days = min(days, (authority.not_valid_after_utc.timestamp() - unix_s) / DAY_S)
    if days <= 0:
        raise KeyFileError(f"{authority_path(directory)}: expired; make a new key folder with `fleetloc keys init`")
    certificate = (
        _builder(_name(name), authority.subject, key, unix_s, days)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(x509.SubjectAlternativeName(names), critical=False)
        .add_extension(x509.ExtendedKeyUsage(USAGES), critical=False)
        .add_extension(x509.AuthorityKeyIdentifier.from_issuer_public_key(signer.public_key()), critical=False)
        .sign(signer, hashes.SHA256())
    )
    write_text(member.private_key(directory), _pem(key), PRIVATE)
    write_text(member.certificate(directory), _certificate_pem(certificate), PUBLIC)
    return info_of(certificate)


def read_certificate(path: Path) -> x509.Certificate:
    """A certificate of PEM text; raises `KeyFileError`."""
    if not os.path.isfile(path):
        raise KeyFileError(f"{path}: no such certificate; see `fleetloc keys init --missing`, or copy it here")
    check_mode(path, forbidden=OTHERS_WRITE, remedy=f"chmod 644 {path}")
    try:
        return x509.load_pem_x509_certificate(read_text(path).encode("ascii"))
    except ValueError:
        raise KeyFileError(f"{path}: expected a certificate in PEM") from None


def certificate_faults(directory: Path, member: Member, hosts: Iterable[str], *, unix_s: float) -> list[str]:
    """Why a member cannot use the certificates in a directory for ``hosts``; a line each, with the remedy."""
    faults: list[str] = []
    parts: list[x509.Certificate | ec.EllipticCurvePrivateKey] = []
    for read, path in (
        (read_certificate, authority_path(directory)),
        (read_certificate, member.certificate(directory)),
        (_read_private_key, member.private_key(directory)),
    ):
        try:
            parts.append(read(path))
        except KeyFileError as error:
            faults.append(str(error))
    if faults:
        return faults
    authority, certificate, key = parts
    assert isinstance(authority, x509.Certificate)
    assert isinstance(certificate, x509.Certificate)
    assert isinstance(key, ec.EllipticCurvePrivateKey)
    path, remedy = member.certificate(directory), _remedy(member)
    if not _issued_by(certificate, authority):
        faults.append(f"{path}: not issued by {authority_path(directory)}; {remedy}")
    if certificate.public_key() != key.public_key():
        faults.append(f"{path}: does not belong to {member.private_key(directory)}; {remedy}")
    info = info_of(certificate)
    if info.common_name != member.common_name:
        faults.append(f"{path}: common name {info.common_name!r}, expected {member.common_name!r}; {remedy}")
    for where, one in ((path, info), (authority_path(directory), info_of(authority))):
        if not one.from_unix_s <= unix_s < one.until_unix_s:
            span = f"{date(one.from_unix_s)} to {date(one.until_unix_s)}"
            faults.append(f"{where}: valid from {span}, and it is {date(unix_s)}; set the clock, or {remedy}")
    missing = sorted(set(hosts) - set(info.hosts))
    if missing:
        faults.append(f"{path}: does not name {', '.join(missing)}, where the agent listens; {remedy}")
    return faults


def info_of(certificate: x509.Certificate) -> CertificateInfo:
    """Name, times and hosts of a certificate."""
    names = certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    hosts: list[str] = []
    try:
        found = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
        hosts = [
            *map(str, found.get_values_for_type(x509.IPAddress)),
            *found.get_values_for_type(x509.DNSName),
        ]
    except x509.ExtensionNotFound:
        hosts = []
    return CertificateInfo(
        str(names[0].value) if names else "",
        certificate.not_valid_before_utc.timestamp(),
        certificate.not_valid_after_utc.timestamp(),
        tuple(hosts),
    )


def date(unix_s: float) -> str:
    """A day in UTC, for people."""
    return datetime.datetime.fromtimestamp(unix_s, datetime.UTC).strftime("%Y-%m-%d")


def _remedy(member: Member) -> str:
    whose = "--observer" if member.agent_id is None else f"--id {member.agent_id}"
    return f"make a new one with `fleetloc keys rotate {whose}`"


def _issued_by(certificate: x509.Certificate, authority: x509.Certificate) -> bool:
    try:
        certificate.verify_directly_issued_by(authority)
    except (ValueError, TypeError, InvalidSignature):
        return False
    return True


def _builder(
    subject: x509.Name, issuer: x509.Name, key: ec.EllipticCurvePrivateKey, unix_s: float, days: float
) -> x509.CertificateBuilder:
    begin = datetime.datetime.fromtimestamp(int(unix_s - BACKDATE_S), datetime.UTC)
    end = datetime.datetime.fromtimestamp(int(unix_s + days * DAY_S), datetime.UTC)
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(begin)
        .not_valid_after(end)
    )


def _name(common_name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common_name)])


def _general_name(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        return x509.DNSName(host)


def _pem(key: ec.EllipticCurvePrivateKey) -> str:
    encoding, no_password = serialization.Encoding.PEM, serialization.NoEncryption()
    return key.private_bytes(encoding, serialization.PrivateFormat.PKCS8, no_password).decode("ascii")


def _certificate_pem(certificate: x509.Certificate) -> str:
    return certificate.public_bytes(serialization.Encoding.PEM).decode("ascii")


def _read_private_key(path: Path) -> ec.EllipticCurvePrivateKey:
    if not os.path.isfile(path):
        raise KeyFileError(f"{path}: no such private key; see `fleetloc keys init --missing`, or copy it here")
    check_mode(path, forbidden=OTHERS, remedy=f"chmod 600 {path}")
    try:
        key = serialization.load_pem_private_key(read_text(path).encode("ascii"), password=None)
    except (ValueError, TypeError):
        raise KeyFileError(f"{path}: expected a private key in PEM without password") from None
    if not isinstance(key, ec.EllipticCurvePrivateKey):
        raise KeyFileError(f"{path}: expected a private key of an elliptic curve")
    return key
