"""A worker that is one or more headsets on blocking sockets: sends, receives, echoes, registers.

``python -m benchmarks.headset PORT COUNT GROUP`` connects COUNT headsets to a gateway, or to the plain relay, on
127.0.0.1; with ``robot`` behind it they are existing robot programs, with ``tls CA`` or ``websocket CA`` they come by
TLS or WebSocket, with ``from ADDRESS`` from that address. ``python -m benchmarks.headset sink`` is the far
end for one such worker in place of a gateway.
"""

from __future__ import annotations

import json
import select
import socket
import struct
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

from bridge.headset import frames
from macs_zenoh.protocol.decoders import FrameDecoder, MessageDecoder
from macs_zenoh.protocol.messages import (
    ROS,
    Configuration,
    Functionality,
    Metadata,
    NodeType,
    Welcome,
    encode_data,
    encode_management,
)
from macs_zenoh.protocol.wire import MACS, encode_frame, encode_message, split_message

from . import sequence, ways
from .worker import serve

RECEIVE_BYTES = 1 << 20
SEND_BYTES = 32 << 10
"""Small frames are repeated until they fill this: a system call per frame would measure the sender."""
BEAT_S = 4.0
KEPT_BYTES = 64 << 20
"""Up to so much of what differs is counted only when all has come."""
PATIENCE_S = 5.0
"""How long an answer or a checked message may take."""

TOPIC = frames.NodeSpec(NodeType.SUBSCRIBER, "/bench", "std_msgs/UInt8MultiArray")
"""What headsets register on the robot of `benchmarks.robot`."""


class Headset:
    """One connection that has its id."""

    def __init__(self, sock: socket.socket, agent_id: int) -> None:
        self.socket = sock
        self.id = agent_id
        self.closed = False
        """Whether the other side has closed the connection; what it still owes is lost."""
        self._next_beat = time.monotonic() + BEAT_S

    @classmethod
    def join(
        cls,
        port: int,
        group: int,
        *,
        robot: bool = False,
        way: str = "plain",
        authority: str = "",
        token: str | None = None,
        source: str = "",
    ) -> Headset:
        """Connect and configure: a gateway counts this headset, or robot program, from now on."""
        sock = ways.connect(port, way, authority, source)
        decoder = MessageDecoder()
        while not (messages := decoder.feed(sock.recv(65536))):
            pass
        metadata, data = split_message(messages[0])
        agent_id = int(json.loads(bytes(data))["agentId"])
        number = json.loads(metadata)["requestId"]
        told = encode_management(Configuration(ROS, agent_id, group, number, Functionality()))
        sock.sendall(
            encode_frame(management=told) if robot else frames.configuration(agent_id, group, number, 0, token)
        )
        return cls(sock, agent_id)

    def beat(self) -> None:
        """Send a heartbeat when one is due; never called in the middle of a frame."""
        if time.monotonic() > self._next_beat and not self.closed:
            self._next_beat = time.monotonic() + BEAT_S
            try:
                self.socket.sendall(frames.heartbeat())
            except ConnectionError:
                self.closed = True

    def take(self, buffer: bytearray | memoryview) -> int:
        """Receive some bytes; 0 when the connection is closed. Raises BlockingIOError when none come in time."""
        try:
            got = self.socket.recv_into(buffer)
        except ConnectionError:
            got = 0
        self.closed = self.closed or not got
        return got

    def give_up_after(self, timeout_s: float) -> None:
        """Let a blocking receive end with BlockingIOError: unlike Python's own timeout, without a poll before each."""
        self.socket.setsockopt(
            socket.SOL_SOCKET, socket.SO_RCVTIMEO, struct.pack("ll", int(timeout_s), int(timeout_s % 1 * 1e6))
        )

    def read(self, size: int) -> bytearray:
        """Exactly ``size`` bytes. Raises BlockingIOError when they do not come, EOFError when they cannot."""
        data = bytearray(size)
        view = memoryview(data)
        while len(view):
            got = self.take(view)
            if not got:
                raise EOFError("the connection was closed")
            view = view[got:]
        return data


