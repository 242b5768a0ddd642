"""What a Foxglove server shows of a mesh, and what its clients ask for.

Every topic of every robot is advertised; a robot is asked for one while somebody looks at it. So a robot's link
carries what is looked at, once.
"""

from __future__ import annotations

import asyncio
import json
import logging
import time
from collections import Counter
from collections.abc import Callable, Coroutine
from contextlib import suppress
from typing import Any

import foxglove
from foxglove.websocket import Capability, ServerListener, WebSocketServer

from bridge.foxglove.publishing import ClientTopics
from bridge.recording.disk import Entry
from bridge.recording.recorder import Recorder, Wanted
from bridge.recording.streams import CDR, JSON, ROS2MSG, STATUS, robot_topic, split_topic
from macs_zenoh.agent import Agent
from macs_zenoh.errors import MacsError
from macs_zenoh.protocol.directory import AgentInfo
from macs_zenoh.protocol.messages import ROS
from macs_zenoh.protocol.robot_state import Offered
from macs_zenoh.protocol.schemas import full_type

log = logging.getLogger("macs.foxglove")

GRAPH_S = 2.0
CALL_S = 10.0
"""How long a service of a robot may take."""
KEPT = 4096
"""Newest values, of latched topics and of what robots say, that a client gets who comes later."""


