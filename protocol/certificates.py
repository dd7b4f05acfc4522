"""Certificates of a private authority: made for a run, and checked before they are used.

The common name of a certificate is its role, ``learner``, ``actor`` or ``viewer``, or a role and a
name of its own, ``actor-lab1``. A folder holds all that one peer needs: the certificate of the
authority, and its own with the key.
"""

import ipaddress
import secrets
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from a2s.protocol.errors import UsageError

AUTHORITY, CERTIFICATE, KEY = "ca.pem", "cert.pem", "key.pem"
AUTHORITY_KEY = "ca.key"
_AUTHORITY_DAYS = 3650
_EARLIER = timedelta(hours=1)  # clocks of other machines may be behind
_RENEW = "make a new one with `a2s certs` where the authority is, and copy it here"


@dataclass(frozen=True, slots=True)
class Authority:
    """The authority of one group of machines; who has its key can make any certificate."""

    certificate: x509.Certificate
    key: ec.EllipticCurvePrivateKey

    @classmethod
    def new(cls, now: datetime) -> "Authority":
        """Make one, valid for ten years."""
        key = ec.generate_private_key(ec.SECP256R1())
        # Of its own: who verifies looks for an issuer by its name.
        name = _named(f"a2s authority {secrets.token_hex(4)}")
        certificate = (
            _valid(now, _AUTHORITY_DAYS)
            .subject_name(name)
            .issuer_name(name)
            .public_key(key.public_key())
            .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
            .add_extension(_usage(signs_certificates=True), critical=True)
            .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), False)
            .sign(key, hashes.SHA256())
        )
        return cls(certificate, key)

    @classmethod
    def read(cls, folder: Path, now: datetime) -> "Authority":
        """Read it.

        Raises:
            UsageError: A file is missing, is something else or does not fit, or it has expired.
        """
        certificate, key = _certificate(folder / AUTHORITY), _key(folder / AUTHORITY_KEY)
        _require_pair(certificate, key, folder / AUTHORITY, folder / AUTHORITY_KEY)
        _require_time(certificate, folder / AUTHORITY, now, "name a new folder for another one")
        return cls(certificate, key)

    def files(self) -> dict[str, bytes]:
        """Give its files by name."""
        return {AUTHORITY: _pem(self.certificate), AUTHORITY_KEY: _key_pem(self.key)}

    def issued(self, folder: Path) -> "Identity | None":
        """Tell whose certificate a folder has; ``None``: no whole one of this authority.

        It may have expired.
        """
        try:
            own, key = _certificate(folder / CERTIFICATE), _key(folder / KEY)
            own.verify_directly_issued_by(self.certificate)
        except (UsageError, ValueError, TypeError, InvalidSignature):
            return None
        return _identity(own) if own.public_key() == key.public_key() else None

    def issue(self, name: str, hosts: list[str], days: int, now: datetime) -> dict[str, bytes]:
        """Make the files of a folder for this common name.

        ``hosts``, names or addresses, are those under which others may reach it: only a peer with
        some can be connected to.
        """
        key = ec.generate_private_key(ec.SECP256R1())
        uses = [ExtendedKeyUsageOID.CLIENT_AUTH]
        if hosts:
            uses.append(ExtendedKeyUsageOID.SERVER_AUTH)
        builder = (
            _valid(now, days)
            .subject_name(_named(name))
            .issuer_name(self.certificate.subject)
            .public_key(key.public_key())
            .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
            .add_extension(_usage(signs_certificates=False), critical=True)
            .add_extension(x509.ExtendedKeyUsage(uses), critical=False)
            .add_extension(
                x509.AuthorityKeyIdentifier.from_issuer_public_key(self.key.public_key()), False
            )
        )
        if hosts:
            names = x509.SubjectAlternativeName([_general_name(host) for host in hosts])
            builder = builder.add_extension(names, critical=False)
        certificate = builder.sign(self.key, hashes.SHA256())
        return {
            AUTHORITY: _pem(self.certificate),
            CERTIFICATE: _pem(certificate),
            KEY: _key_pem(key),
        }


