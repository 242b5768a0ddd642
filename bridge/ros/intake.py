"""Raw messages of data subscriptions, taken in a thread that waits for nothing else.

rclpy's executor builds its wait set anew, in Python, for each message, over all that the node has. While it does so it
competes with everything else on the message's way. Here the wait set stays as long as the subscriptions do, and only
what is ready is looked at.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.exceptions import InvalidHandle
from rclpy.guard_condition import GuardCondition
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.subscription import Subscription

log = logging.getLogger("macs.ros")

OnRaw = Callable[[bytes, Mapping[str, Any]], None]
"""Takes one message as CDR, and what rclpy knows about it; called in the thread of the intake."""

BURST = 64
"""Messages taken of one subscription before the others get their turn."""

ERROR_PAUSE_S = 0.1


class Intake:
    """Raw subscriptions of one node. Its thread begins with the first of them and ends with `close`."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._group = _OutOfExecutor()
        self._lock = threading.Lock()
        self._wanted: dict[Subscription, OnRaw] = {}
        self._changed = GuardCondition(None, None, context=node.context)
        self._version = 0
        self._open = True
        self._thread: threading.Thread | None = None

    def subscribe(
        self,
        message: type[Any],
        topic: str,
        on_raw: OnRaw,
        profile: Any,
        *,
        events: SubscriptionEventCallbacks | None = None,
    ) -> Subscription:
        """Subscribe, with the errors of `Node.create_subscription`. In the ROS thread.

        ``events`` are called in the thread of the intake as well; none of them by default.
        """
        subscription = self._node.create_subscription(
            message,
            topic,
            on_raw,
            profile,
            raw=True,
            callback_group=self._group,
            event_callbacks=events or SubscriptionEventCallbacks(use_default_callbacks=False),
        )
        with self._lock:
            self._wanted[subscription] = on_raw
        self._look_again()
        if self._thread is None:
            self._thread = threading.Thread(target=self._work, name="macs-ros-intake", daemon=True)
            self._thread.start()
        return subscription

    def unsubscribe(self, subscription: Subscription) -> None:
        """End a subscription; a message that is being taken now may still be passed on. In the ROS thread."""
        with self._lock:
            self._wanted.pop(subscription, None)
        self._look_again()
        self._node.destroy_subscription(subscription)

    def close(self) -> None:
        """End the thread; what is still subscribed is destroyed with the node. Closing twice is allowed."""
        if self._open:
            self._open = False
            self._look_again()
            if self._thread is not None:
                self._thread.join()
            self._changed.destroy()

    def _look_again(self) -> None:
        self._version += 1
        self._changed.trigger()

    # -- in its own thread ---------------------------------------------------------------------------------------

    def _work(self) -> None:
        while self._open and self._node.context.ok():
            try:
                self._take_until_changed()
            except InvalidHandle:  # something was unsubscribed in this moment
                continue
            except Exception:
                if self._open and self._node.context.ok():
                    log.exception("waiting for ROS messages failed")
                    time.sleep(ERROR_PAUSE_S)

    def _take_until_changed(self) -> None:
        version, context, changed = self._version, self._node.context, self._changed.handle
        with ExitStack() as in_use:  # nothing that is waited for may be destroyed meanwhile
            in_use.enter_context(context.handle)
            in_use.enter_context(changed)
            wanted = self._enter(in_use)
            handles = [subscription.handle for subscription, _ in wanted.values()]
            takers = {
                pointer: (subscription.handle.take_message, subscription.msg_type, on_raw)
                for pointer, (subscription, on_raw) in wanted.items()
            }
            events = [event for subscription, _ in wanted.values() for event in subscription.event_handlers]
            for event in events:
                in_use.enter_context(event)
            wait_set = rclpy_implementation.WaitSet(len(handles), 1, 0, 0, 0, len(events), context.handle)
            while version == self._version:
                wait_set.clear_entities()
                wait_set.add_guard_condition(changed)
                for handle in handles:
                    wait_set.add_subscription(handle)
                for event in events:
                    event.add_to_wait_set(wait_set)
                wait_set.wait(-1)
                for event in events:  # of a new publisher before its messages
                    if event.is_ready(wait_set):
                        _call(event.callback, event.take_data())
                for pointer in wait_set.get_ready_entities("subscription"):
                    _take(*takers[pointer])

    def _enter(self, in_use: ExitStack) -> dict[int, tuple[Subscription, OnRaw]]:
        """The subscriptions that exist, by the pointers under which the wait set knows them."""
        with self._lock:
            wanted = list(self._wanted.items())
        existing = {}
        for subscription, on_raw in wanted:
            try:
                in_use.enter_context(subscription.handle)
            except InvalidHandle:  # destroyed a moment ago
                continue
            existing[subscription.handle.pointer] = (subscription, on_raw)
        return existing


def _take(take: Callable[[type[Any], bool], tuple[bytes, Any] | None], message: type[Any], on_raw: OnRaw) -> None:
    for _ in range(BURST):
        taken = take(message, True)
        if taken is None:
            return
        _call(on_raw, *taken)


def _call(callback: Callable[..., None], *args: Any) -> None:
    try:
        callback(*args)
    except Exception:
        log.exception("error in a ROS callback")  # one that failed must not end the others


class _OutOfExecutor(CallbackGroup):  # type: ignore[misc]  # rclpy has no types
    """Keeps a subscription and its events from the executor."""

    def can_execute(self, entity: Any) -> bool:
        return False

    def beginning_execution(self, entity: Any) -> bool:
        return False

    def ending_execution(self, entity: Any) -> None:
        pass
