"""What an agent receives: samples → messages. Pure.

Senders repeat themselves: what a key or metadata says is read once and remembered, and of a message that begins like
one before it only the data is looked at.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from ..errors import WireError
from .keyexpr import BROADCAST, GROUP, UNICAST, type_name
from .messages import Metadata
from .routing import takes_group_copy
from .wire import Layout, parse_frame, parse_frames


class Message(NamedTuple):
    """What an agent receives. The sender is taken from the key, which routers can check, and not from the JSON;
    ``metadata`` is corrected to name the same. ``age_s``: how long a command waited on its way, if known.
    ``at_most_s``: how old it is at most by its sender's clock, with a whole way there and back: for limits only."""

    sender_type: str
    sender_id: int
    metadata: Metadata
    data: bytes
    age_s: float = 0.0
    at_most_s: float = 0.0


class _Sender(NamedTuple):
    """What the key of a sample says about it."""

    type: int
    id: int
    type_name: str
    broadcasts: bool


class _Seen(NamedTuple):
    """A message that was read: one that is as long and begins like it differs in its data only."""

    sender: _Sender
    metadata: Metadata
    beginning: bytes


class Reader:
    """Reads the samples of one agent. `reread` may be called in another thread than `read`.

    ``on_bad(key, error)`` hears of each frame that cannot be used; where sizes do not add up that is the whole sample.
    """

    KNOWN = 1024
    """How many keys and metadata are remembered as already read."""
    KNOWN_BYTES = 4096
    """Longer ones are read each time: what others choose must not decide how much is kept here."""

    def __init__(self, layout: Layout, on_bad: Callable[[str, WireError], None]) -> None:
        self._layout = layout
        self._on_bad = on_bad
        self._senders: dict[str, _Sender] = {}
        self._metadata: dict[tuple[_Sender, bytes], Metadata] = {}
        self._seen: dict[tuple[str, int], _Seen] = {}

    def read(self, key: str, payload: bytes | bytearray, me: tuple[int, int], *, by_group: bool) -> list[Message]:
        """The messages of a sample for ``me`` (type, id); none where I am the sender, or, of what came ``by_group``,
        where I am named by id as well."""
        sender = self._senders.get(key) or self._read_sender(key)
        if sender is None or (sender.broadcasts and sender[:2] == me):
            return []
        messages: list[Message] = []
        try:
            frames = parse_frames(payload, self._layout)
        except WireError as error:
            self._on_bad(key, error)
            return messages
        for frame in frames:
            if by_group and not takes_group_copy(frame.header, me[1], sender[:2], me[0]):
                continue
            try:
                raw = frame.metadata
                metadata = self._metadata.get((sender, raw)) or self._read_metadata(sender, raw)
                messages.append(Message(sender.type_name, sender.id, metadata, bytes(frame.body)))
            except WireError as error:
                self._on_bad(key, error)
        return messages

    def reread(self, key: str, payload: bytes | bytearray) -> Message | None:
        """The message of a sample in the inbox of which only the data is new; None for all others."""
        seen = self._seen.get((key, len(payload)))
        if seen is None or not payload.startswith(seen.beginning):
            seen = self._look(key, payload)
            if seen is None:
                return None
        sender, metadata, beginning = seen
        return Message(sender.type_name, sender.id, metadata, bytes(payload[len(beginning) :]))

    def _look(self, key: str, payload: bytes | bytearray) -> _Seen | None:
        """What a message says of itself, if it is one, and all of that was read before."""
        sender = self._senders.get(key)
        if sender is None:
            return None
        try:
            frame = parse_frame(payload, self._layout)
        except WireError:
            return None
        metadata = self._metadata.get((sender, frame.metadata))
        if metadata is None:
            return None
        seen = _Seen(sender, metadata, frame.beginning)
        if len(seen.beginning) <= self.KNOWN_BYTES:
            if len(self._seen) >= self.KNOWN:
                self._seen.clear()
            self._seen[key, len(payload)] = seen
        return seen

    def _read_sender(self, key: str) -> _Sender | None:
        broadcast = BROADCAST.parse(key)
        fields = broadcast or UNICAST.parse(key) or GROUP.parse(key)
        if fields is None:
            return None
        if len(self._senders) >= self.KNOWN:
            self._senders.clear()
        sender = self._senders[key] = _Sender(*fields.sender, type_name(fields.from_type), fields is broadcast)
        return sender

    def _read_metadata(self, sender: _Sender, raw: bytes) -> Metadata:
        metadata = (Metadata.decode(raw) if raw else Metadata()).sent_by(sender.type, sender.id)
        if len(raw) <= self.KNOWN_BYTES:
            if len(self._metadata) >= self.KNOWN:
                self._metadata.clear()
            self._metadata[sender, raw] = metadata
        return metadata
