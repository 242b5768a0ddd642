"""What may be wrong when nothing comes, or nobody hears: the name of a topic, against those that robots have."""

from __future__ import annotations

import asyncio
import difflib
from collections.abc import Collection
from typing import Literal

from macs_zenoh.errors import MacsError
from macs_zenoh.limits import ANSWER_BYTES
from macs_zenoh.messages import Functionality, FunctionalityRequest, decode_data

from .client import Headset

Role = Literal["publishers", "subscribers"]

PATIENCE_S = 2.0
ALIKE = 0.7
"""How alike names are that may be meant by each other, from 0 to 1."""


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


def judge(robot: int, topic: str, role: Role, offered: Functionality) -> str:
    """What seems to be wrong, given what a robot offers; nothing when the topic is there, or may well come.

    A robot does not tell of its own nodes, nor of what its rules hide or remapping renames: what no ROS node
    subscribes to, another headset may.
    """
    there = offered.publishers if role == "publishers" else offered.subscribers
    name = topic if topic.startswith("/") else f"/{topic}"
    if name in there:
        return ""
    if not (offered.publishers or offered.subscribers or offered.services):
        return f"robot {robot} offers nothing at all; is its ROS_DOMAIN_ID that of its nodes?"
    nobody = f"robot {robot} offers no {'publisher of' if role == 'publishers' else 'subscriber to'} {name}"
    near = difflib.get_close_matches(name, there, n=1, cutoff=ALIKE)
    if near:
        return f"{nobody}; did you mean {near[0]}?"
    return nobody if role == "publishers" else ""
