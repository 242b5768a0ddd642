"""From the mesh to TCP agents: who of ours gets a sample, and that nothing reaches them that would harm them.

Some existing headsets go deaf for good on metadata that is empty or no JSON, or on sizes that do not add up. So every
sample is checked here again, whoever put it.
"""

from __future__ import annotations

import logging
from collections import Counter

from macs_zenoh.directory import Directory
from macs_zenoh.errors import WireError
from macs_zenoh.keyexpr import BROADCAST, GROUP, UNICAST
from macs_zenoh.mesh import Sample
from macs_zenoh.messages import ROS, Metadata, NodeType, StreamData, decode_management
from macs_zenoh.routing import takes_group_copy
from macs_zenoh.wire import Frame, Layout, parse_frames

from .agents import Agents
from .connection import Connection

log = logging.getLogger("macs.gateway")

ANSWERS = frozenset((NodeType.CLIENT, NodeType.ACTION))
"""Nodes of headsets to which robots answer."""

KNOWN = 4096
"""How many keys, metadata and registrant lists are remembered as already read."""

KNOWN_BYTES = 4096
"""Longer ones are read each time: what others choose must not decide how much is kept here."""


class Delivery:
    """Samples of the mesh → messages to connections. Each method takes a batch and flushes at its end.

    ``drops`` counts ``bad_frame`` and ``nobody_with_this_id``.
    """

    def __init__(self, agents: Agents, directory: Directory, layout: Layout) -> None:
        self.drops: Counter[str] = Counter()
        self._agents = agents
        self._directory = directory
        self._layout = layout
        self._targets: dict[str, Connection] = {}
        self._metadata: dict[bytes, Metadata] = {}
        self._registrants: dict[bytes, list[tuple[int, int]]] = {}
        self._dirty: list[Connection] = []

    def inbox(self, batch: list[Sample]) -> None:
        """Frames sent to ids of ours."""
        for key, payload in batch:
            connection = self._targets.get(key) or self._find(key)
            if connection is None:
                if self._agents.former:
                    self._late_answer(key, payload)
                continue
            for frame, metadata in self._read(key, payload):
                self._send(connection, frame, metadata)
            if connection.congested and (fields := UNICAST.parse(key)) is not None:
                self._hold_sender((fields["from_type"], fields["from_id"]), [connection])
        self.flush()

    def group(self, batch: list[Sample]) -> None:
        """Frames sent to groups that one of ours is in."""
        for key, payload in batch:
            fields = GROUP.parse(key)
            if fields is None:
                continue
            sender = (int(fields["from_type"]), int(fields["from_id"]))
            members = self._agents.members(int(fields["type"]), int(fields["group"]))
            for frame, metadata in self._read(key, payload):
                header = frame.header
                for connection in members:
                    if takes_group_copy(header, connection.agent_id, sender, connection.peer.agent_type):
                        self._send(connection, frame, metadata)
            self._hold_sender(sender, members)
        self.flush()

    def broadcast(self, batch: list[Sample]) -> None:
        """Frames sent to everybody."""
        for key, payload in batch:
            fields = BROADCAST.parse(key)
            if fields is None:
                continue
            sender = (fields["from_type"], fields["from_id"])
            others = [connection for connection in self._agents.online() if connection.key != sender]
            for frame, metadata in self._read(key, payload):
                for connection in others:
                    self._send(connection, frame, metadata)
            self._hold_sender(sender, others)
        self.flush()

    def stream(self, batch: list[Sample]) -> None:
        """A robot's topic data, for those of its registrants that are ours."""
        for key, payload in batch:
            for frame, metadata in self._read(key, payload):
                for registrant in self._registrants.get(frame.management) or self._read_registrants(key, frame):
                    connection = self._agents.find(*registrant)
                    if connection is None or not self._may_have(connection, frame, metadata):
                        continue
                    if connection.has(metadata):  # else the frame is older than the agent, which has another's id
                        connection.send_stream(metadata.node_name, frame.messages)
        self.flush()

    def dirty(self, connection: Connection) -> None:
        """A connection has messages to flush."""
        self._dirty.append(connection)

    def flush(self) -> None:
        """Write what was gathered, one write per connection."""
        dirty, self._dirty = self._dirty, []
        for connection in dirty:
            connection.flush()

    def forget(self) -> None:
        """Agents came or went: look keys up anew."""
        self._targets.clear()

    def _send(self, connection: Connection, frame: Frame, metadata: Metadata) -> None:
        if self._may_have(connection, frame, metadata):
            connection.send_calls(frame.messages)

    def _may_have(self, connection: Connection, frame: Frame, metadata: Metadata) -> bool:
        if not metadata.node_name or connection.takes(metadata):
            return True
        name = f"{metadata.node_name[:80]} of type {metadata.node_type}"
        problem = f"a message for its node {name}, which has another type there"
        connection.complain("wrong_node_type", problem, frame.count)
        return False

    def _find(self, key: str) -> Connection | None:
        fields = UNICAST.parse(key)
        if fields is None:
            return None
        connection = self._agents.find(fields["type"], fields["id"])
        if connection is None:
            if (fields["type"], fields["id"]) not in self._directory:  # else it is in our block, but somebody else's
                self.drops["nobody_with_this_id"] += 1
            return None
        if len(self._targets) >= KNOWN:
            self._targets.clear()
        self._targets[key] = connection
        return connection

    def _late_answer(self, key: str, payload: bytes | bytearray) -> None:
        """An answer to a service call that an agent made under the id it had then. Anything else that is sent to
        that id is for whoever has it now."""
        fields = UNICAST.parse(key)
        if fields is None or fields["from_type"] != ROS:
            return
        connection = self._agents.former.get((int(fields["type"]), int(fields["id"])))
        if connection is not None:
            for frame, metadata in self._read(key, payload):
                if metadata.node_type in ANSWERS and connection.has(metadata):
                    self._send(connection, frame, metadata)

    def _hold_sender(self, sender: tuple[object, object], receivers: list[Connection]) -> None:
        """Slow down a sender on this gateway. Those elsewhere are slowed by nobody: the outbox's limit decides."""
        for receiver in receivers:
            if receiver.congested and (connection := self._agents.find(*sender)) is not None:
                receiver.brake.hold(connection)

    def _read_registrants(self, key: str, frame: Frame) -> list[tuple[int, int]]:
        """(type, id) of each registrant. The list changes only with registrations, so each is read once."""
        try:
            management = decode_management(frame.management)
        except WireError as error:
            self._bad(key, error)
            return []
        registrants = management.targets() if isinstance(management, StreamData) else []
        if len(frame.management) <= KNOWN_BYTES:
            if len(self._registrants) >= KNOWN:
                self._registrants.clear()
            self._registrants[frame.management] = registrants
        return registrants

    def _read(self, key: str, payload: bytes | bytearray) -> list[tuple[Frame, Metadata]]:
        """The frames of a sample with their metadata; those that no agent must see are left out."""
        try:
            frames = parse_frames(payload, self._layout, runs=True)
        except WireError as error:
            self._bad(key, error)
            return []
        known = self._metadata
        read = []
        for frame in frames:
            raw = frame.metadata
            metadata = known.get(raw) or self._read_metadata(key, raw)
            if metadata is not None:
                read.append((frame, metadata))
        return read

    def _read_metadata(self, key: str, raw: bytes) -> Metadata | None:
        try:
            metadata = Metadata.decode(raw)
        except WireError as error:
            self._bad(key, error)
            return None
        if len(raw) <= KNOWN_BYTES:
            if len(self._metadata) >= KNOWN:
                self._metadata.clear()
            self._metadata[raw] = metadata
        return metadata

    def _bad(self, key: str, error: WireError) -> None:
        self.drops["bad_frame"] += 1
        if self.drops["bad_frame"] == 1:
            log.warning("a frame on %s cannot be used: %s (logged once, counted as bad_frame)", key, error)
