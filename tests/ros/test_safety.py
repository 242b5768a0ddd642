"""Safety: who commands, what happens when commands stop, and the emergency stop."""

from __future__ import annotations

import asyncio
import math
import random
import time
from collections.abc import AsyncIterator
from typing import Any

import msgspec
import pytest
from geometry_msgs.msg import Twist
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import Bool

from bridge.ros.interface import Registrant, Robot
from bridge.ros.nodes import InterfaceNodes
from bridge.ros.requests import ControlRequest, control
from bridge.ros.rules import Rules
from bridge.ros.safety import Control, DeadMan, EmergencyStop
from bridge.ros.session import RosSession
from bridge.ros.shared_stop import A_NODE
from bridge.settings import RobotSettings, TopicRule
from macs_zenoh.errors import Refused
from macs_zenoh.protocol.guard import Ages
from macs_zenoh.protocol.messages import NodeType
from tests.support.delays import Delays
from tests.support.ros_peer import Peer, adding, command, drive
from tests.support.waiting import get, until

SILENCE_S = 0.3
FIVE, SIX = Registrant(2, 5), Registrant(2, 6)

# -- pure ------------------------------------------------------------------------------------------------------------


def test_control_goes_to_the_first_and_expires() -> None:
    """One agent holds control as long as it commands; after the hold time anybody may take it."""
    held = Control(hold_s=3)
    assert held.take("a", 0)
    assert not held.take("b", 2)
    assert held.take("a", 2)
    assert not held.take("b", 4.9)
    assert held.take("b", 5)
    assert held.holder(7) == "b"
    assert held.holder(8) is None


def test_how_long_control_is_held_and_left() -> None:
    """The time since it was taken runs on with each command, and begins anew with a new holder."""
    held = Control(hold_s=3)
    assert (held.seconds_held(0), held.seconds_left(0)) == (0, 0)
    held.take("a", 1)
    held.take("a", 3)
    assert (held.seconds_held(4), held.seconds_left(4)) == (3, 2)
    held.give("a", "b", 5)
    assert (held.seconds_held(6), held.seconds_left(6)) == (1, 2)
    assert held.seconds_held(9) == 0
    held.take("a", 10)
    assert held.seconds_held(11) == 1


def test_control_is_handed_over_and_released() -> None:
    """Only the holder can give it, to anybody, or give it up."""
    held = Control(hold_s=3)
    held.take("a", 0)
    assert not held.give("b", "b", 1)
    assert held.give("a", "b", 1)
    assert not held.take("a", 2)
    assert not held.release("a")
    assert held.release("b")
    assert held.take("a", 2)


def test_a_command_that_waited_counts_from_when_it_was_sent() -> None:
    """The dead-man acts as long after the driver's last command was sent, however late it came; what was sent before
    another shortens nothing."""
    deadman = DeadMan(0.5)
    deadman.command("a", 10.0)
    deadman.command("a", 9.7)
    assert deadman.deadline() == 10.5
    assert not deadman.tick(10.4)
    assert deadman.tick(10.5)


@pytest.mark.parametrize("seed", range(10))
def test_a_dead_man_on_a_link_that_jitters(seed: int) -> None:
    """It does not trip as long as somebody commands and no command is later than it waits; and when the last one was
    sent it trips in its time, however late that one came. Clocks are far apart, and what is late holds up the rest."""
    chance, ages, deadman = random.Random(seed), Ages(), DeadMan(0.3)
    every_s, jitter_s, way_s, clock = 0.05, 0.24, 0.02, 1e6
    now = sent = 0.0
    for number in range(1200):
        sent = number * every_s
        arrives = max(now, sent + way_s + jitter_s * chance.random() ** 3)
        trips = [at for at in (now + 0.001 * n for n in range(round((arrives - now) / 0.001))) if deadman.tick(at)]
        assert not trips, f"while somebody drove, {arrives - sent:.3f} s after a command was sent"
        now = arrives
        deadman.command("a", now - ages.age("unity/300", "router", clock + sent, now))
    tripped = next(at for at in (now + 0.001 * n for n in range(1000)) if deadman.tick(at))
    assert sent + 0.3 <= tripped <= sent + 0.3 + way_s + 0.01


