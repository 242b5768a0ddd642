"""Floods of TCP agents: many small frames, many connections, connections that do not move. Sections 2 and 3."""

from __future__ import annotations

import os
import socket
import struct
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from tests.attack import raw
from tests.attack.inputs import HUGE, MIB
from tests.attack.raw import ROS, UNITY, Agent, frame, header, management, metadata, node_data, registration, request
from tests.attack.table import Target, attack

CHUNK_BYTES = 256 << 10


def flood(target: Target, *frames: bytes, agents: int = 1, agent_type: int = UNITY, group: int = 0) -> None:
    """Send these again and again, as fast as they are taken."""
    blob = b"".join(frames)
    blob *= max(1, CHUNK_BYTES // len(blob))
    senders: list[Agent] = []
    while target.running():
        with suppress(OSError):
            while len(senders) < agents:
                senders.append(Agent(target.port, agent_type=agent_type, group=group))
        senders = [sender for sender in senders if sender.send(blob)]
        if not senders:
            target.rest(0.05)


def crowd(target: Target, count: int, make: Callable[[], Agent | None]) -> list[Agent]:
    """As many connections as are let in."""
    here: list[Agent] = []
    for _ in range(count):
        if not target.running():
            break
        with suppress(OSError, ValueError, struct.error):
            agent = make()
            if agent is not None:
                here.append(agent)
    return here


def vanish(
    target: Target, count: int, make: Callable[[], Agent | None], *, there_s: float = 0.0, gone_s: float = 0.0
) -> None:
    """So many come, end at once after a while, and come again after another."""
    while target.running():
        agents = crowd(target, count, make)
        target.rest(there_s)
        for agent in agents:
            agent.close(reset=True)
        target.rest(gone_s)


# -- work ------------------------------------------------------------------------------------------------------------


@attack(2, "headset", single=True, seen=True)
def a_registration_with_65_535_robots(target: Target) -> None:
    """One registration that names every robot id there is."""
    agent = Agent(target.port)
    while target.running():
        agent.send(registration("nd__x", "/x", agents=range(1, 65_536)))
        target.rest(0.5)


@attack(2, "headset")
def registrations_with_2_000_robots(target: Target) -> None:
    """Registrations that name 2 000 robots each, under other names."""
    flood(target, *(registration(f"nd__{n}", f"/{n}", agents=range(1, 2001)) for n in range(20)))


@attack(2, "headset")
def ever_new_node_names(target: Target) -> None:
    """Registrations and their ends, each under a name never used before."""
    agent, number = Agent(target.port), 0
    while target.running():
        names = [f"n{n}" for n in range(number, number + 200)]
        number += 200
        ok = agent.send(b"".join(registration(name, f"/{name}") for name in names))
        ok = ok and agent.send(b"".join(registration(name, f"/{name}", add=False) for name in names))
        if not ok:
            with suppress(OSError):
                agent = Agent(target.port)
            target.rest(0.02)


@attack(2, "headset", seen=True)
def ever_new_node_names_kept(target: Target) -> None:
    """4 000 registrations and more under different names, none of which ends."""
    agent, number = Agent(target.port), 0
    while target.running():
        if not agent.send(b"".join(registration(f"k{n}", f"/k{n}") for n in range(number, number + 100))):
            with suppress(OSError):
                agent = Agent(target.port)
            target.rest(0.02)
        number += 100


@attack(2, "headset")
def registrations_again_and_again(target: Target) -> None:
    """The same registration and its end at full rate."""
    flood(target, registration("nd__again", "/again"), registration("nd__again", "/again", add=False))


@attack(2, "headset", seen=True)
def fresh_destinations(target: Target) -> None:
    """Messages to ids that were never used: ten new ones in each frame, of every type."""
    agent, count = Agent(target.port), 0
    said = metadata(message_manager="Hello")
    while target.running():
        blob = []
        for _ in range(200):
            ids = [1 + (count + n) % 65_535 for n in range(10)]
            count += 10
            blob.append(frame(metadata=said, to=2 + count // 65_535 % 253, ids=ids, groups=range(1, 11)))
        if not agent.send(b"".join(blob)):
            with suppress(OSError):
                agent = Agent(target.port)
            target.rest(0.02)


@attack(2, "headset", seen=True)
def many_fill_the_robot_with_nodes(target: Target) -> None:
    """300 interface nodes registered at the robot by one headset."""
    agent = Agent(target.port)
    for kind in (1, 2, 3, 4):
        for n in range(75):
            agent.send(registration(f"nd__f{kind}_{n}", f"/f{kind}_{n}", "std_msgs/String", node_type=kind))
        if kind > 2:
            for n in range(75):
                agent.send(registration(f"nd__s{kind}_{n}", f"/s{kind}_{n}", "std_srvs/Trigger", node_type=kind))
    while target.rest(0.2):
        agent.send(registration("nd__f_more", "/f_more"))


@attack(2, "headset")
def who_is_online(target: Target) -> None:
    """OnlineAgentsGetter at full rate, from two headsets, with 200 others online."""
    crowd(target, 200, lambda: Agent(target.port))
    asking = frame(management("OnlineAgentsGetter", agent_type=2, agent_id=1), metadata())
    flood(target, asking, agents=2)


@attack(2, "headset", seen=True)
def changing_groups(target: Target) -> None:
    """Configurations that change the group, at full rate."""
    agent_says = [
        frame(management("AgentclientConfigurer", agent_type=2, agent_id=1, group_id=group, request_id=0))
        for group in range(1, 201)
    ]
    flood(target, *agent_says)


@attack(2, "headset")
def heartbeats(target: Target) -> None:
    """Heartbeats at full rate."""
    flood(target, frame(management("HeartbeatHandler")))


@attack(2, "headset")
def management_that_is_none(target: Target) -> None:
    """Frames at full rate whose management data is no JSON, or names an unknown manager."""
    flood(target, frame(b"{"), frame(management("Unknown")))


@attack(2, "headset")
def metadata_that_is_none(target: Target) -> None:
    """Broadcasts at full rate whose metadata is no object, or nothing."""
    flood(target, frame(metadata=b"[]"), frame(metadata=b"{"), frame(metadata=b""))


@attack(2, "headset")
def sizes_that_lie(target: Target) -> None:
    """Frames at full rate whose inner sizes do not add up, or that have no room for any."""
    lie = b"\xff\xff\xff\x7f" + bytes(8)
    flood(target, header(2, [1], [], 0, len(lie)) + lie, header(0, [], [], 0, 0), header(2, [1], [], 0, 3) + b"abc")


@attack(2, "headset")
def messages_to_nobody(target: Target) -> None:
    """Small messages at full rate to an id that nobody has."""
    flood(target, frame(metadata=metadata(message_manager="Hello"), to=UNITY, ids=[60_000]))


@attack(2, "headset")
def messages_to_the_neighbour(target: Target) -> None:
    """Small messages at full rate to a neighbour, who takes what it can."""
    flood(target, frame(metadata=metadata(message_manager="Hello"), data=bytes(64), to=UNITY, ids=[2]))


@attack(2, "headset")
def broadcasts(target: Target) -> None:
    """Broadcasts at full rate."""
    flood(target, frame(metadata=metadata(message_manager="Hello"), data=bytes(64)))


@attack(2, "headset")
def headers_only(target: Target) -> None:
    """Headers of nothing, at full rate: 6 700 in each 256 KiB."""
    flood(target, header(2, [1], [], 0, 0))


# -- connections -----------------------------------------------------------------------------------------------------


@attack(2, "headset", seen=True)
def half_frames(target: Target) -> None:
    """Fifty connections that each send 31.9 MiB of a frame, and then a byte every now and then."""
    body = bytes(HUGE - MIB)

    def make() -> Agent:
        agent = Agent(target.port)
        agent.send(header(2, [60_000], [], 0, HUGE) + body)
        return agent

    agents = crowd(target, 50, make)
    while target.rest(0.5):
        for agent in agents:
            agent.send(b"x")


@attack(2, "headset")
def half_frames_of_each_part(target: Target) -> None:
    """200 connections that stop in the middle of a header, management data, metadata and data; then byte by byte."""
    beginnings = [
        header(2, [60_000], [], 0, 100)[:20],
        header(0, [], [], 60_000, 8) + b"{",
        header(2, [60_000], [], 0, 60_000) + struct.pack("<I", 4000) + b"{",
        header(2, [60_000], [], 0, MIB) + struct.pack("<I", 2) + b"{}" + bytes(MIB // 2),
    ]
    agents: list[Agent] = []
    for beginning in beginnings * 50:
        agents += crowd(target, 1, lambda: Agent(target.port))
        if agents:
            agents[-1].send(beginning)
    while target.rest(0.3):
        for agent in agents:
            agent.send(b" ")


@attack(2, "headset")
def connections_that_say_nothing(target: Target) -> None:
    """2 000 connections that do not answer the greeting."""
    agents = crowd(target, 2000, lambda: Agent(target.port, configure=False))
    while target.rest(0.2):
        agents += crowd(target, 20, lambda: Agent(target.port, configure=False))


@attack(2, "headset", seen=True)
def every_slot(target: Target) -> None:
    """As many configured headsets from one address as are let in, up to 2 500."""
    agents = crowd(target, 2500, lambda: Agent(target.port))
    while target.rest(0.2):
        agents += crowd(target, 20, lambda: Agent(target.port))


@attack(2, "headset")
def many_that_leave_together(target: Target) -> None:
    """As many configured headsets as come within a second, seen by others, that all end at once; and again."""
    vanish(target, 1000, lambda: Agent(target.port), there_s=2.0, gone_s=0.5)


@attack(2, "headset")
def listeners_that_vanish(target: Target) -> None:
    """Two hundred headsets that register a topic at the robot and end, again and again."""

    def make() -> Agent:
        agent = Agent(target.port)
        agent.send(registration("nd__odom", "/odom", "nav_msgs/Odometry", me=agent.id))
        return agent

    vanish(target, 200, make)


@attack(2, "headset")
def coming_and_going(target: Target) -> None:
    """Connections at full rate that end at once: properly, with a reset, half closed."""
    number = 0
    while target.running():
        with suppress(OSError, ValueError, struct.error):
            agent = Agent(target.port, configure=bool(number % 2), read=False)
            if number % 3 == 1:
                agent.socket.shutdown(socket.SHUT_WR)
            agent.close(reset=number % 3 == 0)
        number += 1


@attack(2, "headset")
def resets_without_reading(target: Target) -> None:
    """Sockets that connect and reset before the greeting, at full rate."""
    while target.running():
        with suppress(OSError), socket.socket() as probe:
            probe.bind((raw.FROM, 0))
            probe.settimeout(1)
            probe.connect(("127.0.0.1", target.port))
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))


@attack(2, "headset")
def half_closed(target: Target) -> None:
    """300 headsets that have closed their sending side and go on reading, with more coming."""
    agents: list[Agent] = []
    while target.running():
        for agent in crowd(target, 20, lambda: Agent(target.port)):
            with suppress(OSError):
                agent.socket.shutdown(socket.SHUT_WR)
            agents.append(agent)
        target.rest(0.05)


@attack(2, "headset", seen=True)
def slow_readers(target: Target) -> None:
    """Twenty headsets that do not read, while two others send each of them large messages."""
    deaf = crowd(target, 20, lambda: Agent(target.port, read=False))
    ids = [agent.id for agent in deaf]
    large = [
        frame(metadata=metadata(message_manager="Big"), data=bytes(MIB), to=UNITY, ids=ids[at : at + 10])
        for at in (0, 10)
    ]
    flood(target, *large, agents=2)


@attack(2, "headset")
def slow_readers_of_answers(target: Target) -> None:
    """Twenty headsets that ask who is online at full rate and read no answer."""
    asking = frame(management("OnlineAgentsGetter", agent_type=2, agent_id=1), metadata()) * 500
    deaf = crowd(target, 20, lambda: Agent(target.port, read=False))
    for agent in deaf:
        agent.socket.settimeout(0.05)
    while target.running():
        deaf = [agent for agent in deaf if _offer(agent, asking)]
        target.rest(0.01)


def _offer(agent: Agent, data: bytes) -> bool:
    """Send what is taken now; False when the connection is over."""
    try:
        agent.socket.sendall(data)
    except TimeoutError:
        return True
    except OSError:
        return False
    return True


@attack(2, "headset")
def slow_readers_of_large_frames(target: Target) -> None:
    """Ten headsets that do not read, each sent frames of 31 MiB by another one."""
    deaf = crowd(target, 10, lambda: Agent(target.port, read=False))
    big = frame(metadata=metadata(message_manager="Big"), data=bytes(HUGE), to=UNITY, ids=[a.id for a in deaf])
    flood(target, big)


@attack(2, "headset", seen=True)
def reconnecting_to_send(target: Target) -> None:
    """A new connection for every 500 messages, so that what is counted per connection begins anew."""
    burst = frame(metadata=metadata(message_manager="Hello"), to=UNITY, ids=[60_001]) * 500
    while target.running():
        with suppress(OSError, ValueError, struct.error):
            agent = Agent(target.port, read=False)
            agent.send(burst)
            agent.close()


# -- the robot and the stop ------------------------------------------------------------------------------------------


@attack(3, "headset", seen=True)
def status_requests(target: Target) -> None:
    """RobotStatus at full rate."""
    flood(target, request("RobotStatus"))


@attack(3, "headset")
def status_requests_of_many(target: Target) -> None:
    """RobotStatus at full rate from twenty headsets."""
    flood(target, request("RobotStatus"), agents=20)


@attack(3, "headset")
def status_requests_from_many_addresses(target: Target) -> None:
    """RobotStatus at full rate from forty headsets, each of an address of its own, that begin in the same moment."""
    asking = request("RobotStatus") * 1000
    agents = [Agent(target.port, host=f"127.0.1.{1 + n}") for n in range(40)]
    while target.running():
        agents = [agent for agent in agents if agent.send(asking)]


@attack(3, "headset")
def registrations_of_every_type(target: Target) -> None:
    """Subscribers, publishers and callers of every type that the robot's computer has, each on a topic of its own."""
    frames = []
    for share in os.environ.get("AMENT_PREFIX_PATH", sys.prefix).split(os.pathsep):
        for at, found in enumerate(sorted(Path(share).glob("**/share/*/msg/*.msg"))):
            kind = f"{found.parts[-3]}/{found.stem}"
            frames += [registration(f"nd__t{at}_{n}", f"/t{at}_{n}", kind, node_type=n) for n in (1, 2)]
            frames += [registration(f"nd__t{at}_{n}", f"/t{at}_{n}", kind, node_type=n, add=False) for n in (1, 2)]
    assert frames, "there are no types here"
    flood(target, *frames)


@attack(3, "headset")
def functionality_requests(target: Target) -> None:
    """FunctionalityGetter at full rate, half of them to follow every change."""
    flood(target, request("FunctionalityGetter"), request("FunctionalityGetter", b'{"follow":true}'))


@attack(3, "headset")
def control_requests(target: Target) -> None:
    """RobotControl at full rate: take, give and release what somebody else has."""
    wanted = (b'{"action":"%s","topic":"/cmd_vel","to":9}' % action for action in (b"take", b"give", b"release"))
    flood(target, *(request("RobotControl", data) for data in wanted))


@attack(3, "headset")
def unknown_requests(target: Target) -> None:
    """Messages to the robot at full rate that name no manager it knows."""
    flood(target, request("Nobody", bytes(32)), request("", bytes(32)))


@attack(3, "headset")
def commands_of_a_stranger(target: Target) -> None:
    """Commands on the driven topic at full rate, by a headset that has not got control."""
    Agent(target.port).send(registration("nd__cmd_vel", "/cmd_vel", "geometry_msgs/Twist", node_type=2))
    twist = b"\x00\x01\x00\x00" + struct.pack("<6d", 9.0, 0, 0, 0, 0, 0)
    flood(target, node_data("nd__cmd_vel", twist, kind="geometry_msgs/Twist"))


@attack(3, "headset")
def large_commands_of_a_stranger(target: Target) -> None:
    """Commands of 1 MiB on the driven topic at full rate."""
    flood(target, node_data("nd__cmd_vel", b"\x00\x01\x00\x00" + bytes(MIB), kind="geometry_msgs/Twist"))


@attack(3, "headset")
def data_for_no_node(target: Target) -> None:
    """Data at full rate for interface nodes that nobody registered, under ever other names."""
    flood(target, *(node_data(f"nd__none_{n}", bytes(64)) for n in range(2000)))


@attack(3, "headset")
def publishing_to_ros(target: Target) -> None:
    """Messages at full rate for a topic of its own on the robot."""
    Agent(target.port).send(registration("nd__flood", "/flood", node_type=2))
    text = b"\x00\x01\x00\x00" + struct.pack("<I", 60) + bytes(60)
    flood(target, node_data("nd__flood", text))


@attack(3, "headset")
def service_calls(target: Target) -> None:
    """Calls at full rate of a service of the robot that does not exist, and of one that does."""
    agent = Agent(target.port)
    for name in ("/absent", "/rosagent/get_type_description"):
        node = "nd_" + name.replace("/", "_")
        agent.send(registration(node, name, "std_srvs/Trigger", node_type=3))
    call = node_data("nd__absent", b"\x00\x01\x00\x00\x00", node_type=3, kind="std_srvs/Trigger")
    flood(target, call)


@attack(3, "headset")
def action_messages(target: Target) -> None:
    """Goals, cancels and lists of an action at full rate."""
    agent = Agent(target.port)
    agent.send(registration("nd__act", "/act", "tf2_msgs/LookupTransform", node_type=5))
    frames = []
    for verb in ("ActionGoal", "ActionCancel", "ActionList", "ActionFeedback", "ActionResult"):
        said = metadata(node_type=5, node_name="nd__act", message_manager=verb)
        frames.append(frame(metadata=said, data=bytes(64), to=ROS, ids=[target.robot]))
    flood(target, *frames)


@attack(3, "headset")
def registrations_at_the_robot(target: Target) -> None:
    """Registrations and their ends at the robot at full rate, of each node type, with types that are not installed."""
    frames = []
    for n in range(40):
        for kind, data_type in ((1, "std_msgs/String"), (2, "no_msgs/Such"), (3, "std_srvs/Trigger")):
            frames.append(registration(f"nd__r{n}", f"/r{n}", data_type, node_type=kind))
            frames.append(registration(f"nd__r{n}", f"/r{n}", data_type, node_type=kind, add=False))
    flood(target, *frames)


@attack(3, "headset", seen=True)
def releasing_all_the_time(target: Target) -> None:
    """``false`` on the emergency stop's topic 50 times per second."""
    agent = Agent(target.port)
    release = node_data("nd__emergency_stop", b"\x00\x01\x00\x00\x00", kind="std_msgs/Bool")
    while target.rest(0.02):
        agent.send(release)


@attack(3, "headset")
def releasing_at_full_rate(target: Target) -> None:
    """``false`` on the emergency stop's topic at full rate, and what is no Bool."""
    good = node_data("nd__emergency_stop", b"\x00\x01\x00\x00\x00", kind="std_msgs/Bool")
    bad = node_data("nd__emergency_stop", b"\x00\x01\x00\x00" + bytes(3), kind="std_msgs/Bool")
    flood(target, good, bad)


@attack(3, "headset")
def leaving_and_coming(target: Target) -> None:
    """Headsets that register at the robot, command and vanish, at full rate."""
    twist = b"\x00\x01\x00\x00" + bytes(48)
    while target.running():
        with suppress(OSError, ValueError, struct.error):
            agent = Agent(target.port)
            agent.send(registration("nd__cmd_vel", "/cmd_vel", "geometry_msgs/Twist", node_type=2, me=agent.id))
            agent.send(node_data("nd__cmd_vel", twist, kind="geometry_msgs/Twist"))
            time.sleep(0.001)
            agent.close(reset=True)


@attack(2, "headset", seen=True)
def a_thousand_leave_at_once(target: Target) -> None:
    """1 000 headsets that have registered at the robot end in the same moment, and come again."""

    def make() -> Agent:
        agent = Agent(target.port, read=False)
        agent.send(registration("nd__cmd_vel", "/cmd_vel", "geometry_msgs/Twist", node_type=2, me=agent.id))
        return agent

    vanish(target, 1000, make, there_s=0.5, gone_s=0.5)


@attack(3, "tcp robot")
def topic_data_at_full_rate(target: Target) -> None:
    """A TCP robot that streams small messages to every headset at full rate."""
    said = management("RosAgentSubscriberDataForwarder", dest_agents={"2": list(range(1, 20))})
    about = metadata(sender_agent_type=ROS, node_type=1, node_name="nd__x", data_exchange_type="std_msgs/String")
    flood(target, frame(said, about, bytes(64)), agent_type=ROS)
