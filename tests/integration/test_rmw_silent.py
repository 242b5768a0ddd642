"""Nodes of a robot that do not describe their types: what they hold up, and what they do not."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack
from pathlib import Path
from typing import Any, NamedTuple

import pytest

import macs_zenoh
from bridge.graph.acts import MeshAction
from bridge.rmw_zenoh import session as module
from bridge.rmw_zenoh.session import ZenohSession
from bridge.rmw_zenoh.types import DESCRIPTION, KnownTypes
from bridge.ros.joined import joined
from bridge.ros.types import InterfaceName
from bridge.settings import RobotSettings, Settings
from macs_zenoh import ros
from macs_zenoh.config import MeshSettings
from macs_zenoh.mesh.ros_network import Request, RosNetwork
from macs_zenoh.protocol.rmw_zenoh.keyexpr import Kind
from macs_zenoh.protocol.rmw_zenoh.qos import Qos
from macs_zenoh.type_hashes import Hashes
from macs_zenoh.typed import Types, response_of
from tests.integration.test_rmw_types import CDR, FIBONACCI, Counting, defined
from tests.support.rmw_sides import both_sides
from tests.support.waiting import PATIENCE_S, until

pytest.importorskip("xxhash", reason="being a ROS node needs xxhash: pip install 'macs-zenoh[rmw-zenoh]'")
pytestmark = pytest.mark.timeout(300)

QOS = Qos(depth=10)
HASH = "RIHS01_" + "ab" * 32


class Site(NamedTuple):
    """Our side of a robot, and the network of the robot's nodes."""

    ours: ZenohSession
    theirs: RosNetwork
    kept: list[Any]
    """What the robot's nodes have, until the end."""

    def node(self, name: str, of_type: str, topics: list[str]) -> list[Request]:
        """A node that has topics of this type and describes nothing; what it is asked."""
        asked: list[Request] = []
        node = self.theirs.node(0, name)
        self.kept.append(node)
        self.kept.append(node.service(f"/{name}/get_type_description", DESCRIPTION, HASH, asked.append))
        self.kept.extend(node.publisher(topic, of_type, HASH, QOS) for topic in topics)
        return asked

    async def sees(self, *topics: str) -> None:
        await until(lambda: all(self.ours.graph.on(topic, Kind.PUBLISHER) for topic in topics), PATIENCE_S)

    async def message(self, name: str, topic: str) -> Any:
        of = InterfaceName.parse(name, "msg")
        return await self.ours.run(lambda: self.ours.message(of, topic))


@pytest.fixture
async def site(router: str) -> AsyncIterator[Site]:
    async with both_sides(router) as (ours, theirs):
        yield Site(ours, theirs, [])


async def test_silent_nodes_are_asked_once(site: Site) -> None:
    """All nodes of a topic are asked at the same time, and who did not answer is not asked for the next type."""
    first = site.node("first", "demo_msgs/msg/Thing", ["/things", "/more_things"])
    second = site.node("second", "demo_msgs/msg/Thing", ["/things"])
    await site.sees("/things", "/more_things")
    await until(lambda: len(site.ours.graph.on("/things", Kind.PUBLISHER)) == 2, PATIENCE_S)
    await site.message("demo_msgs/Thing", "/things")
    assert (len(first), len(second)) == (1, 1)
    await site.message("demo_msgs/Thing", "/more_things")
    await site.message("demo_msgs/Thing", "/things")
    assert (len(first), len(second)) == (1, 1)


