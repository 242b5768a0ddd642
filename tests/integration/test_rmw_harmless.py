"""Beside ROS nodes that run rmw_zenoh: what none of our programs does, since such nodes end by it.

`macs_zenoh.ros` stands for the nodes here; what it serves would tell of a request without payload or attachment, and a
queryable on all that a robot's keys can be sees every query that meets one.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any, NamedTuple

import pytest
import zenoh

import macs_zenoh
from macs_zenoh import ros
from macs_zenoh.protocol.rmw_zenoh.attachment import parse_attachment
from macs_zenoh.protocol.rmw_zenoh.cdr import looks_like_cdr
from macs_zenoh.typed import request_of
from tests.support.programs import Program, ended
from tests.support.routers import Router
from tests.support.waiting import PATIENCE_S, until

pytest.importorskip("xxhash", reason="being a ROS node needs xxhash: pip install 'macs-zenoh[rmw-zenoh]'")
pytestmark = pytest.mark.timeout(300)

DOMAIN = 9


class Seen(NamedTuple):
    """A query or a put that met the keys of robots."""

    key: str
    payload: bytes
    attachment: bytes


@asynccontextmanager
async def watched(endpoint: str) -> AsyncIterator[list[Seen]]:
    """Queries and puts on keys of ROS domains."""
    seen: list[Seen] = []

    def note(asked: Any) -> None:
        payload, attachment = asked.payload, asked.attachment
        seen.append(
            Seen(
                str(asked.key_expr),
                payload.to_bytes() if payload is not None else b"",
                attachment.to_bytes() if attachment is not None else b"",
            )
        )

    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", f'["{endpoint}"]')
    session = await asyncio.to_thread(zenoh.open, config)
    try:
        noted = zenoh.handlers.Callback(note, indirect=False)
        kept = [
            declared
            for domain in (0, DOMAIN)
            for declared in (
                session.declare_queryable(f"{domain}/**", noted, complete=True),
                session.declare_subscriber(f"{domain}/**", noted),
            )
        ]
        yield seen
        del kept
    finally:
        await asyncio.to_thread(session.close)


async def switch(request: dict[str, Any]) -> dict[str, Any]:
    return {"success": request["data"], "message": "switched"}


async def test_no_program_asks_or_puts_what_ends_a_node() -> None:
    """Programs that look, ask, recover and stop, beside a robot that is used: all that meets its keys are requests on
    the exact key of its service and messages of its topics, each whole."""
    async with (
        Router() as router,
        watched(router.endpoint) as seen,
        ros.node("lamp", domain=DOMAIN, connect=[router.endpoint]) as node,
        Program("gateway", "--port", "0", "-e", router.endpoint),
        Program("rmw-zenoh", "--id", "7", "--domain", str(DOMAIN), "-e", router.endpoint),
        macs_zenoh.join("unity", id=300, connect=[router.endpoint]) as agent,
    ):
        node.serve("/lamp", "std_srvs/SetBool", switch)
        orders = node.subscribe("/orders", "std_msgs/String")
        await until(lambda: agent.directory.ids(1) == [7], PATIENCE_S)
        for argv in (("ls", "-v"), ("doctor",), ("stop",), ("stop", "--release", "--all"), ("ls",)):
            code, _, errors = await ended(*argv, "-e", router.endpoint)
            assert code in (0, 1), (argv, errors)
        answer = await agent.call_service("/lamp", {"data": True}, robot=7)
        assert answer == {"success": True, "message": "switched"}
        coming = asyncio.ensure_future(orders.receive())

        async def comes() -> bool:
            await agent.publish("/orders", {"data": "go"}, robot=7)
            return coming.done()

        await until(comes, PATIENCE_S, every_s=0.05)
        assert coming.result().value == {"data": "go"}
        service = [each for each in seen if "/lamp/" in each.key]
        assert len(service) == 1
        assert [each for each in seen if "*" in each.key or not looks_like_cdr(each.payload)] == []
        assert [each for each in seen if parse_attachment(each.attachment) is None] == []


async def test_what_is_no_cdr_is_not_put(router: str) -> None:
    """A payload that would end a node is refused here, to who would put it."""
    async with ros.node("talker", domain=DOMAIN, connect=[router]) as node:
        talking = node.publisher("/chatter", "std_msgs/String")
        for bad in (b"", b"\0\1\0\0", b'{"data": 1}', b"\0\3\0\0abcd"):
            with pytest.raises(macs_zenoh.UsageError, match="no CDR"):
                talking.publish(bad)


async def test_what_others_put_wrongly_ends_nothing(router: str) -> None:
    """Messages and requests without an attachment, with a short one, without payload or with none of CDR, and queries
    for everything: each is counted, and what is right still comes."""
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", f'["{router}"]')
    session = await asyncio.to_thread(zenoh.open, config)
    try:
        async with (
            ros.node("lamp", domain=DOMAIN, connect=[router]) as node,
            ros.node("talker", domain=DOMAIN, connect=[router]) as other,
        ):
            heard = node.subscribe("/orders", "std_msgs/String")
            node.serve("/lamp", "std_srvs/SetBool", switch)
            key, service = heard._made.endpoint.key, node._made[1]._made.endpoint.key
            whole = bytes(8) + bytes(8) + b"\x10" + bytes(16)
            for attachment in (None, b"", b"x" * 20, whole[:-1] + b"", b"\0" * 33, whole + b"\0"):
                await asyncio.to_thread(session.put, key, b"\0\1\0\0\1\0\0\0\0", attachment=attachment)
                await asyncio.to_thread(
                    lambda a=attachment: list(session.get(service, payload=b"\0\1\0\0\1", attachment=a))
                )
            for payload in (b"", b"{}", b"\0\1\0\0", b"\xff" * 100):
                await asyncio.to_thread(session.put, key, payload, attachment=whole)
                await asyncio.to_thread(lambda p=payload: list(session.get(service, payload=p, attachment=whole)))
            await asyncio.to_thread(session.delete, key, attachment=whole)
            await asyncio.to_thread(lambda: list(session.get("**", timeout=2.0)))
            await asyncio.to_thread(lambda: list(session.get(f"{DOMAIN}/**", timeout=2.0)))
            talking = other.publisher("/orders", "std_msgs/String")

            coming = asyncio.ensure_future(heard.receive())

            def comes() -> bool:
                talking.publish({"data": "right"})
                return coming.done()

            await until(comes, PATIENCE_S, every_s=0.05)
            assert coming.result().value == {"data": "right"}
            assert (await other.call("/lamp", "std_srvs/SetBool", {"data": True}))["message"] == "switched"
            assert node.drops["bad_attachment"] >= 10
            assert node.drops["bad_cdr"] >= 6
            assert node.drops["bad_kind"] == 1
    finally:
        await asyncio.to_thread(session.close)


async def test_what_is_cut_short_is_not_put() -> None:
    """A headset's message, and its request, that say they are longer than they are: refused with the reason. Nothing
    of them meets the robot's keys, and what is whole does."""
    async with (
        Router() as router,
        watched(router.endpoint) as seen,
        ros.node("planner", domain=DOMAIN, connect=[router.endpoint]) as node,
        Program("rmw-zenoh", "--id", "7", "--domain", str(DOMAIN), "-e", router.endpoint),
        macs_zenoh.join("unity", id=300, connect=[router.endpoint]) as agent,
    ):
        node.subscribe("/orders", "std_msgs/String")
        node.serve("/plan", "nav_msgs/GetPlan", plan)
        await until(lambda: agent.directory.ids(1) == [7], PATIENCE_S)
        orders = await agent.advertise("/orders", robot=7)
        refused: list[str] = []
        orders.on_refused(lambda robot, reason: refused.append(reason))
        whole = b"\0\1\0\0\2\0\0\0A\0"

        def is_refused() -> bool:
            orders.publish(b"\0\1\0\0\xff\xff\0\0A\0\0\0\0")
            return any("cut off" in reason for reason in refused)

        await until(is_refused, PATIENCE_S, every_s=0.05)

        def is_put() -> bool:
            orders.publish(whole)
            return any("/orders/" in each.key for each in seen)

        await until(is_put, PATIENCE_S, every_s=0.05)
        asked = node.types.serialize(request_of("nav_msgs/srv/GetPlan"), {"tolerance": 0.5})
        for size in (5, 12, len(asked) - 1):
            with pytest.raises(macs_zenoh.Refused, match="cut off"):
                await agent.call_service("/plan", asked[:size], robot=7)
        await agent.call_service("/plan", asked, robot=7)
        assert {each.payload for each in seen if "/orders/" in each.key} == {whole}
        assert [each.payload for each in seen if "/plan/" in each.key] == [asked]


async def plan(request: dict[str, Any]) -> dict[str, Any]:
    return {"plan": {"header": {"frame_id": "map"}}}
