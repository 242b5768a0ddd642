"""For modules: register with the robot's gateway and exchange typed messages with other robots by name.

::

    client = GatewayClient(node)
    client.register_module(String, "planning", "my_module", lambda message, sender: print(sender, message.data))
    client.send(String(data="hello"), "planning", to="drone1")

Nothing here blocks: it works on the node's own executor, whichever that is, and may be called from its callbacks.
"""

from __future__ import annotations

import array
import copy
import json
import logging
import threading
import time
import uuid
from collections import Counter, deque
from collections.abc import Callable, Iterable
from typing import Any

from as2_ca_msgs.msg import LocalGenericMessage
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.duration import Duration
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message, serialize_message
from std_msgs.msg import String

from bridge.awareness.node import AGENTS_TOPIC, LATCHED, QOS, QUESTION, RECEIVED_TOPIC, UNDELIVERED_TOPIC
from bridge.awareness.registrar import LOOK_S, Entry, Registrar
from macs_zenoh.handles import Callbacks, Handle

log = logging.getLogger("macs.awareness")

OnMessage = Callable[[Any, str], None]
OnUndelivered = Callable[[str, str, str], None]

QUESTIONS, ASK_AGAIN_S = 6, 0.1
"""How often a gateway is asked at most, and after how long again, each time after twice as long."""
POLL_S = 0.002
POLL = Duration(seconds=POLL_S)


class Module:
    """A registration made by `GatewayClient.register_module`."""

    def __init__(self, kind: type[Any], callback: OnMessage) -> None:
        self.kind = kind
        self.callback = callback
        self.entry: Entry
        self.subscription: Any = None
        self._answered = threading.Event()

    @property
    def topic(self) -> str:
        """Where its messages come; empty until the gateway has answered, and when it has refused."""
        return self.entry.topic

    @property
    def refused(self) -> bool:
        """The gateway does not take this type: its name is not valid."""
        return self.entry.refused

    def wait(self, timeout_s: float) -> bool:
        """Wait for the gateway's answer; whether it was yes. Not in a thread in which the node's executor spins."""
        return self._answered.wait(timeout_s) and not self.refused

    def answered(self) -> None:
        """The gateway has answered."""
        self._answered.set()


