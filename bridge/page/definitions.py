"""The types of messages, as pages read and write them: the text of a message with all that it needs.

A robot tells its own definitions, also of types that are installed nowhere else. For robots that do not, those that
rosbags brings serve.
"""

from __future__ import annotations

import importlib
import re
import time
from collections import OrderedDict
from typing import Any

from macs_zenoh.errors import MacsError
from macs_zenoh.protocol import schemas
from macs_zenoh.robot_types import definitions

from .robots import Robots

KEPT = 1024
"""So many texts are remembered."""
GOOD_S = 60.0
"""A robot that comes back may have other types."""

_NAME = re.compile(r"[A-Za-z]\w{0,99}/(msg/|(srv|action)/\w+_)[A-Za-z]\w{0,99}", re.ASCII)

_SERVICES = {
    "std_srvs/srv/SetBool_Request": "bool data\n",
    "std_srvs/srv/SetBool_Response": "bool success\nstring message\n",
    "std_srvs/srv/Trigger_Request": "",
    "std_srvs/srv/Trigger_Response": "bool success\nstring message\n",
    "std_srvs/srv/Empty_Request": "",
    "std_srvs/srv/Empty_Response": "",
}
"""What everybody uses and rosbags does not have."""


class Definitions:
    """Texts by robot and type, each asked for once."""

    def __init__(self, robots: Robots) -> None:
        self._robots = robots
        self._kept: OrderedDict[tuple[int, str], tuple[float, str]] = OrderedDict()
        self._store: Any = None

    async def text(self, robot: int, name: str) -> str | None:
        """The text of ``pkg/msg/Name``, ``pkg/srv/Name_Request`` and the like on this robot; None where nobody has
        it."""
        now = time.monotonic()
        at, text = self._kept.get((robot, name), (now, None))
        if text is None or now - at > GOOD_S:
            text = await self._of_robot(robot, name)
            if text is None:
                text = self._of_everybody(name)
            if text is not None:
                self._kept[robot, name] = (now, text)
                while len(self._kept) > KEPT:
                    self._kept.popitem(last=False)
        return text

    async def _of_robot(self, robot: int, name: str) -> str | None:
        if not _NAME.fullmatch(name):
            return None
        whole = name if "/msg/" in name else name.rpartition("_")[0]

        async def ask(verb: str, data: bytes) -> bytes:
            return await self._robots.ask(robot, verb, data)

        try:
            told = await definitions(ask, [whole])
        except MacsError:
            return None  # an existing program, or one that does not answer in time
        return schemas.schema(name, told.definitions)

    def _of_everybody(self, name: str) -> str | None:
        if name in _SERVICES:
            return _SERVICES[name]
        if self._store is None:
            try:
                typesys = importlib.import_module("rosbags.typesys")
            except ImportError:
                return None
            self._store = typesys.get_typestore(typesys.Stores.ROS2_JAZZY)
        if name not in self._store.fielddefs:
            return None
        text: str = self._store.generate_msgdef(name, ros_version=2)[0]
        return text
