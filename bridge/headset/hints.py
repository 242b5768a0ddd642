"""What may be wrong when nothing comes, or nobody hears: the name of a topic, against those that robots have."""

from __future__ import annotations

import asyncio
import difflib
from collections.abc import Collection
from typing import Literal

from macs_zenoh.errors import MacsError, Unreachable, UsageError
from macs_zenoh.protocol.limits import ANSWER_BYTES
from macs_zenoh.protocol.messages import Functionality, FunctionalityRequest, decode_data

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


async def offered_type(headset: Headset, robots: Collection[int], name: str, verb: str) -> str:
    """The type of a topic or service, as robots offer it: of what ``sub``, ``pub`` or ``call`` means by its name.

    Raises Unreachable when no robot offers it, UsageError when robots offer several types.
    """
    name = name if name.startswith("/") else f"/{name}"
    answers = await asyncio.gather(
        *(headset.ask(robot, FunctionalityRequest.manager, timeout_s=PATIENCE_S) for robot in sorted(robots)),
        return_exceptions=True,
    )
    offers = [decode_data(Functionality, answer, ANSWER_BYTES) for answer in answers if isinstance(answer, bytes)]
    found = _types_of(offers, name, verb)
    if len(found) > 1:
        raise UsageError(f"{name} has types {' and '.join(sorted(found))}: name one behind it")
    if found:
        return found.pop()
    known = {known for offered in offers for table in _tables(offered, verb) for known in table}
    near = difflib.get_close_matches(name, known, n=1, cutoff=ALIKE)
    meant = f"; did you mean {near[0]}?" if near else ""
    what = "service" if verb == "call" else "topic"
    raise Unreachable(f"{what} {name}", f"no robot offers it{meant} Or name its TYPE behind it, as pkg/Name")


def _types_of(offers: Collection[Functionality], name: str, verb: str) -> set[str]:
    """What the nodes at the other end have, or else those at the same end."""
    for tables in zip(*(_tables(offered, verb) for offered in offers), strict=True):
        if found := {_short(table[name]) for table in tables if name in table}:
            return found
    return set()


def _short(of_type: str) -> str:
    """As headsets write it: ``pkg/Name``."""
    package, _, name = of_type.partition("/")
    return f"{package}/{name.rpartition('/')[2]}"


def _tables(offered: Functionality, verb: str) -> list[dict[str, str]]:
    if verb == "call":
        return [offered.services]
    return [offered.publishers, offered.subscribers] if verb == "sub" else [offered.subscribers, offered.publishers]


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
