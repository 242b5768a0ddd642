"""A site made from a policy: its files, sessions with each node's certificate, and what arrives."""

from __future__ import annotations

import asyncio
import datetime as dt
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path

import macs_zenoh
from bridge.security import policy
from bridge.security.attempts import Result
from bridge.security.check import check
from bridge.security.generate import generate
from bridge.security.policy import Policy
from bridge.settings import load
from macs_zenoh.config import MeshSettings
from macs_zenoh.errors import NotServed, Refused, Unreachable
from macs_zenoh.mesh import Mesh, Sample
from macs_zenoh.sections import changed
from tests.support.programs import free_port
from tests.support.waiting import PATIENCE_S

NOW = dt.datetime.now(dt.timezone.utc)

CLIENTS = """
robots:
  - {name: robot-7, id: 7, group: 3, awareness_name: drone7}
  - {name: robot-8, id: 8, group: 3, awareness_name: drone8}
  - {name: robot-9, id: 9, awareness_name: drone9}
gateways:
  - {name: hall-1, blocks: [1]}
  - {name: hall-2, blocks: [2]}
operators:
  - {name: anna}
permissions:
  - {who: hall-1, may: [command, see, call], whom: [robot-7, robot-8]}
  - {who: hall-2, may: see, whom: robot-7}
  - {who: gateways, may: message, whom: gateways}
  - {who: robot-7, may: message, whom: robot-8}
  - {who: robot-8, may: message, whom: robot-7}
  - {who: anna, may: call, verbs: [status], whom: robots}
"""


@dataclass
class Site:
    """A policy, its files, and where its first router is."""

    policy: Policy
    directory: Path

    def settings(self, name: str) -> MeshSettings:
        """What a node's own settings file says."""
        return load(self.directory / name / "macs.toml").mesh

    def file(self, name: str = "site") -> Path:
        return self.directory / name / "router.json5"

    @asynccontextmanager
    async def session(self, name: str, router: str | None = None) -> AsyncIterator[Mesh]:
        """A session with a node's certificate, on the first router or the one named."""
        settings = self.settings(name)
        if router is not None:
            settings = changed(settings, connect=self.router(router))
        async with await Mesh.open_once(settings, timeout_s=PATIENCE_S) as mesh:
            yield mesh

    def router(self, name: str) -> list[str]:
        return next(router for router in self.policy.routers if router.name == name).dialled

    async def wrong(self, endpoints: list[str] | None = None) -> list[Result]:
        """What the check finds."""
        return [one for one in await check(self.policy, self.directory, endpoints) if not one.as_expected]


def made(directory: Path, clients: str = CLIENTS, routers: int = 1) -> Site:
    """A site with one router, or with a second one that dials it."""
    lines = [f"  - {{name: site, addresses: [127.0.0.1], listen: ['tls/127.0.0.1:{free_port()}']}}"]
    if routers == 2:
        listen = f"tls/127.0.0.1:{free_port()}"
        lines.append(f"  - {{name: cloud, addresses: [127.0.0.1], listen: ['{listen}'], links: [site]}}")
    read = policy.parse("\n".join(["routers:", *lines]) + clients)
    generate(read, directory, NOW)
    return Site(read, directory)


def listening(mesh: Mesh, key: str) -> list[Sample]:
    """What arrives on an expression."""
    arrived: list[Sample] = []

    def take(batch: Iterator[Sample]) -> None:
        arrived.extend((key, bytes(payload)) for key, payload in batch)

    mesh.subscribe(key, take)
    return arrived


async def answered(mesh: Mesh, key: str, timeout_s: float = 1.0) -> bool:
    try:
        return await mesh.query(key, b"", timeout_s=timeout_s) == b"yes"
    except (Unreachable, NotServed, Refused):
        return False


async def until_answered(mesh: Mesh, key: str) -> None:
    async def ask() -> None:
        while not await answered(mesh, key):
            await asyncio.sleep(0.02)

    await asyncio.wait_for(ask(), PATIENCE_S)


def online(agent: macs_zenoh.Agent) -> set[tuple[str, int]]:
    return {(one.type_name, one.id) for one in agent.online()}


async def linked(found: Site) -> None:
    """Wait until a robot on one router and a gateway on the other see each other."""
    async with found.session("robot-7", "site") as robot, found.session("hall-1", "cloud") as hall:
        token = robot.declare_token("macs/live/ros/0/7/3/a1")
        while not await hall.tokens("macs/live/**"):
            await asyncio.sleep(0.05)
        token.close()
