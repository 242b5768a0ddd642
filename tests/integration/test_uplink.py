"""A robot's uplink carries one copy of a topic message, however many headsets receive it: bytes on the link."""

from __future__ import annotations

import asyncio
import itertools

import macs_zenoh
from macs_zenoh.protocol.messages import Metadata, NodeType, StreamData, encode_management
from macs_zenoh.protocol.wire import encode_frame, encode_message
from macs_zenoh.streams import Streams
from tests.support.given import Connect, StartGateway
from tests.support.links import counted
from tests.support.waiting import PATIENCE_S

IMAGE_BYTES = 100_000


async def test_one_copy_for_any_number_of_headsets(router: str, start_gateway: StartGateway, connect: Connect) -> None:
    """For 1 and for 20 headsets on two gateways, a message costs the robot's uplink its size once."""
    gateways = [await start_gateway(), await start_gateway()]
    async with counted(router) as link, macs_zenoh.join("ros", id=1, connect=[link.endpoint]) as robot:

        async def add(call: macs_zenoh.Call) -> bytes:
            return b""

        robot.serve("add_node", add)
        headsets = [await connect(gateways[number % 2]) for number in range(20)]
        images = [await h.subscribe("/image", "sensor_msgs/Image", agents=[1]) for h in headsets]
        metadata = Metadata(1, 1, 0, StreamData.manager, NodeType.SUBSCRIBER, "nd__image", "sensor_msgs/Image")
        numbers = itertools.count(1)

        def publish(count: int) -> bytes:
            """Publish to so many of them; how the image begins."""
            begins = next(numbers).to_bytes(4, "little")
            targets = StreamData({"2": [headset.id for headset in headsets[:count]]})
            message = encode_message(metadata.encode(), begins + bytes(IMAGE_BYTES - len(begins)))
            Streams(robot).publish(
                "nd__image", encode_frame(1, management=encode_management(targets), message=message)
            )
            return begins

        async def get(count: int, begins: bytes) -> None:
            """Wait until each of them has it: then whatever was published before has passed the link."""
            for stream in images[:count]:
                while True:
                    received = await asyncio.wait_for(stream.__anext__(), PATIENCE_S)
                    assert len(received.data) == IMAGE_BYTES
                    if received.data.startswith(begins):
                        break

        async def deliver(count: int) -> None:
            """Publish until every one of ``count`` headsets has a message: registrations take their way."""
            arriving = [asyncio.ensure_future(stream.__anext__()) for stream in images[:count]]
            while not all(arrival.done() for arrival in arriving):
                publish(count)
                await asyncio.wait(arriving, timeout=0.2)

        await asyncio.wait_for(deliver(20), PATIENCE_S)
        cost = {}
        for count in (1, 20):
            await get(count, publish(count))
            before = link.up_bytes
            for _ in range(10):
                await get(count, publish(count))
            cost[count] = (link.up_bytes - before) / 10
        for count, per_message in cost.items():
            assert IMAGE_BYTES < per_message < 1.05 * IMAGE_BYTES, f"{count} headsets: {per_message} bytes a message"
