"""``macs security headset``: what it prints is so, tried with a real gateway, TLS and Chromium."""

from __future__ import annotations

import base64
import hashlib
import json
import socket
import ssl
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
from cryptography import x509
from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat

from bridge.security.headset_ways import own_addresses, own_names, ways
from tests.support.browser import SCREENSHOTS, browser, chromium, needs_browser
from tests.support.programs import Program, ended, free_port, macs
from tests.support.routers import Router

HOSTS = ("192.0.2.7", "robot-hall.local", "robot-hall")


async def certified(into: Path, port: int) -> Any:
    hosts = [word for host in HOSTS for word in ("--address", host)]
    return await macs("security", "headset", "--into", str(into), "--port", str(port), *hosts, "--json")


def gateway(router: str, into: Path, port: int) -> Program:
    """As the verb says, and open to who has no token."""
    page = into / "page"
    settings = into / "macs.toml"
    settings.write_text(f'[gateway]\nweb_names = {json.dumps(list(HOSTS))}\nweb_without_token = "everybody"\n')
    files = ("--certificate", str(page / "cert.pem"), "--key", str(page / "key.pem"))
    return Program(
        *("gateway", "-e", router, "--port", "0", "--host", "0.0.0.0", "--web-port", str(port), *files),
        *("--settings", str(settings)),
    )


def test_addresses_and_names_are_this_machines() -> None:
    """None that only this machine reaches."""
    assert not [address for address in own_addresses() if address.startswith("127.")]
    assert all(socket.gethostname().lower().startswith(name.removesuffix(".local")) for name in own_names())


def test_where_there_is_no_certificate_the_cable_is_the_way() -> None:
    """An address without one is told to be none."""
    usb, address = ways(["192.0.2.7"], 7080, None)
    assert (usb.url, usb.secure) == ("http://localhost:7080/xr", True)
    assert "adb reverse tcp:7080 tcp:7080" in usb.steps
    assert (address.url, address.secure) == ("http://192.0.2.7:7080/xr", False)


async def test_the_certificate_holds_for_each_address_that_is_printed(tmp_path: Path) -> None:
    """A TLS client that trusts the authority gets the page by each name, and by no other; who does not trust it does
    not. The certificate stays until its addresses change."""
    port = free_port()
    said = await certified(tmp_path / "pki", port)
    assert [way["kind"] for way in said["ways"]] == ["usb", "https", "https", "https"]
    before = (tmp_path / "pki" / "page" / "cert.pem").read_bytes()
    await certified(tmp_path / "pki", port)
    assert (tmp_path / "pki" / "page" / "cert.pem").read_bytes() == before
    async with Router() as router, gateway(router.endpoint, tmp_path / "pki", port):
        trusting = ssl.create_default_context(cafile=said["authority"])
        for host in [urlsplit(way["url"]).hostname for way in said["ways"]]:
            assert b"200 OK" in answer(trusting, host, port)
        with pytest.raises(ssl.SSLCertVerificationError):
            answer(trusting, "elsewhere.local", port)
        with pytest.raises(ssl.SSLCertVerificationError):
            answer(ssl.create_default_context(), HOSTS[0], port)


def answer(context: ssl.SSLContext, host: str, port: int) -> bytes:
    with (
        socket.create_connection(("127.0.0.1", port), timeout=30) as plain,
        context.wrap_socket(plain, server_hostname=host) as secure,
    ):
        secure.sendall(f"GET /xr HTTP/1.1\r\nHost: {host}:{port}\r\nConnection: close\r\n\r\n".encode())
        return secure.recv(64)


@needs_browser
@pytest.mark.skipif(chromium(whole=True) is None, reason="the warning is the browser's own: apt-get install chromium")
async def test_chromium_takes_them_for_secure(tmp_path: Path) -> None:
    """Each address that is said to be secure is, where the authority is trusted, and WebXR is there. One without TLS
    is not. Who does not trust it sees the browser's warning, of which a picture is kept, and a
    secure context behind it."""
    port, plain_port = free_port(), free_port()
    said = await certified(tmp_path / "pki", port)
    own = x509.load_pem_x509_certificate((tmp_path / "pki" / "page" / "cert.pem").read_bytes())
    key = own.public_key().public_bytes(Encoding.DER, PublicFormat.SubjectPublicKeyInfo)
    trusted = f"--ignore-certificate-errors-spki-list={base64.b64encode(hashlib.sha256(key).digest()).decode()}"
    here = f"--host-resolver-rules={','.join(f'MAP {host} 127.0.0.1' for host in HOSTS)}"
    async with (
        Router() as router,
        gateway(router.endpoint, tmp_path / "pki", port),
        Program("gateway", "-e", router.endpoint, "--port", "0", "--web-port", str(plain_port)),
    ):
        async with browser(trusted, here) as chromium:
            for way in said["ways"]:
                page = await chromium.new_page()
                await page.goto(way["url"])
                assert await page.evaluate("[isSecureContext, 'xr' in navigator]") == [way["secure"]] * 2, way
            page = await chromium.new_page()
            await page.goto(f"http://localhost:{plain_port}/xr")
            assert await page.evaluate("[isSecureContext, 'xr' in navigator]") == [True, True]
        async with browser(here, whole=True) as chromium:
            page = await chromium.new_page()
            with pytest.raises(Exception, match="ERR_CERT_AUTHORITY_INVALID"):
                await page.goto(f"https://{HOSTS[1]}:{port}/xr")
            SCREENSHOTS.mkdir(parents=True, exist_ok=True)
            await page.screenshot(path=SCREENSHOTS / "certificate-warning.png")
            await page.click("#details-button")
            await page.click("#proceed-link")
            await page.wait_for_url(f"https://{HOSTS[1]}:{port}/xr")
            assert await page.evaluate("[isSecureContext, 'xr' in navigator]") == [True, True]


async def test_wrong_words_are_told(tmp_path: Path) -> None:
    """Exit code 2, and which."""
    for words in (("--days", "0"), ("--days", "826"), ("--port", "0")):
        code, _, errors = await ended("security", "headset", "--into", str(tmp_path), *words)
        assert code == 2
        assert words[0] in errors


async def test_what_a_person_sees_has_the_picture_of_the_address(tmp_path: Path) -> None:
    """And each step once."""
    code, out, errors = await ended("security", "headset", "--into", str(tmp_path), "--address", HOSTS[0])
    assert code == 0, errors
    assert "▀" in out or "█" in out
    assert out.count("adb reverse") == 1
    assert f"https://{HOSTS[0]}:7080/xr" in out
