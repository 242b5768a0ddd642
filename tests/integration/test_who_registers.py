"""Registrations on robots over TCP and on the mesh: who leaves, what is too much, and who holds a service."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import pytest

import macs_zenoh
from bridge.gateway import Gateway
from bridge.headset import frames
from macs_zenoh.errors import HeldByAnother
from macs_zenoh.protocol.decoders import MessageDecoder
from macs_zenoh.protocol.limits import NAMED_EACH, NODE_AGENTS, NODES_EACH
from macs_zenoh.protocol.messages import (
    ROS,
    UNITY,
    AddNode,
    AgentsGone,
    Configuration,
    Metadata,
    NodeRefused,
    NodeType,
    RemoveNode,
    Welcome,
    decode_data,
    encode_management,
)
from macs_zenoh.protocol.wire import encode_frame, split_message
from tests.support.given import Connect, StartGateway
from tests.support.local import patient
from tests.support.waiting import until


class Agent:
    """A TCP agent whose messages are kept."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.writer = writer
        self.messages: list[tuple[Metadata, bytes]] = []
        self.id = 0
        self._reading = asyncio.ensure_future(self._read(reader))

    async def _read(self, reader: asyncio.StreamReader) -> None:
        decoder = MessageDecoder(1 << 20)
        with contextlib.suppress(ConnectionError):
            while data := await reader.read(65536):
                for message in decoder.feed(data):
                    metadata, body = split_message(message)
                    self.messages.append((Metadata.decode(bytes(metadata)), bytes(body)))

    def configure(self, agent_type: int, group: int = 0) -> None:
        """Say who it is, or that it is in another group."""
        self.id = decode_data(Welcome, self.messages[0][1]).agent_id
        configuration = Configuration(agent_type=agent_type, agent_id=self.id, group_id=group, request_id=1)
        self.writer.write(encode_frame(management=encode_management(configuration)))

    def register(self, node_type: int, topic: str, robots: list[int], groups: list[int] | None = None) -> None:
        """Ask for an interface node."""
        kind = "std_srvs/Trigger" if node_type == NodeType.SERVICE else "std_msgs/String"
        spec = frames.NodeSpec(NodeType(node_type), topic, kind)
        self.writer.write(frames.registration(self.id, spec, robots, groups or []))

    def bodies(self, manager: str) -> list[bytes]:
        """What came for this manager."""
        return [body for metadata, body in self.messages if metadata.message_manager == manager]

    def nodes(self) -> set[tuple[int, str]]:
        """What a robot program of today would have: registrants and node names."""
        have: set[tuple[int, str]] = set()
        for metadata, body in self.messages:
            if metadata.message_manager == AddNode.manager:
                node = decode_data(AddNode, body)
                have.add((node.registrant_agent_id, node.node_name))
            elif metadata.message_manager == RemoveNode.manager:
                removed = decode_data(RemoveNode, body)
                have.discard((removed.registrant_agent_id, removed.node_name))
            elif metadata.message_manager == AgentsGone.manager:
                gone = {agent.agent_id for agent in decode_data(AgentsGone, body).agents}
                have = {node for node in have if node[0] not in gone}
        return have

    def close(self) -> None:
        """Leave without a word."""
        self._reading.cancel()
        self.writer.close()


@asynccontextmanager
async def agent(gateway: Gateway, agent_type: int = UNITY, group: int = 0) -> AsyncIterator[Agent]:
    """Somebody online."""
    agent = Agent(*await asyncio.open_connection("127.0.0.1", gateway.port))
    try:
        await until(lambda: agent.messages)
        agent.configure(agent_type, group)
        await until(lambda: gateway.agents.find(agent_type, agent.id))
        yield agent
    finally:
        agent.close()


