"""A certificate authority in a directory: its own certificate, and one for each node of a policy.

Keys are made with `cryptography`: EC P-256, which Zenoh's TLS takes. Who somebody is stands in the common name, which
is what a router's access control reads. Only routers have certificates for servers, so that no robot can pass for one.
"""

from __future__ import annotations

import datetime as dt
import ipaddress
import os
import stat
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from bridge.security.policy import Policy, Router
from macs_zenoh.errors import ConfigError, MissingExtra, UsageError

try:
    from cryptography import x509
    from cryptography.exceptions import InvalidSignature
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID
except ImportError as error:
    raise MissingExtra("making certificates", "cryptography", "security") from error

CA_DIRECTORY = "ca"
CERTIFICATE, KEY, AUTHORITY = "cert.pem", "key.pem", "ca.pem"

PRIVATE_DIRECTORY = 0o700
PRIVATE_FILE = 0o600
PUBLIC_FILE = 0o644

EARLIER = dt.timedelta(days=1)
"""A certificate is good from this long before it is made: clocks of robots are late."""

RENEW_BELOW = 1 / 3
"""Of its life: with less left, a certificate is renewed."""


@dataclass(frozen=True)
class Issued:
    """What became of one certificate. ``why`` is empty for one that was kept."""

    name: str
    until: dt.datetime
    why: str = ""


def authority(into: Path, policy: Policy, now: dt.datetime, *, renew: bool = False) -> tuple[Authority, Issued]:
    """The certificate authority of a directory, made where there is none, or with ``renew``.

    Raises ConfigError when its files cannot be used.
    """
    directory = into / CA_DIRECTORY
    certificate, key = directory / AUTHORITY, directory / KEY
    why = "asked" if renew else ""
    if not certificate.exists() and not key.exists():
        why = "new"
    if why:
        return _new_authority(directory, policy, now, why)
    if not (certificate.exists() and key.exists()):
        missing = key if certificate.exists() else certificate
        raise ConfigError(str(missing), "is missing; restore it, or make a new authority with --new-ca")
    found = Authority(_read_certificate(certificate), _read_key(key), certificate.read_bytes())
    if not _belongs(found.certificate, found.key):
        raise ConfigError(str(key), "is not the key of the certificate beside it; use --new-ca")
    if not _is_authority(found.certificate):
        raise ConfigError(str(certificate), "is no authority; use --new-ca")
    return found, Issued(CA_DIRECTORY, _until(found.certificate))


@dataclass(frozen=True)
class Authority:
    """Who signs."""

    certificate: x509.Certificate
    key: ec.EllipticCurvePrivateKey
    pem: bytes

    def issue(self, directory: Path, node: Router | None, policy: Policy, now: dt.datetime, *, renew: bool) -> Issued:
        """The certificate in a node's directory, kept while it is good, else made anew with a new key.

        ``node`` is the router that it is for, None for a client; the directory's name is the node's.
        """
        addresses = node.addresses if node is not None else []
        why = "asked" if renew else self._problem(directory, addresses, now)
        if why:
            self._make(directory, addresses, policy, now)
        elif (directory / AUTHORITY).read_bytes() != self.pem:
            write(directory / AUTHORITY, self.pem, PUBLIC_FILE)
        return Issued(directory.name, _until(_read_certificate(directory / CERTIFICATE)), why)

    def _problem(self, directory: Path, addresses: Sequence[str], now: dt.datetime) -> str:
        """Why the certificate there cannot stay; empty when it can."""
        try:
            certificate, key = _read_certificate(directory / CERTIFICATE), _read_key(directory / KEY)
        except ConfigError:
            return "new" if not (directory / CERTIFICATE).exists() else "unreadable"
        if not (directory / AUTHORITY).exists():
            return "incomplete"
        if not _belongs(certificate, key):
            return "not its key"
        if certificate.subject != _named(directory.name):
            return "other name"
        try:
            certificate.verify_directly_issued_by(self.certificate)
        except (InvalidSignature, ValueError, TypeError):
            return "of another authority"
        if _addresses_of(certificate) != {_address(text) for text in addresses}:
            return "other addresses"
        life = _until(certificate) - certificate.not_valid_before_utc
        left = _until(certificate) - now
        return f"{max(0, left.days)} days left" if left < life * RENEW_BELOW else ""

    def _make(self, directory: Path, addresses: Sequence[str], policy: Policy, now: dt.datetime) -> None:
        until = now + dt.timedelta(days=policy.certificates.days)
        if until > _until(self.certificate):
            raise ConfigError(
                "the certificate authority",
                f"ends on {_until(self.certificate):%Y-%m-%d}, before a certificate made now would: use --new-ca",
            )
        key = ec.generate_private_key(ec.SECP256R1())
        usages = [ExtendedKeyUsageOID.CLIENT_AUTH, *([ExtendedKeyUsageOID.SERVER_AUTH] if addresses else [])]
        builder = (
            _builder(_named(directory.name), self.certificate.subject, key, now, until)
            .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
            .add_extension(_usage(digital_signature=True), critical=True)
            .add_extension(x509.ExtendedKeyUsage(usages), critical=False)
            .add_extension(x509.AuthorityKeyIdentifier.from_issuer_public_key(self.key.public_key()), critical=False)
        )
        if addresses:
            names = x509.SubjectAlternativeName([_address(text) for text in addresses])
            builder = builder.add_extension(names, critical=False)
        private_directory(directory)
        write(directory / KEY, _key_pem(key), PRIVATE_FILE)
        write(directory / CERTIFICATE, _pem(builder.sign(self.key, hashes.SHA256())), PUBLIC_FILE)
        write(directory / AUTHORITY, self.pem, PUBLIC_FILE)