def test_a_dead_man_trips_once_per_silence() -> None:
    """Armed by a command, it trips when time or the commander is gone, and then not again."""
    deadman = DeadMan(0.5)
    assert deadman.deadline() is None
    assert not deadman.tick(100)
    deadman.command("a", 0)
    deadman.command("a", 0.4)
    assert deadman.deadline() == 0.9
    assert not deadman.tick(0.8)
    assert deadman.tick(0.9)
    assert not deadman.tick(2)
    deadman.command("b", 3)
    assert not deadman.left("a")
    assert deadman.left("b")
    assert not deadman.left("b")
    assert deadman.trips == 2


def test_an_emergency_stop_is_latched() -> None:
    """Pressed twice it is one stop; it holds until it is released."""
    stop = EmergencyStop()
    assert stop.press("a", 1)
    assert not stop.press("b", 2)
    assert (stop.stopped, stop.by, stop.since) == (True, "a", 1)
    assert stop.release("b", 3)
    assert not stop.release("b", 4)
    assert stop.history == ["stopped by a", "released by b"]


# -- on ROS ----------------------------------------------------------------------------------------------------------

RULES = [
    TopicRule(
        match="/cmd_vel", exclusive=True, hold_s=0.5, deadman_s=SILENCE_S, deadman_message={"linear": {"z": -1}}
    ),
    TopicRule(match="/arm", deadman_message={}),
    TopicRule(match="/read", read_only=True),
    TopicRule(match="/wrong", deadman_message={"lienar": {}}),
]


@pytest.fixture
async def nodes(session: RosSession) -> AsyncIterator[InterfaceNodes]:
    rules = Rules(RobotSettings(rules=RULES, release_allow=["group/3"], groups={"3": ["unity"]}))
    groups = {SIX: 3}
    robot = Robot(session, 7, lambda node, frame: None, rules=rules, group_of=lambda agent: groups.get(agent, 0))
    nodes = InterfaceNodes(robot)
    await nodes.open_stop("/emergency_stop")
    yield nodes
    nodes.close()


async def driving(nodes: InterfaceNodes, peer: Peer, topic: str = "/cmd_vel") -> asyncio.Queue[Any]:
    """A ROS node that is driven by headsets 5 and 6."""
    received = await peer.subscription(Twist, topic)
    await until(lambda: nodes.robot.session.node.count_subscribers(topic) == 1)
    for registrant in (5, 6):
        await nodes.add(adding(topic, "geometry_msgs/Twist", node_type=NodeType.PUBLISHER, registrant=registrant))
    return received


@pytest.mark.alone
async def test_silence_publishes_the_stop_message_once(nodes: InterfaceNodes, peer: Peer) -> None:
    """When commands stop for the configured time, the configured message is on the topic within 100 ms, once."""
    received = await driving(nodes, peer)
    with Delays() as delays:
        for _ in range(10):
            last = time.monotonic()
            nodes.deliver(drive(0.5))
            await asyncio.sleep(0.02)
        for _ in range(10):
            assert (await get(received)).linear.x == 0.5
        stop = await get(received)
        assert SILENCE_S <= time.monotonic() - last < SILENCE_S + 0.1 + delays.s()
    assert (stop.linear.x, stop.linear.z) == (0.0, -1.0)
    await asyncio.sleep(2 * SILENCE_S)
    assert received.empty()
    node = nodes.get(2, "nd__cmd_vel")
    assert node is not None
    assert msgspec.to_builtins(node.status().deadman) == {
        "silence_s": SILENCE_S,
        "commander": None,
        "trips": 1,
        "last": "no command for 0.3 s",
    }


@pytest.mark.alone
@pytest.mark.parametrize("also", [[], [6]], ids=["last registrant", "others stay"])
async def test_a_commander_that_leaves_stops_the_robot(nodes: InterfaceNodes, peer: Peer, also: list[int]) -> None:
    """The stop message comes when the commanding agent's presence ends, also when the publisher goes with it."""
    received = await driving(nodes, peer, "/arm")
    if not also:
        nodes.forget(SIX)
    nodes.deliver(drive(0.5, topic="/arm"))
    assert (await get(received)).linear.x == 0.5
    with Delays() as delays:
        left = time.monotonic()
        nodes.forget(FIVE)
        assert await get(received) == Twist()
        assert time.monotonic() - left < 0.1 + delays.s()


