"""`macs rmw-zenoh --mode router`: the program is the router of the robot's nodes itself, and of who else connects."""

from __future__ import annotations

from contextlib import AsyncExitStack

import pytest

from bridge.headset.client import Headset
from macs_zenoh import ros
from macs_zenoh.protocol.rmw_zenoh.cdr import read_text, written_text
from tests.support.programs import Program, ended, free_port
from tests.support.routers import Router
from tests.support.waiting import PATIENCE_S, until

pytest.importorskip("xxhash", reason="being a ROS node needs xxhash: pip install 'macs-zenoh[rmw-zenoh]'")
pytestmark = pytest.mark.timeout(300)


async def used(headset: Headset, endpoint: str) -> None:
    """A node of the robot's comes, is used by the headset in each way, and goes."""

    async def online() -> bool:
        return 7 in (await headset.online()).ros_agent_ids

    async with ros.node("base", connect=[endpoint]) as node:
        await until(online, PATIENCE_S)
        chatter = node.publisher("/chatter", "std_msgs/String")
        orders = node.subscribe("/orders", "std_msgs/String")

        async def lamp(request: dict[str, bool]) -> dict[str, object]:
            return {"success": request["data"], "message": "lamp"}

        node.serve("/lamp", "std_srvs/SetBool", lamp)
        heard: list[bytes] = []
        await headset.subscribe(
            "/chatter", "std_msgs/String", agents=[7], callback=lambda one: heard.append(bytes(one.data))
        )
        told = await headset.advertise("/orders", "std_msgs/String", agents=[7])

        async def both() -> bool:
            chatter.publish({"data": "here"})
            await told.publish(written_text(b"go"))
            return bool(heard and orders._waiting)

        await until(both, PATIENCE_S, every_s=0.05)
        assert read_text(heard[-1]) == b"here"
        answer = await headset.call("/lamp", "std_srvs/SetBool", 7, b"\0\1\0\0\1", timeout_s=PATIENCE_S)
        assert answer[4:5] == b"\1"

    async def offline() -> bool:
        return not await online()

    await until(offline, PATIENCE_S)


@pytest.mark.parametrize("linked", [False, True])
async def test_a_robot_s_own_router(linked: bool) -> None:
    """A gateway on it, or on a router that it is linked with: topics both ways, a service; nodes go and come back."""
    async with AsyncExitStack() as stack:
        enter = stack.enter_async_context
        own = f"tcp/127.0.0.1:{free_port()}"
        mesh = (await enter(Router())).endpoint if linked else own
        link = ("-e", mesh) if linked else ()
        program = await enter(Program("rmw-zenoh", "--id", "7", "--mode", "router", "-l", own, *link))
        assert program.ready == "robot 7 (domain 0)"
        gateway = await enter(Program("gateway", "--port", "0", "-e", mesh))
        for _ in range(2):
            async with await Headset.connect("127.0.0.1", gateway.port) as headset:
                await used(headset, own)


async def test_one_session_has_no_namespaces() -> None:
    """What needs a second session is refused in words."""
    code, _, errors = await ended(
        "rmw-zenoh", "--id", "7", "--session-namespace", "robot7", "--mode", "router", "-l", "tcp/127.0.0.1:0"
    )
    assert code == 2
    assert "session_namespace: with mode router there is one session" in errors
