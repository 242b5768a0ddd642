"""A ROS node without ROS: it says hello on /chatter, and switches /lamp. Needs pip install 'macs-zenoh[rmw-zenoh]'."""

import asyncio
import sys

from macs_zenoh import ros


async def switch(request: dict[str, bool]) -> dict[str, object]:
    return {"success": True, "message": "on" if request["data"] else "off"}


async def main(router: str = "tcp/127.0.0.1:7447") -> None:
    async with ros.node("hello", connect=[router]) as node:
        node.serve("/lamp", "std_srvs/SetBool", switch)
        hello = node.publisher("/chatter", "std_msgs/String")
        while True:
            hello.publish({"data": "hello"})
            await asyncio.sleep(0.5)


asyncio.run(main(*sys.argv[1:]))
