"""Where a frame goes: header → keys on the way in, key and header → agents on the way out. Pure.

One rule makes one copy per receiver: an agent named by id and by group gets the copy for its id and drops the one
for its group. Nobody hears its own broadcast or group message; an id list that names the sender is honoured.
"""

from __future__ import annotations

from functools import lru_cache

from .keyexpr import BROADCAST, CALL, GROUP, STREAM, UNICAST
from .messages import EVERYBODY, Metadata
from .wire import MACS, Header, Layout, encode_message


def keys_of(header: Header, from_type: int, from_id: int) -> list[str]:
    """The keys on which a frame with this header is put, for a frame without management data.

    Empty when the header names nobody: the caller counts that.
    """
    if header.agent_type == EVERYBODY:
        return [BROADCAST.of(from_type=from_type, from_id=from_id)]
    unicast = [unicast_key(header.agent_type, agent_id, from_type, from_id) for agent_id in dict.fromkeys(header.ids)]
    groups = [
        GROUP.of(group=group, type=header.agent_type, from_type=from_type, from_id=from_id)
        for group in dict.fromkeys(header.groups)
    ]
    return unicast + groups


@lru_cache(maxsize=8192)
def unicast_key(agent_type: int, agent_id: int, from_type: int, from_id: int) -> str:
    """The inbox key of one agent, for one sender."""
    return UNICAST.of(type=agent_type, id=agent_id, from_type=from_type, from_id=from_id)


@lru_cache(maxsize=4096)
def stream_key(agent_type: int, agent_id: int, node: str) -> str:
    """The key of one robot's topic data under one node."""
    return STREAM.of(type=agent_type, id=agent_id, node=node)


def call(
    to: tuple[int, int], verb: str, sender: tuple[int, int], data: bytes, metadata: Metadata, layout: Layout = MACS
) -> tuple[str, bytes]:
    """Key and frame of a call; ``to`` and ``sender`` are (type, id), and the metadata's sender is the same one."""
    return call_of(to, verb, sender, encode_message(metadata.encode(), data), layout)


def call_of(
    to: tuple[int, int], verb: str, sender: tuple[int, int], message: bytes, layout: Layout = MACS
) -> tuple[str, bytes]:
    """The same for a message that is made. Where many ask for the same, all but who asks is worked out once."""
    return _called(*to, verb) + _caller(*sender), _call_header(layout, *to, len(message)) + message


@lru_cache(maxsize=4096)
def _called(agent_type: int, agent_id: int, verb: str) -> str:
    """How the keys of all calls of an agent's verb begin; behind it is who calls."""
    return CALL.every(type=agent_type, id=agent_id, verb=verb).removesuffix("**")


@lru_cache(maxsize=4096)
def _caller(agent_type: int, agent_id: int) -> str:
    """How the keys of all calls end that an agent makes."""
    every = CALL.of(type=agent_type, id=agent_id, verb="ask", from_type=agent_type, from_id=agent_id)
    return every.partition("/ask/")[2]


@lru_cache(maxsize=4096)
def _call_header(layout: Layout, agent_type: int, agent_id: int, message_bytes: int) -> bytes:
    return layout.pack(agent_type, (agent_id,), message_bytes=message_bytes)


def inbox(agent_type: int, agent_id: int) -> str:
    """What an agent subscribes to for frames sent to its id."""
    return UNICAST.every(type=agent_type, id=agent_id)


def takes_group_copy(header: Header, agent_id: int, sender: tuple[int, int], agent_type: int) -> bool:
    """Whether a member of the group keeps this copy: not when its id is named as well, nor its own message."""
    return agent_id not in header.ids and (agent_type, agent_id) != sender
