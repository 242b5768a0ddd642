"""What types robots have: their definitions, asked of them. Used by whoever can call a robot, agent or operator."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Iterable

from .protocol.limits import ANSWER_BYTES
from .protocol.messages import decode_data, encode_data
from .protocol.schemas import TYPES_AT_ONCE, Definition, DefinitionsReply, DefinitionsRequest

Ask = Callable[[str, bytes], Awaitable[bytes]]
"""Calls one robot: (verb, data) → its answer."""

VERB = "definitions"
ROUNDS = 64
"""So often a robot is asked for what had no place in its last answer."""
MOST_BYTES = 8 << 20
"""And for no more when it has told so much; a robot with hundreds of types has a quarter of it."""


async def definitions(ask: Ask, types: Iterable[str] = ()) -> DefinitionsReply:
    """The definitions of these types (``geometry_msgs/msg/Twist``, ``std_srvs/srv/SetBool``) and of all that they
    need; without any, of all that the robot offers::

        told = await definitions(lambda verb, data: agent.call("ros", 7, verb, data), ["geometry_msgs/msg/Twist"])
        text = schemas.schema("geometry_msgs/msg/Twist", told.definitions)

    Raises what ``ask`` raises (Unreachable where the robot is an existing program, or older), WireError.
    """
    found: dict[str, Definition] = {}
    missing: dict[str, str] = {}
    waiting = list(dict.fromkeys(types))
    for _ in range(ROUNDS):
        request = DefinitionsRequest(waiting[:TYPES_AT_ONCE])
        answer = decode_data(DefinitionsReply, await ask(VERB, encode_data(request)), ANSWER_BYTES)
        before = len(found)
        found |= answer.definitions
        missing |= answer.missing
        rest = waiting[TYPES_AT_ONCE:]
        left = [name for name in answer.left if name not in found]
        if len(found) == before and not rest:  # it has no more to tell
            break
        waiting = list(dict.fromkeys([*rest, *left]))
        if not waiting or sum(len(each.text) for each in found.values()) > MOST_BYTES:
            break
    return DefinitionsReply(found, missing, [name for name in waiting if name not in found and name not in missing])
