"""The picture of the mesh that pages show: who is there, behind whom, and how long the way to each session is."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Mapping
from functools import partial
from typing import Any

import msgspec

from bridge.graph.links import Routers
from macs_zenoh.mesh import Mesh
from macs_zenoh.protocol import ping
from macs_zenoh.protocol.directory import Directory
from macs_zenoh.protocol.keyexpr import LEASE, PING
from macs_zenoh.protocol.limits import NAME_BYTES
from macs_zenoh.protocol.messages import ROS, UNITY
from macs_zenoh.protocol.rights import Grant
from macs_zenoh.protocol.routers import Router, between
from macs_zenoh.versions import installed

from .fresh import Fresh
from .robots import Robots, may_see

ROUTERS_GOOD_S = 2.0
PINGS_PER_S = 50.0
PING_GOOD_S = 2.0
PING_S = 2.0
PINGS_AT_ONCE = 16
DROPS = 200
"""So many names of losses are shown of a robot."""
SESSIONS = 1024
"""More are shown without the length of the way to them."""


class Picture:
    """Made when somebody looks, and no more often than it changes."""

    def __init__(self, mesh: Mesh, directory: Directory, robots: Robots) -> None:
        self._mesh = mesh
        self._directory = directory
        self._robots = robots
        self._known = Routers(mesh)
        self._routers: Fresh[list[Router]] = Fresh(self._known.look, ROUTERS_GOOD_S)
        self._carried: dict[str, tuple[float, int]] = {}
        """By session, what its links had carried when."""
        self._gateways: Fresh[set[str]] = Fresh(self._ask_gateways, ROUTERS_GOOD_S)
        self._own: Fresh[dict[str, Any]] = Fresh(self._own_rate, PING_GOOD_S)
        self._pings: dict[str, Fresh[dict[str, Any]]] = {}
        self._room = asyncio.Semaphore(PINGS_AT_ONCE)

    def now(self, visitor: Grant, address: str, drops: Mapping[str, int]) -> dict[str, Any]:
        """All of it, as far as it is known and the visitor may know; the rest is asked for meanwhile. ``address`` and
        ``drops`` are this gateway's own."""
        rights = visitor.rights
        everybody = [agent for agent in self._directory if agent.type in (ROS, UNITY)]
        robots = [a for a in everybody if a.type == ROS and (rights is None or rights.sees(a.id, a.group))]
        headsets = [agent for agent in everybody if agent.type == UNITY]
        states = self._robots.known(agent.id for agent in robots if may_see(visitor, agent.id, agent.group))
        gateways = {*(self._gateways.last() or ()), self._mesh.zid}
        sessions = {agent.zid for agent in (*robots, *headsets)} | gateways
        self._forget({agent.zid for agent in everybody} | gateways)
        routers = self._shown_routers(sessions)
        rate = self._own.last() or {}
        return {
            "time": time.time(),
            "own": self._mesh.zid,
            "linked": self._mesh.linked,
            "routers": routers,
            "gateways": sorted(gateways),
            "sessions": {
                **self._shown_sessions(sessions),
                self._mesh.zid: {"address": address, "version": installed("macs-zenoh"), "drops": dict(drops), **rate},
            },
            "robots": [
                {"id": agent.id, "group": agent.group, "session": agent.zid, **_state(states.get(agent.id))}
                for agent in robots
            ],
            "headsets": [{"id": agent.id, "group": agent.group, "session": agent.zid} for agent in headsets],
        }

    def close(self) -> None:
        """Ask no more."""
        self._routers.close()
        self._gateways.close()
        self._own.close()
        for fresh in self._pings.values():
            fresh.close()

    def _shown_routers(self, sessions: set[str]) -> list[dict[str, Any]]:
        routers = {router.zid: router for router in self._routers.last() or ()}
        linked = set(self._mesh.routers)
        trips = self._known.trips
        of_links = between({zid: router.linked for zid, router in routers.items()}, sorted(linked), trips)
        shown = []
        for zid in sorted(routers.keys() | linked):
            router = routers.get(zid, Router(zid))
            others = sorted(set(router.linked) & routers.keys())
            shown.append(
                {
                    "zid": zid,
                    "version": router.release,
                    "linked": zid in linked,
                    "roundTripMs": _ms(trips.of(zid)),
                    "sessions": sorted(sessions & (router.behind | ({self._mesh.zid} if zid in linked else set()))),
                    "routers": others,
                    "linksMs": {other: _ms(of_links.get((zid, other))) for other in others},
                }
            )
        return shown

    def _forget(self, sessions: set[str]) -> None:
        """Ping none but these, whoever may know of them."""
        for gone in self._pings.keys() - sessions:
            self._pings.pop(gone).close()
            self._carried.pop(gone, None)

    def _shown_sessions(self, sessions: set[str]) -> dict[str, dict[str, Any]]:
        good_s = max(PING_GOOD_S, len(sessions) / PINGS_PER_S)
        shown: dict[str, dict[str, Any]] = {}
        for zid in sorted(sessions)[:SESSIONS]:
            if zid == self._mesh.zid:
                continue  # it would ask itself
            fresh = self._pings.setdefault(zid, Fresh(partial(self._ping, zid), PING_GOOD_S))
            shown[zid] = fresh.last(good_s) or {}
        return shown

    async def _ping(self, zid: str) -> dict[str, Any]:
        async with self._room:
            began = time.perf_counter()
            answer = await self._mesh.query(PING.of(zid=zid), b"", timeout_s=PING_S)
            took_ms = (time.perf_counter() - began) * 1000
        said, _ = ping.decode(answer)
        told = {"roundTripMs": took_ms, "address": said.address, "version": said.macs, "drops": said.drops}
        return {**told, **self._rate(zid, said.link_bytes)}

    async def _own_rate(self) -> dict[str, Any]:
        return self._rate(self._mesh.zid, self._mesh.carried())

    def _rate(self, zid: str, counts: tuple[int, int] | None) -> dict[str, float]:
        """Bytes a second that a session's links have carried since it told them the last time."""
        now = time.monotonic()
        before = self._carried.pop(zid, None)
        if counts is None:
            return {}
        self._carried[zid] = now, sum(counts)
        if before is None or before[1] > sum(counts) or now <= before[0]:  # the link is another one
            return {}
        return {"bytesPerS": (sum(counts) - before[1]) / (now - before[0])}

    async def _ask_gateways(self) -> set[str]:
        leases = [LEASE.parse(key) for key in await self._mesh.tokens(LEASE.every())]
        return {lease.zid for lease in leases if lease is not None}


def _ms(seconds: float | None) -> float | None:
    return None if seconds is None else 1000 * seconds


class _Control(msgspec.Struct):
    holder: str | None = None


class _Node(msgspec.Struct):
    name: str
    control: _Control | None = None


class _Stop(msgspec.Struct):
    by: str = ""


class _Status(msgspec.Struct):
    """Of a robot's state what the picture shows: a robot may answer whatever it likes."""

    stopped: bool = False
    stop: _Stop | None = None
    nodes: list[_Node] = []
    drops: dict[str, int] = {}


def _state(status: dict[str, Any] | None) -> dict[str, Any]:
    """What the picture shows of a robot's state; of one that makes no sense nothing."""
    try:
        said = msgspec.convert(status, _Status)
    except msgspec.ValidationError:  # None as well
        return {"known": False}
    held = {node.name[:NAME_BYTES]: node.control.holder for node in said.nodes if node.control is not None}
    return {
        "known": True,
        "stopped": said.stopped,
        "stoppedBy": said.stop.by[:NAME_BYTES] if said.stop is not None else "",
        "control": {name: holder[:NAME_BYTES] for name, holder in held.items() if holder},
        "drops": {name[:NAME_BYTES]: count for name, count in list(said.drops.items())[:DROPS]},
    }
