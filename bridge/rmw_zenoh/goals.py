"""A client of an action out of the five parts that it has on the graph: three services and two topics.

What ROS wraps around goals, feedback and results is read here; the action's own fields pass as they are, but for a
result, which begins behind a byte and is aligned anew.
"""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import TYPE_CHECKING

from bridge.rmw_zenoh.ends import Typed, ZenohClient
from bridge.rmw_zenoh.types import UnknownMessage
from bridge.ros.shapes import Structure
from bridge.ros.side import GoalTold, NotOfType, OnCancel
from bridge.ros.unity_cdr import Misfit, behind_a_byte
from macs_zenoh.mesh.ros_network import CALL_S, RESULT_S
from macs_zenoh.protocol.rmw_zenoh.cdr import HEADER
from macs_zenoh.protocol.rmw_zenoh.qos import Durability, Qos

if TYPE_CHECKING:
    from bridge.rmw_zenoh.session import ZenohSession

ID_BYTES = 16
STAMP_BYTES = 8
FEEDBACK = Qos(depth=10)
"""As rclpy's clients have it."""
STATUS = Qos(depth=1, durability=Durability.TRANSIENT_LOCAL)
STATUSES = "action_msgs/msg/GoalStatusArray"
ENDED = 4
"""This status of a goal, and those above it, are the last."""
SILENT_S = 2.0
"""A server that has said nothing of a goal's status for so long is asked for its result at once."""
ANYWAY_S = 60.0
"""After so long it is asked in any case: that the goal has ended may have been lost."""
KEPT = 1024
"""Goals whose feedback is passed on; of more, the latest."""


def statuses(cdr: bytes) -> Iterator[tuple[bytes, int]]:
    """The goals of an action_msgs/GoalStatusArray and how they stand, as far as it is whole."""
    if cdr[:2] != HEADER[:2]:
        return
    body = cdr[len(HEADER) :]
    at = 4
    for _ in range(int.from_bytes(body[:at], "little")):
        stamp_at = (at + ID_BYTES + 3) // 4 * 4
        status_at = stamp_at + STAMP_BYTES
        if status_at >= len(body):
            return
        yield bytes(body[at : at + ID_BYTES]), body[status_at]
        at = status_at + 1


class ZenohGoals:
    """`Goals` of one action."""

    def __init__(self, session: ZenohSession, of_type: str, action: str, result: Structure) -> None:
        self._result = result
        self._told: dict[bytes, GoalTold] = {}
        self._session = session
        self._lock = threading.Lock()
        self._status: OrderedDict[bytes, int] = OrderedDict()
        """What the server has said of goals, the latest."""
        self._waiting: dict[bytes, Callable[[], object]] = {}
        """Accepted goals whose result has not been asked for, and what asks. A server may do nothing else, not even
        cancel a goal, while it is asked for a result that it does not have yet (hiroz 0.2.1)."""
        part = f"{action}/_action"
        message, topic = f"{of_type}_FeedbackMessage", f"{part}/feedback"
        with ExitStack() as made:  # when one cannot be had, none stays

            def client(of: str, name: str, timeout_s: float = CALL_S) -> ZenohClient:
                one = ZenohClient(session, of, f"{part}/{name}", timeout_s)
                made.callback(one.close)
                return one

            self._send = client(f"{of_type}_SendGoal", "send_goal")
            self._cancel = client("action_msgs/srv/CancelGoal", "cancel_goal")
            self._get = client(f"{of_type}_GetResult", "get_result", RESULT_S)
            self._feedback = session.subscribe(
                Typed(message, UnknownMessage(message)), topic, self._fed_back, FEEDBACK
            )
            made.callback(self._feedback.close)
            of = Typed(STATUSES, UnknownMessage(STATUSES))
            self._statuses = session.subscribe(of, f"{part}/status", self._said, STATUS)
            made.pop_all()

    def is_ready(self) -> bool:
        """`Goals.is_ready`."""
        return self._send.is_ready() and self._get.is_ready() and self._cancel.is_ready()

    def send(self, goal_id: bytes, goal: bytes, told: GoalTold) -> None:
        """`Goals.send`."""
        if goal[:2] != HEADER[:2]:
            raise NotOfType("it is not in little endian order, as goals are")
        while len(self._told) >= KEPT:
            del self._told[next(iter(self._told))]
        self._told[goal_id] = told

        def accepted(response: bytes | None, problem: str) -> None:
            if response is None or len(response) <= len(HEADER):
                self._told.pop(goal_id, None)
                told.failed(problem or "the action's answer is cut off")
                return
            is_accepted = response[len(HEADER)] != 0
            told.accepted(is_accepted)
            if is_accepted:
                self._when_ended(goal_id, lambda: self._get.call(HEADER + goal_id, finished))
            else:
                self._told.pop(goal_id, None)

        def finished(response: bytes | None, problem: str) -> None:
            self._told.pop(goal_id, None)
            if response is None:
                told.failed(problem)
                return
            try:
                status, result = behind_a_byte(self._result, response)
            except Misfit:
                told.failed("the action's result is not of its type")
                return
            told.finished(status, result)

        self._send.call(HEADER + goal_id + goal[len(HEADER) :], accepted)

    def cancel(self, goal_id: bytes, done: OnCancel) -> None:
        """`Goals.cancel`."""

        def answered(response: bytes | None, problem: str) -> None:
            if response is None or len(response) < 12:
                done(None, False, problem or "the action's answer is cut off")
            else:  # a code, and the goals that it cancels
                done(response[4], int.from_bytes(response[8:12], "little") > 0, "")

        self._cancel.call(HEADER + goal_id + bytes(STAMP_BYTES), answered)

    def close(self) -> None:
        """`Closable.close`."""
        with self._lock:
            self._waiting.clear()
        for part in (self._statuses, self._feedback, self._get, self._cancel, self._send):
            part.close()

    def _when_ended(self, goal_id: bytes, ask: Callable[[], object]) -> None:
        losses, until = self._session.network.losses, time.monotonic() + ANYWAY_S

        def anyway() -> None:
            with self._lock:
                silent = goal_id not in self._status or self._session.network.losses != losses
            if silent or time.monotonic() > until:
                self._ask(goal_id)
            elif goal_id in self._waiting:
                self._session.later(SILENT_S, anyway, hurry=True)

        with self._lock:
            self._waiting[goal_id] = ask
            ended = self._status.get(goal_id, 0) >= ENDED
        if ended:
            self._ask(goal_id)
        else:
            self._session.later(SILENT_S, anyway, hurry=True)

    def _ask(self, goal_id: bytes) -> None:
        with self._lock:
            ask = self._waiting.pop(goal_id, None)
        if ask is not None:
            ask()

    def _said(self, cdr: bytes, _info: object) -> None:
        """How the server's goals stand."""
        ended = []
        for goal_id, status in statuses(cdr):
            with self._lock:
                self._status[goal_id] = status
                self._status.move_to_end(goal_id)
                if len(self._status) > KEPT:
                    self._status.popitem(last=False)
            if status >= ENDED:
                ended.append(goal_id)
        for goal_id in ended:
            self._ask(goal_id)

    def _fed_back(self, cdr: bytes, _info: object) -> None:
        begin = len(HEADER)
        told = self._told.get(cdr[begin : begin + ID_BYTES])
        if told is not None:
            told.fed_back(cdr[:begin] + cdr[begin + ID_BYTES :])
