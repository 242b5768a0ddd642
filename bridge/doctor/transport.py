"""Below Zenoh: whether an endpoint's host answers, and what is wrong with TLS. Zenoh itself only says that it timed
out. Blocking; `gather` calls it in threads."""

from __future__ import annotations

import socket
import ssl
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from macs_zenoh.protocol import greetings
from macs_zenoh.protocol.endpoints import written

from .facts import Certificate, Reach, Speaker, Tls, TlsProblem

ALERT_S = 0.3
"""With TLS 1.3 a server refuses the client's certificate after the handshake: how much longer than that to listen."""

_VERIFY_CODES: dict[int, TlsProblem] = {
    9: "not_yet_valid",
    10: "expired",
    18: "unknown_ca",
    19: "unknown_ca",
    20: "unknown_ca",
    21: "unknown_ca",
    62: "wrong_name",
    64: "wrong_name",
}
"""OpenSSL's X509_V_ERR_* numbers."""


def reach(host: str, port: int, timeout_s: float) -> tuple[Reach, str]:
    """Whether a TCP connection opens there."""
    try:
        socket.create_connection((host, port), timeout_s).close()
    except ConnectionRefusedError as error:
        return "refused", str(error)
    except TimeoutError:
        return "silent", f"no answer within {timeout_s:g} s"
    except socket.gaierror as error:
        return "unknown_host", error.strerror or str(error)
    except OSError as error:
        return "unreachable", error.strerror or str(error)
    return "ok", ""


def speaks_tls(host: str, port: int, timeout_s: float) -> bool:
    """Whether a TLS handshake gets an answer there, whatever the certificate."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname = False
    context.verify_mode = ssl.CERT_NONE
    try:
        with socket.create_connection((host, port), timeout_s) as plain, context.wrap_socket(plain):
            return True
    except ssl.SSLError as error:
        return "ALERT" in (error.reason or "")
    except OSError:
        return False


def answers(host: str, port: int, timeout_s: float) -> Speaker:
    """Who is there, by what it answers to what a Zenoh program says first; a gateway does not wait for that."""
    first = b""
    try:
        with socket.create_connection((host, port), timeout_s) as there:
            there.sendall(greetings.INIT_SYN)
            while len(first) < greetings.ENOUGH_BYTES and (more := there.recv(greetings.ENOUGH_BYTES)):
                first += more
                if greetings.is_gateway(first):
                    return "gateway"
                if greetings.is_zenoh(first):
                    return "zenoh"
    except OSError:
        pass
    return "other" if first else "silent"


def router_beside(host: str, timeout_s: float) -> str:
    """The endpoint of a router on this host at the usual port; empty without one."""
    return written("tcp", host, 7447) if answers(host, 7447, timeout_s) == "zenoh" else ""


def tls(host: str, port: int, settings: Mapping[str, Any], timeout_s: float) -> Tls:
    """A handshake with the certificates that Zenoh would use, and what is wrong with it."""
    try:
        context = _context(settings)
    except _OwnFiles as error:
        return Tls(problem="own_files", detail=str(error))
    try:
        with socket.create_connection((host, port), timeout_s) as plain:
            began = time.monotonic()
            with context.wrap_socket(plain, server_hostname=host) as secure:
                found = secure.getpeercert() or {}
                # a refusal of our certificate comes only now, one way later
                secure.settimeout(ALERT_S + 2 * (time.monotonic() - began))
                if (problem := _refusal(secure)) is not None:
                    return problem
                return Tls(certificate=_certificate(found))
    except ssl.SSLCertVerificationError as error:
        return Tls(problem=_VERIFY_CODES.get(error.verify_code, "failed"), detail=error.verify_message)
    except ssl.SSLError as error:
        return Tls(problem=_alert(error), detail=_words(error))
    except TimeoutError:
        return Tls(problem="no_tls", detail="no answer to the TLS handshake")
    except OSError as error:
        return Tls(problem="no_tls", detail=f"the connection was closed: {error.strerror or error}")


def _context(settings: Mapping[str, Any]) -> ssl.SSLContext:
    authority = settings.get("root_ca_certificate")
    with _naming(authority):
        context = ssl.create_default_context(cafile=authority)
    # stricter than Zenoh, from Python 3.13 on
    context.verify_flags &= ~getattr(ssl, "VERIFY_X509_STRICT", 0)
    context.check_hostname = settings.get("verify_name_on_connect") not in (False, "false")
    if presents_certificate(settings):
        certificate, key = settings["connect_certificate"], settings.get("connect_private_key")
        with _naming(certificate, key):
            context.load_cert_chain(certificate, key)
    return context


class _OwnFiles(Exception):
    """Files of ours cannot be used; says which, and why."""


@contextmanager
def _naming(*paths: str | None) -> Iterator[None]:
    """Name the file that cannot be read, or those that were loaded together, since Python's errors do not."""
    given = [path for path in paths if path]
    try:
        for path in given:
            with Path(path).open("rb"):
                pass
        yield
    except OSError as error:  # of TLS as well
        named = "" if error.filename else f"{' with '.join(given)}: "
        raise _OwnFiles(named + _words(error)) from error


def presents_certificate(settings: Mapping[str, Any]) -> bool:
    """Whether a client shows its certificate: only with ``enable_mtls``."""
    return settings.get("enable_mtls") in (True, "true") and bool(settings.get("connect_certificate"))


def _refusal(secure: ssl.SSLSocket) -> Tls | None:
    try:
        secure.recv(1)
    except TimeoutError:
        return None  # it waits for what Zenoh would say
    except ssl.SSLError as error:
        return Tls(problem=_alert(error), detail=_words(error))
    except OSError as error:
        return Tls(problem="client_certificate_refused", detail=error.strerror or str(error))
    return None


def _alert(error: ssl.SSLError) -> TlsProblem:
    reason = error.reason or ""
    if "CERTIFICATE_REQUIRED" in reason or "HANDSHAKE_FAILURE" in reason:
        return "client_certificate_missing"
    if "ALERT" in reason and ("CERTIFICATE" in reason or "UNKNOWN_CA" in reason or "DECRYPT" in reason):
        return "client_certificate_refused"
    if "WRONG_VERSION_NUMBER" in reason or "UNEXPECTED_EOF" in reason or "RECORD_LAYER" in reason:
        return "no_tls"
    return "failed"


def _words(error: OSError) -> str:
    if isinstance(error, ssl.SSLError):
        return (error.reason or str(error)).lower().replace("_", " ")
    return f"{error.filename}: {error.strerror}" if error.filename else str(error)


def _certificate(found: Mapping[str, Any]) -> Certificate | None:
    if "notAfter" not in found:
        return None
    names = {name: value for part in found.get("subject", ()) for name, value in part}
    return Certificate(subject=names.get("commonName", ""), ends_s=float(ssl.cert_time_to_seconds(found["notAfter"])))


def certificates(settings: Mapping[str, Any]) -> list[Certificate]:
    """Those in our own files: the one we show, and the CA. None without the library that reads them."""
    try:
        from cryptography import x509
    except ImportError:
        return []
    found = []
    for field in ("connect_certificate", "root_ca_certificate"):
        path = settings.get(field)
        try:
            read = x509.load_pem_x509_certificates(Path(path).read_bytes()) if path else []
        except (OSError, ValueError):
            continue  # the handshake says what is wrong with them
        for certificate in read:
            name = certificate.subject.rfc4514_string()
            ends_s = certificate.not_valid_after_utc.timestamp()
            found.append(Certificate(subject=f"{Path(path or '').name} ({name})", ends_s=ends_s))
    return found
