"""Anybody can say that he is a robot of a group that is mirrored, and that he is a thousand of them."""

from __future__ import annotations

from bridge.ros.mirrors import ROBOTS
from bridge.ros.program import open_robot
from bridge.settings import RobotSettings, Settings
from bridge.settings.mirror import MirrorRule
from macs_zenoh.config import MeshSettings
from macs_zenoh.mesh import Mesh
from macs_zenoh.protocol.keyexpr import PRESENCE
from tests.support.waiting import PATIENCE_S, until

MORE = 40


async def test_so_many_robots_are_mirrored_and_no_more(router: str, domain: int) -> None:
    """Each that is costs a question a second. Those that are too many are told of, and others take their places."""
    rule = MirrorRule(source="group/3", topics=["/pose"])
    settings = Settings(mesh=MeshSettings(connect=[router]), robot=RobotSettings(id=2, mirror=[rule]))
    async with (
        open_robot(settings, domain_id=domain) as own,
        await Mesh.open(MeshSettings(connect=[router])) as crowd,
    ):
        tokens = {
            number: crowd.declare_token(PRESENCE.of(type=1, id=number, group=3, zid=crowd.zid))
            for number in range(100, 100 + ROBOTS + MORE)
        }
        await until(lambda: own.nodes.drops["not_mirrored"] == MORE, PATIENCE_S)
        mirrored = own.nodes.robot.rules.mirrored
        assert len(mirrored) == ROBOTS
        for token in tokens.values():
            token.close()
        await until(lambda: not any((1, number) in own.agent.directory for number in tokens), PATIENCE_S)
        late = crowd.declare_token(PRESENCE.of(type=1, id=9, group=3, zid=crowd.zid))
        await until(lambda: "/robot9/pose" in mirrored, PATIENCE_S)
        late.close()
