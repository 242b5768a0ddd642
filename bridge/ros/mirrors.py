"""Topics and services of other robots in this robot's ROS graph: ``[[robot.mirror]]`` (docs/robots-together.md).

A mirror registers on the other robot as a headset does, so that rate, priority and who may are that robot's to say,
and one copy of a message goes over the mesh to this robot, however many nodes here want it. What is mirrored is not
open to agents (`rules.Rules.mirrored`): so nothing comes back, whoever mirrors whom.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from typing import Any

from bridge.ros.interface import Robot
from bridge.ros.side import MessageType, NotOfType, Publisher, Server, ServiceType, first_line
from bridge.ros.types import InterfaceName
from bridge.settings.mirror import MirrorRule
from macs_zenoh.agent import Agent
from macs_zenoh.errors import Refused
from macs_zenoh.protocol.agent_id import AgentId
from macs_zenoh.protocol.directory import AgentInfo
from macs_zenoh.protocol.limits import ANSWER_BYTES
from macs_zenoh.protocol.messages import ROS, decode_data
from macs_zenoh.protocol.rmw_zenoh.qos import Durability, Qos, Reliability
from macs_zenoh.protocol.robot_state import Offered, TopicQos
from macs_zenoh.topics import TopicMessage
from macs_zenoh.typed import Types

log = logging.getLogger("macs.ros")

AGAIN_S = 1.0
"""Pause before another robot is asked again for what it does not have yet, or refuses."""
ROBOTS = 64
"""So many robots are mirrored at one time for their group alone: whoever is in a group is asked again and again, and a
group is open. Those that a rule names by id come beside them."""
TF_TYPE = "tf2_msgs/msg/TFMessage"


class Mirrors:
    """All mirrors of one robot. Belongs to the loop."""

    def __init__(self, robot: Robot, agent: Agent) -> None:
        self._robot = robot
        self._agent = agent
        self._of: dict[int, list[_Mirrored]] = {}
        self._by_group: set[int] = set()
        """Those of them that no rule names by id."""
        self._waiting: dict[int, list[MirrorRule]] = {}
        """Robots that there was no room for and what of them is wanted, the first first."""
        self._watching = agent.on_presence(self._presence)

    def close(self) -> None:
        """Mirror nothing any more."""
        self._watching.close()
        for other in list(self._of):
            self._end(other)

    def _presence(self, other: AgentInfo, online: bool) -> None:
        if other.type != ROS or other.id == self._robot.agent_id:
            return
        self._end(other.id)
        self._waiting.pop(other.id, None)
        rules = [rule for rule in self._robot.rules.settings.mirror if rule.means(other.id, other.group)]
        if online and rules:
            if any(rule.by_id for rule in rules) or self._has_room:
                self._begin(other.id, rules)
            else:
                self._waiting[other.id] = rules
                why = f"{ROBOTS} robots are mirrored already"
                self._robot.drops.note("not_mirrored", str(AgentId(ROS, other.id)), why)
        while self._waiting and self._has_room:
            first = next(iter(self._waiting))
            self._begin(first, self._waiting.pop(first))

    @property
    def _has_room(self) -> bool:
        return len(self._by_group) < ROBOTS

    def _begin(self, other: int, rules: list[MirrorRule]) -> None:
        begun = self._of[other] = []
        if not any(rule.by_id for rule in rules):
            self._by_group.add(other)
        for rule in rules:
            kinds: tuple[tuple[type[_Mirrored], list[str]], ...] = (
                (MirroredTopic, rule.topics),
                (MirroredService, rule.services),
            )
            for kind, names in kinds:
                begun += [kind(self._robot, self._agent, rule, other, name) for name in names]

    def _end(self, other: int) -> None:
        self._by_group.discard(other)
        for mirrored in self._of.pop(other, ()):
            mirrored.close()


class _Mirrored:
    """One name of another robot, while that one is online."""

    def __init__(self, robot: Robot, agent: Agent, rule: MirrorRule, other: int, name: str) -> None:
        self._robot = robot
        self._agent = agent
        self._rule = rule
        self._other = other
        self._there = name
        self._here = rule.name_of(name, other)
        robot.rules.mirrored.add(self._here)
        self._task = asyncio.get_running_loop().create_task(self._follow())

    def close(self) -> None:
        """End it."""
        self._task.cancel()

    async def _follow(self) -> None:
        problem = ""
        while True:
            try:
                await self._mirror(await self._offers())
            except Exception as error:  # noqa: BLE001 - of the middleware, too: it may do it the next time
                if first_line(error) != problem:
                    problem = first_line(error)
                    log.warning("%s of %s is not mirrored: %s", self._there, AgentId(ROS, self._other), problem)
            await asyncio.sleep(AGAIN_S)

    async def _offers(self) -> Offered:
        """What the other robot has. Raises Refused where it is a recording and the rule does not take those."""
        offered = decode_data(Offered, await self._agent.call(ROS, self._other, "offers"), ANSWER_BYTES)
        if offered.replay is True and not self._rule.replays:
            raise Refused("it is a recording that is played; replays = true mirrors those, too")
        return offered

    async def _mirror(self, offered: Offered) -> None:
        raise NotImplementedError


class MirroredTopic(_Mirrored):
    """A topic of another robot, published here."""

    async def _mirror(self, offered: Offered) -> None:
        of_type = offered.publishers.get(self._there)
        if of_type is None:
            return  # nobody publishes it yet
        told = await self._agent.subscribe(self._there, robot=self._other, type=of_type)
        try:
            change = self._prefixed(of_type)
            message, publisher = await self._advertised(of_type, offered.qos.get(self._there, TopicQos()))
            log.info("%s of %s is %s here", self._there, AgentId(ROS, self._other), self._here)
            try:
                async for one in told:
                    self._publish(publisher, message, change, one)
            finally:
                self._robot.session.submit(publisher.close)
        finally:
            told.close()

    async def _advertised(self, of_type: str, told: TopicQos) -> tuple[MessageType, Publisher]:
        latched, best_effort = told.durability == "transient_local", told.reliability == "best_effort"
        qos = Qos(
            depth=1 if latched else 10,
            durability=Durability.TRANSIENT_LOCAL if latched else Durability.VOLATILE,
            reliability=Reliability.BEST_EFFORT if best_effort else Reliability.RELIABLE,
        )
        side, name = self._robot.session, InterfaceName.parse(of_type, "msg")

        def advertise() -> tuple[MessageType, Publisher]:
            message = side.message(name, self._here)
            return message, side.advertise(message, self._here, qos)

        return await side.run(advertise)

    def _publish(
        self, publisher: Publisher, of: MessageType, change: Callable[[bytes], bytes], message: TopicMessage
    ) -> None:
        if problem := of.problem(message.data):  # the nodes that read it may end by it, whoever sent it
            self._robot.drops.note("bad_cdr", self._here, f"not mirrored, {len(message.data)} bytes: {problem}")
            return
        try:
            publisher.publish(change(message.data))
        except Exception as error:  # noqa: BLE001 - the middleware's, whatever it is
            self._robot.drops.note("failed", self._here, f"not mirrored: {error}")

    def _prefixed(self, of_type: str) -> Callable[[bytes], bytes]:
        """What makes of a message what is published here: with other names of frames, where the rule says so."""
        if not self._rule.tf_prefix or of_type != TF_TYPE:
            return lambda cdr: cdr
        types, prefix = Types(), self._rule.tf_prefix.replace("{robot}", str(self._other))

        def change(cdr: bytes) -> bytes:
            value: dict[str, Any] = types.deserialize(TF_TYPE, cdr)
            for transform in value["transforms"]:
                header = transform["header"]
                header["frame_id"] = prefix + header["frame_id"].lstrip("/")
                transform["child_frame_id"] = prefix + transform["child_frame_id"].lstrip("/")
            return types.serialize(TF_TYPE, value)

        return change


class MirroredService(_Mirrored):
    """A service of another robot, served here. Who calls it is told in any case: a ROS node waits for ever."""

    async def _mirror(self, offered: Offered) -> None:
        of_type = offered.services.get(self._there)
        if of_type is None:
            return  # nobody serves it yet
        side, name, loop = self._robot.session, InterfaceName.parse(of_type, "srv"), asyncio.get_running_loop()
        asking: set[asyncio.Task[None]] = set()
        types = await side.run(lambda: side.service(name, self._here))
        await side.run(lambda: self._failure(types, ""))  # that there is one

        def ask(request: bytes, header: Any) -> None:
            task = loop.create_task(self._answer(serving, types, request, header))
            asking.add(task)
            task.add_done_callback(asking.discard)

        def asked(request: bytes, header: Any) -> None:
            loop.call_soon_threadsafe(ask, request, header)

        serving = loop.create_task(side.run(lambda: side.serve(types, self._here, asked)))
        server = await serving
        log.info("%s of %s is %s here", self._there, AgentId(ROS, self._other), self._here)
        try:
            await loop.create_future()  # until it is cancelled
        finally:
            side.submit(server.close)

    async def _answer(self, serving: asyncio.Task[Server], types: ServiceType, request: bytes, header: Any) -> None:
        timeout_s, side = self._robot.rules.call_timeout_s(self._here), self._robot.session
        server = await asyncio.shield(serving)  # it may be called before this is told that it is there
        try:
            response = await self._agent.call_service(self._there, request, robot=self._other, timeout_s=timeout_s)
        except Exception as error:  # noqa: BLE001 - whatever it is, the caller waits
            reason = first_line(error)
            self._robot.drops.note("call_failed", self._here, reason)
            side.submit(lambda: self._send(server, header, self._failure(types, reason)))
            return
        side.submit(lambda: self._send_response(server, types, header, response))

    # -- in the ROS thread ---------------------------------------------------------------------------------------

    def _failure(self, types: ServiceType, reason: str) -> bytes:
        """Raises Refused."""
        return types.response.failure(reason, self._robot.rules.of(self._here).error_response, "error_response")

    def _send_response(self, server: Server, types: ServiceType, header: Any, response: bytes) -> None:
        problem = types.response.problem(response)
        try:
            if problem is None:
                self._send(server, header, response)
        except NotOfType as error:
            problem = str(error)
        if problem is not None:
            reason = f"the answer of {AgentId(ROS, self._other)} is none of this service: {problem}"
            self._robot.drops.note("bad_cdr", self._here, reason)
            self._send(server, header, self._failure(types, reason))

    def _send(self, server: Server, header: Any, response: bytes) -> None:
        """Raises NotOfType."""
        try:
            server.answer(header, response)
        except NotOfType:
            raise
        except Exception as error:  # noqa: BLE001 - the middleware's, as when the caller is gone
            self._robot.drops.note("failed", self._here, f"not answered: {first_line(error)}")
