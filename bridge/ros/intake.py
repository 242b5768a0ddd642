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
from rclpy.node import Node
from rclpy.subscription import Subscription

from bridge.ros.rclpy_private import WaitSet, raw_taker

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
        version = self._version
        with self._lock:
            wanted = dict(self._wanted)
        with ExitStack() as in_use:  # nothing that is waited for may be destroyed meanwhile
            waiting = WaitSet(self._node.context, self._changed, wanted, in_use)
            takers = {subscription: raw_taker(subscription) for subscription in waiting.subscriptions}
            while version == self._version:
                events, ready = waiting.wait()
                for event in events:  # of a new publisher before its messages
                    _call(event.callback, event.take_data())
                for subscription in ready:
                    _take(takers[subscription], wanted[subscription])


def _take(take: Callable[[], tuple[bytes, Any] | None], on_raw: OnRaw) -> None:
    for _ in range(BURST):
        taken = take()
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