def _new_authority(directory: Path, policy: Policy, now: dt.datetime, why: str) -> tuple[Authority, Issued]:
    key = ec.generate_private_key(ec.SECP256R1())
    subject = _named(f"macs {policy.namespace or 'mesh'} authority")
    until = now + dt.timedelta(days=policy.certificates.ca_days)
    certificate = (
        _builder(subject, subject, key, now, until)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(_usage(key_cert_sign=True, crl_sign=True), critical=True)
        .sign(key, hashes.SHA256())
    )
    private_directory(directory)
    write(directory / KEY, _key_pem(key), PRIVATE_FILE)
    write(directory / AUTHORITY, _pem(certificate), PUBLIC_FILE)
    return Authority(certificate, key, _pem(certificate)), Issued(CA_DIRECTORY, until, why)


def _builder(
    subject: x509.Name, issuer: x509.Name, key: ec.EllipticCurvePrivateKey, now: dt.datetime, until: dt.datetime
) -> x509.CertificateBuilder:
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - EARLIER)
        .not_valid_after(until)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
    )


def _named(common_name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common_name)])


def _usage(*, digital_signature: bool = False, key_cert_sign: bool = False, crl_sign: bool = False) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=digital_signature,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        key_cert_sign=key_cert_sign,
        crl_sign=crl_sign,
        encipher_only=False,
        decipher_only=False,
    )


def certificate_until(directory: Path) -> dt.datetime | None:
    """When the certificate in a node's directory ends; None where there is none."""
    try:
        return _until(_read_certificate(directory / CERTIFICATE))
    except ConfigError:
        return None


def _until(certificate: x509.Certificate) -> dt.datetime:
    return certificate.not_valid_after_utc


def _addresses_of(certificate: x509.Certificate) -> set[x509.GeneralName]:
    try:
        return set(certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value)
    except x509.ExtensionNotFound:
        return set()


def _address(text: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(text))
    except ValueError:
        return x509.DNSName(text)


def _is_authority(certificate: x509.Certificate) -> bool:
    """Whether it may sign for others, and has signed itself."""
    try:
        may_sign = certificate.extensions.get_extension_for_class(x509.BasicConstraints).value.ca
        certificate.verify_directly_issued_by(certificate)
    except (x509.ExtensionNotFound, InvalidSignature, ValueError, TypeError):
        return False
    return may_sign


def _belongs(certificate: x509.Certificate, key: ec.EllipticCurvePrivateKey) -> bool:
    return certificate.public_key() == key.public_key()


# -- files -------------------------------------------------------------------------------------------------------


def check_own(*paths: Path) -> None:
    """Raise ConfigError for what is there and somebody else has put or linked there: whoever prepared a directory
    would have our keys, or we would take his for ours. Nothing is found there: nothing is wrong."""
    for path in paths:
        try:
            found = path.lstat()
        except FileNotFoundError:
            continue
        except OSError as error:
            raise ConfigError(str(path), error.strerror or str(error)) from error
        if stat.S_ISLNK(found.st_mode):
            raise ConfigError(str(path), "is a link; keys are neither read nor written through one")
        if not (stat.S_ISDIR(found.st_mode) or stat.S_ISREG(found.st_mode)):
            raise ConfigError(str(path), "is neither a directory nor a file")
        if found.st_uid not in (os.geteuid(), 0):
            raise ConfigError(str(path), f"belongs to user {found.st_uid}, not to who runs this")
        if found.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
            raise ConfigError(str(path), "can be written by others; take that right from them, or use another place")


def private_directory(path: Path) -> None:
    """Make a directory that only its owner can look into. Raises UsageError; ConfigError where it is not ours."""
    check_own(path)
    try:
        path.mkdir(mode=PRIVATE_DIRECTORY, parents=True, exist_ok=True)
        path.chmod(PRIVATE_DIRECTORY)
    except OSError as error:
        raise UsageError(f"{path}: {error.strerror or error}") from error


def write(path: Path, content: bytes, mode: int) -> None:
    """Write a file whole, with its permissions from the first byte on. Raises UsageError."""
    beside = path.with_name(path.name + ".new")
    try:
        beside.unlink(missing_ok=True)
        with os.fdopen(os.open(beside, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as file:
            file.write(content)
        beside.chmod(mode)  # whatever the umask says
        beside.replace(path)
    except OSError as error:
        raise UsageError(f"{path}: {error.strerror or error}") from error


def _pem(certificate: x509.Certificate) -> bytes:
    return certificate.public_bytes(serialization.Encoding.PEM)


def _key_pem(key: ec.EllipticCurvePrivateKey) -> bytes:
    return key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )


def _read_certificate(path: Path) -> x509.Certificate:
    try:
        return x509.load_pem_x509_certificate(path.read_bytes())
    except OSError as error:
        raise ConfigError(str(path), error.strerror or str(error)) from error
    except ValueError as error:
        raise ConfigError(str(path), f"is no certificate: {error}") from error


def _read_key(path: Path) -> ec.EllipticCurvePrivateKey:
    try:
        key = serialization.load_pem_private_key(path.read_bytes(), password=None)
    except OSError as error:
        raise ConfigError(str(path), error.strerror or str(error)) from error
    except (ValueError, TypeError) as error:
        raise ConfigError(str(path), f"is no private key: {error}") from error
    if not isinstance(key, ec.EllipticCurvePrivateKey):
        raise ConfigError(str(path), "is no EC key")
    return key
