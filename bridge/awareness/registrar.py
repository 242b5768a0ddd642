"""Keeps modules registered with a gateway: asks, asks again, and notices when the gateway was restarted.

Nothing here waits: requests are answered by callbacks of the node's own executor, and a timer does the rest.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from as2_ca_msgs.srv import RegisterModule
from rclpy.callback_groups import ReentrantCallbackGroup

log = logging.getLogger("macs.awareness")

LOOK_S = 0.2
"""How often registrations are looked after."""
ANSWER_S = 2.0
"""A request without an answer for so long is made again: the gateway may have died over it."""
ALONE_S = 3.0
"""Without any gateway for so long, one is missed in the log, once."""
GONE_S = 1.0
"""A topic without a publisher for so long: the gateway is another one, and knows nothing of us."""


@dataclass
class Entry:
    """One module's registration of one type. ``topic`` is empty until the gateway has answered."""

    type: str
    module_name: str
    on_topic: Callable[[str], None]
    """Called with the topic when the gateway answers, in the node's executor; with "" when it refuses."""
    topic: str = ""
    refused: bool = False
    asked: Any = None
    asked_at: float = 0.0
    gone_since: float | None = None
    stale: bool = False
    """Another gateway has come since the answer."""


@dataclass
class Registrar:
    """All registrations of one ROS node. ``service`` is relative to the node's namespace."""

    node: Any
    service: str = "register_module"
    entries: list[Entry] = field(default_factory=list)

    def __post_init__(self) -> None:
        # a group of its own, so that a callback of the module's that takes long does not stand in the way
        self.group = ReentrantCallbackGroup()
        self._service_name = self.node.resolve_service_name(self.service)
        self._services = 0
        self._alone_since: float | None = time.monotonic()
        self._client = self.node.create_client(RegisterModule, self.service, callback_group=self.group)
        self._timer = self.node.create_timer(LOOK_S, self._look, callback_group=self.group)

    def add(self, entry: Entry) -> None:
        """Register it as soon as there is a gateway, unless it has a topic, and keep it registered."""
        self.entries.append(entry)
        if not entry.topic and self._client.service_is_ready():
            self._ask(entry)

    def forget(self, entry: Entry) -> None:
        """Keep it registered no more."""
        if entry in self.entries:
            self.entries.remove(entry)
        self._give_up(entry)

    def close(self) -> None:
        """Stop looking after registrations."""
        for entry in list(self.entries):
            self.forget(entry)
        self.node.destroy_timer(self._timer)
        self.node.destroy_client(self._client)

    def _look(self) -> None:
        now = time.monotonic()
        ready = self._client.service_is_ready()
        self._notice_newcomer()
        self._miss_gateway(ready, now)
        for entry in list(self.entries):
            if entry.asked is not None and now - entry.asked_at > ANSWER_S:
                self._give_up(entry)
            if entry.refused or entry.asked is not None or not ready:
                continue
            if not entry.topic or entry.stale or self._is_gone(entry, now):
                self._ask(entry)

    def _miss_gateway(self, ready: bool, now: float) -> None:
        if ready:
            self._alone_since = None
        elif self._alone_since is not None and now - self._alone_since > ALONE_S:
            self._alone_since = None
            log.warning(
                "no gateway offers %s in ROS domain %d: does `macs awareness` run there, in this namespace?",
                self._service_name,
                self.node.context.get_domain_id(),
            )

    def _notice_newcomer(self) -> None:
        """A gateway that was killed is seen by ROS for 20 s more; its successor beside it is seen at once."""
        services = self.node.count_services(self._service_name)
        if services > self._services:
            for entry in self.entries:
                entry.stale = bool(entry.topic)
        self._services = services

    def _is_gone(self, entry: Entry, now: float) -> bool:
        if self.node.count_publishers(entry.topic):
            entry.gone_since = None
            return False
        entry.gone_since = entry.gone_since or now
        return now - entry.gone_since > GONE_S

    def _ask(self, entry: Entry) -> None:
        request = RegisterModule.Request(type=entry.type, module_name=entry.module_name)
        entry.asked_at = time.monotonic()
        entry.asked = self._client.call_async(request)
        entry.asked.add_done_callback(lambda future: self._answered(entry, future))

    def _give_up(self, entry: Entry) -> None:
        if entry.asked is not None:
            self._client.remove_pending_request(entry.asked)
            entry.asked.cancel()
            entry.asked = None

    def _answered(self, entry: Entry, future: Any) -> None:
        if future.cancelled() or entry.asked is not future or entry not in self.entries:
            return
        entry.asked = None
        entry.gone_since = None
        entry.stale = False
        answer = future.result()
        topic = answer.topic if answer is not None else ""
        if not topic:
            entry.refused = True
            log.error("the gateway refuses to register type %r for %r", entry.type, entry.module_name)
        elif entry.topic:
            log.info("registered %r again on %s", entry.type, topic)
        entry.on_topic(topic)
        entry.topic = topic