@dataclass(frozen=True, slots=True)
class Identity:
    """What a folder proves.

    Attributes:
        name: The common name.
        hosts: Under which it may be connected to, as they are written.
        expires: When it does.
    """

    name: str
    hosts: tuple[str, ...]
    expires: datetime


def read(folder: Path, now: datetime) -> Identity:
    """Check the files of a folder, and tell whose they are.

    Raises:
        UsageError: The folder or a file is missing or unreadable, a file is something else, they do
            not fit each other, or a certificate is not valid now.
    """
    if not folder.is_dir():
        raise UsageError(f"--tls: found no folder {folder}; make one with `a2s certs`, or copy it")
    own, place = _certificate(folder / CERTIFICATE), folder / CERTIFICATE
    authority = _certificate(folder / AUTHORITY)
    _require_pair(own, _key(folder / KEY), place, folder / KEY)
    try:
        own.verify_directly_issued_by(authority)
    except (ValueError, TypeError, InvalidSignature):
        raise UsageError(
            f"{place}: found a certificate of another authority than {folder / AUTHORITY}, "
            "expected one of the same; copy the whole folder that `a2s certs` made"
        ) from None
    _require_time(authority, folder / AUTHORITY, now, "make new ones with `a2s certs` for all")
    _require_time(own, place, now, _RENEW)
    return _identity(own)


def _identity(certificate: x509.Certificate) -> Identity:
    names = certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    name = str(names[0].value) if names else ""
    return Identity(name, _hosts(certificate), certificate.not_valid_after_utc)


def _named(common_name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common_name)])


def _valid(now: datetime, days: int) -> x509.CertificateBuilder:
    begin = now - _EARLIER
    return (
        x509.CertificateBuilder()
        .serial_number(x509.random_serial_number())
        .not_valid_before(begin)
        .not_valid_after(now + timedelta(days=days))
    )


def _usage(*, signs_certificates: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not signs_certificates,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        key_cert_sign=signs_certificates,
        crl_sign=signs_certificates,
        encipher_only=False,
        decipher_only=False,
    )


def _general_name(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        return x509.DNSName(host)


def _hosts(certificate: x509.Certificate) -> tuple[str, ...]:
    try:
        names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        return ()
    return tuple(str(each.value) for each in names)


def _certificate(path: Path) -> x509.Certificate:
    try:
        return x509.load_pem_x509_certificate(_bytes(path))
    except ValueError:
        raise UsageError(f"{path}: found no certificate in it, expected one in PEM") from None


def _key(path: Path) -> ec.EllipticCurvePrivateKey:
    try:
        key = serialization.load_pem_private_key(_bytes(path), password=None)
    except (ValueError, TypeError):
        raise UsageError(f"{path}: found no key in it, expected one in PEM, unencrypted") from None
    if not isinstance(key, ec.EllipticCurvePrivateKey):
        raise UsageError(f"{path}: found a key of another kind, expected one of `a2s certs`")
    return key


def _bytes(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise UsageError(
            f"{path}: {error.strerror}; expected a file of `a2s certs` that this user can read"
        ) from None


def _require_pair(
    certificate: x509.Certificate, key: ec.EllipticCurvePrivateKey, place: Path, key_place: Path
) -> None:
    if certificate.public_key() != key.public_key():
        raise UsageError(
            f"{key_place}: found the key of another certificate than {place}; "
            "copy both from the same folder"
        )


def _require_time(certificate: x509.Certificate, place: Path, now: datetime, remedy: str) -> None:
    begin, end = certificate.not_valid_before_utc, certificate.not_valid_after_utc
    if now > end:
        raise UsageError(f"{place}: expired on {end:%Y-%m-%d %H:%M} UTC; {remedy}")
    if now < begin:
        raise UsageError(
            f"{place}: valid from {begin:%Y-%m-%d %H:%M} UTC on, and here it is "
            f"{now.astimezone(UTC):%Y-%m-%d %H:%M}; set the clock of this machine"
        )


def _pem(certificate: x509.Certificate) -> bytes:
    return certificate.public_bytes(serialization.Encoding.PEM)


def _key_pem(key: ec.EllipticCurvePrivateKey) -> bytes:
    return key.private_bytes(
        serialization.Encoding.PEM,
        serialization.PrivateFormat.PKCS8,
        serialization.NoEncryption(),
    )
