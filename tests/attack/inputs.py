"""Single frames that used to cost, or could cost, much more than their sender: sections 1 and 4.

Each is sent again every half second, since one that costs 30 ms would hide in a percentile.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import suppress

from tests.attack import raw
from tests.attack.raw import ROS, Agent, frame, management, metadata, node_data, registration, request
from tests.attack.table import Target, attack

EVERY_S = 0.5
MIB = 1 << 20
HUGE = 31 * MIB
"""Just below what a gateway takes as one frame."""
LONG = "n" * 70_000
"""Longer than a Zenoh key may be."""


def repeatedly(target: Target, *frames: bytes, agent_type: int = raw.UNITY) -> None:
    """Send them on one connection again and again; a connection that is ended for it is made anew."""
    agent: Agent | None = None
    while target.running():
        with suppress(OSError):
            agent = agent or Agent(target.port, agent_type=agent_type)
            if not all(agent.send(each) for each in frames):
                agent.close()
                agent = None
        target.rest(EVERY_S)


def unknown_keys(size: int) -> bytes:
    """An object of about so many bytes with as many keys as possible."""
    keys = (b'"%x":0' % number for number in range(size // 11))
    return b"{" + b",".join(keys) + b"}"


# -- names that become keys ------------------------------------------------------------------------------------------


@attack(1, "headset", single=True, seen=True)
def long_node_name(target: Target) -> None:
    """A registration with a node name of 70 000 characters."""
    repeatedly(target, registration(LONG, "/x"))


@attack(1, "headset", single=True)
def long_node_name_for_a_group(target: Target) -> None:
    """The same for the robots of a group."""
    repeatedly(target, registration(LONG, "/x", agents=[], groups=[1, 255]))


@attack(1, "tcp robot", single=True, seen=True)
def long_node_name_on_a_stream(target: Target) -> None:
    """Topic data of a TCP robot under a node name of 70 000 characters, for every headset."""
    repeatedly(target, _stream({"2": list(range(1, 9))}, LONG), agent_type=ROS)


@attack(1, "headset", single=True)
def long_texts(target: Target) -> None:
    """70 000 characters in each member in turn: topic, type, manager, names of keys, of messages to robots."""
    repeatedly(
        target,
        registration("nd__x", "/" + LONG),
        registration("nd__x", "/x", LONG),
        registration("nd__x", "/x", add=False) + registration(LONG, "/x", add=False),
        node_data(LONG, bytes(8)),
        node_data("nd__x", bytes(8), kind=LONG),
        request(LONG),
        frame(management(LONG)),
        frame(metadata=metadata(message_manager=LONG)),
        frame(metadata=metadata(**{LONG: 1})),
        frame(management("OnlineAgentsGetter", **{LONG: 1}), metadata()),
    )


@attack(1, "headset", single=True)
def names_near_the_limit_of_a_key(target: Target) -> None:
    """Node names of 250 to 65 535 characters, plain ones and ones that grow threefold when they are escaped."""
    lengths = (250, 255, 256, 4_000, 21_800, 65_400, 65_500, 65_535)
    names = [letter * length for length in lengths for letter in "n%/"]
    repeatedly(target, *(registration(name, "/x") for name in names))


# -- much to parse ---------------------------------------------------------------------------------------------------


@attack(1, "headset", single=True, seen=True)
def unknown_keys_as_metadata(target: Target) -> None:
    """31 MiB of metadata with 2.7 million unknown keys, to all headsets."""
    repeatedly(target, frame(metadata=unknown_keys(HUGE)))


@attack(1, "headset", single=True, seen=True)
def unknown_keys_as_management(target: Target) -> None:
    """31 MiB of management data with 2.7 million unknown keys."""
    repeatedly(target, frame(unknown_keys(HUGE)))


@attack(1, "headset", single=True, seen=True)
def empty_lists_as_management(target: Target) -> None:
    """31 MiB of ``[],`` as management data, which become hundreds of MB of lists."""
    repeatedly(target, frame(b'{"messageManager":"HeartbeatHandler","x":[' + b"[]," * (HUGE // 3) + b"[]]}"))


@attack(1, "headset", single=True)
def empty_lists_as_metadata(target: Target) -> None:
    """The same as metadata of a message to a robot."""
    said = b'{"nodeName":"nd__x","x":[' + b"[]," * (HUGE // 3) + b"[]]}"
    repeatedly(target, frame(metadata=said, to=ROS, ids=[target.robot]))


@attack(1, "headset", single=True, seen=True)
def keys_as_data_of_a_request(target: Target) -> None:
    """31 MiB of keys as data of RobotControl, which only the robot reads."""
    repeatedly(target, request("RobotControl", unknown_keys(HUGE)))


@attack(1, "headset", single=True)
def keys_as_data_of_every_request(target: Target) -> None:
    """1 MiB of keys as data of each question a robot answers, and of registrations."""
    keys = unknown_keys(MIB)
    known = ("FunctionalityGetter", "RobotStatus", "RobotControl", "InterfaceNodeAdder", "AgentConfigurer")
    inner = registration("nd__x", "/x", **{"x" + str(number): number for number in range(50_000)})
    repeatedly(target, *(request(name, keys) for name in known), inner)


@attack(1, "headset", single=True)
def registration_with_a_huge_request(target: Target) -> None:
    """A registration whose inner message, passed on to the robot, has 31 MiB of keys."""
    outer = management(
        "RosAgentNodeRegistrationForwarder",
        registrant_agent_id=1,
        registrar_agent_ids=[target.robot],
        registrar_group_ids=[],
        node_type=1,
        node_name="nd__x",
        tos_name="/x",
        data_exchange_type="std_msgs/String",
    )
    repeatedly(target, frame(outer, metadata(message_manager="InterfaceNodeAdder"), unknown_keys(HUGE)))


@attack(1, "headset", single=True)
def deep_nesting(target: Target) -> None:
    """A million opening brackets as metadata, management data, data of a request and of a registration."""
    lists, objects = b"[" * MIB, b'{"a":' * (MIB // 5)
    frames = [
        f for deep in (lists, objects) for f in (frame(deep), frame(metadata=deep), request("RobotControl", deep))
    ]
    inner = b'{"messageManager":"InterfaceNodeAdder","x":' + lists
    repeatedly(target, *frames, frame(metadata=inner, to=ROS, ids=[target.robot]))


@attack(1, "headset", single=True)
def huge_numbers(target: Target) -> None:
    """Integers of a million digits and exponents without end, wherever a number may stand."""
    digits = b"9" * MIB
    numbers = (digits, b"1e" + digits[:6], b"-" + digits, b"1." + digits)
    frames = []
    for number in numbers:
        frames.append(frame(metadata=b'{"requestId":' + number + b"}"))
        frames.append(frame(b'{"messageManager":"OnlineAgentsGetter","agentId":' + number + b"}", metadata()))
        frames.append(request("RobotControl", b'{"to":' + number + b"}"))
    repeatedly(target, *frames)


@attack(1, "headset", single=True)
def long_strings(target: Target) -> None:
    """Strings of 8 MiB, plain and of escapes that take six bytes each, as values in metadata and management data."""
    plain, escaped = b"x" * (8 * MIB), rb"\u0041" * (8 * MIB // 6)
    frames = []
    for text in (plain, escaped):
        frames.append(frame(metadata=b'{"messageManager":"' + text + b'"}'))
        frames.append(frame(b'{"messageManager":"' + text + b'"}'))
    repeatedly(target, *frames)


@attack(1, "headset", single=True)
def the_same_key_again_and_again(target: Target) -> None:
    """A million times the same key, in all three spellings."""
    keys = b",".join([b'"nodeName":"a"', b'"NodeName":"b"', b'"node_name":"c"'] * (MIB // 16))
    repeatedly(
        target, frame(metadata=b"{" + keys + b"}"), frame(b'{"messageManager":"HeartbeatHandler",' + keys + b"}")
    )


@attack(1, "headset", single=True)
def whitespace(target: Target) -> None:
    """31 MiB of blanks before a closing brace: short when read, long to read."""
    repeatedly(target, frame(b'{"messageManager":"HeartbeatHandler"' + b" " * HUGE + b"}"))


@attack(1, "tcp robot", single=True)
def huge_functionality(target: Target) -> None:
    """A robot that says in its configuration that it offers 300 000 topics."""
    offered = {f"/t{number}": "a/msg/B" for number in range(300_000)}
    said = {"subscribers": offered, "publishers": {}, "services": {}}
    configuration = management("AgentclientConfigurer", agent_type=1, agent_id=1, functionality=said)
    repeatedly(target, frame(configuration), agent_type=ROS)


@attack(1, "tcp robot", single=True)
def stream_for_60_000_headsets(target: Target) -> None:
    """Topic data that lists 60 000 receivers, each of them ten times, of five types."""
    ids = list(range(1, 60_001))
    repeatedly(target, _stream({"2": ids}), _stream({str(kind): ids * 2 for kind in range(1, 6)}), agent_type=ROS)


@attack(1, "headset", single=True)
def absurd_values(target: Target) -> None:
    """Buffer sizes, ids, groups and node types at and beyond their ends, null and of the wrong type."""
    frames = [registration("nd__x", "/x", buffer=size) for size in (0, -1, 2**31, 2**63, 2**64, 10**30)]
    frames += [registration("nd__x", "/x", node_type=kind) for kind in (-1, 0, 6, 255, 256, 2**40)]
    frames += [registration("nd__x", "/x", agents=[each]) for each in (-1, 0, 65_535, 65_536, 2**64)]
    frames += [registration("nd__x", "/x", agents=[], groups=[each]) for each in (-1, 0, 255, 256, 2**64)]
    frames += [registration("nd__x", "/x", me=each) for each in (-1, 0, 65_535, 65_536)]
    for value in (b"null", b"[]", b"{}", b'"x"', b"true", b"-1", b"1e99", b'"\\ud800"'):
        for key in raw.KNOWN:
            frames.append(frame(metadata=b'{"' + key.encode() + b'":' + value + b"}", to=ROS, ids=[target.robot]))
    frames += [frame(metadata=metadata(), to=kind, ids=[1], groups=[1]) for kind in (3, 254, 255)]
    repeatedly(target, *frames)


@attack(1, "headset", single=True)
def names_that_are_no_names(target: Target) -> None:
    """Node names and topics with control characters, wildcards, slashes, surrogates, right-to-left marks, none."""
    names = ["", " ", "/", "*", "**", "$*", "a/b", "#", "?", "%", "\x00", "\x1b[2J\n", "\u202e", "é" * 100, "@adv"]
    for_group = [registration(name, "/x", agents=[], groups=[1]) for name in names]
    repeatedly(target, *(registration(name, f"/{name}") for name in names), *for_group, *map(_to_robot, names))


# -- other people's values -------------------------------------------------------------------------------------------


@attack(4, "headset", single=True, seen=True)
def empty_node_name_for_a_group(target: Target) -> None:
    """A registration with an empty node name for group 200, and then a TCP robot that joins group 200."""
    while target.running():
        with suppress(OSError):
            headset = Agent(target.port)
            headset.send(registration("", "/x", agents=[], groups=[200]))
            robot = Agent(target.port, agent_type=ROS, group=200)
            target.rest(EVERY_S)
            robot.close()
            headset.close()


@attack(4, "headset", single=True)
def bad_names_for_a_group(target: Target) -> None:
    """The same with every other name that no key can hold, and robots that come and go."""
    while target.running():
        with suppress(OSError):
            headset = Agent(target.port)
            for name in (".", "..", "\x00", "\ud800", "@", "%", LONG, "/", "*"):
                headset.send(registration(name, "/x", agents=[], groups=[200]))
                headset.send(registration(name, name, agents=[77], groups=[201]))
            robots = [Agent(target.port, agent_type=ROS, group=group) for group in (200, 201, 200)]
            target.rest(EVERY_S)
            for each in (*robots, headset):
                each.close(reset=True)


# -- inside ----------------------------------------------------------------------------------------------------------


def _stream(receivers: dict[str, list[int]], name: str = "nd__x") -> bytes:
    said = management("RosAgentSubscriberDataForwarder", dest_agents=receivers)
    about = metadata(sender_agent_type=ROS, node_type=1, node_name=name, data_exchange_type="std_msgs/String")
    return frame(said, about, bytes(16))


def _to_robot(name: str) -> bytes:
    return node_data(name, b"\x00\x01\x00\x00" + bytes(12))


def with_each_member(value: object) -> Iterator[bytes]:
    """Metadata in which one member after the other has this value."""
    for key in raw.KNOWN:
        yield json.dumps({key: value}).encode()
