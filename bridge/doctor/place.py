"""A router endpoint while it is probed: two sessions through it, of which one sees what the other does."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from dataclasses import dataclass, field

from macs_zenoh.mesh import Mesh, Subscription

from .facts import Endpoint

MARK = "%64octor-"
"""An escape that nothing of ours writes (``d`` needs none): access rules see one chunk, readers of keys see nobody."""

SETTLE_S = 0.5
"""How long something that was declared may take until others see it, apart from the way there."""


@dataclass
class Place:
    """A router endpoint while it is probed: its facts, and the sessions through it."""

    facts: Endpoint
    first: Mesh
    second: Mesh
    everywhere: Mesh
    """Without the settings' namespace."""
    mark: str = ""
    waited_s: float = SETTLE_S
    kept: list[Subscription] = field(default_factory=list)


async def tokens(mesh: Mesh, key: str, timeout_s: float) -> list[str]:
    """Each token once, without our own."""
    return [found for found in dict.fromkeys(await mesh.tokens(key, timeout_s=timeout_s)) if MARK not in found]


async def until(condition: Callable[[], bool], timeout_s: float) -> bool:
    """Whether it holds in time."""
    deadline = time.monotonic() + timeout_s
    while not condition():
        if time.monotonic() > deadline:
            return False
        await asyncio.sleep(0.002)
    return True
