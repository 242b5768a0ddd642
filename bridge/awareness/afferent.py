"""For modules whose subscriptions come from a file: as2_ca's ``CA_GatewayClientAfferent`` in Python.

::

    modules:
      - type: "perception"
        module_name: "drone0_perception"
      - type: "planning"
        module_name: "drone0_planning"
"""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable
from enum import Enum
from pathlib import Path
from typing import Any, NamedTuple

import yaml
from as2_ca_msgs.msg import LocalGenericMessage
from as2_ca_msgs.srv import RegisterModule
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node

from bridge.awareness.node import QOS
from bridge.awareness.registrar import Entry, Registrar

log = logging.getLogger("macs.awareness")

CONFIG_FILE = "CA_GatewayClientAfferent.config_file"
"""The node's parameter with the file's path."""

WAIT_S = 5.0
"""For the service to be there, and for each of its answers."""

QUEUE = 100
"""Messages kept per type in on-demand mode; the oldest go."""


class Mode(Enum):
    """How messages of one type are taken."""

    ON_DEMAND = "on demand"
    """They wait for `GatewayClientAfferent.get_msg`."""
    CALLBACK = "callback"


class ModuleEntry(NamedTuple):
    """One line of the file."""

    type: str
    module_name: str


class GatewayClientAfferent:
    """Registers what a file lists. Inputs are numbered in the order in which they were registered.

    Args:
        node: whose executor calls the callbacks.
        config_file: None takes the node's parameter ``CA_GatewayClientAfferent.config_file``.
        service: of the gateway, relative to the node's namespace.
        wait_s: for the service, and for each answer.
    """

    def __init__(
        self,
        node: Any,
        config_file: str | None = None,
        *,
        service: str = "register_module",
        wait_s: float = WAIT_S,
    ) -> None:
        self._node = node
        self._config_file = config_file
        self._service = service
        self._wait_s = wait_s
        self._inputs: list[_Input] = []
        self._registrar: Registrar | None = None
        self._group = MutuallyExclusiveCallbackGroup()

    @property
    def topics(self) -> list[str]:
        """The topic of each input."""
        return [taken.entry.topic for taken in self._inputs]

    def configure(self) -> bool:
        """Read the file and register its modules; whether at least one is registered.

        It blocks until every answer is there, at most ``wait_s`` for the service and for each entry. It may be called
        in a callback of the node: answers are taken by an executor of its own, on a node of its own.
        """
        entries = self._read()
        if entries is None:
            return False
        asker = Node(
            f"{self._node.get_name()}_afferent",
            namespace=self._node.get_namespace(),
            context=self._node.context,
            use_global_arguments=False,
            start_parameter_services=False,
            enable_rosout=False,
        )
        try:
            answers = self._ask(asker, entries)
        finally:
            asker.destroy_node()
        for entry, topic in answers:
            self._subscribe(entry, topic)
        return bool(answers)

    def set_mode(self, index: int, mode: Mode, callback: Callable[[Any], None] | None = None) -> bool:
        """Take an input's messages (LocalGenericMessage) by callback or on demand; False: there is no such input."""
        if not 0 <= index < len(self._inputs) or (mode is Mode.CALLBACK) != (callback is not None):
            return False
        self._inputs[index].callback = callback
        return True

    def get_msg(self, index: int = 0) -> Any:
        """The oldest waiting message of an input in on-demand mode (LocalGenericMessage), or None. Never waits."""
        return self._inputs[index].get() if 0 <= index < len(self._inputs) else None

    def close(self) -> None:
        """Drop the subscriptions."""
        if self._registrar is not None:
            self._registrar.close()
            self._registrar = None
        for taken in self._inputs:
            self._node.destroy_subscription(taken.subscription)
        self._inputs.clear()

    def _read(self) -> list[ModuleEntry] | None:
        """What the file lists; None, with the reason in the log, when it is of no use."""
        path = self._config_file
        if path is None:
            if not self._node.has_parameter(CONFIG_FILE):
                self._node.declare_parameter(CONFIG_FILE, "")
            path = str(self._node.get_parameter(CONFIG_FILE).value)
        if not path:
            log.error("no file: the parameter %s is empty", CONFIG_FILE)
            return None
        try:
            document = yaml.safe_load(Path(path).read_text(encoding="utf-8"))
        except (OSError, ValueError, TypeError, OverflowError, RecursionError, yaml.YAMLError) as error:
            log.error("%s cannot be read: %s", path, str(error).replace("\n", " "))
            return None
        listed = document.get("modules") if isinstance(document, dict) else None
        if not isinstance(listed, list):
            log.error("%s has no list `modules`", path)
            return None
        return [entry for number, item in enumerate(listed) if (entry := _entry(path, number, item)) is not None]

    def _ask(self, asker: Any, entries: list[ModuleEntry]) -> list[tuple[ModuleEntry, str]]:
        executor = SingleThreadedExecutor(context=asker.context)
        executor.add_node(asker)
        client = asker.create_client(RegisterModule, self._service)
        answers = []
        try:
            if not client.wait_for_service(timeout_sec=self._wait_s):
                log.error("no service %s after %g s", client.srv_name, self._wait_s)
                return []
            for entry in entries:
                future = client.call_async(RegisterModule.Request(type=entry.type, module_name=entry.module_name))
                executor.spin_until_future_complete(future, timeout_sec=self._wait_s)
                if not future.done():
                    client.remove_pending_request(future)
                    log.warning("no answer for %r within %g s; skipped", entry.type, self._wait_s)
                elif not future.result().topic:
                    log.warning("the gateway refuses %r; skipped", entry.type)
                else:
                    answers.append((entry, future.result().topic))
        finally:
            executor.shutdown()
        return answers

    def _subscribe(self, entry: ModuleEntry, topic: str) -> None:
        if self._registrar is None:
            self._registrar = Registrar(self._node, self._service)
        taken = _Input(Entry(entry.type, entry.module_name, lambda _topic: None, topic=topic))
        taken.subscription = self._node.create_subscription(
            LocalGenericMessage, topic, taken.take, QOS, callback_group=self._group
        )
        self._inputs.append(taken)
        self._registrar.add(taken.entry)


class _Input:
    """One registered type."""

    def __init__(self, entry: Entry) -> None:
        self.entry = entry
        self.subscription: Any = None
        self.callback: Callable[[Any], None] | None = None
        self._waiting: deque[Any] = deque(maxlen=QUEUE)
        self._lock = threading.Lock()

    def take(self, message: Any) -> None:
        if self.callback is not None:
            self.callback(message)
            return
        with self._lock:
            self._waiting.append(message)

    def get(self) -> Any:
        with self._lock:
            return self._waiting.popleft() if self._waiting else None


def _entry(path: str, number: int, item: object) -> ModuleEntry | None:
    if isinstance(item, dict):
        message_type, module_name = item.get("type"), item.get("module_name")
        if isinstance(message_type, str) and message_type and isinstance(module_name, str):
            return ModuleEntry(message_type, module_name)
    log.warning("%s: entry %d is not {type: TEXT, module_name: TEXT}; skipped", path, number)
    return None
