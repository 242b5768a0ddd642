"""A robot agent that ends while its ROS thread does nothing any more: what moves is stopped nevertheless."""

from __future__ import annotations

import asyncio
import threading
from contextlib import AsyncExitStack

import macs_zenoh
from bridge.ros.program import open_robot
from bridge.settings import RobotSettings, Settings, TopicRule
from bridge.settings.robot import AsJpeg
from tests.ros.driven import STOPPED, driving, hear, may_command
from tests.support.local import patient
from tests.support.ros_peer import ROBOT, Peer
from tests.support.waiting import until

RULES = [
    TopicRule(match="/cmd_vel", deadman_s=60, deadman_message={"linear": {"z": -1}}),
    TopicRule(match="/camera/**", as_jpeg=AsJpeg()),
]


async def test_the_stop_message_comes_first(router: str, domain: int, peer: Peer) -> None:
    """Commands flow, the ROS thread hangs, and the robot is ended: the stop message comes before anything is asked of
    that thread."""
    heard = await hear(peer)
    settings = Settings(mesh=patient(router), robot=RobotSettings(id=ROBOT, rules=RULES))
    release, hangs = threading.Event(), threading.Event()
    async with macs_zenoh.join("unity", settings=patient(router)) as driver, AsyncExitStack() as stack:
        robot = await stack.enter_async_context(open_robot(settings, domain_id=domain))
        await may_command(driver, ROBOT)
        async with driving(driver, ROBOT):
            await until(lambda: heard.values and heard.last == 0.5)
            robot.session.submit(lambda: (hangs.set(), release.wait(100)))
            await until(hangs.is_set)
            ending = asyncio.create_task(stack.aclose())
            try:
                await until(lambda: heard.last == STOPPED)
                assert not release.is_set()
            finally:
                release.set()
                await ending
            assert heard.last == STOPPED
