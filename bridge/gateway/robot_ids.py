"""Which ids agents that are no headsets may have over TCP. Pure.

The protocol has no password, so whoever reaches the port can say that it is a robot; with the id of a robot that is
away just then it would get that robot's commands. So such agents get ids that whoever runs the gateway set aside.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Literal

ANY: Literal["any"] = "any"


class RobotIds:
    """``allowed``: the ids, or `ANY` for whatever id a connection has, as the old router did."""

    def __init__(self, allowed: Sequence[int] | Literal["any"]) -> None:
        self._any = allowed == ANY
        self._allowed: dict[int, None] = {} if allowed == ANY else dict.fromkeys(int(each) for each in allowed)

    def __contains__(self, agent_id: int) -> bool:
        """Whether an id is set aside: headsets do not get it."""
        return agent_id in self._allowed

    def choose(self, own: int, is_taken: Callable[[int], bool]) -> int | None:
        """The id for an agent whose connection has the id ``own``; None when it may have none."""
        if self._any:
            return own
        return next((each for each in self._allowed if each == own or not is_taken(each)), None)

    @property
    def problem(self) -> str:
        """Why there is none."""
        if not self._allowed:
            return (
                "robots may come over TCP only under ids that gateway.robots lists, and it lists none (--robots 1,2)"
            )
        return "every id that gateway.robots lists for agents over TCP is taken"
