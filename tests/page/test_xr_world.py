"""What robots publish besides pictures, from a ROS node to the table of the scene for headsets."""

from __future__ import annotations

import asyncio
import math
import struct
from collections.abc import Callable
from typing import Any

import pytest

pytest.importorskip("rclpy")

from sensor_msgs.msg import JointState, LaserScan, PointCloud2, PointField
from std_msgs.msg import Float32

from tests.page.conftest import Site
from tests.page.headsets import headset_at, needs_headset
from tests.page.polls import until
from tests.support.browser import needs_browser
from tests.support.ros_peer import Peer

pytestmark = [needs_browser, needs_headset, pytest.mark.timeout(200)]

POINTS = 50_000


def scan() -> Any:
    message = LaserScan(angle_min=-math.pi, angle_increment=math.pi / 90, range_min=0.1, range_max=30.0)
    message.header.frame_id = "laser"
    message.ranges = [2.0] * 180
    return message


def cloud() -> Any:
    message = PointCloud2(height=1, width=POINTS, point_step=12, row_step=12 * POINTS, is_dense=True)
    message.header.frame_id = "nobody_tells_of_it"
    message.fields = [
        PointField(name=name, offset=4 * at, datatype=PointField.FLOAT32, count=1) for at, name in enumerate("xyz")
    ]
    message.data = b"".join(struct.pack("<3f", 1 + at / POINTS, 0.0, 0.5) for at in range(POINTS))
    return message


MESSAGES: dict[str, Callable[[], Any]] = {
    "/scan": scan,
    "/points": cloud,
    "/joint_states": lambda: JointState(name=["arm", "hand"], position=[0.5, -1.0]),
    "/level": lambda: Float32(data=0.625),
}


async def test_what_a_robot_publishes_is_on_the_table(site: Site) -> None:
    """A scan and a cloud, of few of its points, on the robot, as nobody tells where their frames are; joints, the map,
    its battery, and a value as text."""
    peer = Peer(site.domain)
    publishing = None
    try:
        messages = {topic: make() for topic, make in MESSAGES.items()}
        publishers = {topic: await peer.publisher(type(message), topic) for topic, message in messages.items()}

        async def publish() -> None:
            while True:
                for topic, message in messages.items():
                    await peer.session.run(lambda topic=topic, message=message: publishers[topic].publish(message))
                await asyncio.sleep(0.3)

        publishing = asyncio.create_task(publish())
        headset = await headset_at(site, settings={"cameras": [], "values": ["/level"], "points": 1000})
        await headset.ready(pictures=False)
        for layer in ("scan", "cloud"):
            await until(lambda layer=layer: headset.value(f"macsXr.room.model.{layer}.visible"))
        model = "macsXr.room.model"
        assert await headset.value(f"{model}.cloud.parent === {model}.atRobot")
        # the demo robot has a smaller one on the same topic
        count = f"[{model}.cloud.geometry.drawRange.count].find((count) => count > 500)"
        drawn = await until(lambda: headset.value(count))
        assert drawn <= 1000, "few of its points"
        await until(lambda: headset.value(f"{model}.joints.group.children.length === 2"))
        await until(lambda: headset.value("macsXr.telling.batteries.all(0)[0]?.value.text.includes('V')"))
        await until(lambda: headset.value("macsXr.telling.texts.all(0)[0]?.value[0] === 'level: data 0.625'"))
        await until(lambda: headset.value(f"Boolean({model}.map?.visible)"))
        await headset.shot("world")
        await headset.value("macsXr.settings.set('layers', ['scan'])")
        await until(lambda: headset.value(f"!{model}.cloud.visible && {model}.scan.visible"))
    finally:
        if publishing is not None:
            publishing.cancel()
            await asyncio.gather(publishing, return_exceptions=True)
        peer.session.close()
