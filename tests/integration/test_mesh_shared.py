"""Two robots of one program over one Zenoh session, as `macs rmw-zenoh --mode router` has them."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import AsyncExitStack
from pathlib import Path
from typing import Any

import pytest

from macs_zenoh import ros
from macs_zenoh.config import MeshSettings
from macs_zenoh.errors import Unreachable
from macs_zenoh.mesh import Mesh
from macs_zenoh.mesh.outgoing import Outgoing
from macs_zenoh.mesh.panics import unwatched
from tests.support.programs import Program, free_port
from tests.support.waiting import PATIENCE_S, until

KEY = "macs/to/ros/0/2/ros/1"
SIZES = [20 << 10, 200 << 10]
SETTINGS = """
[[rmw_zenoh.robots]]
id = 1
domain = 51

[[rmw_zenoh.robots]]
id = 2
domain = 52

[[robot.mirror]]
from = "ros/1"
services = ["/map"]
"""


@pytest.fixture
async def meshes() -> AsyncIterator[list[Mesh]]:
    settings = MeshSettings(mode="router", listen=[f"tcp/127.0.0.1:{free_port()}"])
    async with AsyncExitStack() as stack:
        session = unwatched((await stack.enter_async_context(await Mesh.open(settings)))._session)
        yield [await stack.enter_async_context(Mesh.over(session, settings)) for _ in range(2)]


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("settled", [True, False])
async def test_a_neighbour_hears_what_was_put(
    meshes: list[Mesh], size: int, settled: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What one puts reaches the other whole, once and in order, with a publisher and without."""
    monkeypatch.setattr(Outgoing, "SETTLE_S", 0.0 if settled else PATIENCE_S)
    put = [bytes([number]) * size for number in range(6)]
    heard: list[bytes] = []
    meshes[1].subscribe(KEY, lambda batch: heard.extend(bytes(payload) for _, payload in batch))
    for payload in put:
        meshes[0].put(KEY, payload)
    await until(lambda: len(heard) >= len(put), PATIENCE_S)
    assert heard == put


async def test_a_service_of_a_neighbour(tmp_path: Path) -> None:
    """Robot 2 calls a service of robot 1, which answers at length: all of it comes, the first time."""
    pytest.importorskip("xxhash", reason="being a ROS node needs xxhash: pip install 'macs-zenoh[rmw-zenoh]'")
    settings, own = tmp_path / "robots.toml", f"tcp/127.0.0.1:{free_port()}"
    settings.write_text(SETTINGS, encoding="utf-8")
    async with AsyncExitStack() as stack:
        await stack.enter_async_context(
            Program("rmw-zenoh", "--settings", str(settings), "--mode", "router", "-l", own)
        )
        first, second = [
            await stack.enter_async_context(ros.node("base", domain=domain, connect=[own])) for domain in (51, 52)
        ]
        sizes = iter(SIZES)

        async def answer(_request: dict[str, bool]) -> dict[str, object]:
            return {"success": True, "message": "x" * next(sizes)}

        first.serve("/map", "std_srvs/SetBool", answer)
        for size in SIZES:
            said = await until(lambda: called(second), PATIENCE_S)
            assert (said["success"], len(said["message"])) == (True, size), said["message"][:200]


async def called(node: ros.Node) -> dict[str, Any]:
    """What the mirrored service answers; empty while it is not there."""
    try:
        answer: dict[str, Any] = await node.call("/robot1/map", "std_srvs/SetBool", {"data": True}, timeout_s=60.0)
    except Unreachable:
        return {}
    return answer
