"""Whether what a session puts or asks goes to somebody yet: what others declare takes a moment to get around."""

from __future__ import annotations

import asyncio
import time

from macs_zenoh.errors import NotServed
from macs_zenoh.mesh import Mesh
from tests.support.waiting import PATIENCE_S, until


async def matched(sender: Mesh, key: str) -> None:
    """Wait until the session knows of a subscription to a key. What it puts there from now on arrives."""
    publisher = sender._session.declare_publisher(key)
    try:
        await until(lambda: publisher.matching_status.matching)
    finally:
        publisher.undeclare()


async def answer_of(sender: Mesh, key: str, frame: bytes) -> bytes:
    """What is answered to a question, by somebody who may just have begun to serve it."""
    deadline = time.monotonic() + PATIENCE_S
    while True:
        try:
            return await sender.query(key, frame, timeout_s=PATIENCE_S)
        except NotServed:
            assert time.monotonic() < deadline
            await asyncio.sleep(0.01)
