"""What headsets and robots say to each other, as a recording hears it: commands as they were sent, calls and answers,
what robots refused, and plain messages. Pure."""

from __future__ import annotations

import base64
from collections.abc import Callable
from typing import Any, NamedTuple

import msgspec

from bridge.recording.streams import CALLS, MESSAGES, REFUSALS
from macs_zenoh.errors import WireError
from macs_zenoh.protocol.agent_id import AgentId
from macs_zenoh.protocol.keyexpr import BROADCAST, GROUP, UNICAST
from macs_zenoh.protocol.messages import CallFailure, DataRefused, Metadata, NodeType, decode_data
from macs_zenoh.protocol.wire import Layout, parse_frames

DATA_BYTES = 16 << 10
"""So much of the data of a call or a message is in the recording; of more its size, and its beginning."""
KNOWN = 1024


class Sent(NamedTuple):
    """A command: who sent it, to whom (``7``, ``group3``, ``all``), for which node, and its CDR."""

    sender: str
    to: str
    node: str
    type: str
    data: bytes


class Said(NamedTuple):
    """Everything else, for a JSON channel."""

    channel: str
    value: dict[str, Any]


class Traffic:
    """Reads samples of keys that are for agents. ``on_bad`` hears of what cannot be read."""

    def __init__(self, layout: Layout, on_bad: Callable[[str, WireError], None]) -> None:
        self._layout = layout
        self._on_bad = on_bad
        self._known: dict[bytes, Metadata] = {}

    def read(self, key: str, payload: bytes | bytearray) -> list[Sent | Said]:
        """What a sample says."""
        ends = _ends(key)
        if ends is None:
            return []
        found: list[Sent | Said] = []
        try:
            for frame in parse_frames(payload, self._layout):
                if frame.has_management:
                    continue
                metadata = self._metadata(frame.metadata)
                found.append(self._one(*ends, metadata, bytes(frame.body)))
        except WireError as error:
            self._on_bad(key, error)
        return found

    def _metadata(self, raw: bytes) -> Metadata:
        found = self._known.get(raw)
        if found is None:
            if len(self._known) >= KNOWN:
                self._known.clear()
            found = self._known[raw] = Metadata.decode(raw) if raw else Metadata()
        return found

    def _one(self, sender: str, to: str, metadata: Metadata, data: bytes) -> Sent | Said:
        said = {"from": sender, "to": to}
        if metadata.message_manager == DataRefused.manager:
            try:
                refusal = msgspec.to_builtins(decode_data(DataRefused, data))
                return Said(REFUSALS, {**said, **refusal})
            except WireError:
                pass
        if not metadata.node_name:
            about = {"manager": metadata.message_manager, "request_id": metadata.request_id}
            return Said(MESSAGES, {**said, **about, **_data(data)})
        if metadata.node_type == NodeType.PUBLISHER:
            return Sent(sender, to, metadata.node_name, metadata.data_exchange_type, data)
        about = {
            "node": metadata.node_name,
            "node_type": metadata.node_type,
            "type": metadata.data_exchange_type,
            "request_id": metadata.request_id,
        }
        if metadata.message_manager == CallFailure.manager and data[:1] == b"{":
            return Said(CALLS, {**said, **about, "failure": data[:DATA_BYTES].decode(errors="replace")})
        return Said(CALLS, {**said, **about, **_data(data)})


def _data(data: bytes) -> dict[str, Any]:
    told = {"bytes": len(data)}
    return {**told, "data": base64.b64encode(data[:DATA_BYTES]).decode()}


def _ends(key: str) -> tuple[str, str] | None:
    """Who sent a sample, and to whom; None for other keys."""
    unicast = UNICAST.parse(key)
    if unicast is not None:
        to = str(unicast.id) if unicast.type == 1 else str(AgentId(unicast.type, unicast.id))
        return str(AgentId(*unicast.sender)), to
    group = GROUP.parse(key)
    if group is not None:
        return str(AgentId(*group.sender)), f"group{group.group}"
    broadcast = BROADCAST.parse(key)
    return (str(AgentId(*broadcast.sender)), "all") if broadcast is not None else None
