"""The router that a headset under test connects to: sockets, and the answers that any router gives."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable, Iterable

from macs_zenoh.errors import Unreachable
from macs_zenoh.protocol.addresses import joined
from macs_zenoh.protocol.decoders import FrameDecoder, MessageDecoder
from macs_zenoh.protocol.wire import Run
from macs_zenoh.timeouts import within

from . import vectors
from .client_frames import ClientFrames, Kind, Node, Said

_READ_BYTES = 64 << 10

_TWIST = "00010000" + "00" * 48
_OK = "00010000" + "01000000" + "03000000" + "6f6b00"
MESSAGES = {
    "std_msgs/String": "00010000" + "06000000" + "68656c6c6f00",
    "std_msgs/Bool": "0001000001",
    "std_msgs/Int32": "00010000" + "07000000",
    "std_msgs/Float64": "00010000" + "00" * 8,
    "geometry_msgs/Twist": _TWIST,
}
"""Topic messages of types that the kit knows, as hex."""
REQUESTS = {"std_srvs/SetBool": "0001000001", "std_srvs/Trigger": "0001000000", "std_srvs/Empty": "0001000000"}
RESPONSES = {"std_srvs/SetBool": _OK, "std_srvs/Trigger": _OK, "std_srvs/Empty": "0001000000"}


def cdr_for(node: Node) -> str:
    """What a headset gets for a node of its, as hex; empty when the kit does not know the type."""
    return {1: MESSAGES, 3: RESPONSES, 4: REQUESTS}.get(node.node_type, {}).get(node.data_type, "")


class Client:
    """One connection of the headset under test. What it says is judged as it comes, and kept in ``said``."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, frames: ClientFrames) -> None:
        self.said: list[Said] = []
        self.ended = False
        self.reset = False
        self.sent: int | None = None
        """How many messages were sent to it since this was 0; None while nobody counts them, as where some are bad."""
        self._counter = MessageDecoder()
        self._reader = reader
        self._writer = writer
        self._frames = frames
        self._decoder = FrameDecoder()
        self._come = asyncio.Condition()
        self._sending = asyncio.Lock()
        self._open = asyncio.Event()
        self._open.set()
        self._reading = asyncio.create_task(self._read())

    async def send(self, data: bytes, pieces: Iterable[int] = (), pause_s: float = 0.001) -> None:
        """Send bytes, cut into pieces that end at these places, each by itself. A lost connection is no error here."""
        async with self._sending:  # an answer to what it asks must not come in between
            await self._send(data, pieces, pause_s)

    async def _send(self, data: bytes, pieces: Iterable[int], pause_s: float) -> None:
        if self.sent is not None:
            self.sent += len(self._counter.feed(data))
        start = 0
        with contextlib.suppress(OSError, asyncio.TimeoutError):
            for end in [*pieces, len(data)]:
                self._writer.write(data[start:end])
                start = end
                await within(self._writer.drain(), 5.0)
                if end < len(data):
                    await asyncio.sleep(pause_s)

    async def until(self, done: Callable[[], bool], seconds: float) -> bool:
        """Wait for what it says; whether it came in time."""
        with contextlib.suppress(asyncio.TimeoutError):
            async with self._come:
                await within(self._come.wait_for(lambda: done() or self.ended), seconds)
        return done()

    def pause(self) -> None:
        """Read nothing until `resume`."""
        self._open.clear()

    def resume(self) -> None:
        """Read on."""
        self._open.set()

    def finish(self) -> None:
        """End the connection in order."""
        self._writer.close()

    def abort(self) -> None:
        """Reset it."""
        self._reading.cancel()
        self._writer.transport.abort()
        self.ended = True

    async def _read(self) -> None:
        try:
            while True:
                await self._open.wait()
                data = await self._reader.read(_READ_BYTES)
                if not data:
                    break
                await self._take(data)
        except OSError:
            self.reset = True
        async with self._come:
            self.ended = True
            self._come.notify_all()

    async def _take(self, data: bytes) -> None:
        now = asyncio.get_running_loop().time()
        for each in self._decoder.feed(data):
            for frame in each.each() if isinstance(each, Run) else [each]:
                said = self._frames.take(frame, now)
                await self._answer(said)
                async with self._come:
                    self.said.append(said)
                    self._come.notify_all()

    async def _answer(self, said: Said) -> None:
        """What any router, and the robot behind it, answers."""
        number = said.metadata.get("requestId")
        if not isinstance(number, int):
            return
        if said.kind is Kind.ONLINE:
            await self.send(vectors.fill("router_messages", "online_answer", number=number, id=self._frames.id))
        elif said.kind is Kind.MESSAGE and said.metadata.get("nodeType") == 3:
            data_type = str(said.metadata.get("dataExchangeType"))
            if data_type in RESPONSES:
                await self.send(
                    vectors.fill(
                        "router_messages",
                        "answer",
                        number=number,
                        node=str(said.metadata.get("nodeName")),
                        type=data_type,
                        cdr=RESPONSES[data_type],
                    )
                )


class Router:
    """Listens for the headset under test, and takes its connections one by one."""

    def __init__(self, frames: ClientFrames, host: str, port: int) -> None:
        self.port = port
        self.entrance = port
        """Where the headset comes in: another port where something is in front of this one."""
        self.arrivals = 0
        self._host = host
        self._frames = frames
        self._waiting: asyncio.Queue[Client] = asyncio.Queue()
        self._clients: list[Client] = []

    async def __aenter__(self) -> Router:
        try:
            self._server = await asyncio.start_server(self._accept, self._host, self.port)
        except OSError as error:
            raise Unreachable(joined(self._host, self.port), error.strerror or str(error)) from error
        self.port = self.entrance = self._server.sockets[0].getsockname()[1]
        return self

    async def __aexit__(self, *_: object) -> None:
        self._server.close()
        for client in self._clients:
            client.abort()

    async def next(self, seconds: float) -> Client | None:
        """The next connection that lives; None when there is none in time."""
        loop = asyncio.get_running_loop()
        until = loop.time() + seconds
        while (left := until - loop.time()) > 0:
            try:
                client = await within(self._waiting.get(), left)
            except asyncio.TimeoutError:
                return None
            if not client.ended:
                return client
        return None

    async def _accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.arrivals += 1
        client = Client(reader, writer, self._frames)
        self._clients.append(client)
        self._waiting.put_nowait(client)
