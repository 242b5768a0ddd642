"""What others say of themselves does nothing to the terminal or the log of whoever hears it, in every program."""

from __future__ import annotations

import asyncio
import json
import time

import msgspec
import pytest

import macs_zenoh
from bridge.headset.client import Headset
from macs_zenoh.config import MeshSettings
from macs_zenoh.errors import Refused
from macs_zenoh.mesh import Mesh
from macs_zenoh.protocol import ping
from macs_zenoh.protocol.keyexpr import NAME, PING
from macs_zenoh.protocol.messages import Metadata
from macs_zenoh.protocol.wire import encode_frame, encode_message
from tests.integration.test_bounds import Raw
from tests.support.programs import Program, ended, free_port
from tests.support.waiting import PATIENCE_S, until

EVIL = "x\x1b[2J\x1b]0;owned\x07\r\n12:00:00 I macs.gateway: all is well\x9b31m\u202e\x7f"


def harmless(text: str, *, lines: bool = True) -> None:
    """No control character is left, and no line that somebody else wrote."""
    for line in text.split("\n"):
        assert line.replace("\t", "").isprintable(), line
        assert not line.startswith("12:00:00 I macs.gateway"), line


async def hostile_robot(mesh: Mesh, agent: macs_zenoh.Agent) -> None:
    """Robot 7: all that it can say of itself is hostile."""

    async def pong(key: str, payload: bytes) -> bytes:
        said = ping.pong(mesh.settings, now_s=time.time(), macs=EVIL, zenoh=EVIL, drops={EVIL: 3})
        return ping.encode(msgspec.structs.replace(said, mode=EVIL), payload)

    agent._declared[0].close()  # its own, true answer
    mesh.serve(PING.of(zid=mesh.zid), pong)

    async def status(call: macs_zenoh.Call) -> bytes:
        stop = {"stopped": True, "by": EVIL, "seconds": 1.0, "times": 1, "history": [EVIL]}
        node = {"role": EVIL, "name": EVIL, "type": EVIL, "registrants": [EVIL], "control": {"holder": EVIL}}
        node["carried"] = {"messages": 3, "bytes": 4}
        return json.dumps(
            {"ros_node": EVIL, "stopped": True, "stop": stop, "nodes": [node], "drops": {EVIL: 1}}
        ).encode()

    async def offers(call: macs_zenoh.Call) -> bytes:
        named = {EVIL: EVIL}
        return json.dumps(
            {
                "publishers": named,
                "subscribers": named,
                "services": named,
                "actions": named,
                "qos": {EVIL: {EVIL: EVIL}},
            }
        ).encode()

    async def refuse(call: macs_zenoh.Call) -> bytes:
        raise Refused(EVIL)

    for verb, handler in (("status", status), ("offers", offers), ("stop", refuse), ("add_node", refuse)):
        agent.serve(verb, handler)
    mesh.declare_token(NAME.of(name=EVIL[:100], type=1, id=7, zid=mesh.zid))


@pytest.fixture
async def endpoint() -> str:
    """Where the router of this test listens."""
    return f"tcp/127.0.0.1:{free_port()}"


async def test_every_program_filters_what_it_shows(endpoint: str) -> None:
    """`ls`, `stop`, `doctor`, `headset`, and the logs of gateway and router, beside a robot, a headset and pongs that
    are full of escapes and line breaks."""
    async with (
        Program("router", "-l", endpoint) as router,
        Program("gateway", "--port", "0", "-e", endpoint, "-v") as gateway,
        macs_zenoh.join("ros", id=7, settings=MeshSettings(connect=[endpoint])) as robot,
        await Headset.connect("127.0.0.1", gateway.port) as headset,
    ):
        await hostile_robot(robot.mesh, robot)
        outputs = []
        for command in (
            ("ls", "-e", endpoint),
            ("ls", "-v", "-e", endpoint),
            ("ls", "-v", "--json", "-e", endpoint),
            ("stop", "7", "-e", endpoint, "--timeout", "1"),
            ("stop", "7", "--json", "-e", endpoint, "--timeout", "1"),
            ("doctor", "-e", endpoint, "--quick"),
            ("doctor", "-e", endpoint, "--quick", "--json"),
            ("top", "--once", "-e", endpoint),
            ("top", "--once", "--view", "topics", "-e", endpoint),
            ("top", "--once", "--view", "lost", "-e", endpoint),
            ("top", "--json", "-e", endpoint),
            ("topic", "list", "-v", "-e", endpoint),
            ("topic", "list", "--json", "-e", endpoint),
            ("topic", "info", EVIL, "-v", "-e", endpoint),
            ("topic", "echo", "/chatter", "-e", endpoint),
            ("topic", "pub", "/chatter", "std_msgs/msg/String", "{}", "-1", "-e", endpoint),
            ("service", "list", "-t", "-e", endpoint),
            ("action", "list", "-t", "-e", endpoint),
            ("trace", "/chatter", "--seconds", "0.5", "-e", endpoint),
            ("ping", "7", "--count", "1", "-e", endpoint),
            (
                "headset",
                f"127.0.0.1:{gateway.port}",
                "sub",
                "/chatter",
                "std_msgs/String",
                "--agents",
                "7",
                "--timeout",
                "2",
            ),
        ):
            _, out, errors = await ended(*command)
            harmless(out)
            harmless(errors)
            outputs.append(out + errors)
        assert sum("owned" in output for output in outputs) >= 6  # it was shown, as what it is
        raw = Raw(gateway.port)
        for message in (
            encode_frame(management=json.dumps({"messageManager": EVIL}).encode()),
            encode_frame(2, [headset.id], message=encode_message(json.dumps({EVIL: EVIL, "nodeName": EVIL}).encode())),
            encode_frame(management=b'{"messageManager":"AgentclientConfigurer","agentType":"%s"}' % EVIL.encode()),
        ):
            await raw.send(message)
        await raw.send(encode_frame(2, [headset.id], message=encode_message(Metadata(2, 0, 0, "Hello").encode())))
        while (await asyncio.wait_for(headset.receive(), PATIENCE_S)).metadata.message_manager != "Hello":
            pass
        raw.socket.close()
    for line in [*gateway.log, *router.log]:
        harmless(line)
    await until(lambda: any("unknown message manager" in line for line in gateway.log))
