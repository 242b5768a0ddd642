"""Traces for pages: the hops of a topic's messages to this gateway, collected once for all who look, and only then."""

from __future__ import annotations

import asyncio
from collections import OrderedDict
from dataclasses import dataclass
from functools import partial
from typing import Any, cast

from bridge.graph.site import Site
from bridge.graph.traces import Noting, Tracing
from macs_zenoh.errors import Refused
from macs_zenoh.mesh import Mesh
from macs_zenoh.protocol.directory import Directory

from .fresh import Fresh

COLLECT_S = 1.0
COUNT = 100
"""So many messages are enough for one look."""
GOOD_S = 0.3
ANSWER_S = 1.0
TOPICS = 16
"""So many topics are traced at one time; whose messages are awaited is not forgotten for another."""


@dataclass
class _Session:
    mesh: Mesh
    directory: Directory


@dataclass
class _Here:
    """Of a site what tracing asks."""

    agent: _Session
    timeout_s: float = ANSWER_S


class _ToGateway(Tracing):
    """Messages of a topic that somebody at this gateway receives anyway."""

    async def begin(self) -> None:
        self._names[self._mesh.zid] = "this gateway"
        self._marking = [self._robot_zid]
        self._looking = [Noting(self._mesh.zid, "this gateway")]


class Traces:
    """Of one gateway."""

    def __init__(self, mesh: Mesh, directory: Directory) -> None:
        self._here = _Here(_Session(mesh, directory))
        self._kept: OrderedDict[tuple[int, str], Fresh[list[dict[str, Any]]]] = OrderedDict()
        self._one = asyncio.Lock()
        """What a program notes is told once: two that collect would each have a part."""

    async def of(self, robot: int, topic: str) -> list[dict[str, Any]]:
        """Each way that messages took, as `bridge.graph.traces.Traced` tells it; none where no message came. Raises
        Refused, Unreachable, UsageError."""
        fresh = self._kept.get((robot, topic))
        if fresh is None:
            if len(self._kept) >= TOPICS:
                idle = next((about for about, kept in self._kept.items() if not kept.asking), None)
                if idle is None:
                    raise Refused(f"{TOPICS} topics are traced for pages already")
                del self._kept[idle]
            fresh = self._kept[robot, topic] = Fresh(partial(self._collect, robot, topic), GOOD_S)
        self._kept.move_to_end((robot, topic))
        return await fresh.now()

    def close(self) -> None:
        """Collect no more."""
        for fresh in self._kept.values():
            fresh.close()

    async def _collect(self, robot: int, topic: str) -> list[dict[str, Any]]:
        async with self._one:
            tracing = _ToGateway(cast(Site, self._here), robot, topic, every=1, commands=False)
            await tracing.begin()
            await tracing.collect(seconds=COLLECT_S, count=COUNT)
            found = await tracing.conclude()
            await tracing.end()
        return [traced.facts() for traced in sorted(found, key=lambda each: -each.count)]
