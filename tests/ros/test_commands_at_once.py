"""Commands go from Zenoh's thread straight into a ROS publisher: safety holds in whatever thread they are judged."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import AsyncIterator
from typing import Any

import pytest
from geometry_msgs.msg import Twist
from std_msgs.msg import Bool

from bridge.ros.interface import Registrant, Robot
from bridge.ros.nodes import InterfaceNodes
from bridge.ros.program import open_robot
from bridge.ros.rules import Rules
from bridge.ros.session import RosSession
from bridge.ros.topics import PublisherNode
from bridge.settings import RobotSettings, Settings, TopicRule
from macs_zenoh import join
from macs_zenoh.config import MeshSettings
from macs_zenoh.protocol.messages import AddNode, Metadata, NodeType, encode_data, node_name
from macs_zenoh.protocol.reading import Message
from tests.support.ros_peer import Peer, adding, command, drive
from tests.support.routers import Router
from tests.support.waiting import until

RULES = [
    TopicRule(match="/cmd_vel", deadman_s=0.3, deadman_message={"linear": {"z": -1}}),
    TopicRule(match="/lent", exclusive=True, hold_s=5.0),
]


@pytest.fixture
async def nodes(session: RosSession) -> AsyncIterator[InterfaceNodes]:
    robot = Robot(session, 7, lambda node, frame: None, rules=Rules(RobotSettings(rules=RULES)))
    nodes = InterfaceNodes(robot)
    await nodes.open_stop("/emergency_stop")
    yield nodes
    nodes.close()


def pressed(stop: bool) -> Message:
    return command("/emergency_stop", Bool(data=stop), "std_msgs/Bool")


async def driven(nodes: InterfaceNodes, peer: Peer, topic: str) -> asyncio.Queue[Any]:
    received = await peer.subscription(Twist, topic)
    await until(lambda: nodes.robot.session.node.count_subscribers(topic) == 1)
    await register(nodes, topic)
    return received


async def register(nodes: InterfaceNodes, topic: str) -> None:
    for registrant in (5, 6):
        await nodes.add(adding(topic, "geometry_msgs/Twist", node_type=NodeType.PUBLISHER, registrant=registrant))


async def started(nodes: InterfaceNodes, received: asyncio.Queue[Any]) -> None:
    """Drive until it arrives; the dead-man watches from now on."""
    await until(lambda: (nodes.deliver(drive(1.0)), received.qsize())[1])


async def ends_with_the_stop_message(received: asyncio.Queue[Any]) -> bool:
    """Whether it comes, and no command after it."""
    got: list[float] = []
    await until(lambda: (got.extend(drained(received)), -1.0 in got)[1])
    await asyncio.sleep(0.05)
    got += drained(received)
    return got[-1] == -1.0


class Driver:
    """A thread as Zenoh's that sends commands as fast as they are taken, and counts those that were judged."""

    def __init__(self, nodes: InterfaceNodes, message: Message) -> None:
        self.judged = 0
        self.errors: list[Exception] = []
        self._nodes = nodes
        self._message = message
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._drive)

    def _drive(self) -> None:
        while not self._end.is_set():
            try:
                self._nodes.deliver(self._message)
                self.judged += 1
            except Exception as error:  # noqa: BLE001 - of which the test hears
                self.errors.append(error)
            time.sleep(0.0002)

    async def __aenter__(self) -> Driver:
        self._thread.start()
        return self

    async def __aexit__(self, *_: object) -> None:
        self._end.set()
        await asyncio.to_thread(self._thread.join)
        assert not self.errors


@pytest.fixture
def hesitating(monkeypatch: pytest.MonkeyPatch) -> None:
    """Between two steps of a command other threads get a turn, which else happens one time in thousands."""
    take, judge = PublisherNode.receive, PublisherNode._refusal

    def hesitant_take(node: PublisherNode, message: Message) -> None:
        time.sleep(0.01)
        take(node, message)

    def hesitant_judge(node: PublisherNode, *message: Any) -> tuple[str, str] | None:
        judged = judge(node, *message)
        time.sleep(0.01)
        return judged

    monkeypatch.setattr(PublisherNode, "receive", hesitant_take)
    monkeypatch.setattr(PublisherNode, "_refusal", hesitant_judge)


def drained(queue: asyncio.Queue[Any]) -> list[float]:
    """Linear x of what was received, or z where that is the stop message's."""
    got = []
    while not queue.empty():
        twist = queue.get_nowait()
        got.append(twist.linear.x or twist.linear.z)
    return got


@pytest.mark.usefixtures("hesitating")
async def test_no_command_follows_an_emergency_stop(nodes: InterfaceNodes, peer: Peer) -> None:
    """However close a command in Zenoh's thread comes to the stop: the stop message is the last on the topic."""
    received = await driven(nodes, peer, "/cmd_vel")
    await started(nodes, received)
    async with Driver(nodes, drive(1.0)) as driver:
        for i in range(15):
            judged = driver.judged
            await until(lambda judged=judged: driver.judged > judged)  # type: ignore[misc]
            await asyncio.sleep(i / 15 * 0.02)  # at each point of a command's way
            nodes.deliver(pressed(True))
            assert await ends_with_the_stop_message(received)
            nodes.deliver(pressed(False))
            nodes.deliver(drive(1.0))
    assert nodes.drops["stopped"] > 10