async def test_who_vanishes_leaves_no_node(start_gateway: StartGateway) -> None:
    """Sixty headsets that register four topics each and vanish at once leave nothing on a robot program, whichever of
    the two overtakes the other."""
    near, far = await start_gateway(), await start_gateway()
    async with agent(far, ROS) as robot:
        await until(lambda: (ROS, robot.id) in near.directory)
        for _ in range(3):
            come = (asyncio.open_connection("127.0.0.1", near.port) for _ in range(60))
            headsets = [Agent(*streams) for streams in await asyncio.gather(*come)]
            await until(lambda headsets=headsets: all(headset.messages for headset in headsets))
            for headset in headsets:
                headset.configure(UNITY)
                for topic in "abcd":
                    headset.register(1, f"/{topic}", [robot.id])
            await asyncio.sleep(0.02)
            for headset in headsets:
                headset.close()
            await until(lambda: len(near.agents) == 0)
        await asyncio.sleep(0.5)
        await until(lambda: robot.nodes() == set())


async def test_a_robot_that_leaves_a_group_loses_its_nodes(start_gateway: StartGateway) -> None:
    """A robot over TCP that changes its group drops what was for the former one and keeps the rest."""
    gateway = await start_gateway()
    async with agent(gateway, ROS, group=3) as robot, agent(gateway) as headset:
        headset.register(1, "/by_group", [], [3])
        headset.register(1, "/by_id", [robot.id])
        await until(lambda: len(robot.nodes()) == 2)
        robot.configure(ROS, group=4)
        await until(lambda: robot.nodes() == {(headset.id, "nd__by_id")})
        robot.configure(ROS, group=3)
        await until(lambda: len(robot.nodes()) == 2)


async def test_a_robot_program_serves_for_one(start_gateway: StartGateway) -> None:
    """A second registrant of a type 4 node on a robot program is refused with a reason; it gets the node when the
    first has left, not before."""
    near, far = await start_gateway(), await start_gateway()
    async with agent(near, ROS) as robot, agent(far) as second:
        await until(lambda: (ROS, robot.id) in far.directory)
        async with agent(near) as first:
            first.register(4, "/ask", [robot.id])
            await until(lambda: robot.nodes() == {(first.id, "nd__ask")})
            second.register(4, "/ask", [robot.id])
            await until(lambda: second.bodies(NodeRefused.manager))
            refused = decode_data(NodeRefused, second.bodies(NodeRefused.manager)[0])
            assert (refused.robot_id, refused.node_name) == (robot.id, "nd__ask")
            assert "already registered by another agent" in refused.reason
        await until(lambda: robot.nodes() == {(second.id, "nd__ask")})


async def test_who_holds_a_service_keeps_it_when_the_robot_restarts(
    start_gateway: StartGateway, connect: Connect, router: str
) -> None:
    """A refused type 4 registration is not repeated when the robot comes back, so its holder has it again; it is when
    the holder has left."""
    near, far = await start_gateway(), await start_gateway()

    @asynccontextmanager
    async def robot() -> AsyncIterator[list[tuple[int, int]]]:
        holders: list[tuple[int, int]] = []

        async def add(call: macs_zenoh.Call) -> bytes:
            node = decode_data(AddNode, call.data)
            who = (node.registrant_agent_type, node.registrant_agent_id)
            if holders and holders[0] != who:
                raise HeldByAnother("taken", holders[0])
            holders[:] = [who]
            return b""

        async with macs_zenoh.join("ros", id=9, settings=patient(router)) as robot:
            robot.on_presence(lambda agent, online: holders.clear() if not online and agent.key in holders else None)
            robot.serve("add_node", add)
            yield holders

    async with agent(far) as second:
        async with agent(near) as first:
            async with robot() as holders:
                await until(lambda: (ROS, 9) in near.directory and (ROS, 9) in far.directory)
                first.register(4, "/ask", [9])
                await until(lambda: holders)
                second.register(4, "/ask", [9])
                await until(lambda: second.bodies(NodeRefused.manager))
            await until(lambda: (ROS, 9) not in near.directory and (ROS, 9) not in far.directory)
            for _ in range(3):
                async with robot() as holders:
                    await until(lambda holders=holders: holders)
                    assert holders == [(UNITY, first.id)]
                await until(lambda: (ROS, 9) not in near.directory and (ROS, 9) not in far.directory)
            running = await contextlib.AsyncExitStack().__aenter__()
            holders = await running.enter_async_context(robot())
            await until(lambda: holders == [(UNITY, first.id)])
        await until(lambda: holders == [(UNITY, second.id)])
        assert len(second.bodies(NodeRefused.manager)) == 1
        await running.aclose()


