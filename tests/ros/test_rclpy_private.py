"""What we use of rclpy beyond what it promises does what we think, on the rclpy that is installed; and nothing else is
used."""

from __future__ import annotations

import ast
import asyncio
import re
import threading
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from rclpy.guard_condition import GuardCondition
from rclpy.lifecycle import LifecycleNode
from rclpy.serialization import deserialize_message
from std_msgs.msg import String
from std_srvs.srv import SetBool

from bridge.ros.intake import _OutOfExecutor
from bridge.ros.rclpy_private import (
    WaitSet,
    answer_later,
    change_state,
    lifecycle_state,
    on_transition,
    raw_taker,
    waiting_requests,
)
from bridge.ros.session import RosSession
from tests.support.ros_peer import Peer

ROOT = Path(__file__).parents[2]
INNER = re.compile(r"_state_machine|_service_change_state|_LifecycleNodeMixin\w+|service_take_request|pointer")


async def test_a_wait_set_tells_what_has_come(session: RosSession, peer: Peer) -> None:
    """A message wakes who waits, and is taken raw with what rclpy knows of it; so does the guard, with nothing."""
    node = session.node
    subscription = await session.run(
        lambda: node.create_subscription(String, "/a", print, 10, raw=True, callback_group=_OutOfExecutor())
    )
    publisher = await peer.publisher(String, "/a", matched=1)
    guard = GuardCondition(None, None, context=node.context)
    with ExitStack() as in_use:
        waiting = WaitSet(node.context, guard, [subscription], in_use)
        assert list(waiting.subscriptions) == [subscription]
        publisher.publish(String(data="hello"))
        ready: list[Any] = []
        while not ready:  # its events come first
            _, ready = await asyncio.to_thread(waiting.wait)
        assert ready == [subscription]
        taken = raw_taker(subscription)()
        assert taken is not None
        cdr, info = taken
        assert (deserialize_message(cdr, String).data, "publication_sequence_number" in info) == ("hello", True)
        assert raw_taker(subscription)() is None
        threading.Timer(0.05, guard.trigger).start()
        assert await asyncio.to_thread(waiting.wait) == ([], [])


async def test_a_destroyed_subscription_is_left_out(session: RosSession) -> None:
    """Who waits again after one has gone does not fail on it."""
    node = session.node
    subscription = await session.run(
        lambda: node.create_subscription(String, "/a", print, 10, callback_group=_OutOfExecutor())
    )
    await session.run(lambda: node.destroy_subscription(subscription))
    guard = GuardCondition(None, None, context=node.context)
    with ExitStack() as in_use:
        assert list(WaitSet(node.context, guard, [subscription], in_use).subscriptions) == []


async def test_a_service_may_answer_later(session: RosSession, peer: Peer) -> None:
    """A request is handed over with what its answer needs, others that wait are had at once, and each call gets the
    answer that was given to it, in any order."""
    open_calls: list[tuple[Any, Any]] = []

    def take(request: Any, header: Any) -> None:
        open_calls.append((request, header))
        open_calls.extend(waiting_requests(service, SetBool.Request, 64))

    def serve() -> Any:
        made = session.node.create_service(SetBool, "/set", lambda request, response: request)
        return made, answer_later(made, take)

    service, respond = await session.run(serve)
    client = await peer.session.run(lambda: peer.session.node.create_client(SetBool, "/set"))
    while not (client.service_is_ready() and session.node.count_clients("/set")):  # the service finds out later
        await asyncio.sleep(0.01)
    calls = [client.call_async(SetBool.Request(data=value)) for value in (True, False)]
    while len(open_calls) < 2:
        await asyncio.sleep(0.01)
    for request, header in reversed(open_calls):
        await session.run(lambda r=request, h=header: respond(SetBool.Response(message=str(r.data)), h))
    while not all(call.done() for call in calls):
        await asyncio.sleep(0.01)
    assert [call.result().message for call in calls] == ["True", "False"]


def test_a_transition_may_be_answered_by_us(session: RosSession) -> None:
    """A managed node says its state, and the answer to a change of it may be ours, rclpy's own within it."""
    node = LifecycleNode("managed", context=session.node.context)
    try:
        assert lifecycle_state(node) == "unconfigured"
        on_transition(node, print)
        from lifecycle_msgs.srv import ChangeState

        request = ChangeState.Request()
        request.transition.label = "configure"
        assert change_state(node, request, ChangeState.Response()).success
        assert lifecycle_state(node) == "inactive"
    finally:
        node.destroy_node()


def test_nothing_else_of_rclpy_is_used() -> None:
    """No other module imports what is below rclpy's surface, or names its inner attributes."""
    for path in sorted((ROOT / "bridge").rglob("*.py")):
        if path.name == "rclpy_private.py":
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom):
                assert not (node.module or "").startswith(("rclpy.impl", "rclpy._")), path
            elif isinstance(node, ast.Attribute):
                assert not INNER.fullmatch(node.attr), (path, node.attr, node.lineno)
