"""What the keys of the mesh say, as values: for each key space of `keyexpr` its fields, in their order. Pure."""

from __future__ import annotations

from typing import NamedTuple


class UnicastFields(NamedTuple):
    """Of a key of `UNICAST`."""

    type: int
    block: int
    id: int
    from_type: int
    from_id: int

    @property
    def sender(self) -> tuple[int, int]:
        """Type and id."""
        return self.from_type, self.from_id


class GroupFields(NamedTuple):
    """Of a key of `GROUP`."""

    group: int
    type: int
    from_type: int
    from_id: int

    @property
    def sender(self) -> tuple[int, int]:
        """Type and id."""
        return self.from_type, self.from_id


class BroadcastFields(NamedTuple):
    """Of a key of `BROADCAST`."""

    from_type: int
    from_id: int

    @property
    def sender(self) -> tuple[int, int]:
        """Type and id."""
        return self.from_type, self.from_id


class StreamFields(NamedTuple):
    """Of a key of `STREAM`."""

    type: int
    id: int
    node: str


class PresenceFields(NamedTuple):
    """Of a key of `PRESENCE`."""

    type: int
    block: int
    id: int
    group: int
    zid: str


class LeaseFields(NamedTuple):
    """Of a key of `LEASE`."""

    block: int
    zid: str


class CallFields(NamedTuple):
    """Of a key of `CALL`."""

    type: int
    id: int
    verb: str
    from_type: int
    from_id: int

    @property
    def sender(self) -> tuple[int, int]:
        """Type and id."""
        return self.from_type, self.from_id


class CallsFields(NamedTuple):
    """Of a key of `CALLS`."""

    type: int
    id: int
    verb: str
    from_type: int
    from_block: int


class NameFields(NamedTuple):
    """Of a key of `NAME`."""

    name: str
    type: int
    id: int
    zid: str


class WantedFields(NamedTuple):
    """Of a key of `WANTED`."""

    name: str
    message_type: str
    zid: str


class NamedFields(NamedTuple):
    """Of a key of `NAMED`."""

    name: str
    message_type: str
    from_name: str


class NamedAllFields(NamedTuple):
    """Of a key of `NAMED_ALL`."""

    message_type: str
    from_name: str


class LastFields(NamedTuple):
    """Of a key of `LAST`."""

    name: str
    message_type: str
    from_name: str


class PingFields(NamedTuple):
    """Of a key of `PING`."""

    zid: str


class SlowFields(NamedTuple):
    """Of a key of `SLOW`."""

    zid: str
    from_type: int
    from_id: int

    @property
    def sender(self) -> tuple[int, int]:
        """Type and id."""
        return self.from_type, self.from_id


Fields = (
    UnicastFields
    | GroupFields
    | BroadcastFields
    | StreamFields
    | PresenceFields
    | LeaseFields
    | CallFields
    | CallsFields
    | NameFields
    | WantedFields
    | NamedFields
    | NamedAllFields
    | LastFields
    | PingFields
    | SlowFields
)
"""What a key says, by its space."""
