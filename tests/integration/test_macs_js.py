"""macs.js comes back as the same headset when its connection was lost: a real gateway, node, a robot of the mesh."""

from __future__ import annotations

import json

from macs_zenoh import join
from macs_zenoh.protocol.messages import ROS, AddNode, decode_data
from macs_zenoh.serving import Call
from tests.support.browser import ROOT, STATIC, needs_node, node
from tests.support.given import StartGateway
from tests.support.local import patient
from tests.support.processes import finished
from tests.support.waiting import until

SCRIPT = ROOT / "tests" / "page" / "resume.mjs"


@needs_node
async def test_it_comes_back_as_the_same_headset(start_gateway: StartGateway, router: str) -> None:
    """Cut off, it is back with its id and its registrations, and hears once and in order all that was said to it;
    what it registered meanwhile is registered."""
    registered: list[str] = []

    async def add_node(call: Call) -> bytes:
        registered.append(decode_data(AddNode, call.data).tos_name)
        return b""

    gateway = await start_gateway(web_port=0)
    async with join(ROS, id=1, settings=patient(router)) as robot:
        robot.serve("add_node", add_node)
        await until(lambda: gateway.directory.ids(ROS) == [1])
        url = f"ws://127.0.0.1:{gateway.listeners.web_port}/macs"
        command = [*(node() or []), str(SCRIPT), str(STATIC), url]
        code, out, errors = await finished(*command)
    assert code == 0, errors
    told = json.loads(out)
    assert told["back"] == told["id"]
    assert told["links"] == [[True, told["id"], False], [False, told["id"], False], [True, told["id"], True]]
    assert told["heard"] == [f"{when} {number}" for when in ("before", "asleep", "after") for number in range(20)]
    assert registered == ["/state", "/later"]
    assert told["asked"] == "offline"  # a question that cannot go now does not go
    assert (told["sent"], told["bad"]) == (True, 0)
    assert told["online"]["robots"] == [1]
