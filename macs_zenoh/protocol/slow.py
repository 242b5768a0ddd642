"""What one gateway tells another of an agent that cannot take what is sent to it: who should slow down. Pure.

It goes on a `keyexpr.SLOW` key, whose end is the agent that cannot take it.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

_NOTE = struct.Struct("<BHB")


class Note(NamedTuple):
    """For one sender: ``slow`` for the next moment, or as fast as it likes again."""

    agent_type: int
    agent_id: int
    slow: bool

    def encode(self) -> bytes:
        """As payload: u8 type, u16 id, u8 1 or 0."""
        return _NOTE.pack(*self)

    @classmethod
    def decode(cls, payload: bytes | bytearray) -> Note | None:
        """None for what is no note."""
        if len(payload) != _NOTE.size:
            return None
        agent_type, agent_id, slow = _NOTE.unpack(payload)
        return cls(agent_type, agent_id, bool(slow))
