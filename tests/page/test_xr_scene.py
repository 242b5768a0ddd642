"""The scene for headsets with a real robot, in a Chromium whose headset is emulated: it sees, drives, stops,
sends poses and comes back."""

from __future__ import annotations

import asyncio
import math
import time
from functools import partial
from typing import Any

import pytest

pytest.importorskip("rclpy")

from geometry_msgs.msg import PoseArray, PoseStamped
from sensor_msgs.msg import Joy

from tests.page.conftest import ROBOT, Site
from tests.page.driving import Heard, heard_at
from tests.page.headsets import PATIENT_ROBOT, UNDRAWN, Headset, about_up, headset_at, needs_headset
from tests.page.polls import until
from tests.support.browser import needs_browser
from tests.support.ros_peer import Peer

pytestmark = [needs_browser, needs_headset]
RULES = PATIENT_ROBOT + ROBOT
"""The robot is patient."""

POSES = {"head": "/xr/head", "right": "/xr/right", "rightHand": "/xr/right/hand", "joy": "/xr/joy"}


async def by_stick(headset: Headset, hand: str, x: float, y: float) -> None:
    """Hold the grip, and push the stick."""
    await headset.squeeze(hand, held=True)
    await headset.stick(hand, x, y)


async def released(headset: Headset, hand: str) -> None:
    await headset.stick(hand, 0, 0)
    await headset.squeeze(hand, held=False)


async def by_hand(headset: Headset, metres: float) -> None:
    """Pinch, and move the hand ahead."""
    await headset.place("rightHand", (0.2, 1.2, -0.3))
    await headset.pinch("right", 1)
    await headset.frame()
    await headset.place("rightHand", (0.2, 1.2, -0.3 - metres))


async def stands(headset: Headset, heard: Heard) -> None:
    """The last command is a zero, and none follows that drives."""
    await until(lambda: heard.last == 0.0)
    after = len(heard.speeds)
    await headset.frame(10)
    assert set(heard.speeds[after:]) <= {0.0}


async def test_it_sees_and_drives(site: Site) -> None:
    """Enter VR; the panel's pixels change as the robot turns; stick and hand drive it while they hold, and a zero
    follows; leave, come back, drive on; both face buttons stop it, also while it drives."""
    async with heard_at(site) as heard:
        headset = await headset_at(site)
        await headset.ready()
        await until(lambda: headset.state("maxAgeS === 10"))  # its commands tell when they were made
        await headset.page.set_viewport_size({"width": 1280, "height": 760})
        await headset.frame(4)
        await headset.shot("screen")
        await headset.page.set_viewport_size({"width": 640, "height": 420})
        await headset.enter()
        await headset.frame()
        before = await headset.pixels()
        assert len(set(before)) > 3, "there is nothing to be seen"
        await headset.drives(
            heard, partial(by_stick, headset, "right", -0.9, -0.6), partial(released, headset, "right")
        )
        await until(lambda: changed(headset, before))
        await headset.shot("driving")
        assert await headset.state("holder") in (None, "you")
        await released(headset, "right")
        await stands(headset, heard)
        await headset.stick("right", 0, -1)  # without its grip
        await headset.frame(5)
        assert heard.last == 0.0
        await headset.stick("right", 0, 0)

        await headset.drives(heard, partial(by_hand, headset, 0.2), partial(headset.pinch, "right", 0))
        await headset.shot("hands")
        await headset.pinch("right", 0)
        await stands(headset, heard)
        await headset.value("device.primaryInputMode = 'controller'")

        await headset.leave()
        await headset.shot("left")
        await headset.enter()
        await headset.drives(heard, partial(by_stick, headset, "left", 0, -1), partial(released, headset, "left"))
        await headset.button("right", "a-button", held=True)
        await headset.button("right", "b-button", held=True)
        await until(lambda: headset.value("macsXr.telling.stop.state === 'stopped'"))
        await stands(headset, heard)
        assert "stop" in await headset.state("barred")
        await headset.shot("stopped")
        for name in ("a-button", "b-button"):
            await headset.button("right", name, held=False)
        await released(headset, "left")
        await headset.value("(macsXr.release(), macsXr.release())")
        await until(lambda: headset.value("macsXr.telling.stop.state === 'free'"))
        await until(lambda: headset.state("barred === ''"))


async def changed(headset: Headset, before: list[int]) -> bool:
    return await headset.pixels() != before


async def newest(queue: asyncio.Queue[Any], fits: Any) -> Any:
    """The first message that fits."""
    while True:
        message = await asyncio.wait_for(queue.get(), 60)
        if fits(message):
            return message


def at(pose: Any) -> tuple[float, float, float]:
    return round(pose.position.x, 3), round(pose.position.y, 3), round(pose.position.z, 3)


async def test_poses_come_in_ros_axes(site: Site) -> None:
    """Head, controller, hand and buttons, each on the topic that was chosen: x is ahead, y to the left, z up."""
    peer = Peer(site.domain)
    try:
        heads = await peer.subscription(PoseStamped, "/xr/head", 100)
        rights = await peer.subscription(PoseStamped, "/xr/right", 100)
        hands = await peer.subscription(PoseArray, "/xr/right/hand", 100)
        joys = await peer.subscription(Joy, "/xr/joy", 100)
        headset = await headset_at(site, settings=POSES, size=UNDRAWN)
        await headset.ready()
        await headset.enter()
        print(await headset.value("JSON.stringify([macsXr.telling.last, macsXr.telling.state, [...macsXr.wanted]])"))
        await headset.place("head", (0.5, 1.5, -2.0), about_up(math.pi / 2))
        head = await newest(heads, lambda message: at(message.pose)[0] == 2.0)
        assert at(head.pose) == (2.0, -0.5, 1.5)
        assert head.header.frame_id == "xr"
        turned = head.pose.orientation
        assert (turned.x, turned.y) == (0, 0)
        assert math.isclose(2 * math.atan2(turned.z, turned.w), math.pi / 2, abs_tol=1e-6)
        await headset.place("right", (0.25, 1.25, -0.5), about_up(-math.pi / 2))
        right = await newest(rights, lambda message: abs(message.pose.position.z - 1.25) < 0.1)
        assert abs(right.pose.position.x - 0.5) < 0.1
        assert abs(right.pose.position.y + 0.25) < 0.1
        assert right.pose.orientation.z < -0.4  # to the right
        await by_stick(headset, "right", 1.0, -0.5)
        joy = await newest(joys, lambda message: message.buttons[7] and message.axes[2])
        assert [round(axis, 3) for axis in joy.axes] == [0, 0, -1.0, 0.5, 0, 0, 0, 1.0]
        await released(headset, "right")
        await headset.value("device.primaryInputMode = 'hand'")
        await headset.place("rightHand", (0.25, 1.25, -0.5))
        hand = await newest(hands, lambda message: abs(message.poses[0].position.z - 1.25) < 0.15)
        assert len(hand.poses) == 25
        assert all(abs(pose.position.x - 0.5) < 0.3 for pose in hand.poses)
        assert head.header.stamp.sec <= hand.header.stamp.sec <= time.time() + 1
    finally:
        peer.session.close()
