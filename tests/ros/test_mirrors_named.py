"""Who mirrors a group and a robot by name: a crowd in the group keeps that robot out of nothing."""

from __future__ import annotations

from contextlib import AsyncExitStack

from bridge.ros.mirrors import ROBOTS
from bridge.ros.program import open_robot
from bridge.settings import RobotSettings, Settings
from bridge.settings.mirror import MirrorRule
from macs_zenoh.config import MeshSettings
from macs_zenoh.mesh import Mesh
from macs_zenoh.protocol.keyexpr import PRESENCE
from tests.support.waiting import PATIENCE_S, until


async def test_a_robot_named_by_id_needs_no_place(router: str, domain: int) -> None:
    """It comes behind as many as there are places for; one more of the group waits, and has the first that is free."""
    rules = [MirrorRule(source=source, topics=["/pose"]) for source in ("group/3", "ros/1")]
    settings = Settings(mesh=MeshSettings(connect=[router]), robot=RobotSettings(id=2, mirror=rules))
    async with AsyncExitStack() as stack:
        own = await stack.enter_async_context(open_robot(settings, domain_id=domain))
        crowd = await stack.enter_async_context(await Mesh.open(MeshSettings(connect=[router])))
        mirrored, drops = own.nodes.robot.rules.mirrored, own.nodes.drops

        def come(number: int) -> None:
            tokens[number] = crowd.declare_token(PRESENCE.of(type=1, id=number, group=3, zid=crowd.zid))

        tokens: dict[int, object] = {}
        for number in range(100, 100 + ROBOTS):
            come(number)
        await until(lambda: len(mirrored) == ROBOTS, PATIENCE_S)
        come(9)
        await until(lambda: drops["not_mirrored"] == 1, PATIENCE_S)
        come(1)
        await until(lambda: "/robot1/pose" in mirrored, PATIENCE_S)
        assert "/robot9/pose" not in mirrored
        tokens[100].close()  # type: ignore[attr-defined]
        await until(lambda: "/robot9/pose" in mirrored, PATIENCE_S)
        assert drops["not_mirrored"] == 1