class Live(ServerListener):  # type: ignore[misc, unused-ignore]  # of a checkout without the SDK
    """One server for one mesh. The SDK calls in threads of its own; all else belongs to the loop."""

    def __init__(self, agent: Agent, wanted: Wanted, *, secret: str | None) -> None:
        """``secret``: clients that say they will publish to a channel of this name may publish and call services,
        which may move robots; None: nobody may."""
        self.recorder = Recorder(agent, self, wanted)
        self.recorder.demand = self._is_demanded
        self.recorder.on_offered = self._offered
        self.shown = 0
        self._agent = agent
        self._publishes = secret is not None
        self._secret = secret
        self._trusted: dict[int, int] = {}
        """Clients that know the secret, and the channel in which they said so. In the SDK's threads."""
        self._loop = asyncio.get_running_loop()
        self._context = foxglove.Context()
        self._channels: dict[str, foxglove.Channel] = {}
        self._kept: dict[str, dict[str, Entry]] = {}
        self._looking: Counter[str] = Counter()
        self._services: dict[str, tuple[int, str, str]] = {}
        self._nodes: dict[int, list[dict[str, Any]]] = {}
        self._published = ClientTopics(
            agent, lambda robot, topic: wanted.robot(robot) and wanted.topic(topic), self._tell
        )
        self._tasks: set[asyncio.Task[None]] = set()
        self._server: WebSocketServer | None = None

    def start(self, host: str, port: int, **tls: bytes) -> int:
        """Serve; the port. Raises OSError, RuntimeError: the SDK's."""
        capabilities = [Capability.ConnectionGraph]
        if self._publishes:
            capabilities += [Capability.ClientPublish, Capability.Services]
        self._server = foxglove.start_server(
            name="macs-zenoh",
            host=host,
            port=port,
            capabilities=capabilities,
            server_listener=self,
            supported_encodings=[CDR, JSON],
            context=self._context,
            **tls,  # type: ignore[arg-type, unused-ignore]
        )
        self.recorder.start()
        self._agent.on_presence(self._presence)
        self._spawn(self._show_graph())
        return int(self._server.port)

    def close(self) -> None:
        """End."""
        for task in self._tasks:
            task.cancel()
        self._published.close()
        self.recorder.close()
        if self._server is not None:
            self._server.stop()

    # -- what is shown -------------------------------------------------------------------------------------------

    def put(self, entry: Entry) -> None:
        """A message, of a topic that somebody looks at or about the mesh."""
        name = entry.channel.topic
        channel = self._channels.get(name)
        if channel is None:
            schema = None
            if entry.channel.schema:
                schema = _schema(entry.channel.type, entry.channel.schema)
            channel = self._open(name, entry.channel.encoding, schema, entry.channel.metadata)
        if name == STATUS:
            said = json.loads(entry.data)
            self._nodes[said["robot"]] = said["status"]["nodes"]
        if entry.keep:
            kept = self._kept.setdefault(name, {})
            if entry.keep in kept or len(kept) < KEPT:
                kept[entry.keep] = entry
        channel.log(entry.data, log_time=entry.log_ns)
        self.shown += 1

    def _open(
        self, name: str, encoding: str, schema: foxglove.Schema | None, metadata: dict[str, str]
    ) -> foxglove.Channel:
        channel = foxglove.Channel(
            name, message_encoding=encoding, schema=schema, context=self._context, metadata=metadata
        )
        self._channels[name] = channel
        return channel

    def _offered(self, robot: int, offered: Offered) -> None:
        self._spawn(self._advertise(robot, offered))

    async def _advertise(self, robot: int, offered: Offered) -> None:
        """Topics and services that are new."""
        for topic, of_type in offered.publishers.items():
            name = robot_topic(robot, topic)
            if name in self._channels or not self.recorder.wants(topic):
                continue
            try:
                schema = await self.recorder.schemas.of(robot, full_type(of_type))
            except MacsError as error:
                log.warning("%s is not shown: %s", name, error)
                continue
            if name not in self._channels:
                about = {"robot": str(robot), "topic": topic}
                self._open(name, CDR, _schema(full_type(of_type), schema.text), about)
        if not self._publishes:
            return
        for service, of_type in offered.services.items():
            name = robot_topic(robot, service)
            if name not in self._services:
                await self._advertise_service(name, robot, service, full_type(of_type, "srv"))

    async def _advertise_service(self, name: str, robot: int, service: str, of_type: str) -> None:
        try:
            halves = [await self.recorder.schemas.of(robot, f"{of_type}_{half}") for half in ("Request", "Response")]
        except MacsError as error:
            log.warning("%s is not shown: %s", name, error)
            return
        request, response = (
            foxglove.MessageSchema(encoding=CDR, schema=_schema(f"{of_type}_{half}", schema.text))
            for half, schema in zip(("Request", "Response"), halves, strict=True)
        )
        self._services[name] = (robot, service, of_type)
        shown = foxglove.Service(
            name,
            schema=foxglove.ServiceSchema(of_type, request=request, response=response),
            handler=self._called,
        )
        if self._server is not None:
            self._server.add_services([shown])

    def _presence(self, agent: AgentInfo, online: bool) -> None:
        if agent.type != ROS or online:
            return
        for name in [name for name in self._channels if (split_topic(name) or (0, ""))[0] == agent.id]:
            self._channels.pop(name).close()
            self._kept.pop(name, None)
            self._looking.pop(name, None)
        gone = [name for name, (robot, _, _) in self._services.items() if robot == agent.id]
        for name in gone:
            del self._services[name]
        if gone and self._server is not None:
            self._server.remove_services(gone)
        self._nodes.pop(agent.id, None)
        if (follower := self.recorder.robots.get(agent.id)) is not None:
            follower.forget_offers()

    async def _show_graph(self) -> None:
        """Who publishes, receives and serves what, as far as robots tell."""
        while True:
            graph = foxglove.ConnectionGraph()
            for robot, follower in self.recorder.robots.items():
                for topic in follower.offered.publishers:
                    graph.set_published_topic(robot_topic(robot, topic), [f"robot {robot}"])
                for service in follower.offered.services:
                    graph.set_advertised_service(robot_topic(robot, service), [f"robot {robot}"])
                for node in self._nodes.get(robot, []):
                    if node.get("role") == "subscriber":
                        graph.set_subscribed_topic(robot_topic(robot, node["name"]), node.get("registrants", []))
            if self._server is not None:
                self._server.publish_connection_graph(graph)
            await asyncio.sleep(GRAPH_S)

    # -- what clients ask for, in the SDK's threads --------------------------------------------------------------

    def on_subscribe(self, client: Any, channel: Any) -> None:
        """Somebody looks at a channel."""
        self._from_thread(self._look, channel.topic, 1)

    def on_unsubscribe(self, client: Any, channel: Any) -> None:
        """Somebody looks away."""
        self._from_thread(self._look, channel.topic, -1)

    def on_client_advertise(self, client: Any, channel: Any) -> None:
        """Somebody will publish."""
        if self._secret is not None and channel.topic == self._secret:
            self._trusted[client.id] = channel.id
            return
        key, said = (client.id, channel.id), (channel.topic, channel.schema_name or "", channel.encoding)
        if client.id in self._trusted:  # whatever the SDK lets through
            self._from_thread(self._published.advertise, key, *said)

    def on_client_unadvertise(self, client: Any, client_channel_id: int) -> None:
        """No more."""
        if self._trusted.get(client.id) == client_channel_id:  # it has gone
            del self._trusted[client.id]
        self._from_thread(self._published.unadvertise, (client.id, client_channel_id))

    def on_message_data(self, client: Any, client_channel_id: int, data: bytes) -> None:
        """Somebody publishes."""
        self._from_thread(self._published.publish, (client.id, client_channel_id), bytes(data), time.monotonic())

    def _from_thread(self, callback: Callable[..., None], *args: object) -> None:
        with suppress(RuntimeError):  # the loop is closed: clients look away when the server ends
            self._loop.call_soon_threadsafe(callback, *args)

    def _called(self, request: Any) -> bytes:
        if request.client_id not in self._trusted:
            raise PermissionError("calls come through the relay")
        robot, service, of_type = self._services[request.service_name]
        calling = asyncio.run_coroutine_threadsafe(
            self._agent.call_service(service, bytes(request.payload), robot=robot, type=of_type, timeout_s=CALL_S),
            self._loop,
        )
        return bytes(calling.result(CALL_S + 1))

    # -- on the loop ---------------------------------------------------------------------------------------------

    def _is_demanded(self, robot: int, topic: str) -> bool:
        return self._looking[robot_topic(robot, topic)] > 0

    def _look(self, name: str, more: int) -> None:
        self._looking[name] = max(0, self._looking[name] + more)
        named = split_topic(name)
        if named is not None and (follower := self.recorder.robots.get(named[0])) is not None:
            follower.look_again()
        channel = self._channels.get(name)
        if more > 0 and channel is not None:
            for entry in list(self._kept.get(name, {}).values()):
                channel.log(entry.data, log_time=entry.log_ns)

    def _tell(self, name: str, why: str) -> None:
        """Something that a client published is not sent."""
        log.warning("what was published to %s is not sent: %s", name, why)
        if self._server is not None:
            self._server.publish_status(f"{name}: {why}", foxglove.StatusLevel.Warning, name)

    def _spawn(self, work: Coroutine[Any, Any, None]) -> None:
        task = self._loop.create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)


def _schema(name: str, text: str) -> foxglove.Schema:
    return foxglove.Schema(name=name, encoding=ROS2MSG, data=text.encode())
