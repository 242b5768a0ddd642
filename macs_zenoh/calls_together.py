"""Asking a robot for several agents of one block in one query, where it is known to answer such (`protocol.together`).

Whether it does is asked first, with no calls: existing robots do not, nor ones behind routers that do not allow it. No
call waits for that, nor depends on it: what does not come of many together is tried again by itself.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import Generic, TypeVar

from .errors import MacsError, Unreachable
from .known import Known
from .mesh import Mesh, understood
from .protocol.keyexpr import CALLS, block_of
from .protocol.limits import CALL_BYTES
from .protocol.messages import ROS, AddNode, Metadata, RemoveNode, encode_data
from .protocol.registrations import AgentKey
from .protocol.together import read_answers
from .protocol.wire import encode_message

log = logging.getLogger("macs.registrations")

T = TypeVar("T")


class Told:
    """What robots are told of a registration, as a message: made once for all that it names."""

    __slots__ = ("_message", "node")

    def __init__(self, node: AddNode | RemoveNode) -> None:
        self.node = node
        self._message = b""

    @property
    def message(self) -> bytes:
        if not self._message:
            node = self.node
            metadata = Metadata(node.registrant_agent_type, node.registrant_agent_id, message_manager=node.manager)
            self._message = encode_message(metadata.encode(), encode_data(node))
        return self._message


@dataclass(frozen=True)
class Question(Generic[T]):
    """A call that is to be made now: what it is ``of``, who calls which robot, its verb, key and frame."""

    of: T
    caller: AgentKey
    robot_id: int
    verb: str
    key: str
    frame: bytes
    alone: bool
    """Whether it goes in a query of its own, whatever the robot takes."""

    @property
    def together_key(self) -> str:
        """The key of those with which it can go; empty: it goes alone."""
        kind, number = self.caller
        return "" if self.alone else _key(self.robot_id, self.verb, kind, block_of(number))


def in_order(questions: list[Question[T]]) -> Iterator[list[Question[T]]]:
    """Calls to one robot by what can go together, and an agent's own in the order in which they were wanted."""
    groups: dict[str, list[Question[T]]] = {}
    sizes: dict[str, int] = {}
    where: dict[AgentKey, str] = {}
    for question in questions:
        key = question.together_key
        if where.get(question.caller, key) != key:
            yield from groups.values()
            groups, sizes, where = {}, {}, {}
        elif key in groups and sizes[key] + len(question.frame) > CALL_BYTES:
            yield groups.pop(key)
            sizes[key] = 0
        where[question.caller] = key
        groups.setdefault(key, []).append(question)
        sizes[key] = sizes.get(key, 0) + len(question.frame)
    yield from groups.values()


class CallsTogether:
    """Which robots take calls together, and those calls."""

    def __init__(self, mesh: Mesh, timeout_s: float) -> None:
        self._robots = Known(mesh, timeout_s, lambda answer: came_of("", answer, 0) == [])
        self.forget = self._robots.forget

    def takes(self, question: Question[T]) -> bool:
        """Whether its robot takes what can go together with this one. If that is not known, it is asked meanwhile."""
        key = question.together_key
        return bool(key) and self._robots.holds(question.robot_id, key, lambda: (key, b""))

    def ask(self, questions: list[Question[T]], on_answer: Callable[[Question[T], bytes | Exception], None]) -> None:
        """Make these calls together. ``on_answer`` hears of each what has come of it, later."""
        robot_id, key = questions[0].robot_id, questions[0].together_key

        def answered(answer: bytes | MacsError) -> None:
            came = came_of(key, answer, len(questions))
            if isinstance(came, Unreachable):
                log.debug("calls of several agents, %s", came)
                self._robots.failed(robot_id, key, answer)
                came = [came] * len(questions)
            for question, each in zip(questions, came, strict=True):
                on_answer(question, each)

        self._robots.ask(key, b"".join(question.frame for question in questions), answered)


def came_of(key: str, answer: bytes | MacsError, count: int) -> list[bytes | MacsError] | Unreachable:
    """What came of so many calls: nothing to say, or why not. Otherwise why that is not known of any of them."""
    try:
        if isinstance(answer, MacsError):
            raise answer
        return [understood(key, came) if came is not None else b"" for came in read_answers(answer, count)]
    except MacsError as error:
        return Unreachable(key, str(error))


@lru_cache(maxsize=4096)
def _key(robot_id: int, verb: str, agent_type: int, block: int) -> str:
    return CALLS.of(type=ROS, id=robot_id, verb=verb, from_type=agent_type, from_block=block)
