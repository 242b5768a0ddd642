"""`macs rmw-zenoh --all`: a node without a namespace comes first, and then the robots of a fleet."""

from __future__ import annotations

from contextlib import AsyncExitStack

import pytest

import macs_zenoh
from macs_zenoh import ros
from macs_zenoh.errors import MacsError
from macs_zenoh.protocol.limits import ANSWER_BYTES
from macs_zenoh.protocol.messages import ROS, decode_data
from macs_zenoh.protocol.robot_state import Offered, RobotStatus
from tests.support.programs import Program, ended
from tests.support.routers import Router
from tests.support.waiting import PATIENCE_S, until

pytest.importorskip("xxhash", reason="being a ROS node needs xxhash: pip install 'macs-zenoh[rmw-zenoh]'")
pytestmark = pytest.mark.timeout(300)


async def test_robot_1_is_another_one_and_a_stop_holds() -> None:
    """Robot 1 is the domain's, is stopped, and is the namespace's from then on: it is on the mesh, and stopped."""
    async with AsyncExitStack() as stack:
        enter = stack.enter_async_context
        router = await enter(Router())
        where = [router.endpoint]
        agent = await enter(macs_zenoh.join("unity", id=300, connect=where))
        await enter(Program("rmw-zenoh", "--all", "-e", router.endpoint))
        tool = await enter(ros.node("tool", connect=where))
        tool.publisher("/tool", "std_msgs/String")

        async def offered() -> list[str]:
            try:
                answer = await agent.call(ROS, 1, "offers", timeout_s=2)
            except MacsError:  # robot 1 has left, and has not come yet
                return []
            return list(decode_data(Offered, answer, ANSWER_BYTES).publishers)

        async def is_the_domains() -> bool:
            return "/tool" in await offered()

        async def is_the_namespaces() -> bool:
            names = await offered()
            return "/robot1/pose" in names and "/tool" not in names

        await until(is_the_domains, PATIENCE_S)
        code, _, errors = await ended("stop", "1", "-e", router.endpoint)
        assert code == 0, errors
        for number in (1, 2):
            base = await enter(ros.node("base", namespace=f"/robot{number}", connect=where))
            base.publisher("pose", "std_msgs/String")
        await until(is_the_namespaces, PATIENCE_S)
        await until(lambda: agent.directory.ids(1) == [1, 2], PATIENCE_S)
        status = decode_data(RobotStatus, await agent.call(ROS, 1, "status"), ANSWER_BYTES)
        assert status.stopped
