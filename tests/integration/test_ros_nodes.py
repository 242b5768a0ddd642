"""Python programs as ROS nodes, without ROS: with each other, and the shipped example."""

from __future__ import annotations

import asyncio
import sys
from pathlib import Path

import pytest

import macs_zenoh
from macs_zenoh import ros
from macs_zenoh.protocol.rmw_zenoh.keyexpr import Kind
from tests.support.waiting import PATIENCE_S, until

pytest.importorskip("xxhash", reason="being a ROS node needs xxhash: pip install 'macs-zenoh[rmw-zenoh]'")

EXAMPLE = Path(__file__).parents[2] / "examples" / "ros_node.py"
LATCHED = ros.Qos(durability=ros.Durability.TRANSIENT_LOCAL, depth=3)
TEXT = "std_msgs/String"


async def test_the_example_is_a_node(router: str) -> None:
    """Its topic is heard, its service answers, and it is in the graph."""
    process = await asyncio.create_subprocess_exec(sys.executable, str(EXAMPLE), router)
    try:
        async with ros.node("listener", connect=[router]) as node:
            heard = node.subscribe("/chatter", TEXT)
            message = await asyncio.wait_for(heard.receive(), PATIENCE_S)
            assert message.value == {"data": "hello"}
            assert await node.call("/lamp", "std_srvs/SetBool", {"data": False}, timeout_s=PATIENCE_S) == {
                "success": True,
                "message": "off",
            }
            graph = node.network.graph(0)
            assert "/hello" in {one.full_name for one in graph.nodes(others=True)}
            assert ("/chatter", ["std_msgs/msg/String"]) in graph.names_and_types()
    finally:
        process.terminate()
        await process.wait()


async def test_topics_in_order_and_what_is_held_for_late_ones(router: str) -> None:
    """Messages come in their order with their numbers; of a latched topic the last ones to who comes later, once."""
    async with (
        ros.node("talker", namespace="/robot1", connect=[router]) as talker,
        ros.node("listener", connect=[router]) as listener,
    ):
        held = talker.publisher("map", TEXT, qos=LATCHED)
        assert held.topic == "/robot1/map"
        early = listener.subscribe("/robot1/map", TEXT, qos=LATCHED)
        graph = talker.network.graph(0)
        await until(lambda: graph.on("/robot1/map", Kind.SUBSCRIPTION, others=True))  # not what is held
        for number in range(5):
            held.publish({"data": str(number)})
        for number in range(5):  # they have passed the router, and none of them is on its way to who comes later
            assert (await asyncio.wait_for(early.receive(), PATIENCE_S)).value["data"] == str(number)
        late = listener.subscribe("/robot1/map", TEXT, qos=LATCHED)
        got = [(await asyncio.wait_for(late.receive(), PATIENCE_S)).value["data"] for _ in range(3)]
        assert got == ["2", "3", "4"]
        held.publish({"data": "5"})
        last = await asyncio.wait_for(late.receive(), PATIENCE_S)
        assert (last.value["data"], last.number) == ("5", 6)


async def test_services_answer_or_say_why_not(router: str) -> None:
    """A call has an answer, in its caller's form; without a service, and when it fails, it says so in time."""

    async def switch(request: dict[str, bool]) -> dict[str, object]:
        if request["data"]:
            raise RuntimeError("no")
        return {"success": True}

    async with ros.node("one", connect=[router]) as one, ros.node("two", connect=[router]) as two:
        with pytest.raises(macs_zenoh.Unreachable, match="no such service"):
            await two.call("/lamp", "std_srvs/SetBool", {"data": False}, timeout_s=0.2)
        serving = one.serve("/lamp", "std_srvs/SetBool", switch)
        answer = await two.call("/lamp", "std_srvs/SetBool", b"\0\1\0\0\0")
        assert answer[:5] == b"\0\1\0\0\1"
        with pytest.raises(macs_zenoh.Unreachable):
            await two.call("/lamp", "std_srvs/SetBool", {"data": True}, timeout_s=1.0)
        serving.close()
        graph = two.network.graph(0)
        await until(lambda: graph.on("/lamp", ros.Kind.SERVICE) == [])
