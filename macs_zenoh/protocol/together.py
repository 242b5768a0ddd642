"""Calls for several agents of one block in one query: how they are written, and what came of each. Pure.

A call is for whoever calls, and routers hold callers to their keys. Here the key says a block, which a certificate for
one agent does not cover, and each call says in its metadata for whom of that block it is.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import msgspec

from ..errors import BadJson, BadSizes, Refused, TooLong
from .agent_id import AgentId
from .keyexpr import CALLS, block_of, type_name
from .limits import ANSWER_BYTES
from .messages import Metadata
from .wire import Layout, parse_frames

VERBS = frozenset({"add_node", "remove_node"})
"""What can be asked so: what is answered with nothing, or a refusal."""
MOST = 64
"""So many calls go in one query: what each costs is little more then, and none waits long behind others."""
MOST_READ = 256
"""So many are taken."""
FAILED = "failed"

CameTo = dict[str, str] | None
"""What came of a call: nothing to say, or as in an answer that is an error."""

_decoder = msgspec.json.Decoder(list[CameTo])


class One(NamedTuple):
    """One of such calls."""

    sender: AgentId
    metadata: Metadata
    data: bytes
    size: int
    """Bytes of its frame."""


def read_calls(key: str, payload: bytes, layout: Layout) -> list[One]:
    """The calls of a query, each for an agent of the block that the key says; no bytes are no calls.

    Raises WireError for what is no frame; Refused: they are too many, or one is not for an agent of that block.
    """
    fields = CALLS.parse(key)
    if fields is None:
        raise Refused(f"{key[:200]} is no key of such calls")
    calls = []
    for frame in parse_frames(payload, layout) if payload else ():
        metadata = Metadata.decode(frame.metadata)
        sender = AgentId(metadata.sender_agent_type or 0, metadata.sender_agent_id or 0)
        if sender.type != fields.from_type or not sender.id or block_of(sender.id) != fields.from_block:
            block = f"{type_name(fields.from_type)} of block {fields.from_block}"
            raise Refused(f"who speaks for agents {block} cannot call for {sender}")
        calls.append(One(sender, metadata, bytes(frame.body), len(frame.data)))
    if len(calls) > MOST_READ:
        raise Refused(f"{len(calls)} calls at once, at most {MOST_READ} are read")
    return calls


def write_answers(answers: Sequence[CameTo]) -> bytes:
    """What is answered, in the order of the calls."""
    return msgspec.json.encode(answers)


def read_answers(payload: bytes, count: int) -> list[CameTo]:
    """What came of so many calls. Raises TooLong, BadJson, BadSizes."""
    if len(payload) > ANSWER_BYTES:
        raise TooLong("answers to calls", len(payload), ANSWER_BYTES)
    try:
        answers = _decoder.decode(payload)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise BadJson("answers to calls", str(error)) from error
    if len(answers) != count:
        raise BadSizes("answers to calls", count, len(answers))
    return answers
