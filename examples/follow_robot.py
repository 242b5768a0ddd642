"""Drive robot 1 forward until it has come half a metre, and switch its lights on: an agent on the mesh, without TCP.

It meets the demo of ``make run``, whose robot is robot 1. Commands may move a robot: mind where it stands.
"""

import asyncio

import macs_zenoh


async def main() -> None:
    settings = macs_zenoh.MeshSettings(connect=["tcp/127.0.0.1:7447"], namespace="demo")
    async with macs_zenoh.join("unity", settings=settings) as agent:
        lights = await agent.call_service("/set_lights", {"data": True}, robot=1)
        print("lights:", lights["message"])
        poses = await agent.subscribe("/pose", robot=1)
        drive = await agent.advertise("/cmd_vel", robot=1)
        start = (await poses.receive()).value["pose"]["position"]
        async for pose in poses:
            x = pose.value["pose"]["position"]["x"] - start["x"]
            drive.publish({"linear": {"x": 0.2 if x < 0.5 else 0.0}})
            if x >= 0.5:
                break
        print(f"robot {pose.robot} has come {x:.1f} m")


asyncio.run(main())
