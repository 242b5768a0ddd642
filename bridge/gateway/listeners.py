"""The ports of a gateway: plain TCP, the same over TLS, and the web port. All three lead to one kind of connection."""

from __future__ import annotations

import asyncio
import logging
import os
import ssl
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from bridge.listening import bound
from bridge.settings import GatewaySettings
from macs_zenoh.errors import ConfigError, MissingExtra, Unreachable
from macs_zenoh.losses import Losses
from macs_zenoh.protocol.addresses import is_local, joined, reachable

from .connection import Connection
from .door import Door, Entrance, Entrances
from .listener import BACKLOG, Listener, descriptors
from .tcp import tune

if TYPE_CHECKING:
    from . import Gateway
    from .web import WebPort

log = logging.getLogger("macs.gateway")

OTHER_DESCRIPTORS = 64
"""What a gateway has open besides its connections, of which each takes up to two."""

Connect = Callable[[Entrance], Connection]


class Closable(Protocol):
    """Whatever listens."""

    def close(self) -> None:
        """Accept nobody any more."""


class Certificate:
    """What TLS shows, as the files are: who connects after they have changed gets the new one."""

    def __init__(self, certificate: str, key: str) -> None:
        """Raises ConfigError: they cannot be used."""
        self._files = certificate, key
        self._seen = _times(certificate, key)
        self.context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
        self.context.minimum_version = ssl.TLSVersion.TLSv1_2
        self._load()

    def look(self) -> None:
        """Read the files again if they have changed; what cannot be used changes nothing."""
        seen = _times(*self._files)
        if seen == self._seen or None in seen:
            return
        self._seen = seen
        try:
            # a pair that does not fit leaves the context without one, so it is tried elsewhere
            ssl.create_default_context(ssl.Purpose.CLIENT_AUTH).load_cert_chain(*self._files)
            self._load()
        except (ConfigError, OSError, ssl.SSLError) as error:
            log.error("the certificate stays as it was: %s", error)
        else:
            log.info("%s is another certificate now", self._files[0])

    def _load(self) -> None:
        certificate, key = self._files
        for name in self._files:
            if not os.access(name, os.R_OK):
                raise ConfigError(name, "cannot be read")
        try:
            self.context.load_cert_chain(certificate, key)
        except (OSError, ssl.SSLError) as error:
            why = getattr(error, "reason", None) or error.strerror or str(error)
            raise ConfigError(certificate, f"is no certificate with the key {key}: {why}") from error


def _times(*names: str) -> tuple[float | None, ...]:
    times: list[float | None] = []
    for name in names:
        try:
            times.append(Path(name).stat().st_mtime)
        except OSError:
            times.append(None)
    return tuple(times)


class Listeners:
    """What a gateway has open. ``port``, ``tls_port`` and ``web_port`` are 0 where there is none."""

    def __init__(
        self,
        settings: GatewaySettings,
        entrances: Entrances,
        door: Door,
        connect: Connect,
        drops: Losses,
        gateway: Gateway,
    ) -> None:
        """``connect`` makes what a socket becomes. Raises ConfigError: the certificate cannot be used."""
        self._settings = settings
        self._entrances = entrances
        self._door = door
        self._connect = connect
        self._drops = drops
        self._gateway = gateway
        self._open: list[Closable] = []
        self._few = False
        self._web: WebPort | None = None
        self.port = self.tls_port = self.web_port = 0
        self.certificate: Certificate | None = None
        if settings.certificate is not None and settings.key is not None:
            self.certificate = Certificate(settings.certificate, settings.key)

    @property
    def web_host(self) -> str:
        """Where the web port is."""
        return self._settings.host if self._settings.web_host is None else self._settings.web_host

    @property
    def others(self) -> str:
        """The ports besides the plain one, as a log says them."""
        tls = f", over TLS on port {self.tls_port}" if self.tls_port else ""
        scheme = "http" if self.web_context is None else "https"
        web = f", and on {scheme}://{joined(reachable(self.web_host), self.web_port)}" if self.web_port else ""
        return tls + web

    @property
    def web_context(self) -> ssl.SSLContext | None:
        """What the web port does TLS with: nothing where only this machine reaches it."""
        return None if self.certificate is None or is_local(self.web_host) else self.certificate.context

    async def open(self) -> None:
        """Listen. Raises Unreachable: a port cannot be had. MissingExtra: there is no web server here."""
        settings = self._settings
        self._look_at_room()
        self.port = await self._listen(settings.port, self._entrances.plain, None)
        if settings.tls_port is not None and self.certificate is not None:
            self.tls_port = await self._listen(settings.tls_port, self._entrances.tls, self.certificate.context)
        if settings.web_port is not None:
            self.web_port = await self._open_web(settings.web_port)

    async def _open_web(self, port: int) -> int:
        try:
            from .web import WebPort  # a gateway without a web port needs no web server
        except ModuleNotFoundError as error:
            raise MissingExtra("a web port", "aiohttp", "web") from error
        sockets = bound(self.web_host, port, shared=self._settings.reuse_port)
        number: int = sockets[0].getsockname()[1]
        for listening in sockets:
            tune(listening)
        self._web = WebPort(
            self._settings,
            self._entrances.web,
            self._door,
            self._connect,
            self._drops,
            self.web_context,
            self._gateway,
        )
        try:
            await self._web.open(sockets)
        except OSError as error:
            why = f"cannot listen there: {error.strerror or error}"
            raise Unreachable(joined(self.web_host, number), why) from error
        self._open.append(self._web)
        return number

    def look(self) -> None:
        """See whether the certificate is another one."""
        if self.certificate is not None:
            self.certificate.look()

    async def end(self) -> None:
        """After all connections were closed: end what is left of them."""
        if self._web is not None:
            await self._web.end()

    def close(self) -> None:
        """Accept nobody any more."""
        for listener in self._open:
            listener.close()

    def _look_at_room(self) -> None:
        room = (descriptors() - OTHER_DESCRIPTORS - BACKLOG) // 2
        self._few = room < self._settings.max_connections
        if self._few:
            problem = "gateway.max_connections is %d, and at most %d connections have room: few files may be open"
            log.warning(problem, self._settings.max_connections, max(0, room + BACKLOG // 2))

    async def _listen(self, port: int, entrance: Entrance, context: ssl.SSLContext | None) -> int:
        settings = self._settings
        sockets = bound(settings.host, port, shared=settings.reuse_port)
        number: int = sockets[0].getsockname()[1]

        def protocol() -> Connection:
            return self._connect(entrance)

        for listening in sockets:
            tune(listening)
            try:
                if self._few or context is not None:
                    self._open.append(
                        Listener(
                            listening,
                            protocol,
                            self._drops,
                            context=context,
                            handshake_s=settings.handshake_timeout_s,
                        )
                    )
                else:  # quicker, and silent where there are no descriptors
                    create = asyncio.get_running_loop().create_server
                    self._open.append(await create(protocol, sock=listening, backlog=BACKLOG))
            except OSError as error:  # two gateways can hold a port, and one of them can listen
                why = f"cannot listen there: {error.strerror or error}"
                raise Unreachable(joined(settings.host, number), why) from error
        return number
