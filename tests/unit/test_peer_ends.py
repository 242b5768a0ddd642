"""What the benchmarks say to other programs, and read of them, in those programs' own words."""

from __future__ import annotations

import base64
import json
import socket
import struct
import threading
from collections.abc import Iterator

import pytest

from benchmarks.peer_ends import Rosbridge, RosTcp
from benchmarks.robot_ends import Arrivals, pace, stamped

CDR = stamped(300)


@pytest.fixture
def ends() -> Iterator[tuple[socket.socket, socket.socket]]:
    """A client's socket, and its server's."""
    client, server = socket.socketpair()
    server.settimeout(10)
    with client, server:
        yield client, server


def piece(text: bytes) -> bytes:
    """A part of ROS-TCP-Endpoint's messages: its length and itself."""
    return struct.pack("<I", len(text)) + text


def test_ros_tcp(ends: tuple[socket.socket, socket.socket]) -> None:
    """Commands and data have a destination and a content; what the endpoint says of itself is no message."""
    client, server = ends
    peer = RosTcp(client)
    peer.subscribe("/pose")
    said = {"topic": "/pose", "message_name": "std_msgs/UInt8MultiArray"}
    assert server.recv(65536) == piece(b"__subscribe") + piece(json.dumps(said).encode())
    peer.publish("/pose", CDR)
    message = piece(b"/pose") + piece(bytes(CDR))
    assert server.recv(65536) == message
    stream = piece(b"__handshake") + piece(b"{}") + message + message
    assert [cdr for at in range(0, len(stream), 7) for cdr in peer.feed(stream[at : at + 7])] == [bytes(CDR)] * 2


def framed(text: bytes, opcode: int = 1) -> bytes:
    """A WebSocket frame of a server."""
    length = struct.pack(">B", len(text)) if len(text) < 126 else struct.pack(">BH", 126, len(text))
    return bytes([128 | opcode]) + length + text


def test_rosbridge(ends: tuple[socket.socket, socket.socket]) -> None:
    """JSON in frames of a WebSocket; the bytes of a message in base64."""
    client, server = ends

    def answer() -> None:
        asked = server.recv(65536)
        assert asked.startswith(b"GET / HTTP/1.1\r\n")
        assert b"Upgrade: websocket\r\n" in asked
        server.sendall(b"HTTP/1.1 101 Switching Protocols\r\n\r\n")

    answering = threading.Thread(target=answer)
    answering.start()
    peer = Rosbridge(client)
    answering.join()
    peer.subscribe("/pose")
    first, length, *_ = head = server.recv(65536)
    assert (first, length) == (0x81, 128 | len(head) - 6)
    assert json.loads(head[6:])["type"] == "std_msgs/msg/UInt8MultiArray"
    published = {"op": "publish", "topic": "/pose", "msg": {"data": base64.b64encode(bytes(300)).decode()}}
    stream = (
        framed(b"", opcode=9) + framed(json.dumps({"op": "status"}).encode()) + framed(json.dumps(published).encode())
    )
    assert [cdr for at in range(0, len(stream), 7) for cdr in peer.feed(stream[at : at + 7])] == [bytes(CDR)]


def test_what_leads_is_not_counted() -> None:
    """Who commands after a pause has done so for a while before it is measured: of what comes together then a gateway
    passes on the newest alone, which is no loss that a benchmark is about."""
    arrivals = Arrivals()
    sent: list[bytes] = []

    def send(message: bytearray) -> None:
        sent.append(bytes(message))
        arrivals.take(message)

    pace(10, 10_000.0, send, stamped(64), lead=5)
    assert len(sent) == 15
    assert arrivals.report()["got"] == 10
