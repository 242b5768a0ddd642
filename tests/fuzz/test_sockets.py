"""A short run of the socket fuzzer; `python -m tests.fuzz.sockets` is the long one."""

from __future__ import annotations

from tests.fuzz.sockets import run


async def test_mutated_frames_cost_only_their_own_connections() -> None:
    """Twenty thousand mutated frames leave the gateway up, its neighbours served in order, and nothing behind."""
    report = await run(20_000, seed=7)
    assert report.frames >= 20_000
    assert report.neighbour_messages > 0
