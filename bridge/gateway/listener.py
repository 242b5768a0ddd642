"""The door itself: accepts connections as long as there are descriptors, and says when there are none.

libuv closes whom it has no descriptor for without a word, so this is done here where they can run out. Some are kept
for what a gateway needs besides: its links to routers, above all.
"""

from __future__ import annotations

import asyncio
import logging
import resource
import socket
import ssl
import sys
from collections import Counter, OrderedDict, deque
from collections.abc import Callable
from typing import Any

from macs_zenoh.losses import Losses

log = logging.getLogger("macs.gateway")

BACKLOG = 1024
AT_ONCE = 64
"""How many are accepted before others have their turn."""

PAUSE_S = 0.2
"""So long nobody is accepted when the system has no room: who connects meanwhile waits."""

GREETING = 512
GREETING_PER_ADDRESS = 128
"""So many may be in the middle of TLS's greeting: they are no connections yet, which others count."""

GREETED_AT_ONCE = 16
"""Of these, so many of one address, and the others behind them, milliseconds apart: each takes about one."""
GREETING_EVERY_S = 0.003

SHUTDOWN_S = 2.0
"""How long the other end has to answer TLS's goodbye."""

KEPT = 64
"""Descriptors that connections do not get; of few, an eighth."""


def descriptors() -> int:
    """How many descriptors connections may have."""
    limit, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    return limit - min(KEPT, limit // 8) if limit != resource.RLIM_INFINITY else 1 << 30


class Listener:
    """One listening socket. ``drops`` counts those for whom there was no descriptor or, over TLS, no place."""

    def __init__(
        self,
        listening: socket.socket,
        protocol: Callable[[], asyncio.BaseProtocol],
        drops: Losses,
        *,
        context: ssl.SSLContext | None = None,
        handshake_s: float = 10.0,
    ) -> None:
        """``context`` is for TLS, whose greeting may take ``handshake_s``. Raises OSError when somebody else listens
        there."""
        self._context = context
        self._handshake_s = handshake_s
        self._greeting: Counter[str] = Counter()
        """Who is to be greeted, or is being so, by address."""
        self._greeted: Counter[str] = Counter()
        """Who is being greeted."""
        self._to_greet: OrderedDict[str, deque[tuple[socket.socket, float]]] = OrderedDict()
        """Who waits for that, and since when; of addresses the one whose turn it is comes first."""
        self._greets: asyncio.TimerHandle | None = None
        self._listening = listening
        self._protocol = protocol
        self._drops = drops
        self._loop = asyncio.get_running_loop()
        self._again: asyncio.TimerHandle | None = None
        self._accepting: set[asyncio.Task[object]] = set()
        listening.setblocking(False)
        listening.listen(BACKLOG)
        self._listen()

    def close(self) -> None:
        """Accept nobody any more."""
        for timer in (self._again, self._greets):
            if timer is not None:
                timer.cancel()
        for waiting in self._to_greet.values():
            for accepted, _ in waiting:
                accepted.close()
        self._to_greet.clear()
        if self._listening.fileno() >= 0:
            self._loop.remove_reader(self._listening.fileno())
        self._listening.close()

    def _listen(self) -> None:
        self._again = None
        self._loop.add_reader(self._listening.fileno(), self._accept)

    def _accept(self) -> None:
        for _ in range(AT_ONCE):
            try:
                accepted, address = self._listening.accept()
            except (BlockingIOError, InterruptedError, ConnectionAbortedError):
                return
            except OSError as error:  # EMFILE, ENFILE, ENOBUFS, ENOMEM
                self._turned_away(error.strerror or str(error))
                self._loop.remove_reader(self._listening.fileno())
                self._again = self._loop.call_later(PAUSE_S, self._listen)
                return
            if accepted.fileno() >= descriptors():  # the lowest free number: so many are in use
                accepted.close()
                self._turned_away(str(address[0]))
                continue
            host = str(address[0])
            if self._context is not None and not self._has_place(host):
                accepted.close()
                problem = "%s: turned away, for too many are in the middle of TLS's greeting"
                self._drops.once("too_many_greetings", problem, host)
                continue
            self._greeting[host] += 1
            accepted.setblocking(False)
            if self._context is None:
                self._connect(accepted, host)
            else:
                self._to_greet.setdefault(host, deque()).append((accepted, self._loop.time()))
                if self._greets is None:
                    self._greets = self._loop.call_later(0, self._greet_next)

    def _connect(self, accepted: socket.socket, host: str) -> None:
        self._greeted[host] += 1
        task: asyncio.Task[object] = self._loop.create_task(self._connected(accepted, host))
        self._accepting.add(task)
        task.add_done_callback(self._accepting.discard)

    def _greet_next(self) -> None:
        """Begin TLS's greeting with the next whose turn it is."""
        self._greets = None
        if not self._to_greet:
            return
        self._greets = self._loop.call_later(GREETING_EVERY_S, self._greet_next)
        host = next((host for host in self._to_greet if self._greeted[host] < GREETED_AT_ONCE), None)
        if host is None:
            return  # until one of these has ended
        waiting = self._to_greet.pop(host)
        accepted, since = waiting.popleft()
        if waiting:
            self._to_greet[host] = waiting  # to the back
        if self._loop.time() - since < self._handshake_s:
            self._connect(accepted, host)
        else:
            accepted.close()
            self._drops.once("too_many_greetings", "%s: turned away, for its greeting would not begin in time", host)
            self._has_left(host)

    def _turned_away(self, whom: str) -> None:
        """There was no descriptor for a connection."""
        problem = "%s: turned away, for there are no descriptors left (ulimit -n)"
        self._drops.once("no_descriptors", problem, whom, level=logging.ERROR)

    def _has_place(self, host: str) -> bool:
        return self._greeting.total() < GREETING and self._greeting[host] < GREETING_PER_ADDRESS

    async def _connected(self, accepted: socket.socket, host: str) -> None:
        tls: dict[str, Any] = {}
        if self._context is not None:
            tls = {"ssl": self._context, "ssl_handshake_timeout": self._handshake_s}
            if sys.version_info >= (3, 11):
                tls["ssl_shutdown_timeout"] = SHUTDOWN_S
        try:
            await self._loop.connect_accepted_socket(self._protocol, accepted, **tls)
        except (OSError, asyncio.TimeoutError) as error:  # it is gone already, or does not speak TLS
            log.debug("a connection ended at once: %s", error)
            accepted.close()
        finally:
            self._greeted[host] -= 1
            if self._greeted[host] <= 0:
                del self._greeted[host]
            self._has_left(host)

    def _has_left(self, host: str) -> None:
        self._greeting[host] -= 1
        if self._greeting[host] <= 0:
            del self._greeting[host]
