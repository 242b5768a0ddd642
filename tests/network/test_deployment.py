"""config/wan as shipped, behind two NATs: what `macs security generate` makes of its policy, on hosts of its own."""

from __future__ import annotations

import datetime as dt
import time
from contextlib import AsyncExitStack
from pathlib import Path

import pytest

from bridge.security import policy
from bridge.security.generate import generate
from tests.network.hosts import Network
from tests.network.inside import Inside
from tests.support.programs import ROOT, Program
from tests.support.routers import Router

WAN = ROOT / "config" / "wan"
CLOUD = "10.214.0.1"
"""The cloud's address for everybody, as on the internet."""


async def test_a_robot_behind_nat_is_driven_from_behind_another(network: Network, tmp_path: Path) -> None:
    """With nothing but the cloud's port open, and certificates on each link, a headset reads a topic of the robot's
    ROS graph and commands it; also when the site's router is gone, for the robot dials the cloud itself then."""
    pytest.importorskip("rclpy")
    hosts = {name: network.host(name) for name in ("robot", "site", "home", "cloud", "office", "desk")}
    robot, site, home, cloud, office, desk = hosts.values()
    network.cable(robot, site)
    network.cable(robot, home)
    network.cable(site, home)
    network.link(home, cloud, delay_ms=20)
    network.link(cloud, office, delay_ms=20)
    network.cable(office, desk)
    for inside, nat in ((robot, home), (site, home), (desk, office)):
        inside.default_route(nat)
    for nat in (home, office):
        network.nat(nat, towards=cloud)
        nat.default_route(cloud)
    cloud.ip("addr", "add", f"{CLOUD}/32", "dev", "lo")

    text = (WAN / "policy.yaml").read_text(encoding="utf-8")
    text = text.replace("cloud.example.org", CLOUD).replace("192.168.1.10", site.address_towards(robot))
    generate(policy.parse(text), tmp_path, dt.datetime.now(dt.timezone.utc))

    async with AsyncExitStack() as stack:
        for name in ("cloud", "site"):
            router = Router(tmp_path / name / "router.json5", within=hosts[name].within)
            await stack.enter_async_context(router)
        ros = {"ROS_DOMAIN_ID": "0", "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}  # a host of its own, so any domain
        for verb, own, name, host in (("agent", "robot", "robot-7", robot), ("gateway", "gateway", "desk", desk)):
            files = ("--settings", str(WAN / f"{own}.toml"), "--settings", str(tmp_path / name / "macs.toml"))
            await stack.enter_async_context(Program(verb, *files, env=ros, within=host.within))
        node = await stack.enter_async_context(Inside("ros", domain=0, within=robot.within))
        headset = await stack.enter_async_context(Inside("headset", port=7000, within=desk.within))
        await headset.until_online("ros", 7)
        await headset.ask("subscribe", topic="/pose", robot=7)
        await headset.ask("command", topic="/cmd_vel", robot=7, hz=20)
        await node.ask("subscribe", topic="/cmd_vel")
        await node.ask("stream", topic="/pose", hz=20, size=100)
        await headset.until_received("/pose")
        await node.until_received("/cmd_vel")

        await router.stop()
        stopped_s = time.monotonic()
        for end, topic in ((headset, "/pose"), (node, "/cmd_vel")):
            while not any(message.sent_s > stopped_s for message in await end.until_received(topic, 20)):
                pass