class Headsets:
    """What a worker can be asked. ``size`` is always that of the data part, in bytes."""

    def __init__(self, headsets: list[Headset]) -> None:
        self.headsets = headsets
        self.first = headsets[0]
        self.buffer = bytearray(RECEIVE_BYTES)
        self._load: sequence.Load

    def beat(self) -> None:
        """Heartbeats, where due."""
        for headset in self.headsets:
            headset.beat()

    # -- sending -------------------------------------------------------------------------------------------------

    def send(self, size: int, count: int, ids: list[int], groups: list[int]) -> dict[str, Any]:
        """Send ``count`` equal frames as fast as they are taken; returns when it began."""
        frame = self._frame(size, ids, groups)
        repeat = min(count, max(1, SEND_BYTES // len(frame)))
        chunk = frame * repeat
        began = time.monotonic()
        with suppress(ConnectionError):  # the receiver sees what is missing
            for _ in range(count // repeat):
                self.first.socket.sendall(chunk)
            self.first.socket.sendall(frame * (count % repeat))
        return {"began": began}

    def message_bytes(self, size: int) -> dict[str, Any]:
        """How long a message is on the wire that carries so much data."""
        return {"message_bytes": len(self._frame(size, [], [])) - MACS.header_bytes}

    def register(self, robots: int = 1, ids: Sequence[int] = ()) -> dict[str, Any]:
        """Every headset registers on the topic of robot 1, of the first so many, or of those with these ids."""
        for headset in self.headsets:
            on = list(ids or range(1, robots + 1))
            headset.socket.sendall(frames.registration(headset.id, TOPIC, on, []))
        return {"registered": len(self.headsets)}

    def prepare(self, size: int, count: int, ways: list[dict[str, list[int]]]) -> dict[str, Any]:
        """Make ``count`` messages that differ in number, request id and length, to these destinations in turn; returns
        how many bytes each destination is to receive."""
        totals = [0] * len(ways)
        for number, frame in enumerate(sequence.messages(self.first.id, size, count, ways)):
            totals[number % len(ways)] += len(frame) - MACS.header_bytes
        self._load = sequence.Load(sequence.messages(self.first.id, size, count, ways), size)
        return {"bytes": totals}

    def prepare_topic(self, size: int, count: int, to: list[int]) -> dict[str, Any]:
        """The same for topic data of a robot program."""
        made = list(sequence.topic(self.first.id, size, count, to, TOPIC))
        whole = sum(map(len, made)) - sum(FrameDecoder().feed(made[0])[0].message_at for _ in made)
        self._load = sequence.Load(iter(made), size)
        return {"bytes": whole}

    def send_prepared(self) -> dict[str, Any]:
        """Send what was prepared; returns when it began."""
        began = time.monotonic()
        with suppress(ConnectionError):  # the receiver sees what is missing
            self._load.send(self.first.socket)
        return {"began": began}

    # -- receiving -----------------------------------------------------------------------------------------------

    def check(self, size: int, count: int) -> dict[str, Any]:
        """Receive ``count`` messages on every connection; returns how many had exactly the data that was sent."""
        wanted = _data(size)
        good = 0
        for headset in self.headsets:
            headset.give_up_after(PATIENCE_S)
            try:
                for _ in range(count):
                    headset.read(*struct.unpack("<I", headset.read(4)))  # metadata
                    good += headset.read(*struct.unpack("<I", headset.read(4))) == wanted
            except (BlockingIOError, EOFError):
                break  # the run sees the number
        return {"good": good}

    def receive(self, total_bytes: int, timeout_s: float) -> dict[str, Any]:
        """Count bytes on every connection until each has ``total_bytes``, or nothing comes for ``timeout_s``."""
        counts = self._receive_one if len(self.headsets) == 1 else self._receive_many
        return {"bytes": counts(total_bytes, timeout_s), "ended": time.monotonic()}

    def _receive_one(self, total_bytes: int, timeout_s: float) -> list[int]:
        self.first.give_up_after(timeout_s)
        received = 0
        with suppress(BlockingIOError):
            while received < total_bytes and (got := self.first.take(self.buffer)):
                received += got
                self.first.beat()
        return [received]

    def _receive_many(self, total_bytes: int, timeout_s: float) -> list[int]:
        received = [0] * len(self.headsets)
        by_descriptor = {headset.socket.fileno(): i for i, headset in enumerate(self.headsets)}
        with select.epoll() as ready:
            for descriptor in by_descriptor:
                ready.register(descriptor, select.EPOLLIN)
            missing = len(received)
            while missing and (events := ready.poll(timeout_s)):
                for descriptor, _ in events:
                    i = by_descriptor[descriptor]
                    got = self.headsets[i].take(self.buffer)
                    received[i] += got
                    if not got or received[i] >= total_bytes:
                        ready.unregister(descriptor)
                        missing -= 1
                self.beat()
        return received

    def receive_sequence(self, totals: list[int], timeout_s: float) -> dict[str, Any]:
        """Receive what was prepared until each connection has its bytes, or nothing comes for ``timeout_s``: how many
        messages each received, and how many of them out of order."""
        tallies = [sequence.Tally() for _ in self.headsets]
        by_descriptor = {headset.socket.fileno(): i for i, headset in enumerate(self.headsets)}
        kept: list[tuple[sequence.Tally, bytes]] = []
        left = list(totals)
        at_once = sum(totals) > KEPT_BYTES  # otherwise in the end: it would slow down the receiver
        view = memoryview(self.buffer)
        with select.epoll() as ready:
            for descriptor in by_descriptor:
                ready.register(descriptor, select.EPOLLIN)
            missing = len(left)
            while missing and (events := ready.poll(timeout_s)):
                for descriptor, _ in events:
                    i = by_descriptor[descriptor]
                    got = self.headsets[i].take(self.buffer)
                    if at_once:
                        tallies[i].feed(view[:got])
                    else:
                        kept.append((tallies[i], bytes(view[:got])))
                    left[i] -= got
                    if not got or left[i] <= 0:
                        ready.unregister(descriptor)
                        missing -= 1
                self.beat()
        ended = time.monotonic()
        return {"ended": ended, **sequence.count(tallies, kept)}

    # -- both ----------------------------------------------------------------------------------------------------

    def ping(self, size: int, count: int, to_type: int, to: int, answer_bytes: int) -> dict[str, Any]:
        """Send a message and wait for its answer, ``count`` times; returns the seconds that each took."""
        frame = frames.plain_data(self.first.id, _data(size), to_type=to_type, ids=[to])
        self.first.give_up_after(PATIENCE_S)
        times = []
        with suppress(BlockingIOError, EOFError):
            for _ in range(count):
                began = time.perf_counter()
                self.first.socket.sendall(frame)
                self._skip(answer_bytes)
                times.append(time.perf_counter() - began)
        return {"times": times}

    def echo(self, size: int, count: int, to: int, message_bytes: int) -> dict[str, Any]:
        """Answer ``count`` messages of ``message_bytes`` with one that carries ``size`` bytes."""
        frame = self._frame(size, [to], [])
        self.first.give_up_after(PATIENCE_S)
        answered = 0
        with suppress(BlockingIOError, EOFError):
            while answered < count:
                self._skip(message_bytes)
                self.first.socket.sendall(frame)
                answered += 1
        return {"answered": answered}

    def _skip(self, size: int) -> None:
        received = 0
        while received < size:
            got = self.first.take(self.buffer)
            if not got:
                raise EOFError("the connection was closed")
            received += got

    def _frame(self, size: int, ids: list[int], groups: list[int]) -> bytes:
        return frames.plain_data(self.first.id, _data(size), to_type=2, ids=ids, groups=groups)


class Sink(Headsets):
    """Receives what a headset worker sends, with nothing in between."""

    def __init__(self) -> None:
        self.server = socket.create_server(("127.0.0.1", 0))

    @property
    def port(self) -> int:
        """Where the headset worker connects."""
        port: int = self.server.getsockname()[1]
        return port

    def accept(self) -> dict[str, Any]:
        """Take one headset in."""
        sock, _ = self.server.accept()
        welcome = Metadata(request_id=1, message_manager=Welcome.manager)
        sock.sendall(encode_message(welcome.encode(), encode_data(Welcome(1))))
        decoder = FrameDecoder()
        while not decoder.feed(sock.recv(65536)):
            pass
        super().__init__([Headset(sock, 1)])
        return {}


def _data(size: int) -> bytes:
    """Data in which a shifted, doubled or lost part shows."""
    return (bytes(range(251)) * (size // 251 + 1))[:size]


def main() -> None:
    """Run the worker."""
    if sys.argv[1] == "sink":
        sink = Sink()
        serve({"port": sink.port}, {"accept": sink.accept, "receive": sink.receive})
        return
    port, count, group = map(int, sys.argv[1:4])
    robot = sys.argv[4:] == ["robot"]
    way, authority = sys.argv[4:6] if len(sys.argv) > 5 else ("plain", "")
    way, authority, source = ("plain", "", authority) if way == "from" else (way, authority, "")
    token = sys.argv[6] if len(sys.argv) > 6 else None
    how = {"robot": robot, "way": way, "authority": authority, "token": token, "source": source}
    joined = [Headset.join(port, group, **how) for _ in range(count)]
    workers = Headsets(joined)
    names: tuple[str, ...] = ("send", "message_bytes", "register", "check", "receive", "ping", "echo")
    names = (*names, "prepare", "prepare_topic", "send_prepared", "receive_sequence")
    works = {name: getattr(workers, name) for name in names}
    serve({"ids": [headset.id for headset in workers.headsets]}, works, workers.beat)


if __name__ == "__main__":
    main()
