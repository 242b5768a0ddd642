"""The gateway: between the modules of one robot and the other robots.

A module's message goes out on the mesh, on the plain topic, or on both; one that arrives goes to the topic of its
type. Nothing that arrived is ever sent on, so there are no loops. With both transports, a message to one robot takes
the mesh when the robot is there and the topic when it is not, and a message to all takes both; `Copies` drops the
second copy.
"""

from __future__ import annotations

import asyncio
import json
import logging
import time
from collections import Counter
from collections.abc import AsyncIterator, Callable, Iterator, Sequence
from contextlib import asynccontextmanager, suppress
from typing import Any

from bridge.awareness.link import MeshLink
from bridge.awareness.node import NODE_NAME, SUCCESS, GatewayNode, Parameters
from bridge.metrics.endpoint import watched_at
from bridge.metrics.families import Family, counter
from bridge.metrics.watched import Watched
from bridge.ros.session import RosSession
from bridge.settings import Settings
from macs_zenoh.awareness import Received
from macs_zenoh.errors import ConfigError, MacsError
from macs_zenoh.losses import Losses
from macs_zenoh.mesh import Mesh
from macs_zenoh.protocol.named import Copies, Outcome

log = logging.getLogger("macs.awareness")

REPORT_S = 1.0
"""How often counters that have changed are published."""

TELL_S = 0.1
"""How soon after one change modules are told who is there."""

PENDING_BYTES = 64 << 20
"""What may wait between the ROS thread and the loop."""


