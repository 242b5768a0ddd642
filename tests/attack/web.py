"""Attacks on the ports besides the plain one: requests of the web port, WebSocket's own frames, TLS's greetings.

Section 2. What agents say is the same on each port; this is what those ports understand besides.
"""

from __future__ import annotations

import os
import socket
import ssl
import struct
import threading
from collections.abc import Callable
from contextlib import suppress
from itertools import count
from typing import Any

from tests.attack.raw import FROM, Agent, frame, management, metadata, request
from tests.attack.table import Target, attack

MESSAGE, MORE = 0x02, 0x00
"""Opcodes; with FIN they have 0x80 besides."""
FIN = 0x80


def connected(target: Target) -> socket.socket:
    """A socket that has said nothing yet."""
    opened = socket.socket()
    opened.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    opened.bind((FROM, 0))
    opened.settimeout(5)
    opened.connect(("127.0.0.1", target.port))
    return opened


def asking(target: Target, path: str) -> bytes:
    """A request, whose connection goes on."""
    return f"GET {path} HTTP/1.1\r\nHost: 127.0.0.1:{target.port}\r\n\r\n".encode()


def together(target: Target, threads: int, run: object) -> None:
    """Run this in so many threads, again whenever its connection ends."""
    assert callable(run)

    def again() -> None:
        while target.running():
            with suppress(OSError, ValueError, struct.error):
                run()

    for _ in range(threads):
        threading.Thread(target=again, daemon=True).start()
    while target.rest(0.2):
        pass


def small_frame(opcode: int, data: bytes = b"") -> bytes:
    """A WebSocket frame of a client, masked with zeros."""
    return struct.pack(">BB", opcode, 0x80 | len(data)) + bytes(4) + data


@attack(2, "headset", way="web")
def web_requests_at_full_rate(target: Target) -> None:
    """Whatever the web port answers, at full rate: pages, figures, robots, types, traces, under ever other names."""
    number = count()

    def ask() -> None:
        opened = connected(target)
        threading.Thread(target=_drain, args=(opened,), daemon=True).start()
        while target.running():
            at = next(number)
            paths = ["/", "/metrics", "/diagnostics", "/view/mesh", "/view/me", "/readyz", f"/none{at}"]
            paths += [f"/view/robots/{robot}/{what}" for robot in (1, 2) for what in ("status", "offers")]
            paths += [f"/types/1/std_msgs/msg/A{at}", f"/view/trace/1?topic=/t{at % 40}"]
            opened.sendall(b"".join(asking(target, path) for path in paths))

    together(target, 24, ask)


@attack(2, "headset", way="web")
def web_requests_that_do_not_end(target: Target) -> None:
    """As many connections as are let in, whose requests come byte by byte, or have a body that does not come."""
    heads = [b"GET / HTTP/1.1\r\nX: ", b"POST /login HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 4000\r\n\r\n{"]
    here: list[socket.socket] = []
    while target.running():
        with suppress(OSError):
            here.append(connected(target))
            here[-1].sendall(heads[len(here) % 2])
        for each in here:
            with suppress(OSError):
                each.sendall(b"x" * 200)
        if len(here) > 300:
            here.pop(0).close()


@attack(2, "headset", way="web")
def web_frames_of_nothing(target: Target) -> None:
    """Twenty WebSockets with a message that goes on for ever in frames without a byte in them."""
    nothing = small_frame(MORE) * 10_000

    def send() -> None:
        agent = Agent(target.port)
        agent.socket.sendall(b"")
        whole = agent.socket
        plain = getattr(whole, "_socket")  # noqa: B009 - below what makes messages of it
        plain.sendall(small_frame(MESSAGE))
        while target.running():
            plain.sendall(nothing)

    together(target, 20, send)


@attack(2, "headset", way="web")
def web_messages_of_a_byte(target: Target) -> None:
    """Twenty WebSockets that send small messages to nobody, each byte as a message of its own."""
    said = frame(metadata=metadata(message_manager="Hello"), data=b"x", to=2, ids=[60_000])
    bytewise = b"".join(small_frame(FIN | MESSAGE, said[at : at + 1]) for at in range(len(said))) * 20

    def send() -> None:
        agent = Agent(target.port)
        plain = getattr(agent.socket, "_socket")  # noqa: B009 - below what makes messages of it
        while target.running():
            plain.sendall(bytewise)

    together(target, 20, send)


@attack(2, "headset", way="web")
def web_sockets_that_come_and_go(target: Target) -> None:
    """WebSockets at full rate that end at once, some without a goodbye, some in the middle of the greeting."""

    def come() -> None:
        Agent(target.port, read=False).close(reset=True)
        half = connected(target)
        half.sendall(b"GET /macs HTTP/1.1\r\nUpgrade: websocket\r\nSec-WebSocket-Key: ")
        half.close()

    together(target, 8, come)


@attack(2, "headset", way="tls")
def tls_greetings(target: Target) -> None:
    """TLS greetings at full rate: whole ones that end at once, halves, and what is none."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    number = count()

    def greet() -> None:
        opened = connected(target)
        at = next(number)
        if at % 10 == 0:
            opened.sendall(b"\x16\x03\x01\x02\x00" + os.urandom(100))
        elif at % 10 == 1:
            opened.sendall(b"GET / HTTP/1.1\r\n\r\n")
        else:
            opened = context.wrap_socket(opened)
        opened.close()

    together(target, 8, greet)


@attack(2, "headset", way="tls")
def tls_records_of_a_byte(target: Target) -> None:
    """Forty headsets that send RobotStatus without end, each byte encrypted for itself, from the same moment on."""
    said = request("RobotStatus")
    agents = [Bytewise(target) for _ in range(40)]
    ready = [agent.encrypted(said * (CRUMBS // len(said))) for agent in agents]
    while target.running():
        for agent, records in zip(agents, ready, strict=True):
            with suppress(OSError):
                agent.plain.sendall(records)
        ready = [agent.encrypted(said) for agent in agents]


CRUMBS = 20_000


class Bytewise:
    """A headset over TLS that encrypts by hand."""

    def __init__(self, target: Target) -> None:
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
        self._came, self._goes = ssl.MemoryBIO(), ssl.MemoryBIO()
        self._tls = context.wrap_bio(self._came, self._goes)
        self.plain = connected(target)
        self._until_done(self._tls.do_handshake)
        greeting = struct.unpack("<I", self._exactly(4))[0]
        self._exactly(greeting)
        self._exactly(struct.unpack("<I", self._exactly(4))[0])
        self._tls.write(frame(management("AgentclientConfigurer", agent_type=2, agent_id=1, group_id=0)))
        self.plain.sendall(self._goes.read())
        threading.Thread(target=_drain, args=(self.plain,), daemon=True).start()

    def encrypted(self, data: bytes) -> bytes:
        """A record for each byte."""
        for at in range(len(data)):
            self._tls.write(data[at : at + 1])
        return self._goes.read()

    def _exactly(self, count: int) -> bytes:
        data = b""
        while len(data) < count:
            data += self._until_done(lambda: self._tls.read(count - len(data)))  # noqa: B023 - called at once
        return data

    def _until_done(self, step: Callable[[], Any]) -> Any:
        while True:
            try:
                done = step()
            except ssl.SSLWantReadError:
                self.plain.sendall(self._goes.read())
                self._came.write(self.plain.recv(1 << 16))
            else:
                self.plain.sendall(self._goes.read())
                return done


def _drain(opened: socket.socket) -> None:
    with suppress(OSError):
        opened.settimeout(None)
        while opened.recv(1 << 20):
            pass
