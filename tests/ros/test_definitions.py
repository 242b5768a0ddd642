"""The verb ``definitions`` of a real robot agent, for every type that is installed and for types of one's own."""

from __future__ import annotations

import asyncio
import sys
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import msgspec
import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

import macs_zenoh
from bridge.ros.definitions import Definitions, Telling, _written
from macs_zenoh import robot_types
from macs_zenoh.agent import Agent
from macs_zenoh.protocol.limits import ANSWER_BYTES
from macs_zenoh.protocol.schemas import DefinitionsReply, schema
from tests.support.programs import Program
from tests.support.ros_peer import Peer
from tests.support.routers import Router
from tests.support.thorough import some
from tests.support.waiting import until

SHARE = Path(sys.prefix) / "share"
MESSAGES = sorted(f"{path.parts[-3]}/msg/{path.stem}" for path in SHARE.glob("*/msg/*.msg"))
SERVICES = sorted(f"{path.parts[-3]}/srv/{path.stem}" for path in SHARE.glob("*/srv/*.srv"))


@pytest.fixture
async def agent(domain: int, kinds: Any) -> AsyncIterator[Agent]:
    """An agent on the mesh of robot 7; types of the test's own package are installed there."""
    async with (
        Router() as router,
        Program("agent", "--id", "7", "-e", router.endpoint, env={"ROS_DOMAIN_ID": str(domain)}),
        macs_zenoh.join("unity", connect=[router.endpoint]) as agent,
    ):
        yield agent


async def asked(agent: Agent, *types: str) -> DefinitionsReply:
    return await robot_types.definitions(lambda verb, data: agent.call("ros", 7, verb, data, timeout_s=60), types)


async def test_every_installed_type_has_a_schema_that_others_read(agent: Agent) -> None:
    """Each text is that of the package's file, and parsed by somebody else it has the hash that the robot tells."""
    told = await asked(agent, *MESSAGES, *SERVICES)
    assert len(MESSAGES) > 100
    assert not told.left
    assert not told.missing
    assert set(told.definitions) >= {*MESSAGES, *SERVICES}
    store = get_typestore(Stores.EMPTY)
    for name in some(MESSAGES):
        package, kind, short = name.split("/")
        assert told.definitions[name].text == (SHARE / package / kind / f"{short}.msg").read_text()
        text = schema(name, told.definitions)
        assert text, name
        store.register(get_types_from_msg(text, name))
        if "char" not in text:  # which rosbags hashes otherwise than ROS
            assert store.hash_rihs01(name) == told.definitions[name].hash, name
    for name in SERVICES:
        assert told.definitions[name].hash.startswith("RIHS01_")
        assert schema(f"{name}_Request", told.definitions) is not None
        assert schema(f"{name}_Response", told.definitions) is not None


async def test_without_names_all_that_the_robot_offers(agent: Agent, peer: Peer, kinds: Any) -> None:
    """Who asks for nothing in particular gets the types of its topics, its own packages' among them."""
    await peer.publisher(kinds.Kinds, "/kinds")

    async def offered() -> DefinitionsReply:
        return await asked(agent)

    async def has_it() -> bool:
        return "macs_kinds_msgs/msg/Kinds" in (await offered()).definitions

    await until(has_it, every_s=0.2)
    told = await offered()
    text = schema("macs_kinds_msgs/msg/Kinds", told.definitions)
    assert text is not None
    assert "MSG: geometry_msgs/Point\n" in text
    assert "rcl_interfaces/msg/Log" not in told.definitions


async def test_what_is_not_installed_is_told_with_a_reason(agent: Agent) -> None:
    """Names of no type, of none that is installed, and paths: a reason for each, and what else was asked for."""
    bad = [
        "no_such_msgs/msg/Any",
        "std_msgs/msg/Nope",
        "../../etc/passwd",
        "std_msgs/msg/../../x",
        "a/b/c",
        "std_msgs",
    ]
    told = await asked(agent, *bad, "std_msgs/msg/String")
    assert set(told.definitions) == {"std_msgs/msg/String"}
    assert len(told.missing) == len(bad)
    assert "is not installed on this robot" in told.missing["std_msgs/msg/Nope"]
    assert not any("Traceback" in reason for reason in told.missing.values())


@pytest.mark.parametrize(
    "request_data", [b"{", b"[]", b'{"types": 5}', msgspec.json.encode({"types": ["a/msg/B"] * 257}), b"x" * 70_000]
)
async def test_bad_requests_are_refused(agent: Agent, request_data: bytes) -> None:
    """What is no request is refused with a reason, and the robot goes on."""
    with pytest.raises(macs_zenoh.Refused):
        await agent.call("ros", 7, "definitions", request_data, timeout_s=60)
    assert (await asked(agent, "std_msgs/msg/String")).definitions


def test_an_answer_has_an_end() -> None:
    """What does not fit into one answer is named, so that it can be asked for, and nothing is told twice."""
    robot, found, waiting = Definitions(), dict[str, Any](), [*MESSAGES, *(f"a{n}_msgs/msg/X" for n in range(3000))]
    rounds = 0
    while waiting:
        told = robot.tell(waiting)
        assert len(msgspec.json.encode(told)) < ANSWER_BYTES
        assert told.definitions or told.missing
        found |= told.definitions
        waiting = told.left
        rounds += 1
    assert set(found) == set(MESSAGES)
    assert rounds < 10


def test_a_type_without_a_text_is_written_from_its_class(kinds: Any) -> None:
    """Of packages that ship .idl alone: what is written has the same fields, so that it reads the same bytes."""
    from_file = Definitions().tell(["macs_kinds_msgs/msg/Kinds"]).definitions
    text = schema("macs_kinds_msgs/msg/Kinds", from_file)
    assert text is not None
    ours, others = get_typestore(Stores.EMPTY), get_typestore(Stores.EMPTY)
    name = "macs_kinds_msgs/msg/Kinds"
    # what rosbags does not know, or knows by another name
    plain = text.replace("wstring", "string").replace("char[", "uint8[").replace("char ", "uint8 ")
    ours.register(get_types_from_msg(plain, name))
    own, _, needed = plain.partition("=" * 80)
    written = _written(kinds.Kinds).replace("wstring", "string")
    others.register(get_types_from_msg(f"{written}{'=' * 80}{needed}", name))
    assert ours.fielddefs[name][1] == others.fielddefs[name][1]
    assert own


async def test_many_asking_at_once(agent: Agent) -> None:
    """As many as may wait of one sender: each gets the same."""
    asking = (asked(agent, "geometry_msgs/msg/PoseStamped") for _ in range(Telling.EACH))
    told = await asyncio.gather(*asking)
    assert all(each == told[0] for each in told)