async def test_a_spectator_that_leaves_stops_nothing(nodes: InterfaceNodes, peer: Peer) -> None:
    """Only the commander's end counts."""
    received = await driving(nodes, peer, "/arm")
    nodes.deliver(drive(0.5, topic="/arm"))
    nodes.forget(SIX)
    nodes.deliver(drive(0.6, topic="/arm"))
    assert [(await get(received)).linear.x for _ in range(2)] == [0.5, 0.6]


async def test_a_robot_that_ends_stops_what_it_commanded(session: RosSession, peer: Peer) -> None:
    """When the robot agent closes, the stop message is its last."""
    nodes = InterfaceNodes(Robot(session, 7, lambda node, frame: None, rules=Rules(RobotSettings(rules=RULES))))
    received = await driving(nodes, peer, "/arm")
    nodes.deliver(drive(0.5, topic="/arm"))
    nodes.close()
    assert [(await get(received)).linear.x for _ in range(2)] == [0.5, 0.0]


async def test_one_headset_commands_at_a_time(nodes: InterfaceNodes, peer: Peer) -> None:
    """Commands of others are counted and never reach the topic; after the hold time they do."""
    received = await driving(nodes, peer)
    nodes.deliver(drive(0.5, 5))
    nodes.deliver(drive(0.6, 6))
    assert nodes.drops["not_in_control"] == 1
    assert (await get(received)).linear.x == 0.5
    assert (await get(received)).linear.z == -1.0

    def six_drives() -> bool:
        nodes.deliver(drive(0.6, 6))
        return not received.empty()

    await until(six_drives)
    assert (await get(received)).linear.x == 0.6


async def test_control_is_given_on_request(nodes: InterfaceNodes, peer: Peer) -> None:
    """The holder hands control over, and who holds it is in the state."""
    received = await driving(nodes, peer)
    nodes.deliver(drive(0.5, 5))
    now = asyncio.get_running_loop().time
    refused = control(nodes, SIX, ControlRequest("take", "/cmd_vel"), now())
    assert (refused.done, refused.holder, refused.reason) == (False, "unity/5", "unity/5 has control")
    assert control(nodes, FIVE, ControlRequest("give", "/cmd_vel", to=6), now()).holder == "unity/6"
    node = nodes.get(2, "nd__cmd_vel")
    assert node is not None
    assert node.status().control.holder == "unity/6"
    nodes.deliver(drive(0.5, 5))
    nodes.deliver(drive(0.6, 6))
    assert [(await get(received)).linear.x for _ in range(2)] == [0.5, 0.6]
    assert control(nodes, SIX, ControlRequest("release", "/cmd_vel"), now()).done
    await nodes.add(adding("/arm", "geometry_msgs/Twist", node_type=2))
    with pytest.raises(Refused, match="not under exclusive control"):
        control(nodes, SIX, ControlRequest("take", "/arm"), now())


async def test_an_emergency_stop_holds_until_it_is_released(nodes: InterfaceNodes, peer: Peer) -> None:
    """Any permitted headset stops, without registering; commands are refused; only who may release, releases."""
    received = await driving(nodes, peer)
    state = await peer.subscription(
        Bool, "/emergency_stop", QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    )
    assert (await get(state)).data is False
    nodes.deliver(drive(0.5))
    assert (await get(received)).linear.x == 0.5
    nodes.deliver(command("/emergency_stop", Bool(data=True), "std_msgs/Bool"))
    assert (await get(received)).linear.z == -1.0
    assert (await get(state)).data is True
    for _ in range(3):
        nodes.deliver(drive(0.5))
    nodes.deliver(command("/emergency_stop", Bool(data=False), "std_msgs/Bool"))
    assert nodes.robot.stop.stopped
    assert nodes.drops == {"stopped": 3, "not_allowed": 1}
    nodes.deliver(command("/emergency_stop", Bool(data=False), "std_msgs/Bool")._replace(sender_id=6))
    assert not nodes.robot.stop.stopped
    assert (await get(state)).data is False
    nodes.deliver(drive(0.7))
    assert (await get(received)).linear.x == 0.7


