"""Messages that differ: each has a number in its data and in its request id, and who receives them counts."""

from __future__ import annotations

import socket
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from bridge.headset import frames
from macs_zenoh.protocol.messages import ROS, UNITY, Metadata, NodeType, StreamData, encode_management
from macs_zenoh.protocol.wire import encode_frame, encode_message

_U32 = struct.Struct("<I")
CDR = b"\x00\x01\x00\x00"
FIRST_REQUEST = 1_000_000
"""Request ids have seven digits, so that numbers do not change a message's length."""

VARIED_BYTES = (0, 1, 5, 12)
"""What lengths differ by, in turn."""


Way = dict[str, list[int]]
"""A destination: ids and groups."""


def data(number: int, size: int) -> bytes:
    """Data with a number in it, about so long."""
    return CDR + _U32.pack(number) + bytes(max(0, size - 8 - VARIED_BYTES[number % len(VARIED_BYTES)]))


def messages(sender: int, size: int, count: int, ways: Sequence[Way]) -> Iterator[bytes]:
    """Frames of a headset, to each destination in turn."""
    for number in range(count):
        to = ways[number % len(ways)]
        yield frames.plain_data(
            sender,
            data(number, size),
            to_type=UNITY,
            request_id=FIRST_REQUEST + number,
            ids=to["ids"],
            groups=to["groups"],
        )


def topic(robot: int, size: int, count: int, to: list[int], node: frames.NodeSpec) -> Iterator[bytes]:
    """Topic data of a robot program over TCP."""
    management = encode_management(StreamData({str(UNITY): to}))
    metadata = Metadata(ROS, robot, 0, "", int(NodeType.SUBSCRIBER), node.name, node.data_type).encode()
    for number in range(count):
        yield encode_frame(management=management, message=encode_message(metadata, data(number, size)))


class Load:
    """Frames that are ready to be sent: small ones joined, as a system call for each would measure the sender; of
    large ones all share their zeros."""

    JOINED_BYTES = 32 << 10
    LARGE_BYTES = 16 << 10

    def __init__(self, made: Iterator[bytes], size: int) -> None:
        self._pieces: list[list[bytes | memoryview]] = []
        joined: list[bytes] = []
        zeros = memoryview(bytes(size))
        for frame in made:
            if size > self.LARGE_BYTES:
                own = len(frame) - (size - self.LARGE_BYTES // 2)
                self._pieces.append([frame[:own], zeros[: len(frame) - own]])
                continue
            joined.append(frame)
            if len(frame) * len(joined) > self.JOINED_BYTES:
                self._pieces.append([b"".join(joined)])
                joined = []
        self._pieces.append([b"".join(joined)])

    def send(self, to: socket.socket) -> None:
        """Send all of it, as fast as it is taken."""
        for piece in self._pieces:
            left = sum(map(len, piece)) - to.sendmsg(piece)
            if left:
                to.sendall(b"".join(piece)[-left:])


@dataclass
class Tally:
    """What one connection received: how many messages, and how many of them not after all that were sent before."""

    received: int = 0
    out_of_order: int = 0
    last: int = -1
    _skip: int = 0
    _begun: bytes = b""

    def feed(self, piece: memoryview) -> None:
        """Count what came."""
        at, end = min(self._skip, len(piece)), len(piece)
        self._skip -= at
        if self._begun:
            piece = memoryview(self._begun + piece[at:])
            at, end, self._begun = 0, len(piece), b""
        while at < end:
            if end - at < 4:
                break
            body_at = at + 4 + _U32.unpack_from(piece, at)[0]
            if end - body_at < 12:  # the data's size, CDR, and the number
                break
            number = _U32.unpack_from(piece, body_at + 8)[0]
            self.received += 1
            self.out_of_order += number <= self.last
            self.last = number
            at = body_at + 4 + _U32.unpack_from(piece, body_at)[0]
        if at > end:
            self._skip = at - end
        else:
            self._begun = bytes(piece[at:])


def count(tallies: Sequence[Tally], kept: Sequence[tuple[Tally, bytes]]) -> dict[str, list[int]]:
    """Of each connection: messages received, and how many of them out of order."""
    for tally, piece in kept:
        tally.feed(memoryview(piece))
    return {
        "received": [tally.received for tally in tallies],
        "out_of_order": [tally.out_of_order for tally in tallies],
    }
