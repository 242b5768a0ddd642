"""Where the schemas of a recording come from: the robot's own definitions, else `rosbags`, never nothing."""

from __future__ import annotations

import asyncio
import importlib
import logging
from collections.abc import Callable
from typing import Any, NamedTuple

from macs_zenoh import robot_types
from macs_zenoh.agent import Agent
from macs_zenoh.errors import MacsError, Unreachable
from macs_zenoh.protocol import schemas
from macs_zenoh.protocol.messages import ROS
from macs_zenoh.protocol.schemas import Definition

log = logging.getLogger("macs.record")

ASK_S = 10.0
"""How long a robot may take to tell a definition."""


class Schema(NamedTuple):
    """The text of a type with all that it needs, and its hash, empty where nobody knows it."""

    text: str
    hash: str = ""


class Schemas:
    """Of all robots; each tells its own, since two may have different types of one name."""

    def __init__(self, agent: Agent) -> None:
        self._agent = agent
        self._told: dict[int, dict[str, Definition]] = {}
        self._asking: dict[tuple[int, str], asyncio.Task[Schema]] = {}
        self._rosbags: Any = None

    def forget(self, robot: int) -> None:
        """The robot has left: the next one with its id may have other types."""
        self._told.pop(robot, None)
        for key in [key for key in self._asking if key[0] == robot]:
            del self._asking[key]

    def known(self, robot: int, of_type: str) -> Schema | None:
        """The schema, if it has been found before."""
        task = self._asking.get((robot, of_type))
        return task.result() if task is not None and task.done() and not task.exception() else None

    async def of(self, robot: int, of_type: str) -> Schema:
        """The schema of a message type (``geometry_msgs/msg/Twist``) as this robot has it.

        Raises Unreachable where neither the robot nor `rosbags` knows it.
        """
        key = (robot, of_type)
        task = self._asking.get(key)
        if task is None:
            task = self._asking[key] = asyncio.get_running_loop().create_task(self._find(robot, of_type))
        try:
            return await asyncio.shield(task)
        except MacsError:
            self._asking.pop(key, None)
            raise

    async def _find(self, robot: int, of_type: str) -> Schema:
        problem = ""
        told = self._told.setdefault(robot, {})
        text = schemas.schema(of_type, told)
        if text is None:
            try:
                whole = of_type if "_" not in of_type.rpartition("/")[2] else of_type.rpartition("_")[0]
                answer = await robot_types.definitions(self._ask(robot), [whole])
                told |= answer.definitions
                problem = "; ".join(answer.missing.values())
            except MacsError as error:
                problem = str(error)
            text = schemas.schema(of_type, told)
        if text is not None:
            own = told.get(of_type)
            return Schema(_never_empty(of_type, text), own.hash if own is not None else "")
        found = await asyncio.to_thread(self._of_rosbags, of_type)
        if found is None:
            raise Unreachable(f"the definition of {of_type}", problem or "nobody has it")
        log.info("ros/%d does not tell what a %s is; taken from rosbags", robot, of_type)
        return found

    def _ask(self, robot: int) -> Callable[[str, bytes], Any]:
        return lambda verb, data: self._agent.call(ROS, robot, verb, data, timeout_s=ASK_S)

    def _of_rosbags(self, of_type: str) -> Schema | None:
        try:
            if self._rosbags is None:
                typesys = importlib.import_module("rosbags.typesys")
                self._rosbags = typesys.get_typestore(typesys.Stores.ROS2_JAZZY)
            if of_type not in self._rosbags.fielddefs:
                return None
            text, _ = self._rosbags.generate_msgdef(of_type, ros_version=2)
            return Schema(_never_empty(of_type, text), self._rosbags.hash_rihs01(of_type))
        except ImportError:
            return None


def _never_empty(of_type: str, text: str) -> str:
    """The same; of a type without fields a comment, since an empty schema means that nobody knows it."""
    return text if text.strip() else f"# {of_type} has no fields\n"