class Gateway:
    """One robot among robots. Made by `open_gateway`.

    ``counters`` are those of `MeshLink`, and ``on_topic`` (sent on the plain topic), ``from_topic``, ``own`` (came
    back on the topic), ``for_others`` (addressed to others there), ``second_copy``, ``invalid`` (a module's message
    that cannot be sent), ``delivered_here`` (published to modules), ``unregistered``, ``too_many_waiting``.
    """

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self.parameters = Parameters("", "", "", "", "")
        self.node: GatewayNode
        self.session: RosSession
        self._loop = asyncio.get_running_loop()
        self._link = MeshLink(settings, self._from_mesh, self._outcome, self._refused, self._agents_changed)
        self._counters = Losses(log)
        self._reported: dict[str, int] = {}
        self._copies = Copies()
        self._pending_bytes = 0
        self._types: frozenset[str] = frozenset()
        self._link_task: asyncio.Task[None] | None = None
        self._activation: asyncio.Task[None] | None = None
        self._telling: asyncio.TimerHandle | None = None
        self._broken: asyncio.Future[None] = self._loop.create_future()

    @property
    def counters(self) -> dict[str, int]:
        """Everything that is counted, by name."""
        return dict(self._link.counters + Counter(dict(self._counters)))  # dict: at once, the ROS thread counts too

    @property
    def mesh(self) -> Mesh | None:
        """Its session, once it is on the mesh."""
        return self._link.mesh

    @property
    def on_mesh(self) -> bool:
        """Whether the parameters say so."""
        return self.parameters.transport != "topic"

    @property
    def on_topic(self) -> bool:
        """Likewise for the plain topic."""
        return self.parameters.transport != "mesh"

    # -- life ----------------------------------------------------------------------------------------------------

    def start(self, session: RosSession, on_waiting: Callable[[str], None] | None) -> None:
        """Begin with a node that exists."""
        self.session = session
        self.node = session.node
        self._on_waiting = on_waiting
        self._report_task = self._loop.create_task(self._report())

    async def autostart(self) -> None:
        """Configure and activate; on the mesh, wait until the name is ours. Raises ConfigError, UsageError."""
        for trigger in (self.node.trigger_configure, self.node.trigger_activate):
            if await self.session.run(trigger) != SUCCESS:
                raise ConfigError(self.session.full_name, self.node.problem or "the transition failed")
        await asyncio.sleep(0)  # what the transitions have asked for has begun then
        if self.parameters.transport == "mesh" and self._activation is not None:
            await self._activation

    async def close(self) -> None:
        """Leave the mesh, then ROS."""
        for task in (self._report_task, self._activation, self._link_task):
            if task is not None:
                task.cancel()
                with suppress(asyncio.CancelledError, MacsError):
                    await task
        self._broken.cancel()
        if self._telling is not None:
            self._telling.cancel()

    async def failed(self) -> None:
        """Wait until the gateway cannot go on, and raise why."""
        await self._broken

    # -- told by the node, in the ROS thread ---------------------------------------------------------------------

    def configured(self, parameters: Parameters) -> None:
        """The node has its service and topics."""
        self.parameters = parameters
        self._later(self._configure)

    def activated(self) -> None:
        """Messages are passed from now on."""
        self._later(self._activate)

    def deactivated(self) -> None:
        """And no more."""
        self._later(self._deactivate)

    def types_wanted(self, types: frozenset[str]) -> None:
        """What living modules take has changed."""
        self._later(self._want, types)

    def module_sent(self, receiver: str, message_type: str, data: bytes) -> None:
        """A module has published on gateway_out.

        It is sent right here: the loop would get to it only when this thread has built its next wait set in Python,
        which takes longer than all else on the message's way.
        """
        try:
            if self.on_mesh and (not self.on_topic or not receiver or self._link.knows(receiver)):
                self._link.send(receiver, message_type, data)
                if not self.on_topic or receiver:
                    return
        except MacsError as error:
            self._refused(receiver, message_type, error)
            return
        self.node.send_on_topic(self.parameters.agent_id, receiver, message_type, data)
        self._counters["on_topic"] += 1

    def topic_received(self, sender: str, receiver: str, message_type: str, data: bytes) -> None:
        """Something came on the plain topic."""
        self._pass(len(data), self._from_topic, sender, receiver, message_type, data)

    def _pass(self, size: int, take: Callable[..., None], *args: Any) -> None:
        if self._pending_bytes and self._pending_bytes + size > PENDING_BYTES:
            self._counters["too_many_waiting"] += 1
            return
        self._pending_bytes += size
        self._later(self._taken, size, take, *args)

    def _taken(self, size: int, take: Callable[..., None], *args: Any) -> None:
        self._pending_bytes -= size
        take(*args)

    def _later(self, call: Callable[..., None], *args: Any) -> None:
        with suppress(RuntimeError):  # the loop is closed: the program is ending
            self._loop.call_soon_threadsafe(call, *args)

    # -- on the loop ---------------------------------------------------------------------------------------------

    def _configure(self) -> None:
        if self.on_mesh and self._link_task is None:
            self._link_task = self._loop.create_task(self._link.run(self._on_waiting))
            self._link_task.add_done_callback(self._link_ended)

    def _link_ended(self, task: asyncio.Task[None]) -> None:
        if not task.cancelled() and (error := task.exception()) is not None and not self._broken.done():
            self._broken.set_exception(error)

    def _activate(self) -> None:
        if self.on_mesh:
            self._activation = self._loop.create_task(self._claim_name())

    def _deactivate(self) -> None:
        if self._activation is not None:
            self._activation.cancel()
        self._link.deactivate()
        self._agents_changed()

    async def _claim_name(self) -> None:
        try:
            await self._link.activate(self.parameters.agent_id)
            log.info("reachable as %r", self.parameters.agent_id)
        except MacsError as error:
            log.error("cannot be reached as %r: %s", self.parameters.agent_id, error)
            self.session.submit(lambda: self.node.trigger_deactivate() if self.node.state == "active" else None)
            raise

    def _want(self, types: frozenset[str]) -> None:
        for message_type in types - self._types:
            self._link.want(message_type)
        for message_type in self._types - types:
            self._link.unwant(message_type)
        self._types = types

    def _from_mesh(self, message: Received) -> None:
        self._deliver("mesh", message.sender, message.type, message.data)

    def _from_topic(self, sender: str, receiver: str, message_type: str, data: bytes) -> None:
        settings, own_name = self.settings.awareness, self.parameters.agent_id
        if sender == own_name and settings.drop_own:
            self._counters["own"] += 1
        elif receiver not in ("", own_name) and settings.only_addressed:
            self._counters["for_others"] += 1
        else:
            self._counters["from_topic"] += 1
            self._deliver("topic", sender, message_type, data)

    def _deliver(self, path: str, sender: str, message_type: str, data: bytes) -> None:
        both = self.on_mesh and self.on_topic
        if both and not self._copies.first(path, sender, message_type, data, time.monotonic()):
            self._counters["second_copy"] += 1
        elif self.node.deliver(sender, message_type, data):
            self._counters["delivered_here"] += 1
        else:
            text = "nobody here has registered %r; %s sent one"
            self._counters.once("unregistered", text, message_type, sender, about=message_type)

    def _refused(self, receiver: str, message_type: str, error: MacsError) -> None:
        about = f"{message_type} to {receiver}"
        self._counters.once("invalid", "a module's message was not sent: %s", error, about=about)
        self.node.say_undelivered(receiver, message_type, str(error))

    def _outcome(self, receiver: str, message_type: str, outcome: Outcome) -> None:
        if outcome in (Outcome.SENT, Outcome.DELIVERED, Outcome.KEPT):
            return
        if self.on_topic and not receiver:
            return  # on the plain topic it may have reached somebody
        about = f"{message_type!r} to {receiver or 'all'!r}"
        # the link has counted it
        self._counters.once(outcome.counter, "%s: %s", about, outcome.value, about=about, count=0)
        self.node.say_undelivered(receiver, message_type, outcome.value)

    def _agents_changed(self) -> None:
        """Tell it soon, and of many changes once: each telling costs what all agents cost."""
        if self._telling is None:
            self._telling = self._loop.call_later(TELL_S, self._say_agents)

    def _say_agents(self) -> None:
        self._telling = None
        self.node.say_agents(json.dumps(self._link.others(), ensure_ascii=False))

    async def _report(self) -> None:
        while True:
            await asyncio.sleep(REPORT_S)
            counters = self.counters
            if counters != self._reported:
                self._reported = counters
                self.node.say_counters(counters)


