"""Commands as they were sent, each kind in a channel of its own. Asyncio.

Whoever sends chooses the names and types: so there is an end to the channels, and to what robots are asked for them.
What has no channel of its own is in one for all such.
"""

from __future__ import annotations

import asyncio
import time
from collections import Counter
from collections.abc import Awaitable, Callable, Mapping

import msgspec

from bridge.recording.disk import Entry, Sink
from bridge.recording.follower import RobotFollower
from bridge.recording.schema_source import Schemas
from bridge.recording.streams import CDR, JSON, Channel, command_topic
from bridge.recording.traffic import Sent
from macs_zenoh.errors import MacsError
from macs_zenoh.protocol.schemas import full_type

OTHERS = "/sent/others"
KNOWN, KNOWN_OF_ONE = 4096, 256
"""So many channels there are, and of one sender."""
EARLY = 4096
"""So many commands wait for the schema of their type."""
EARLY_BYTES = 16 << 20
"""And no more of them than this."""
ASKING = 2
"""So many types are asked for at a time: robots let a recording ask only so often."""
ASKED = 3
"""So many robots are asked for one type, where a command is not for one robot that is known."""
UNKNOWN_S = 30.0
"""So long a robot is not asked again for a type that it has not."""

Kind = tuple[str, str, str, str]
"""Sender, receiver, node and type."""


class SentCommands:
    """Puts commands into a sink. ``robots``: those that are followed; ``token(sender)`` names whose token it has."""

    def __init__(
        self,
        sink: Sink,
        schemas: Schemas,
        robots: Mapping[int, RobotFollower],
        token: Callable[[str], Awaitable[str]] | None = None,
    ) -> None:
        self._sink = sink
        self._schemas = schemas
        self._robots = robots
        self._token = token
        self._channels: dict[Kind, Channel] = {}
        self._early: dict[Kind, list[tuple[Sent, int]]] = {}
        self._early_count = 0
        self._early_bytes = 0
        self._of: Counter[str] = Counter()
        self._unknown: dict[tuple[int, str], float] = {}
        self._asking = asyncio.Semaphore(ASKING)
        self._tasks: set[asyncio.Task[None]] = set()
        self._others = Channel(OTHERS, JSON, metadata={"as": "sent"})

    def close(self) -> None:
        """Ask for nothing more; what still waits for its schema is put without."""
        for task in self._tasks:
            task.cancel()
        for kind in list(self._early):
            for sent, log_ns in self._waited(kind):
                self._put_other(sent, log_ns)

    def put(self, sent: Sent, log_ns: int) -> None:
        """A command came at this time, in ns since 1970."""
        kind = (sent.sender, sent.to, sent.node, sent.type)
        channel = self._channels.get(kind)
        if channel is not None:
            self._put(channel, sent, log_ns)
            return
        is_new = kind not in self._early
        has_room = self._early_count < EARLY and self._early_bytes + len(sent.data) <= EARLY_BYTES
        may = len(self._channels) + len(self._early) < KNOWN and self._of[sent.sender] < KNOWN_OF_ONE
        if not has_room or (is_new and not may):
            self._put_other(sent, log_ns)
            return
        self._early.setdefault(kind, []).append((sent, log_ns))
        self._early_count += 1
        self._early_bytes += len(sent.data)
        if is_new:
            self._of[sent.sender] += 1
            task = asyncio.get_running_loop().create_task(self._open(kind, sent))
            self._tasks.add(task)
            task.add_done_callback(self._tasks.discard)

    def _put(self, channel: Channel, sent: Sent, log_ns: int) -> None:
        data = sent.data
        if channel.encoding == JSON:
            data = msgspec.json.encode({"type": sent.type, "bytes": len(data), "data": data})
        self._sink.put(Entry(channel, channel.next(len(data)), log_ns, data))

    def _put_other(self, sent: Sent, log_ns: int) -> None:
        said = {"from": sent.sender, "to": sent.to, "node": sent.node, "type": sent.type}
        data = msgspec.json.encode({**said, "bytes": len(sent.data), "data": sent.data})
        self._sink.put(Entry(self._others, self._others.next(len(data)), log_ns, data))

    def _waited(self, kind: Kind) -> list[tuple[Sent, int]]:
        """What waited for this channel, which it does no longer."""
        early = self._early.pop(kind, [])
        self._early_count -= len(early)
        self._early_bytes -= sum(len(sent.data) for sent, _ in early)
        return early

    async def _open(self, kind: Kind, sent: Sent) -> None:
        """Make the channel of commands like this one, and put those that waited for it."""
        async with self._asking:
            channel = await self._channel(sent)
        self._channels[kind] = channel
        for early, log_ns in self._waited(kind):
            self._put(channel, early, log_ns)

    async def _channel(self, sent: Sent) -> Channel:
        meant = self._robots.get(int(sent.to)) if sent.to.isdigit() else None
        robots = [meant] if meant is not None else list(self._robots.values())[:ASKED]
        topic = robots[0].topic_of(sent.node) if robots else "/" + sent.node.removeprefix("nd_").removeprefix("_")
        metadata = {"robot": sent.to, "sender": sent.sender, "as": "sent", "topic": topic, "node": sent.node}
        if self._token is not None and (token := await self._token(sent.sender)):
            metadata["token"] = token
        name, of_type = command_topic(sent.sender, sent.to, topic), full_type(sent.type)
        for follower in robots:
            asked = (follower.robot, of_type)
            if time.monotonic() < self._unknown.get(asked, 0.0):
                continue
            try:
                schema = await self._schemas.of(follower.robot, of_type)
            except MacsError:
                if len(self._unknown) >= KNOWN:
                    self._unknown.clear()
                self._unknown[asked] = time.monotonic() + UNKNOWN_S
                continue
            metadata |= {"topic_type_hash": schema.hash, "offered_qos_profiles": ""}
            return Channel(name, CDR, of_type, schema.text, metadata)
        return Channel(name, JSON, metadata=metadata)
