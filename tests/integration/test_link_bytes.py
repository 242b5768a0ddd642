"""What the links of a session have carried, as the kernel counts it, against a relay that counts as well."""

from __future__ import annotations

import asyncio
import sys
from pathlib import Path

import pytest

from bridge import link_bytes
from macs_zenoh.mesh import Mesh, Traffic
from macs_zenoh.protocol import ping
from macs_zenoh.protocol.keyexpr import PING
from tests.support.links import counted
from tests.support.local import patient
from tests.support.waiting import until

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells it")

SENT_BYTES = 1_000_000


async def test_a_program_tells_what_its_link_has_carried(router: str) -> None:
    """What went out and came in is told to whoever pings it, to the byte that the relay counts at rest; of another
    link nothing; asking leaves no descriptor behind."""
    async with (
        counted(router) as link,
        await Mesh.open(patient(link.endpoint)) as mesh,
        await Mesh.open(patient(router)) as other,
    ):
        link_bytes.tell_of(mesh)
        answering = mesh.answer_pings()
        came: list[int] = []
        subscription = other.subscribe("macs/from/**", lambda batch: came.extend(len(data) for _, data in batch))
        await until(lambda: (mesh.put("macs/from/ros/7/nd__x", b"", Traffic.STREAM), came)[1])
        for _ in range(100):
            mesh.put("macs/from/ros/7/nd__x", bytes(SENT_BYTES // 100), Traffic.STREAM)
            await asyncio.sleep(0.001)
        await until(lambda: sum(came) >= SENT_BYTES)

        async def told() -> tuple[int, int]:
            said = ping.decode(await other.query(PING.of(zid=mesh.zid), b"", timeout_s=60))[0]
            assert said.link_bytes is not None
            return said.link_bytes

        open_before = len(list(Path("/proc/self/fd").iterdir()))
        before = (link.up_bytes, link.down_bytes)
        counts = await told()
        after = (link.up_bytes, link.down_bytes)
        assert before[0] - 2000 <= counts[0] <= after[0] + 2000  # beats and the question itself
        assert before[1] - 2000 <= counts[1] <= after[1] + 2000
        assert counts[0] > SENT_BYTES
        for _ in range(20):
            assert (await told())[0] >= counts[0]
        assert len(list(Path("/proc/self/fd").iterdir())) <= open_before + 1
        assert link_bytes.LinkBytes().of([("tcp/127.0.0.1:1", "tcp/127.0.0.1:2")]) is None
        assert link_bytes.LinkBytes().of([("unixsock-stream/a", "unixsock-stream/b")]) is None
        assert link_bytes.LinkBytes().of([]) is None
        subscription.close()
        answering.close()
