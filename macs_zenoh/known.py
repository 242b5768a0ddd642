"""What robots say of themselves when they are asked: once, until another, or a newer program, has its place."""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import Callable

from .errors import MacsError, Unreachable
from .mesh import Mesh, Traffic

TRUE = 0.0
AGAIN_S = 5.0
"""Who has not answered is asked again so much later: one that has just come is online a moment before it serves."""

Answer = bytes | MacsError


class Known:
    """Which robots do something, of many that may. ``says_yes`` reads what one answers; who answers in another way, as
    with a refusal, is not asked again."""

    def __init__(self, mesh: Mesh, timeout_s: float, says_yes: Callable[[Answer], bool]) -> None:
        self._mesh = mesh
        self._timeout_s = timeout_s
        self._says_yes = says_yes
        self._robots: dict[int, dict[str, float]] = {}
        """By robot and key: `TRUE`, or when it may be asked again."""

    def forget(self, robot_id: int) -> None:
        """Another one may have its place."""
        self._robots.pop(robot_id, None)

    def holds(self, robot_id: int, key: str, question: Callable[[], tuple[str, bytes]]) -> bool:
        """Whether a robot has said so about ``key``. If that is not known, it is asked meanwhile: key and payload."""
        known = self._robots.setdefault(robot_id, {})
        again = known.get(key)
        if again is None or TRUE < again <= time.monotonic():
            known[key] = math.inf

            def told(answer: Answer) -> None:
                known[key] = TRUE if self._says_yes(answer) else _again(answer)

            self.ask(*question(), told)
        return known[key] == TRUE

    def failed(self, robot_id: int, key: str, answer: Answer) -> None:
        """It has said so, and then answered in this way."""
        self._robots.get(robot_id, {})[key] = _again(answer)

    def ask(self, key: str, payload: bytes, on_answer: Callable[[Answer], None]) -> None:
        """Ask, once. ``on_answer`` is called later, also where it could not be asked."""
        try:
            self._mesh.ask(key, payload, on_answer, of=key, timeout_s=self._timeout_s, traffic=Traffic.REGISTRATION)
        except MacsError as error:  # a traffic rule, or the session is closed
            asyncio.get_running_loop().call_soon(on_answer, error)


def _again(answer: Answer) -> float:
    return time.monotonic() + AGAIN_S if isinstance(answer, Unreachable) else math.inf
