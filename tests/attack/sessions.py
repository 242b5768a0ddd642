"""Attacks from a Zenoh session of its own, which knows the router's address and nothing else. Sections 1 to 4.

What a certificate would forbid is in docs/security.md; these attack a mesh without access rules, and with those that
they have an agent who is allowed that much could do the same.
"""

from __future__ import annotations

import json
import struct
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress

import zenoh

from macs_zenoh.protocol.keyexpr import PRESENCE
from tests.attack.inputs import HUGE, LONG, MIB, unknown_keys
from tests.attack.raw import ROS, UNITY, frame, header, management, message, metadata
from tests.attack.table import Target, attack

URGENT = zenoh.Priority.REAL_TIME
DROP = zenoh.CongestionControl.DROP
BLOCK = zenoh.CongestionControl.BLOCK
OPEN_QUERIES = 2000


@contextmanager
def session(target: Target) -> Iterator[zenoh.Session]:
    """A client of the router."""
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps([target.endpoint]))
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("transport/shared_memory/enabled", "false")
    with zenoh.open(config) as opened:
        yield opened


def puts(
    target: Target,
    keys: list[str],
    payloads: list[bytes],
    *,
    every_s: float = 0.0,
    priority: zenoh.Priority = URGENT,
) -> None:
    """Put each payload on each key, again and again: at full rate, or a round every so often."""
    with session(target) as mesh:
        publishers = [mesh.declare_publisher(key, congestion_control=BLOCK, priority=priority) for key in keys]
        while target.running():
            for publisher in publishers:
                for payload in payloads:
                    publisher.put(payload)
                    if not target.running():
                        return
            if every_s:
                target.rest(every_s)


def queries(target: Target, verb: str, data: bytes = b"", *, caller: str = "unity/4000", payload: bytes = b"") -> None:
    """Ask the robot this at full rate, and wait for no answer."""
    asked = payload or frame(metadata=metadata(), data=data, to=ROS, ids=[target.robot])
    answered = [0]

    def count(_reply: object) -> None:
        answered[0] += 1

    with session(target) as mesh:
        sent = 0
        while target.running():
            if sent - answered[0] > OPEN_QUERIES and not target.rest(0.0005):
                break
            key = f"macs/call/ros/{target.robot}/{verb}/{caller}"
            mesh.get(key, count, payload=asked, priority=URGENT, timeout=1.0)
            sent += 1


def _everybody(target: Target, sender: str = "ros/4000") -> list[str]:
    """A key of each space on which agents and gateways listen."""
    robot = target.robot
    to_headsets = [f"macs/to/unity/0/{n}/{sender}" for n in (2, 3)]
    return [*to_headsets, f"macs/to/ros/0/{robot}/{sender}", f"macs/all/{sender}", f"macs/from/ros/{robot}/nd__x"]


def _to_headset(said: bytes, data: bytes = b"") -> bytes:
    return frame(metadata=said, data=data, to=UNITY, ids=[2, 3])


# -- single samples --------------------------------------------------------------------------------------------------


@attack(1, "mesh", single=True, seen=True)
def samples_with_31_mib_of_metadata(target: Target) -> None:
    """31 MiB of unknown keys as metadata, on each key space."""
    puts(target, _everybody(target), [_to_headset(unknown_keys(HUGE))], every_s=0.5)


