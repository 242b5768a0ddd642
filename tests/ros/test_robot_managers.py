"""An own management message on a robot: the worked example of docs/managers.md beside a real ROS graph."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path

import pytest

import macs_zenoh
from bridge.ros.program import open_robot
from bridge.settings import RobotSettings, Settings
from macs_zenoh.config import MeshSettings
from macs_zenoh.mesh import Mesh
from macs_zenoh.protocol.messages import Metadata
from tests.support.programs import free_port
from tests.support.waiting import PATIENCE_S

EXAMPLES = Path(__file__).parents[2] / "examples"


async def test_a_robot_answers_an_own_management_message(domain: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """The listed manager gets typed data and its answer has the request id; bad data is counted."""
    monkeypatch.syspath_prepend(str(EXAMPLES))
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    mesh = MeshSettings(connect=[endpoint])
    settings = Settings(mesh=mesh, robot=RobotSettings(id=1, managers=["macs_clock.clock_comparer:ClockComparer"]))
    async with (
        await Mesh.open(MeshSettings(mode="router", listen=[endpoint])),
        open_robot(settings, domain_id=domain) as robot,
        macs_zenoh.join("unity", settings=mesh) as asker,
    ):
        metadata = Metadata(request_id=5, message_manager="ClockComparer")
        for data in (b"not json", b'{"sentAtS": "soon"}', b'{"sentAtS": -1}', b'{"sentAtS": 1760000000.25}'):
            asker.send(data, to="ros", ids=[1], metadata=metadata)
        answer = await asyncio.wait_for(asker.receive(), PATIENCE_S)
        assert answer.metadata.request_id == 5
        assert json.loads(answer.data)["sentAtS"] == 1760000000.25
        assert json.loads(answer.data)["asker"] == f"2/{asker.id}"
        assert robot.nodes.drops["refused_by_manager"] == 3
