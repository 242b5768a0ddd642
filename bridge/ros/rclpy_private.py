"""What we use of rclpy that it does not promise, in one place: names that a newer rclpy may change.

`tests/ros/test_rclpy_private.py` tries each of them on the installed one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack
from functools import partial
from typing import Any

from rclpy.exceptions import InvalidHandle
from rclpy.guard_condition import GuardCondition
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.subscription import Subscription


class WaitSet:
    """Subscriptions with their events, and a guard, waited for in a thread of our own. Those that were destroyed a
    moment ago are left out."""

    def __init__(
        self, context: Any, guard: GuardCondition, subscriptions: Iterable[Subscription], in_use: ExitStack
    ) -> None:
        """``in_use`` keeps what is waited for from being destroyed meanwhile. Raises InvalidHandle."""
        in_use.enter_context(context.handle)
        in_use.enter_context(guard.handle)
        self._guard = guard.handle
        self._by_pointer: dict[int, Subscription] = {}
        for subscription in subscriptions:
            try:
                in_use.enter_context(subscription.handle)
            except InvalidHandle:
                continue
            self._by_pointer[subscription.handle.pointer] = subscription
        self._handles = [subscription.handle for subscription in self._by_pointer.values()]
        self._events = [event for subscription in self._by_pointer.values() for event in subscription.event_handlers]
        for event in self._events:
            in_use.enter_context(event)
        self._set = rclpy_implementation.WaitSet(len(self._handles), 1, 0, 0, 0, len(self._events), context.handle)

    @property
    def subscriptions(self) -> Iterable[Subscription]:
        """Those that exist."""
        return self._by_pointer.values()

    def wait(self) -> tuple[list[Any], list[Subscription]]:
        """Wait until something is there or the guard is triggered; events and subscriptions that have something."""
        waited = self._set
        waited.clear_entities()
        waited.add_guard_condition(self._guard)
        for handle in self._handles:
            waited.add_subscription(handle)
        for event in self._events:
            event.add_to_wait_set(waited)
        waited.wait(-1)
        events = [event for event in self._events if event.is_ready(waited)]
        return events, [self._by_pointer[pointer] for pointer in waited.get_ready_entities("subscription")]


def raw_taker(subscription: Subscription) -> Callable[[], tuple[bytes, Any] | None]:
    """Takes the next message of a subscription as CDR, with what rclpy knows about it; None when there is none."""
    return partial(subscription.handle.take_message, subscription.msg_type, True)


def answer_later(service: Any, take: Callable[[Any, Any], None]) -> Callable[[Any, Any], None]:
    """Have ``take(request, header)`` called for each request of a service whose callback returns the request; returns
    what answers one later.

    rclpy sends as the response what the callback returned, through ``send_response`` of the service object, with the
    header of the request. Its own way of answering later, a coroutine, makes the executor spin as long as any call is
    open.
    """
    respond: Callable[[Any, Any], None] = service.send_response
    service.send_response = take
    return respond


def waiting_requests(service: Any, kind: type[Any], most: int) -> Iterator[tuple[Any, Any]]:
    """Requests of a service, with their headers, that wait behind the one that the executor has taken."""
    handle = service.handle
    with handle:
        for _ in range(most):
            request, header = handle.service_take_request(kind)
            if header is None:
                return
            yield request, header


def lifecycle_state(node: Any) -> str:
    """``unconfigured``, ``inactive``, ``active`` or ``finalized``."""
    return str(node._state_machine.current_state[1])


def on_transition(node: Any, answer: Callable[[Any, Any], Any]) -> None:
    """Have ``answer(request, response)`` answer the service that changes a managed node's state."""
    node._service_change_state.callback = answer


def change_state(node: Any, request: Any, response: Any) -> Any:
    """rclpy's own answer. Raises RuntimeError for a transition that is not possible now, and has answered nothing."""
    return node._LifecycleNodeMixin__on_change_state(request, response)