def _watched(gateway: Gateway) -> Watched:
    """A gateway as who watches it sees it."""

    def figures() -> Iterator[Family]:
        counted = counter("macs_awareness", "messages between named agents, by what became of them")
        for name, count in gateway.counters.items():
            counted.add(count, counter=name)
        yield counted

    return Watched(
        "awareness",
        lambda: gateway.mesh,
        figures=figures,
        facts=lambda: {"name": gateway.parameters.agent_id, "state": gateway.node.state, "counters": gateway.counters},
    )


@asynccontextmanager
async def open_gateway(
    settings: Settings,
    *,
    domain_id: int | None = None,
    ros_args: Sequence[str] = (),
    on_waiting: Callable[[str], None] | None = None,
) -> AsyncIterator[Gateway]:
    """Start the node, unconfigured, and be a gateway until the end of the block.

    Args:
        settings: name, transport and limits (``settings.awareness``), and how to reach the mesh.
        domain_id: None takes ``ROS_DOMAIN_ID``.
        ros_args: ROS arguments, as ``["--ros-args", "-p", "agent_id:=drone0"]``.
        on_waiting: called once while no router answers.

    Raises Unreachable when ROS cannot start, ConfigError for a parameter of the wrong type.
    """
    gateway = Gateway(settings)

    def make_node(name: str, **options: Any) -> GatewayNode:
        return GatewayNode(name, settings=settings.awareness, owner=gateway, **options)

    session = await asyncio.to_thread(
        RosSession, NODE_NAME, domain_id=domain_id, ros_args=ros_args, make_node=make_node
    )
    try:
        gateway.start(session, on_waiting)
        yield gateway
    finally:
        await gateway.close()
        await asyncio.to_thread(session.close)


async def run(
    settings: Settings,
    *,
    ros_args: Sequence[str] = (),
    autostart: bool = True,
    on_ready: Callable[[str], None] | None = None,
    on_waiting: Callable[[str], None] | None = None,
    metrics: str | None = None,
) -> None:
    """Be a gateway until the task is cancelled. See `open_gateway`; raises UsageError when the name is taken. At
    ``metrics``, HOST:PORT, it tells who watches it."""
    async with (
        open_gateway(settings, ros_args=ros_args, on_waiting=on_waiting) as gateway,
        watched_at(metrics, _watched(gateway)),
    ):
        if autostart:
            await gateway.autostart()
        if on_ready is not None:
            name = gateway.parameters.agent_id or settings.awareness.name
            on_ready(f"awareness of {name} in {gateway.session.full_name}, {gateway.node.state}")
        await gateway.failed()