async def test_a_release_from_before_a_press_is_not_carried_out(nodes: InterfaceNodes, peer: Peer) -> None:
    """It has waited on its way, and meanwhile somebody else has stopped the robot: that stop holds, also where its
    sender may release everybody's; what he sends once he has seen it counts."""
    await driving(nodes, peer)
    press, release = (command("/emergency_stop", Bool(data=state), "std_msgs/Bool") for state in (True, False))
    nodes.deliver(press._replace(age_s=0.3))
    nodes.deliver(release._replace(sender_id=6, age_s=0.2))  # both have waited, and this one was sent later
    assert not nodes.robot.stop.stopped
    nodes.deliver(press)
    nodes.deliver(release._replace(sender_id=6))
    assert not nodes.robot.stop.stopped
    nodes.deliver(press)
    nodes.deliver(release._replace(sender_id=6, age_s=0.2))
    assert nodes.robot.stop.stopped
    assert nodes.drops == {"too_old": 1}
    nodes.deliver(press._replace(age_s=0.3))
    nodes.deliver(release._replace(sender_id=6))
    assert not nodes.robot.stop.stopped
    assert nodes.stop is not None
    nodes.stop._pressed_at = -math.inf  # long ago
    nodes.stop.press(A_NODE)
    nodes.deliver(release._replace(sender_id=6, age_s=60.0))
    assert nodes.robot.stop.stopped, "also what a button on the robot has pressed"
    nodes.deliver(release._replace(sender_id=6))
    assert not nodes.robot.stop.stopped


@pytest.mark.parametrize("bad", [b"", b"\x01", b"\x00\x01\x00\x00", b"\x01\x00\x00\x00\x01"])
async def test_a_bad_emergency_stop_changes_nothing(nodes: InterfaceNodes, bad: bytes) -> None:
    """Bytes that are no Bool neither stop nor release, and the next one works."""
    nodes.deliver(command("/emergency_stop", bad, "std_msgs/Bool"))
    assert not nodes.robot.stop.stopped
    nodes.deliver(command("/emergency_stop", Bool(data=True), "std_msgs/Bool"))
    assert nodes.robot.stop.stopped
    nodes.deliver(command("/emergency_stop", bad, "std_msgs/Bool"))
    assert nodes.robot.stop.stopped


async def test_a_headset_can_register_the_emergency_stop(nodes: InterfaceNodes) -> None:
    """It is an ordinary publisher for existing programs, with its own type; it stays when they leave."""
    await nodes.add(adding("/emergency_stop", "std_msgs/Bool", node_type=NodeType.PUBLISHER))
    with pytest.raises(Refused, match="registered with type std_msgs/msg/Bool"):
        await nodes.add(adding("/emergency_stop", "std_msgs/String", node_type=NodeType.PUBLISHER))
    nodes.forget(FIVE)
    nodes.deliver(command("/emergency_stop", Bool(data=True), "std_msgs/Bool"))
    assert nodes.robot.stop.stopped


async def test_what_settings_forbid_is_refused(nodes: InterfaceNodes, caplog: pytest.LogCaptureFixture) -> None:
    """A read-only topic takes no commands, and settings that do not fit a type are a reason."""
    with pytest.raises(Refused, match="headsets may only read /read"):
        await nodes.add(adding("/read", node_type=NodeType.PUBLISHER))
    await nodes.add(adding("/read"))
    for _ in range(2):
        with pytest.raises(Refused, match="Twist has no field lienar"):
            await nodes.add(adding("/wrong", "geometry_msgs/Twist", node_type=NodeType.PUBLISHER))
    told = [record.getMessage() for record in caplog.records if "lienar" in record.getMessage()]
    assert len(told) == 1, "the robot's own log names what its owner has to mend"
    assert nodes.drops["wrong_settings"] == 2