@attack(1, "mesh", single=True)
def samples_with_31_mib_of_lists(target: Target) -> None:
    """31 MiB of ``[],`` as metadata to all, as management data of topic data."""
    lists = b"[" + b"[]," * (HUGE // 3) + b"[]]"
    said = b'{"messageManager":"RosAgentSubscriberDataForwarder","destAgents":{"2":' + lists + b"}}"
    puts(target, _everybody(target), [_to_headset(b'{"x":' + lists + b"}"), frame(said, metadata())], every_s=0.5)


@attack(1, "mesh", single=True)
def samples_that_nest(target: Target) -> None:
    """A million brackets as metadata, management data and data, on each key space."""
    deep = b"[" * MIB
    frames = [_to_headset(deep), frame(deep, metadata()), _to_headset(metadata(message_manager="RobotControl"), deep)]
    puts(target, _everybody(target), frames, every_s=0.5)


@attack(1, "mesh", single=True)
def samples_that_are_no_frames(target: Target) -> None:
    """Nothing, single bytes, cut frames, sizes that lie by GiB, and 8 MiB of zeros, on each key space."""
    whole = _to_headset(metadata(message_manager="Hello"), b"hello")
    lying = [header(2, [2], [], 0xFFFFFFFF, 0xFFFFFFFF), header(0, [], [], 0, 0x7FFFFFFF) + bytes(64)]
    inner = header(2, [2], [], 0, 16) + b"\xff" * 16
    cut = [whole[:size] for size in (0, 1, 20, 38, 39, 60, len(whole) - 1)]
    puts(target, _everybody(target), [*cut, *lying, inner, whole + b"x", bytes(8 * MIB)], every_s=0.5)


@attack(1, "mesh", single=True, seen=True)
def one_sample_of_many_frames(target: Target) -> None:
    """One sample that is 200 000 frames, good ones and ones of nothing."""
    good = _to_headset(metadata(message_manager="Hello"), b"x") * 100_000
    nothing = header(2, [2], [], 0, 0) * 200_000
    puts(target, _everybody(target), [good, nothing], every_s=0.5)


@attack(1, "mesh", single=True)
def streams_for_60_000(target: Target) -> None:
    """Topic data for 60 000 headsets, and under node names of 8 000 characters."""
    said = management("RosAgentSubscriberDataForwarder", dest_agents={"2": list(range(1, 60_001))})
    about = metadata(sender_agent_type=ROS, node_type=1, node_name="nd__x")
    long = metadata(sender_agent_type=ROS, node_type=1, node_name=LONG[:60_000])
    keys = [f"macs/from/ros/{target.robot}/{node}" for node in ("nd__x", "n" * 8000)]
    puts(target, keys, [frame(said, about, bytes(16)), frame(said, long, bytes(16))], every_s=0.5)


@attack(1, "mesh", single=True)
def keys_that_are_odd(target: Target) -> None:
    """Samples on keys with ids, types, groups and blocks that nobody can have, escapes that end early, long chunks."""
    spaces = [
        *(f"macs/to/unity/0/2/{sender}" for sender in ("ros/99999", "300/1", "x/y", "operator/0", "unity/-1")),
        *(f"macs/to/ros/0/{target.robot}/{sender}" for sender in ("unity/0", "0/1", "unity/1e9", "unity/٣")),
        *(f"macs/all/{sender}" for sender in ("unity/65536", "2/2", "unity/02", "a/" + "9" * 5000)),
        *(f"macs/from/ros/{target.robot}/{node}" for node in ("%", "%2", "%00", "%FF", "n" * 8000)),
        *(f"macs/group/{group}/unity/ros/1" for group in ("0", "256", "x", "9" * 4000)),
    ]
    puts(target, spaces, [_to_headset(metadata(message_manager="Hello"), b"x")], every_s=0.3)


@attack(1, "mesh", single=True)
def calls_with_31_mib(target: Target) -> None:
    """31 MiB of keys as the data of each verb, and as its metadata."""
    keys = unknown_keys(HUGE)
    with session(target) as mesh:
        while target.running():
            for verb in ("add_node", "remove_node", "offers", "status", "control", "stop", "ping"):
                for asked in (frame(metadata=metadata(), data=keys, to=ROS), frame(metadata=keys, to=ROS)):
                    if target.running():
                        key = f"macs/call/ros/{target.robot}/{verb}/unity/4000"
                        mesh.get(key, lambda _: None, payload=asked, timeout=2.0)
                        target.rest(0.2)


@attack(1, "mesh", single=True)
def calls_for_long_names(target: Target) -> None:
    """``add_node`` with names, topics and types of 70 000 characters, of nothing, and with a buffer of 2^62."""
    nodes = [
        {"nodeName": LONG, "tosName": "/x"},
        {"nodeName": "nd__x", "tosName": "/" + LONG},
        {"nodeName": "nd__x", "tosName": "/x", "dataExchangeType": LONG},
        {"nodeName": "", "tosName": ""},
        {"nodeName": "nd__big", "tosName": "/big", "bufferSize": 2**62},
    ]
    base = {"registrantAgentType": 2, "registrantAgentId": 4000, "nodeType": 1, "dataExchangeType": "std_msgs/String"}
    with session(target) as mesh:
        while target.running():
            for node in nodes:
                data = json.dumps({**base, **node}).encode()
                asked = frame(metadata=metadata(), data=data, to=ROS)
                mesh.get(
                    f"macs/call/ros/{target.robot}/add_node/unity/4000", lambda _: None, payload=asked, timeout=2.0
                )
            target.rest(0.3)


@attack(1, "mesh", single=True)
def tokens_with_long_names(target: Target) -> None:
    """Presence, name and lease tokens whose chunks have 20 000 characters, or are no numbers."""
    long = "z" * 20_000
    keys = [
        f"macs/live/unity/15/4000/0/{long}",
        "macs/live/unity/390/99999/0/a",
        "macs/live/unity/15/4001/999/a",
        "macs/live/300/0/1/0/a",
        "macs/live/unity/16/4001/0/a",
        f"macs/name/{long}/ros/77/a1",
        f"macs/ca/wanted/{long}/x/a1",
        "macs/block/999/a1",
        f"macs/block/7/{long}",
        "macs/live/ros/15/4002/0/not hexadecimal",
    ]
    with session(target) as mesh:
        while target.running():
            tokens = [mesh.liveliness().declare_token(key) for key in keys]
            target.rest(0.3)
            for token in tokens:
                token.undeclare()


# -- floods ----------------------------------------------------------------------------------------------------------


@attack(3, "mesh")
def small_samples_to_the_robot(target: Target) -> None:
    """Messages to the robot at full rate and the highest priority, from ever other senders."""
    keys = [f"macs/to/ros/0/{target.robot}/unity/{n}" for n in range(4000, 4050)]
    puts(target, keys, [frame(metadata=metadata(message_manager="Hello"), data=b"x", to=ROS, ids=[1])])


@attack(3, "mesh")
def small_samples_that_wait_to_the_robot(target: Target) -> None:
    """The same at the priority of calls, which wait where a link is full."""
    keys = [f"macs/to/ros/0/{target.robot}/unity/{n}" for n in range(4000, 4050)]
    frames = [frame(metadata=metadata(message_manager="Hello"), data=b"x", to=ROS, ids=[1])]
    puts(target, keys, frames, priority=zenoh.Priority.INTERACTIVE_HIGH)


@attack(3, "mesh")
def status_samples_to_the_robot(target: Target) -> None:
    """RobotStatus as messages at full rate, from ever other senders."""
    keys = [f"macs/to/ros/0/{target.robot}/unity/{n}" for n in range(4000, 4050)]
    puts(target, keys, [frame(metadata=metadata(message_manager="RobotStatus"), to=ROS, ids=[1])])


@attack(3, "mesh")
def bad_samples_to_the_robot(target: Target) -> None:
    """What is no frame, at full rate, to the robot and to all."""
    puts(target, [f"macs/to/ros/0/{target.robot}/unity/4000", "macs/all/unity/4000"], [b"", b"x", bytes(64)])


@attack(3, "mesh")
def samples_of_many_frames_to_the_robot(target: Target) -> None:
    """Samples of 2 000 frames each, at full rate."""
    one = frame(metadata=metadata(message_manager="RobotStatus"), to=ROS, ids=[1])
    puts(target, [f"macs/to/ros/0/{target.robot}/unity/4000"], [one * 2000])


@attack(2, "mesh")
def small_samples_to_headsets(target: Target) -> None:
    """Messages to ids of the gateway that nobody has, at full rate."""
    puts(target, [f"macs/to/unity/0/{n}/ros/4000" for n in range(200, 250)], [_to_headset(metadata(), b"x")])


@attack(2, "mesh")
def bad_samples_to_headsets(target: Target) -> None:
    """What is no frame, at full rate, on each key on which the gateway listens."""
    puts(target, _everybody(target), [b"", b"x", bytes(64), message(b"{}", b"x")])


@attack(2, "mesh")
def streams_at_full_rate(target: Target) -> None:
    """Topic data of the robot's own name at full rate."""
    said = management("RosAgentSubscriberDataForwarder", dest_agents={"2": [2, 3, 4]})
    about = metadata(sender_agent_type=ROS, node_type=1, node_name="nd__x")
    puts(target, [f"macs/from/ros/{target.robot}/nd__x"], [frame(said, about, bytes(64))])


@attack(3, "mesh", seen=True)
def status_queries(target: Target) -> None:
    """The verb ``status`` at full rate."""
    queries(target, "status")


@attack(3, "mesh", seen=True)
def offers_queries(target: Target) -> None:
    """The verb ``offers`` at full rate: what somebody may ask who may only see."""
    queries(target, "offers")


@attack(3, "mesh")
def control_queries(target: Target) -> None:
    """The verb ``control`` at full rate."""
    queries(target, "control", b'{"action":"take","topic":"/cmd_vel"}')


@attack(3, "mesh")
def add_node_queries(target: Target) -> None:
    """The verb ``add_node`` at full rate, for a topic, and what is no JSON."""
    node = {"registrantAgentType": 2, "registrantAgentId": 4000, "nodeType": 1, "nodeName": "nd__q", "tosName": "/q"}
    queries(target, "add_node", json.dumps({**node, "dataExchangeType": "std_msgs/String"}).encode())


@attack(3, "mesh")
def definitions_queries(target: Target) -> None:
    """The verb ``definitions`` at full rate, for 256 types that there are not in packages that there are."""
    names = [f"sensor_msgs/msg/A{number}" for number in range(256)]
    queries(target, "definitions", json.dumps({"types": names}).encode())


@attack(3, "mesh")
def bad_queries(target: Target) -> None:
    """Queries at full rate without a frame in them."""
    queries(target, "status", payload=b"x")


@attack(3, "mesh")
def ping_queries(target: Target) -> None:
    """The verb ``ping`` at full rate."""
    queries(target, "ping", bytes(32))


@attack(3, "mesh")
def large_ping_queries(target: Target) -> None:
    """The verb ``ping`` at full rate with 256 KiB to send back."""
    queries(target, "ping", bytes(256 << 10))


@attack(3, "mesh")
def release_queries(target: Target) -> None:
    """The verb ``stop`` with ``false`` at full rate, by somebody who may not release."""
    queries(target, "stop", b"false")


@attack(3, "operator")
def status_queries_of_an_operator(target: Target) -> None:
    """The verb ``status`` at full rate by an operator."""
    queries(target, "status", caller="operator/9")


@attack(3, "operator")
def ping_queries_of_an_operator(target: Target) -> None:
    """The verb ``ping`` at full rate by an operator, with 64 KiB to send back."""
    queries(target, "ping", bytes(64 << 10), caller="operator/9")


@attack(3, "mesh")
def queries_of_all_verbs_from_many(target: Target) -> None:
    """Each verb at full rate, from ever other callers."""
    asked = frame(metadata=metadata(), to=ROS, ids=[target.robot])
    with session(target) as mesh:
        number, answered = 0, [0]

        def count(_reply: object) -> None:
            answered[0] += 1

        while target.running():
            for verb in ("status", "offers", "control", "remove_node", "add_node", "ping", "none"):
                number += 1
                key = f"macs/call/ros/{target.robot}/{verb}/unity/{4000 + number % 5000}"
                mesh.get(key, count, payload=asked, priority=URGENT, timeout=1.0)
            if number - answered[0] > OPEN_QUERIES:
                target.rest(0.001)


@attack(2, "mesh", seen=True)
def twenty_thousand_tokens(target: Target) -> None:
    """20 000 presence tokens of one session."""
    with session(target) as mesh:
        tokens = []
        for number in range(20_000):
            if not target.running():
                break
            tokens.append(
                mesh.liveliness().declare_token(
                    PRESENCE.of(type=UNITY, id=4000 + number, group=0, zid=str(mesh.zid()))
                )
            )
        while target.rest(0.2):
            pass


@attack(2, "mesh")
def one_agent_of_many_sessions(target: Target) -> None:
    """20 000 presence tokens for one headset, each as another session's, again and again."""
    number = 0
    with session(target) as mesh:
        while target.running():
            tokens = []
            for _ in range(20_000):
                number += 1
                tokens.append(mesh.liveliness().declare_token(f"macs/live/unity/15/4000/0/{number:032x}"))
                if not target.running():
                    return
            for token in tokens:
                token.undeclare()


@attack(2, "mesh")
def tokens_that_come_and_go(target: Target) -> None:
    """Presence tokens declared and undeclared at full rate."""
    with session(target) as mesh:
        number = 0
        while target.running():
            tokens = []
            for _ in range(200):
                number += 1
                key = PRESENCE.of(type=UNITY, id=4000 + number % 50_000, group=number % 256, zid=str(mesh.zid()))
                tokens.append(mesh.liveliness().declare_token(key))
            for token in tokens:
                token.undeclare()


@attack(2, "mesh")
def leases_of_every_block(target: Target) -> None:
    """Lease tokens for all 256 blocks, with a Zenoh id smaller than any, again and again."""
    with session(target) as mesh:
        while target.running():
            tokens = [mesh.liveliness().declare_token(f"macs/block/{block}/fffffff0") for block in range(1, 256)]
            target.rest(0.3)
            for token in tokens:
                token.undeclare()


@attack(2, "mesh", seen=True)
def a_thousand_agents_and_questions(target: Target) -> None:
    """1 000 agents online by tokens, while two headsets ask at full rate who is."""
    from tests.attack.floods import flood

    with session(target) as mesh:
        tokens = []
        for number in range(1000):
            tokens.append(
                mesh.liveliness().declare_token(
                    PRESENCE.of(type=UNITY, id=4000 + number, group=0, zid=str(mesh.zid()))
                )
            )
        asking = frame(management("OnlineAgentsGetter", agent_type=2, agent_id=1), metadata())
        flood(target, asking, agents=2)


@attack(2, "mesh")
def sessions_that_come_and_go(target: Target) -> None:
    """Zenoh sessions with a presence token each, that end at once."""
    while target.running():
        with suppress(zenoh.ZError), session(target) as mesh:
            token = mesh.liveliness().declare_token(f"macs/live/unity/15/4000/0/{mesh.zid()}")
            time.sleep(0.01)
            token.undeclare()


@attack(2, "mesh")
def pings_of_every_program(target: Target) -> None:
    """``macs/ping/**`` at full rate, which every program answers."""
    with session(target) as mesh:
        answered, sent = [0], 0

        def count(_reply: object) -> None:
            answered[0] += 1

        while target.running():
            mesh.get("macs/ping/**", count, payload=bytes(1024), priority=URGENT, timeout=1.0)
            sent += 1
            if sent - answered[0] > OPEN_QUERIES:
                target.rest(0.001)


@attack(3, "mesh")
def traces_of_everything(target: Target) -> None:
    """Every program is asked to mark all that it puts and to note all that is marked, is sent marked messages, and is
    asked at full rate for all that it has noted."""
    wanted = [{"put": put, "every": 1, "look": True, "seconds": 60} for put in ("", "m", "macs/to/", "macs/from/")]
    asked = [b"macs: trace " + json.dumps(each).encode() for each in wanted]
    mark = struct.pack("<4sQB", b"mtr1", 7, 0)
    said = _to_headset(metadata(message_manager="Hello"), b"x")
    with session(target) as mesh:
        answered, sent = [0], 0

        def count(_reply: object) -> None:
            answered[0] += 1

        while target.running():
            for question in asked:
                mesh.get("macs/ping/**", count, payload=question, priority=URGENT, timeout=1.0)
            for key in _everybody(target):
                mesh.put(key, said, attachment=mark)
            sent += len(asked)
            if sent - answered[0] > OPEN_QUERIES:
                target.rest(0.001)
