"""ROS nodes that die in the moment in which somebody begins to follow: nobody has them for good."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from contextlib import AsyncExitStack

import pytest

from bridge.rmw_zenoh.program import _Following
from bridge.settings.rmw_zenoh import RmwZenohSettings
from macs_zenoh.config import MeshSettings
from macs_zenoh.mesh.ros_network import RosNetwork
from tests.support.waiting import until

pytest.importorskip("xxhash", reason="being a ROS node needs xxhash: pip install 'macs-zenoh[rmw-zenoh]'")
pytestmark = pytest.mark.timeout(120)

Names = Callable[[], set[str]]


async def by_graph(network: RosNetwork) -> Names:
    await network.known(0)
    return lambda: {node.name for node in network.graph(0).nodes(others=True)}


async def by_all(network: RosNetwork) -> Names:
    following = await _Following.begin(RmwZenohSettings(), network)
    return lambda: {node.name for node in following._nodes.values()}


@pytest.mark.parametrize("follow", [by_graph, by_all])
async def test_a_node_that_dies_unseen(
    router: str, monkeypatch: pytest.MonkeyPatch, follow: Callable[[RosNetwork], Awaitable[Names]]
) -> None:
    """It dies after the router has named it, before it is watched: it is there at first, and not any more a little
    later. One that lives stays, and one that comes is there."""
    async with AsyncExitStack() as stack:
        settings = MeshSettings(connect=[router])
        lives, dies, ours = [await stack.enter_async_context(await RosNetwork.open(settings)) for _ in range(3)]
        kept = [lives.node(0, "living"), dies.node(0, "dying")]
        really = RosNetwork.tokens

        async def routers() -> set[str]:
            """Who is there as the router says."""
            return {token.rpartition("/")[2] for token in await really(lives, None)}

        async def only_living() -> bool:
            return await routers() == {"living"}

        async def both() -> bool:
            return await routers() == {"living", "dying"}

        async def then_it_dies(self: RosNetwork, domain: int | None, *, timeout_s: float = 2.0) -> list[str]:
            found = await really(self, domain, timeout_s=timeout_s)
            monkeypatch.setattr(RosNetwork, "tokens", really)
            await dies.close()
            await until(only_living)
            return found

        await until(both)
        monkeypatch.setattr(RosNetwork, "tokens", then_it_dies)
        there = await follow(ours)
        assert there() == {"living", "dying"}
        await until(lambda: there() == {"living"})
        kept.append(lives.node(0, "came"))
        await until(lambda: there() == {"living", "came"})
