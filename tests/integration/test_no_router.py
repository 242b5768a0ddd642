"""A gateway that has lost its router says so to who commands robots: nobody drives on by himself when it is back."""

from __future__ import annotations

import macs_zenoh
from bridge.gateway import Gateway
from macs_zenoh.protocol.messages import DataRefused
from tests.support.given import Connect, StartGateway
from tests.support.links import counted
from tests.support.local import patient
from tests.support.sockets import Socket, socket
from tests.support.waiting import until

TWIST = "geometry_msgs/Twist"
NO_ROUTER = "the gateway has no router now"


async def _managers_until_answered(existing: Socket) -> list[str]:
    """What comes to an existing program until a question of its is answered."""
    existing.ask_online(9)
    found = []
    while True:
        metadata, _ = await existing.message()
        if metadata.request_id == 9:
            return found
        found.append(metadata.message_manager)


async def test_who_commands_is_told_that_there_is_no_router(
    router: str, start_gateway: StartGateway, connect: Connect
) -> None:
    """Of each topic and robot, once a second, as long as there is none; not of a robot at the same gateway, and no
    existing program hears of it."""
    async with counted(router) as link, macs_zenoh.join("ros", id=7, settings=patient(router)):
        gateway: Gateway = await start_gateway(link.endpoint)
        async with socket(gateway) as near, socket(gateway) as existing:
            near.configure(agent_type=1)
            existing.configure()
            headset = await connect(gateway)
            await until(lambda: {(1, 7), (1, near.id)} <= {agent.key for agent in gateway.directory})
            far_away = await headset.advertise("/cmd_vel", TWIST, agents=[7])
            at_hand = await headset.advertise("/arm", TWIST, agents=[near.id])
            of_group = await headset.advertise("/legs", TWIST, groups=[3])
            nodes = (far_away, at_hand, of_group)
            for node in nodes:
                await node.publish(b"1")
            await headset.online(60)
            assert NO_ROUTER not in {reason for node in nodes for reason in node.refusing().values()}
            link.cut()
            await until(lambda: not gateway.mesh.linked)
            for node in nodes:
                await node.publish(b"2")
            existing.command(7, "/cmd_vel", TWIST, b"2")
            assert DataRefused.manager not in await _managers_until_answered(existing)
            await headset.online(60)
            assert far_away.refusing() == {7: NO_ROUTER}
            assert NO_ROUTER in of_group.refusing().values()
            assert NO_ROUTER not in at_hand.refusing().values()
            assert gateway.mesh.drops["no_route"] >= 3
            link.mend()
            await until(lambda: gateway.mesh.linked)
            far_away.refusals.clear()
            await far_away.publish(b"3")
            await headset.online(60)
            assert not far_away.refusing()
