"""What is asked of robots for agents that have registered, when it is much."""

from __future__ import annotations

import asyncio
import time
from collections import Counter
from typing import Any

import pytest

from macs_zenoh import registration_calls
from macs_zenoh.mesh import Mesh
from macs_zenoh.protocol.directory import AgentInfo, Change, Directory
from macs_zenoh.protocol.messages import UNITY, AddNode, NodeType, RemoveNode
from macs_zenoh.protocol.wire import Layout
from macs_zenoh.registration_calls import RobotCalls
from tests.support.local import patient
from tests.support.waiting import PATIENCE_S

NODES = 200
ROBOT = AgentInfo(1, 7, 0, "a")


def node(number: int) -> AddNode:
    """A registration on one of many topics."""
    return AddNode(UNITY, 256, NodeType.SUBSCRIBER, f"nd__{number}", f"/{number}", "std_msgs/String")


async def test_a_robot_for_which_much_is_registered_comes(router: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its topics are listened to, each before it is asked for it, in many rounds of the loop, of which all others have
    a part; what is taken back or registered anew meanwhile is asked for as it is then."""
    monkeypatch.setattr(registration_calls, "TURN_S", 0.0)
    happened: list[tuple[str, str, int]] = []
    now = 0

    async with await Mesh.open(patient(router)) as mesh:
        ask = mesh.ask

        def asks(key: str, payload: bytes, *args: Any, **how: Any) -> None:
            verb = "remove" if "/remove_node/" in key else "add"
            name = payload.decode(errors="replace").rpartition('"nodeName":"')[2].partition('"')[0]
            happened.append((verb, name, now))
            ask(key, payload, *args, **how)

        monkeypatch.setattr(mesh, "ask", asks)
        calls = RobotCalls(
            mesh,
            Directory(),
            Layout(),
            on_streams=lambda changes: happened.extend(
                ("listen" if registrants else "leave", name, now) for (_, name), registrants in changes
            ),
            on_refused=lambda *_: None,
        )
        for number in range(NODES):
            calls.register(node(number), [7], [])
        assert happened == []
        calls.presence(Change(ROBOT, online=True))
        last = node(NODES - 1)
        calls.register(RemoveNode(UNITY, 256, NodeType.SUBSCRIBER, last.node_name), [7], [])
        names = {node(number).node_name for number in range(NODES - 1)}

        def asked() -> set[str]:
            return {name for what, name, _ in happened if what == "add"}

        deadline = time.monotonic() + PATIENCE_S
        while asked() != names and time.monotonic() < deadline:
            await asyncio.sleep(0)
            now += 1
        assert asked() == names
        calls.close()
    listened = {name: at for at, (what, name, _) in reversed([*enumerate(happened)]) if what == "listen"}
    first_asked = {name: at for at, (what, name, _) in reversed([*enumerate(happened)]) if what == "add"}
    assert listened.keys() == names
    assert all(listened[name] < first_asked[name] for name in names)
    assert max(Counter(round_ for what, _, round_ in happened if what == "listen").values()) <= 4