@pytest.mark.usefixtures("hesitating")
async def test_no_command_follows_the_end_of_its_node(nodes: InterfaceNodes, peer: Peer) -> None:
    """When the last registrant leaves, the stop message is the last on the topic."""
    received = await driven(nodes, peer, "/cmd_vel")
    for _ in range(5):
        await register(nodes, "/cmd_vel")
        await started(nodes, received)
        async with Driver(nodes, drive(1.0)) as driver:
            await until(lambda driver=driver: driver.judged)  # type: ignore[misc]
            for registrant in (5, 6):
                nodes.forget(Registrant(2, registrant))
            assert await ends_with_the_stop_message(received)


async def judge(nodes: InterfaceNodes, message: Message) -> None:
    """As Zenoh's thread does."""
    await asyncio.to_thread(nodes.deliver, message)


async def test_only_who_has_control_commands(nodes: InterfaceNodes, peer: Peer) -> None:
    """The holder's commands pass, also the first; another's do not, and are counted."""
    received = await driven(nodes, peer, "/lent")
    await judge(nodes, drive(1.0, topic="/lent"))
    await judge(nodes, drive(2.0, sender=6, topic="/lent"))
    await asyncio.sleep(0.2)
    assert drained(received) == [1.0]
    assert nodes.drops["not_in_control"] == 1


async def test_all_is_judged_where_it_comes(nodes: InterfaceNodes, peer: Peer) -> None:
    """Commands before their node is there wait for it, bytes that are no CDR are counted, the stop stops, and the
    dead-man sees every command, without the loop."""
    await judge(nodes, drive(3.0))
    received = await driven(nodes, peer, "/cmd_vel")
    await judge(nodes, drive(1.0))
    await judge(nodes, drive(1.0)._replace(data=b""))
    await judge(nodes, drive(2.0))
    await until(lambda: received.qsize() == 4)
    assert drained(received) == [3.0, 1.0, 2.0, -1.0]  # the dead-man has seen the last command
    await judge(nodes, pressed(True))
    await judge(nodes, drive(1.0))
    await until(lambda: received.qsize() == 1)
    assert drained(received) == [-1.0]
    assert nodes.drops == {"bad_cdr": 1, "stopped": 1}


async def test_a_busy_loop_delays_neither_commands_nor_the_dead_man(nodes: InterfaceNodes, peer: Peer) -> None:
    """While the loop does something else for a second, a command passes, and the dead-man trips in time after it."""
    times: list[tuple[float, float]] = []
    node = peer.session.node

    def take(twist: Any) -> None:
        times.append((time.monotonic(), twist.linear.x or twist.linear.z))

    await peer.session.run(lambda: node.create_subscription(Twist, "/cmd_vel", take, 10))
    await until(lambda: nodes.robot.session.node.count_subscribers("/cmd_vel") == 1)
    await register(nodes, "/cmd_vel")
    command = threading.Timer(0.1, nodes.deliver, [drive(1.0)])
    command.start()
    time.sleep(1.5)
    free = time.monotonic()
    command.join()
    await until(lambda: len(times) == 2)
    assert [value for _, value in times] == [1.0, -1.0]
    assert times[1][0] < free, "the dead-man waited for the loop"


async def test_commands_of_a_headset_are_taken_at_once(
    domain: int, peer: Peer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Over a real router: every command once and in order, all of them in Zenoh's thread."""
    threads: list[int] = []
    take = PublisherNode.receive

    def noted(node: PublisherNode, message: Message) -> None:
        take(node, message)
        threads.append(threading.get_ident())

    monkeypatch.setattr(PublisherNode, "receive", noted)
    received = await peer.subscription(Twist, "/cmd", 1000)
    async with Router() as router:
        mesh = MeshSettings(connect=[router.endpoint])
        settings = Settings(mesh=mesh, robot=RobotSettings(id=7))
        async with open_robot(settings, domain_id=domain), join("unity", id=300, settings=mesh) as headset:
            asked = AddNode(2, 300, NodeType.PUBLISHER, node_name("/cmd"), "/cmd", "geometry_msgs/Twist")
            await until(lambda: ("ros", 7) in {(agent.type_name, agent.id) for agent in headset.online()})
            await headset.call("ros", 7, "add_node", encode_data(asked))
            metadata = Metadata(node_type=NodeType.PUBLISHER, node_name=asked.node_name, data_exchange_type="x")

            def command(x: float) -> None:
                headset.send(drive(x).data, to="ros", ids=[7], metadata=metadata)

            # until its node is open, and ROS has brought both ends together
            await until(lambda: (command(0.5), received.qsize())[1], every_s=0.02)
            before = len(threads)
            for i in range(1, 101):
                command(float(i))
                await asyncio.sleep(0.005)
            got: list[float] = []
            await until(lambda: (got.extend(drained(received)), 100.0 in got)[1])
    assert [x for x in got if x != 0.5] == [float(i) for i in range(1, 101)]
    assert len(threads) - before >= 100
    assert threading.get_ident() not in threads[before:]