class GatewayClient:
    """A module's connection to its robot's gateway. Names are relative to the node's namespace, as the gateway's are.

    ``counters`` counts ``received``, ``sent``, ``bad_message`` (does not deserialize as its type) and ``unsent`` (no
    gateway was there for too long).
    """

    HELD = 100
    """Messages that wait for a gateway that is not there yet; the oldest go."""

    def __init__(
        self, node: Any, *, service: str = "register_module", out_topic: str = "gateway_out", qos: Any = QOS
    ) -> None:
        self.counters: Counter[str] = Counter()
        self._node = node
        self._qos = qos
        self._lock = threading.RLock()
        self._modules: list[Module] = []
        self._held: deque[Any] = deque()
        self._agents: dict[str, list[str]] = {}
        self._on_undelivered: Callbacks[OnUndelivered] = Callbacks()
        self._registrar = Registrar(node, service)
        # typed callbacks of one client never run at the same time, and never wait for the registrations
        self._group = MutuallyExclusiveCallbackGroup()
        self._out = node.create_publisher(LocalGenericMessage, out_topic, _with_room_for_questions(qos))
        self._received = self._subscribe(String, RECEIVED_TOPIC, self._take_received, QOS)
        self._answered: deque[str] = deque(maxlen=QUESTIONS)
        self._timer = node.create_timer(LOOK_S, self._flush, callback_group=self._registrar.group)
        self._watching = [
            self._subscribe(String, AGENTS_TOPIC, self._take_agents, LATCHED),
            self._subscribe(LocalGenericMessage, UNDELIVERED_TOPIC, self._take_undelivered, qos),
        ]

    # -- receive -------------------------------------------------------------------------------------------------

    def register_module(self, kind: type[Any], message_type: str, module_name: str, callback: OnMessage) -> Module:
        """Call ``callback(message, sender)`` for messages of a type, each an instance of ``kind``. Returns at once.

        The module is registered as soon as there is a gateway, and again when the gateway was restarted.

        Args:
            kind: the ROS message class that the data is, as ``std_msgs.msg.String``.
            message_type: the word by which robots know this kind of message.
            module_name: for the gateway's log.
            callback: runs in the node's executor.
        """
        module = Module(kind, callback)
        module.entry = Entry(message_type, module_name, lambda topic: self._registered(module, topic))
        with self._lock:
            self._modules.append(module)
        self._registrar.add(module.entry)
        return module

    def get_subscriber_count(self) -> int:
        """How many registrations have a subscription now."""
        with self._lock:
            return sum(module.subscription is not None for module in self._modules)

    def clear(self) -> None:
        """Drop all registrations and their subscriptions."""
        with self._lock:
            modules, self._modules = self._modules, []
        for module in modules:
            self._registrar.forget(module.entry)
            self._unsubscribe(module)

    def close(self) -> None:
        """Drop everything that this client made on the node."""
        self.clear()
        self._registrar.close()
        self._node.destroy_timer(self._timer)
        for subscription in self._watching:
            self._node.destroy_subscription(subscription)
        self._node.destroy_publisher(self._out)

    def _registered(self, module: Module, topic: str) -> None:
        with self._lock:
            if module in self._modules and topic and topic != module.topic:
                self._unsubscribe(module)
                module.subscription = self._subscribe(
                    LocalGenericMessage, topic, lambda message: self._take(module, message), self._qos
                )
        module.entry.topic = topic
        module.answered()

    def _take(self, module: Module, message: Any) -> None:
        try:
            typed = deserialize_message(bytes(message.data), module.kind)
        except Exception as error:  # noqa: BLE001 - whatever the middleware raises: the data is not ours
            self.counters["bad_message"] += 1
            log.warning(
                "%r from %s is no %s: %s",
                message.type,
                message.agent,
                module.kind.__name__,
                str(error).splitlines()[0],
            )
            return
        self.counters["received"] += 1
        module.callback(typed, message.agent)

    def _subscribe(self, kind: type[Any], topic: str, callback: Any, qos: Any) -> Any:
        return self._node.create_subscription(kind, topic, callback, qos, callback_group=self._group)

    def _unsubscribe(self, module: Module) -> None:
        if module.subscription is not None:
            self._node.destroy_subscription(module.subscription)
            module.subscription = None

    # -- send ----------------------------------------------------------------------------------------------------

    def send(self, message: Any, message_type: str, *, to: str | Iterable[str] = "") -> None:
        """Send a ROS message to one robot, to several, or with ``to`` left out to all others. Returns at once.

        While there is no gateway, the last messages wait for it.
        """
        self.send_data(bytes(serialize_message(message)), message_type, to=to)

    def send_data(self, data: bytes, message_type: str, *, to: str | Iterable[str] = "") -> None:
        """The same for data that is serialized already, or is none of ROS's."""
        for agent in [to] if isinstance(to, str) else list(to):
            wrapped = LocalGenericMessage(agent=agent, type=message_type, data=array.array("B", data))
            with self._lock:
                self._held.append(wrapped)
                if len(self._held) > self.HELD:
                    self._held.popleft()
                    self.counters["unsent"] += 1
        self._flush()

    def flush(self, timeout_s: float = 5.0) -> bool:
        """Wait until the gateway has everything that was sent: for programs that end then. Whether it has.

        Our gateway answers when it is asked. Of another one it is known when its middleware has acknowledged all, and
        Fast DDS, ROS's usual one, asks for that every 3 s.
        """
        deadline = time.monotonic() + timeout_s
        word, asked, ask_at = uuid.uuid4().hex, 0, 0.0
        while (now := time.monotonic()) < deadline:
            self._flush()
            if not self._held:
                if asked < QUESTIONS and now >= ask_at and self._received.get_publisher_count():
                    self._out.publish(LocalGenericMessage(agent=word, data=array.array("B", QUESTION)))
                    asked, ask_at = asked + 1, now + ASK_AGAIN_S * 2**asked  # its publisher may not know us yet
                if self._has_answered(word) or self._out.wait_for_all_acked(POLL):
                    return True
            time.sleep(POLL_S)
        return False

    def _has_answered(self, word: str) -> bool:
        with self._received.handle:  # the node's executor may be this very thread
            taken = self._received.handle.take_message(String, False)
        if taken is not None:
            self._take_received(taken[0])
        return word in self._answered

    def _take_received(self, message: Any) -> None:
        self._answered.append(message.data)

    def _flush(self) -> None:
        with self._lock:
            while self._held and self._out.get_subscription_count():
                self._out.publish(self._held.popleft())
                self.counters["sent"] += 1

    # -- who is there --------------------------------------------------------------------------------------------

    def reachable(self, message_type: str | None = None) -> list[str]:
        """The other robots on the mesh by name, or those of them that take a message type."""
        with self._lock:
            return sorted(n for n, types in self._agents.items() if message_type is None or message_type in types)

    def on_undelivered(self, callback: OnUndelivered) -> Handle:
        """Call ``callback(agent, message_type, why)`` for messages of this robot that were not delivered. Without any
        such callback they are logged.

        ``why`` is a text as ``no such agent`` or ``not registered``.
        """
        return self._on_undelivered.add(callback)

    def _take_agents(self, message: Any) -> None:
        agents = {name: list(agent["takes"]) for name, agent in json.loads(message.data).items()}
        with self._lock:
            self._agents = agents

    def _take_undelivered(self, message: Any) -> None:
        why = bytes(message.data).decode(errors="replace")
        if not self._on_undelivered:
            log.warning("%r to %r was not delivered: %s", message.type, message.agent, why)
        for callback in self._on_undelivered:
            callback(message.agent, message.type, why)


def _with_room_for_questions(qos: Any) -> QoSProfile:
    """A queue in which questions displace no messages that wait to be acknowledged."""
    profile = QoSProfile(depth=qos) if isinstance(qos, int) else copy.copy(qos)
    profile.depth += QUESTIONS
    return profile
