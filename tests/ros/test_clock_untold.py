"""A headset commands by a clock that the robot has not heard of, or through a group: nothing stays refused."""

from __future__ import annotations

from pathlib import Path

from bridge.headset.client import Headset
from tests.ros.test_command_age import driven, twist
from tests.support.ros_peer import Peer
from tests.support.waiting import until


async def test_a_robot_asks_whoever_commands_by_a_clock_it_does_not_know(
    domain: int, peer: Peer, tmp_path: Path
) -> None:
    """No hello has come: the first commands are refused, and the robot asks at once by itself."""
    async with driven(peer, domain, tmp_path, 5.0) as site:
        other = await Headset.connect("127.0.0.1", site.relay.port)
        async with other:
            commands = await other.advertise("/cmd_vel", "geometry_msgs/Twist", agents=[1])
            other.clock.robots.add(1)

            async def arrives() -> bool:
                await commands.publish(twist(3))
                return 3.0 in site.carried_out

            await until(arrives, every_s=0.1)
            assert (await site.drops())["no_clock"]
            assert 1 in other.clock.known


async def test_commands_through_a_group_are_carried_out_of_who_tells_the_robot_alone(
    domain: int, peer: Peer, tmp_path: Path
) -> None:
    """The robot is told by its number and commanded as a member of its group."""
    async with driven(peer, domain, tmp_path, 5.0, "group = 3\n") as site:
        await site.commands.register(groups=[3])

        async def arrives() -> bool:
            await site.commands.publish(twist(4), groups=[3])
            return 4.0 in site.carried_out

        await until(arrives, every_s=0.1)
        assert not (await site.drops()).total()
