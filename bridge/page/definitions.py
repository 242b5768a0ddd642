"""The types of messages, as pages read and write them: the text of a message with all that it needs.

A robot tells its own definitions, also of types that are installed nowhere else. For robots that do not, those that
rosbags brings serve.
"""

from __future__ import annotations

import asyncio
import importlib
import math
import re
import time
from collections import OrderedDict
from typing import Any, ClassVar, TypeVar

from macs_zenoh.errors import MacsError
from macs_zenoh.protocol import schemas
from macs_zenoh.robot_types import definitions

from .robots import Robots

KEPT = 1024
"""So many texts are remembered."""
GOOD_S = 60.0
"""A robot that comes back may have other types."""
UNKNOWN_S = 5.0
"""So long nobody is asked again for what nobody knew."""

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


T = TypeVar("T")


class Definitions:
    """Texts by robot and type, each asked for once."""

    def __init__(self, robots: Robots) -> None:
        self._robots = robots
        self._kept: OrderedDict[tuple[int, str], tuple[float, str]] = OrderedDict()
        self._unknown: OrderedDict[tuple[int, str], float] = OrderedDict()
        """When nobody knew it: names that somebody makes up displace no texts."""
        self._store: Any = None
        self._loading = asyncio.Lock()

    async def text(self, robot: int | None, name: str) -> str | None:
        """The text of ``pkg/msg/Name``, ``pkg/srv/Name_Request`` and the like on this robot, or as everybody has it;
        None where nobody has it."""
        if not _NAME.fullmatch(name):
            return None
        if robot is None:
            return await self._of_everybody(name)
        about, now = (robot, name), time.monotonic()
        at, text = self._kept.get(about, (now, None))
        if text is not None and now - at <= GOOD_S:
            return text
        if now - self._unknown.get(about, -math.inf) <= UNKNOWN_S:
            return None
        text = await self._of_robot(robot, name)
        if text is None:
            text = await self._of_everybody(name)
        if text is None:
            _keep(self._unknown, about, now)
        else:
            _keep(self._kept, about, (now, text))
        return text

    async def _of_robot(self, robot: int, name: str) -> str | None:
        whole = name if "/msg/" in name else name.rpartition("_")[0]

        async def ask(verb: str, data: bytes) -> bytes:
            return await self._robots.ask(robot, verb, data)

        try:
            told = await definitions(ask, [whole])
        except MacsError:
            return None  # an existing program, or one that does not answer in time
        return await asyncio.to_thread(schemas.schema, name, told.definitions)  # as much as a robot likes to tell

    async def _of_everybody(self, name: str) -> str | None:
        if name in _SERVICES:
            return _SERVICES[name]
        async with self._loading:
            if self._store is None:
                self._store = await asyncio.to_thread(_load)  # it takes as long as many frames
        if name not in self._store.fielddefs:
            return None
        text: str = self._store.generate_msgdef(name, ros_version=2)[0]
        return text


class _Nothing:
    """Where rosbags is not installed."""

    fielddefs: ClassVar[dict[str, Any]] = {}


def _load() -> Any:
    try:
        typesys = importlib.import_module("rosbags.typesys")
    except ImportError:
        return _Nothing()
    return typesys.get_typestore(typesys.Stores.ROS2_JAZZY)


def _keep(kept: OrderedDict[tuple[int, str], T], about: tuple[int, str], what: T) -> None:
    kept.pop(about, None)
    kept[about] = what
    while len(kept) > KEPT:
        kept.popitem(last=False)
