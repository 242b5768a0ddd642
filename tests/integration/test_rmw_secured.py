"""Robots that run rmw_zenoh behind certificates: each is held to the namespace of its own sessions."""

from __future__ import annotations

from contextlib import AbstractAsyncContextManager, AsyncExitStack
from pathlib import Path

import pytest

from macs_zenoh import ros
from tests.support.programs import Program, macs
from tests.support.routers import Router
from tests.support.secured import made
from tests.support.waiting import PATIENCE_S, until

pytest.importorskip("xxhash", reason="being a ROS node needs xxhash: pip install 'macs-zenoh[rmw-zenoh]'")
pytestmark = pytest.mark.timeout(300)

CLIENTS = """
robots:
  - {name: robot-7, id: 7, ros_namespace: robot7}
  - {name: robot-8, id: 8, ros_namespace: robot8}
gateways: [{name: hall-1, blocks: [1]}]
operators: [{name: anna}]
permissions:
  - {who: hall-1, may: [command, see, call], whom: [robot-7, robot-8]}
  - {who: anna, may: call, verbs: [status], whom: robots}
"""
STRING = "std_msgs/String"


async def test_the_check_holds_certificates_to_their_namespaces(tmp_path: Path) -> None:
    """With the rules that are written all is as it should be; where both robots' are loosened, it says what passes."""
    found = made(tmp_path / "pki", CLIENTS)
    async with Router(found.file()):
        assert await found.wrong() == []
    text = found.file().read_text(encoding="utf-8")
    loosened = text.replace('"robot8/**"', '"robot$*/**"')
    assert loosened != text
    found.file().write_text(loosened, encoding="utf-8")
    async with Router(found.file()):
        wrong = [one.what for one in await found.wrong()]
    assert "robot-7 puts to its ROS nodes, heard by robot-8" in wrong
    assert any(what.startswith("robot-8 puts as robot-7 to its ROS nodes") for what in wrong), wrong


async def test_a_robot_is_its_own_nodes_only(tmp_path: Path) -> None:
    """`macs rmw-zenoh` with what was written for the robot presents it. Who has another robot's certificate says
    nothing to its nodes, hears nothing of them and is none of them."""
    found = made(tmp_path / "pki", CLIENTS)

    def node(name: str, certificate: str, namespace: str) -> AbstractAsyncContextManager[ros.Node]:
        return ros.node(name, settings=found.settings(certificate), session_namespace=namespace)

    async with AsyncExitStack() as stack:
        enter = stack.enter_async_context
        await enter(Router(found.file()))
        operator = ("--settings", str(found.directory / "anna" / "macs.toml"))

        async def online() -> list[int]:
            return [one["id"] for one in await macs("ls", "--json", *operator) if one["type"] == "ros"]

        for name in ("robot-7", "robot-8"):
            await enter(Program("rmw-zenoh", "--settings", str(found.directory / name / "macs.toml")))
        intruder = await enter(node("intruder", "robot-8", "robot7"))
        spying = intruder.subscribe("/chatter", STRING)
        forged = intruder.publisher("/orders", STRING)
        talker = await enter(node("talker", "robot-7", "robot7"))
        listener = await enter(node("listener", "robot-7", "robot7"))
        orders, heard = talker.subscribe("/orders", STRING), listener.subscribe("/chatter", STRING)
        says, commands = talker.publisher("/chatter", STRING), listener.publisher("/orders", STRING)

        def both() -> bool:
            forged.publish({"data": "forged"})
            says.publish({"data": "mine"})
            commands.publish({"data": "mine"})
            return len(orders._waiting) > 10 and len(heard._waiting) > 10

        await until(both, PATIENCE_S, every_s=0.05)
        assert {message.value["data"] for message in orders._waiting} == {"mine"}
        assert not spying._waiting
        names = {one.full_name for one in talker._ros.graph.nodes()}
        assert names == {"/talker", "/listener", "/rosagent"}
        assert {one.full_name for one in intruder._ros.graph.nodes(others=True)} == set()

        async def alone() -> bool:
            return await online() == [7]

        await until(alone, PATIENCE_S)
        async with node("arm", "robot-8", "robot8"):

            async def together() -> bool:
                return await online() == [7, 8]

            await until(together, PATIENCE_S)
