"""What a recording knows of what a robot has, where the robot could not tell it of a change."""

from __future__ import annotations

from typing import Any

import pytest

pytest.importorskip("mcap", reason="needs the extra record: pip install 'macs-zenoh[record]'")

import macs_zenoh
from bridge.recording import follower
from bridge.recording.follower import RobotFollower
from bridge.recording.schema_source import Schemas
from macs_zenoh.errors import Refused
from macs_zenoh.protocol.messages import AddNode, decode_data, encode_data
from macs_zenoh.protocol.robot_state import Offered
from tests.support.local import patient
from tests.support.waiting import until


async def test_a_topic_of_which_nothing_was_heard_is_followed(router: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A robot that has a topic more, and whose word of that is lost, is asked again what it has."""
    monkeypatch.setattr(follower, "LOOK_S", 0.2, raising=False)
    publishers = {"/a": "std_msgs/String"}
    registered: set[str] = set()

    async def offers(_: macs_zenoh.Call) -> bytes:
        return encode_data(Offered(publishers=dict(publishers)))

    async def add_node(call: macs_zenoh.Call) -> bytes:
        registered.add(decode_data(AddNode, call.data).tos_name)
        return b""

    async def definitions(_: macs_zenoh.Call) -> bytes:
        raise Refused("what is installed will do")

    async with (
        macs_zenoh.join("ros", id=7, settings=patient(router)) as robot,
        macs_zenoh.join("operator", id=5, settings=patient(router)) as recorder,
    ):
        robot.serve("offers", offers)
        robot.serve("add_node", add_node)
        robot.serve("definitions", definitions)
        notes: list[Any] = []
        following = RobotFollower(
            recorder,
            7,
            notes,  # type: ignore[arg-type]  # nothing comes
            Schemas(recorder),
            wants=lambda topic: True,
            carried_out=False,
            on_note=notes.append,
            on_stop_state=lambda: None,
        )
        try:
            await until(lambda: registered == {"/a"})
            publishers["/b"] = "std_msgs/String"
            await until(lambda: registered == {"/a", "/b"})
        finally:
            following.close()
