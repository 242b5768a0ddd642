"""What may be wrong when nothing comes, or nobody hears: the name of a topic, against those that robots have."""

from __future__ import annotations

import asyncio
from collections.abc import Collection
from typing import Literal

from macs_zenoh.errors import MacsError
from macs_zenoh.protocol.limits import ANSWER_BYTES
from macs_zenoh.protocol.messages import Functionality, FunctionalityRequest, NodeType, decode_data
from macs_zenoh.protocol.offers import absolute, closest, type_behind

from .client import Headset

Role = Literal["publishers", "subscribers"]

PATIENCE_S = 2.0
_NODES = {"sub": NodeType.SUBSCRIBER, "pub": NodeType.PUBLISHER, "call": NodeType.CLIENT}


async def hints(headset: Headset, robots: Collection[int], topic: str, role: Role) -> dict[int, str]:
    """A line for each robot where something seems to be wrong; none for robots that do not tell what they have."""
    asked = sorted(robots)
    lines = await asyncio.gather(*(_hint(headset, robot, topic, role) for robot in asked))
    return {robot: line for robot, line in zip(asked, lines, strict=True) if line}


async def _hint(headset: Headset, robot: int, topic: str, role: Role) -> str:
    try:
        answer = await headset.ask(robot, FunctionalityRequest.manager, timeout_s=PATIENCE_S)
        return judge(robot, topic, role, decode_data(Functionality, answer, ANSWER_BYTES))
    except MacsError:  # not every program answers, and the user has not asked this
        return ""


async def offered_type(headset: Headset, robots: Collection[int], name: str, verb: str) -> str:
    """The type of a topic or service, as robots offer it: of what ``sub``, ``pub`` or ``call`` means by its name.

    Raises Unreachable when no robot offers it, UsageError when robots offer several types.
    """
    answers = await asyncio.gather(
        *(headset.ask(robot, FunctionalityRequest.manager, timeout_s=PATIENCE_S) for robot in sorted(robots)),
        return_exceptions=True,
    )
    offers = [decode_data(Functionality, answer, ANSWER_BYTES) for answer in answers if isinstance(answer, bytes)]
    return type_behind(name, _NODES[verb], offers)


def judge(robot: int, topic: str, role: Role, offered: Functionality) -> str:
    """What seems to be wrong, given what a robot offers; nothing when the topic is there, or may well come.

    A robot does not tell of its own nodes, nor of what its rules hide or remapping renames: what no ROS node
    subscribes to, another headset may.
    """
    there = offered.publishers if role == "publishers" else offered.subscribers
    name = absolute(topic)
    if name in there:
        return ""
    if not (offered.publishers or offered.subscribers or offered.services):
        return f"robot {robot} offers nothing at all; is its ROS_DOMAIN_ID that of its nodes?"
    nobody = f"robot {robot} offers no {'publisher of' if role == 'publishers' else 'subscriber to'} {name}"
    if near := closest(name, there):
        return f"{nobody}; did you mean {near}?"
    return nobody if role == "publishers" else ""
