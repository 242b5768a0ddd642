"""A robot's link that is full because somebody puts commands there and waits: what else goes through the router."""

from __future__ import annotations

import asyncio
import threading
from contextlib import AsyncExitStack, ExitStack
from pathlib import Path

import pytest
import zenoh

from macs_zenoh.config import MeshSettings
from macs_zenoh.mesh.zenoh_config import zenoh_config
from macs_zenoh.sections import changed
from tests.support.links import counted
from tests.support.programs import ROOT
from tests.support.routers import Router, as_macs_router
from tests.support.waiting import until

PUTTING = 3
"""Sessions that put: more than a router has threads that read."""
SIZE, EACH = 60_000, 200
"""Together many times what sockets and queues hold."""
MS = 60_000
"""Nobody's link is closed meanwhile."""
ROBOT = "macs/to/ros/0/7/unity/9"
SHIPPED = ["one-host/router.json5", "site/router-a.json5", "site/router-b.json5"]


LINK = MeshSettings(block_limit_ms=MS, lease_ms=MS)
OURS = as_macs_router(LINK)


def _shipped(name: str) -> list[str]:
    """The same with what a file says of messages."""
    written = zenoh.Config.from_file(str(ROOT / "config" / name))
    links = [line for line in OURS if not line.startswith("qos/")]
    return [*links, f"qos/network:{written.get_json('qos/network')}"]


class _Putter:
    """Puts commands that wait for room, in a thread of its own."""

    def __init__(self, session: zenoh.Session) -> None:
        self._publisher = session.declare_publisher(
            ROBOT, priority=zenoh.Priority.REAL_TIME, congestion_control=zenoh.CongestionControl.BLOCK
        )
        self.is_done = False
        threading.Thread(target=self._run, daemon=True).start()

    def _run(self) -> None:
        for _ in range(EACH):
            self._publisher.put(bytes(SIZE))
        self.is_done = True


@pytest.mark.parametrize("rules", [OURS, *map(_shipped, SHIPPED)], ids=["ours", *(Path(n).stem for n in SHIPPED)])
async def test_whoever_waits_for_a_robot_holds_up_nobody(rules: list[str]) -> None:
    """A robot reads nothing, and several put to it with the priority of commands and wait for room: a question to
    somebody else is answered, and they are done too."""
    router = Router(overrides=rules)
    await router.start()
    async with AsyncExitStack() as stack:
        stack.push_async_callback(router.stop)
        link = await stack.enter_async_context(counted(router.endpoint, buffer_bytes=65536))
        sessions = stack.enter_context(ExitStack())

        async def joined(endpoint: str) -> zenoh.Session:
            settings = changed(LINK, connect=[endpoint])
            return sessions.enter_context(await asyncio.to_thread(zenoh.open, zenoh_config(settings)))

        came: list[int] = []
        robot, stop, operator = (
            await joined(link.endpoint),
            await joined(router.endpoint),
            await joined(router.endpoint),
        )
        robot.declare_subscriber("macs/to/ros/*/7/**", lambda sample: came.append(len(sample.payload)))
        stop.declare_queryable("macs/call/stop", lambda query: query.reply("macs/call/stop", b"yes"))

        async def heard() -> bool:
            await asyncio.to_thread(operator.put, ROBOT, b"x")
            return bool(came)

        async def answered() -> bool:
            return bool(await asyncio.to_thread(lambda: list(operator.get("macs/call/stop", timeout=20))))

        await until(heard)
        await until(answered)
        link.hold_down()
        try:
            putters = [_Putter(await joined(router.endpoint)) for _ in range(PUTTING)]
            await until(lambda: all(each.is_done for each in putters))
            assert await answered()
        finally:
            link.release()