async def test_too_much_is_refused(start_gateway: StartGateway) -> None:
    """A registration that names more robots than may be, and a node beyond those that one headset may have, are
    refused with a reason; what is taken back makes room, and a neighbour gets what it wants."""
    gateway = await start_gateway()
    async with agent(gateway) as greedy, agent(gateway) as neighbour, agent(gateway, ROS) as robot:
        greedy.register(1, "/everywhere", list(range(1, NODE_AGENTS + 2)))
        await until(lambda: greedy.bodies(NodeRefused.manager) or gateway.drops.total())
        greedy.messages.clear()
        for number in range(NODES_EACH + 3):
            greedy.register(1, f"/t{number}", [robot.id])
        await until(lambda: len(greedy.bodies(NodeRefused.manager)) == 3)
        assert f"each may have {NODES_EACH} interface nodes" in str(greedy.bodies(NodeRefused.manager)[0])
        neighbour.register(1, "/mine", [robot.id])
        await until(lambda: (neighbour.id, "nd__mine") in robot.nodes())
        spec = frames.NodeSpec(NodeType.SUBSCRIBER, "/t0", "std_msgs/String")
        greedy.writer.write(frames.deregistration(greedy.id, spec, [robot.id], []))
        greedy.register(1, "/one_more", [robot.id])
        await until(lambda: (greedy.id, "nd__one_more") in robot.nodes())
        connection = gateway.agents.find(UNITY, greedy.id)
        assert connection is not None
        assert connection.recipient.node_count == NODES_EACH


async def test_who_names_robots_without_end_is_refused(start_gateway: StartGateway) -> None:
    """All that one headset's registrations name is bounded, in many nodes or in one that is registered over and over;
    what was named before may be named again, and a neighbour gets what it wants."""
    gateway = await start_gateway()
    async with agent(gateway) as greedy, agent(gateway) as neighbour, agent(gateway, ROS) as robot:
        there = list(range(10_000, 10_000 + NODE_AGENTS))
        for number in range(NAMED_EACH // NODE_AGENTS - 1):
            greedy.register(1, f"/t{number}", there)
        greedy.register(1, "/t0", [each + NODE_AGENTS for each in there])
        greedy.register(1, "/t0", there)
        for topic in ("/t0", "/one_more"):
            greedy.register(1, topic, [each + 2 * NODE_AGENTS for each in there])
        await until(lambda: len(greedy.bodies(NodeRefused.manager)) == 2, 60)
        assert f"each may have {NAMED_EACH} robots and groups" in str(greedy.bodies(NodeRefused.manager)[0])
        neighbour.register(1, "/mine", [robot.id])
        await until(lambda: (neighbour.id, "nd__mine") in robot.nodes())
        key, connection = (UNITY, greedy.id), gateway.agents.find(UNITY, greedy.id)
        assert gateway._registry.named.of(connection) == NAMED_EACH
    await until(lambda: gateway.agents.find(*key) is None)
    assert gateway._registry.named.used == 0


@pytest.mark.parametrize("count", [1000])
async def test_names_are_forgotten(start_gateway: StartGateway, count: int) -> None:
    """A headset that registers and takes back one topic after the other has nothing left."""
    gateway = await start_gateway()
    async with agent(gateway) as headset, agent(gateway, ROS) as robot:
        for number in range(count):
            spec = frames.NodeSpec(NodeType.SUBSCRIBER, f"/t{number}", "std_msgs/String")
            headset.writer.write(frames.registration(headset.id, spec, [robot.id], []))
            headset.writer.write(frames.deregistration(headset.id, spec, [robot.id], []))
        headset.register(1, "/last", [robot.id])
        await until(lambda: robot.nodes() == {(headset.id, "nd__last")}, 60)
        connection = gateway.agents.find(UNITY, headset.id)
        assert connection is not None
        assert connection.recipient.node_count == 1
