"""Whether what a session puts goes to somebody yet: a subscription takes a moment to get around."""

from __future__ import annotations

from macs_zenoh.mesh import Mesh
from tests.support.waiting import until


async def matched(sender: Mesh, key: str) -> None:
    """Wait until the session knows of a subscription to a key. What it puts there from now on arrives."""
    publisher = sender._session.declare_publisher(key)
    try:
        await until(lambda: publisher.matching_status.matching)
    finally:
        publisher.undeclare()