async def test_one_that_answers_is_heard_beside_those_that_do_not(site: Site, tmp_path: Path) -> None:
    """A type is known as soon as one node of the topic describes it."""
    types = Types([defined(tmp_path, "demo_msgs", "msg", "Thing", "uint8 size\n")])
    site.node("first", "demo_msgs/msg/Thing", ["/things"])
    field = {"type_id": 3, "capacity": 0, "string_capacity": 0, "nested_type_name": ""}
    described = {"type_name": "demo_msgs/msg/Thing", "fields": [{"name": "size", "type": field}]}
    answer = {"successful": True, "type_description": {"type_description": described}}
    cdr = types.serialize(response_of(DESCRIPTION), answer)
    second = site.theirs.node(0, "second")
    server = second.service("/second/get_type_description", DESCRIPTION, HASH, lambda each: server.answer(each, cdr))
    site.kept.append(second.publisher("/things", "demo_msgs/msg/Thing", Hashes(types).of("demo_msgs/msg/Thing"), QOS))
    await until(lambda: len(site.ours.graph.on("/things", Kind.PUBLISHER)) == 2, PATIENCE_S)
    await until(lambda: site.ours.graph.on("/second/get_type_description", Kind.SERVICE), PATIENCE_S)
    of = await site.message("demo_msgs/Thing", "/things")
    assert of.least_bytes == 5
    assert site.ours._silent == {}


async def test_a_silent_node_is_asked_again_in_time(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    """It may only have been busy."""
    monkeypatch.setattr(module, "SILENT_S", 0.0)
    asked = site.node("first", "demo_msgs/msg/Thing", ["/things"])
    await site.sees("/things")
    for _ in range(2):
        await site.message("demo_msgs/Thing", "/things")
    assert len(asked) == 2


async def test_what_is_in_a_hurry_waits_for_nobody(site: Site) -> None:
    """It is done while the ROS thread waits, and before what is submitted later, as what ends its client."""
    waits, go = threading.Event(), threading.Event()
    done: list[str] = []

    def wait() -> None:
        waits.set()
        assert go.wait(PATIENCE_S)
        done.append("waited")

    waiting = site.ours.submit(wait)
    await asyncio.to_thread(waits.wait, PATIENCE_S)
    await asyncio.wrap_future(site.ours.hurry(lambda: done.append("hurried")))
    assert (done, waiting.done()) == (["hurried"], False)
    go.set()
    await asyncio.wrap_future(waiting)

    go.clear()
    first = site.ours.hurry(wait)
    last = site.ours.submit(lambda: done.append("last"))
    go.set()
    await asyncio.gather(*map(asyncio.wrap_future, (first, last)))
    assert done == ["hurried", "waited", "waited", "last"]


async def test_a_stop_cancels_goals_while_the_ros_thread_waits(router: str, tmp_path: Path) -> None:
    """The emergency stop is pressed while a node is asked what it does not answer: the action hears at once that its
    goal is cancelled."""
    folder = defined(tmp_path / "own", "example_interfaces", "action", "Fibonacci", FIBONACCI)
    settings = Settings(mesh=MeshSettings(connect=[router]), robot=RobotSettings(id=7))
    waits, go = threading.Event(), threading.Event()
    async with AsyncExitStack() as stack:
        node = await stack.enter_async_context(ros.node("fib", connect=[router], definitions=[folder]))
        counting = Counting(node)
        network = await stack.enter_async_context(await RosNetwork.open(settings.mesh))
        session = ZenohSession(network, await asyncio.to_thread(KnownTypes, [folder]))
        stack.push_async_callback(asyncio.to_thread, session.close)
        robot = await stack.enter_async_context(joined(settings, session))
        agent = await stack.enter_async_context(macs_zenoh.join("unity", id=300, connect=[router]))
        await until(lambda: agent.directory.ids(1) == [7], PATIENCE_S)
        client = MeshAction(agent, "/fibonacci", "example_interfaces/Fibonacci")
        of_type = "example_interfaces/Fibonacci"
        await agent.use_action("/fibonacci", robot=7, type=of_type, timeout_s=PATIENCE_S)
        stack.callback(agent.on_message(client.take).close)
        goal = await client.send_goal(7, CDR + (900).to_bytes(4, "little"), timeout_s=PATIENCE_S)
        stack.callback(go.set)

        def wait() -> None:
            waits.set()
            go.wait(PATIENCE_S)

        waiting = session.submit(wait)
        await asyncio.to_thread(waits.wait, PATIENCE_S)
        assert robot.nodes.stop is not None
        robot.nodes.stop.press("unity/300")
        status, _ = await goal.result(PATIENCE_S)
        assert status == 5
        assert not waiting.done()
        assert counting._running
