"""What our programs put on the network as ROS nodes, beside recordings of the real middleware."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest
import zenoh

from bridge.rmw_zenoh.goals import FEEDBACK
from bridge.rmw_zenoh.session import ZenohSession
from bridge.rmw_zenoh.types import KnownTypes
from bridge.ros.side import GoalTold
from bridge.ros.types import InterfaceName
from macs_zenoh.config import MeshSettings
from macs_zenoh.mesh.ros_network import Request, RosNetwork
from macs_zenoh.protocol.rmw_zenoh.attachment import parse_attachment
from macs_zenoh.protocol.rmw_zenoh.keyexpr import Endpoint, Kind, parse_token
from tests.support.rmw_vectors import rows, tokens
from tests.support.waiting import PATIENCE_S, get, until

pytest.importorskip("xxhash", reason="being a ROS node needs xxhash: pip install 'macs-zenoh[rmw-zenoh]'")

DOMAIN = 50
"""In which all was recorded."""
FIBONACCI = "int32 order\n---\nint32[] sequence\n---\nint32[] sequence\n"
ACTION = "example_interfaces/action/Fibonacci"
GOAL_ID = bytes.fromhex("7301588b55254c678cf2fc7fff481e1e")


@asynccontextmanager
async def network(router: str) -> AsyncIterator[RosNetwork]:
    async with await RosNetwork.open(MeshSettings(connect=[router])) as made:
        yield made


@asynccontextmanager
async def plain(router: str) -> AsyncIterator[zenoh.Session]:
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", f'["{router}"]')
    session = await asyncio.to_thread(zenoh.open, config)
    try:
        yield session
    finally:
        await asyncio.to_thread(session.close)


def hexed(data: Any) -> str:
    return data.to_bytes().hex() if data is not None else ""


def named(value: Any, kind: Any) -> str:
    """A value of one of Zenoh's enums, as the recordings have it."""
    return next(name for name in ("DATA", "DROP", "BLOCK", "REAL_TIME") if getattr(kind, name, None) == value)


def fixed(attachment: bytes) -> bytes:
    """What is the same each time: how long the GID is."""
    assert parse_attachment(attachment) is not None
    return attachment[16:17]


async def test_messages_as_recorded(router: str) -> None:
    """Each message that was recorded, put by a publisher of the same token, is the same on the network: key, payload,
    encoding, priority, congestion control; with a time, a whole attachment, and its number."""
    wanted: dict[str, list[dict[str, Any]]] = {}
    for row in rows("puts"):
        if row["kind"] == "put" and "@adv" not in row["key"]:
            wanted.setdefault(row["key"], []).append(row)
    publishers = [found for found in map(parse_token, tokens()) if isinstance(found, Endpoint)]
    by_key = {found.key: found for found in publishers if found.kind is Kind.PUBLISHER and found.key in wanted}
    assert len(by_key) >= 14
    heard: asyncio.Queue[zenoh.Sample] = asyncio.Queue()
    loop = asyncio.get_running_loop()
    async with plain(router) as session, network(router) as ours:
        listening = session.declare_subscriber(
            f"{DOMAIN}/**", lambda sample: loop.call_soon_threadsafe(heard.put_nowait, sample)
        )
        told = session.liveliness().declare_token("listening")
        await until(lambda: list(ours.session.liveliness().get("listening")))  # it has the subscriber, too
        node = ours.node(DOMAIN, "talker", "/robot1")
        for key, endpoint in by_key.items():
            publisher = node.publisher(endpoint.topic, endpoint.type, endpoint.hash, endpoint.qos)
            for number, row in enumerate(wanted[key], start=1):
                publisher.publish(bytes.fromhex(row["payload_hex"]))
                sample = await get(heard)
                seen = {
                    "key": str(sample.key_expr),
                    "payload_hex": hexed(sample.payload),
                    "encoding": str(sample.encoding),
                    "priority": named(sample.priority, zenoh.Priority),
                    "congestion_control": named(sample.congestion_control, zenoh.CongestionControl),
                    "express": sample.express,
                }
                assert seen == {name: row[name] for name in seen}
                assert sample.timestamp is not None
                attached = parse_attachment(sample.attachment.to_bytes())
                assert attached is not None
                assert (attached.number, attached.gid) == (number, publisher.gid)
                assert fixed(sample.attachment.to_bytes()) == fixed(bytes.fromhex(row["attachment_hex"]))
            publisher.close()
        told.undeclare()
        listening.undeclare()


async def test_requests_and_replies_as_recorded(router: str) -> None:
    """A client asks as the recorded one did, and a server answers so: payloads, attachments, target and quality."""
    recorded = rows("wire_service_call")
    asked = [row for row in recorded if row["kind"] == "query"]
    answered = [row for row in recorded if row["kind"] == "reply"]
    endpoint = next(
        found
        for found in map(parse_token, [row["key"] for row in recorded if row["kind"] == "declare_token"])
        if isinstance(found, Endpoint) and found.kind is Kind.SERVICE
    )
    loop = asyncio.get_running_loop()
    requests: asyncio.Queue[Request] = asyncio.Queue()
    async with plain(router) as session, network(router) as ours:
        node = ours.node(DOMAIN, "lamp", "/robot1")
        served = node.service(
            endpoint.topic,
            endpoint.type,
            endpoint.hash,
            lambda request: loop.call_soon_threadsafe(requests.put_nowait, request) and None,
        )
        client = node.client(endpoint.topic, endpoint.type, endpoint.hash)
        assert served.endpoint.key == asked[0]["key"]
        querier = session.declare_querier(asked[0]["key"], target=zenoh.QueryTarget.ALL_COMPLETE)
        await until(lambda: querier.matching_status.matching, PATIENCE_S)  # the way there is known
        for question, answer in zip(asked, answered, strict=True):
            replies = session.get(
                question["key"],
                payload=bytes.fromhex(question["payload_hex"]),
                attachment=bytes.fromhex(question["attachment_hex"]),
                target=zenoh.QueryTarget.ALL_COMPLETE,
                consolidation=zenoh.ConsolidationMode.NONE,
            )
            request = await get(requests)
            assert request.cdr.hex() == question["payload_hex"]
            served.answer(request, bytes.fromhex(answer["payload_hex"]))
            (reply,) = await asyncio.to_thread(list, replies)
            assert reply.ok is not None
            seen = {
                "key": str(reply.ok.key_expr),
                "payload_hex": hexed(reply.ok.payload),
                "encoding": str(reply.ok.encoding),
                "priority": named(reply.ok.priority, zenoh.Priority),
                "congestion_control": named(reply.ok.congestion_control, zenoh.CongestionControl),
            }
            assert seen == {name: answer[name] for name in seen}
            attached = hexed(reply.ok.attachment)
            assert (attached[:16], attached[32:]) == (answer["attachment_hex"][:16], answer["attachment_hex"][32:])
        served.close()
        await until(lambda: not client.is_ready())
        queries: asyncio.Queue[zenoh.Query] = asyncio.Queue()
        standing_in = session.declare_queryable(
            endpoint.key, lambda query: loop.call_soon_threadsafe(queries.put_nowait, query), complete=True
        )
        for number, question in enumerate(asked, start=1):

            async def comes(question: dict[str, Any] = question) -> bool:
                client.call(bytes.fromhex(question["payload_hex"]), lambda response, problem: None)
                return not queries.empty()

            if number == 1:  # until the way there is known
                await until(comes, PATIENCE_S)
            else:
                client.call(bytes.fromhex(question["payload_hex"]), lambda response, problem: None)
            query = await get(queries)
            while number > 1 and hexed(query.payload) == asked[0]["payload_hex"]:  # one more of the first
                query.drop()
                query = await get(queries)
            assert (hexed(query.payload), str(query.parameters)) == (question["payload_hex"], "")
            assert fixed(query.attachment.to_bytes()) == fixed(bytes.fromhex(question["attachment_hex"]))
            query.drop()
        standing_in.undeclare()


async def test_an_action_as_recorded(router: str, tmp_path: Path) -> None:
    """A goal is given, fed back, finished and cancelled with the bytes of the recorded client, against a server that
    answers with those of the recorded one."""
    (tmp_path / "example_interfaces" / "action").mkdir(parents=True)
    (tmp_path / "example_interfaces" / "action" / "Fibonacci.action").write_text(FIBONACCI, encoding="utf-8")
    recorded = rows("wire_action_client")
    loop = asyncio.get_running_loop()
    asked: list[str] = []
    async with network(router) as theirs, network(router) as ours:
        server = theirs.node(DOMAIN, "fib_server")
        services: dict[str, Any] = {}
        queries = [
            row for row in recorded if row["kind"] == "query" and "_action" in row["key"] and row["payload_hex"]
        ]
        replies = {row["rid"]: row["payload_hex"] for row in recorded if row["kind"] == "reply"}
        answers = {row["payload_hex"]: replies[row["rid"]] for row in queries if row["rid"] in replies}
        declared = [row["key"] for row in recorded if row["kind"] == "declare_token"]
        found = [parse_token(key) for key in declared if key.startswith("@ros2_lv/")]
        ends = {
            (one.topic, one.type, one.hash)
            for one in found
            if isinstance(one, Endpoint) and one.kind is Kind.SERVICE and "_action" in one.topic
        }
        assert len(ends) == 3

        def answer(name: str, request: Request) -> None:
            asked.append(request.cdr.hex())
            services[name].answer(request, bytes.fromhex(answers[request.cdr.hex()]))

        for topic, of_type, type_hash in ends:
            services[topic] = server.service(
                topic, of_type, type_hash, lambda request, topic=topic: answer(topic, request)
            )
        fed = [row for row in recorded if row["kind"] == "put" and "FeedbackMessage" in row["key"]]
        key = fed[0]["key"].split("/")
        feedback = server.publisher("/fibonacci/_action/feedback", f"{ACTION}_FeedbackMessage", key[-1], FEEDBACK)
        types = await asyncio.to_thread(KnownTypes, [tmp_path])
        session = ZenohSession(ours, types, domain=DOMAIN)
        try:
            name = InterfaceName.parse(ACTION, "action")
            of = await session.run(lambda: session.action(name, "/fibonacci"))
            goals = await session.run(lambda: session.goals(of, "/fibonacci"))
            await until(goals.is_ready, PATIENCE_S)
            told: asyncio.Queue[tuple[Any, ...]] = asyncio.Queue()

            def tell(*what: Any) -> None:
                loop.call_soon_threadsafe(told.put_nowait, what)

            def telling(verb: str) -> Any:
                return lambda *what: tell(verb, *what)

            given = GoalTold(telling("accepted"), telling("fed back"), telling("finished"), telling("failed"))
            goals.send(GOAL_ID, b"\0\1\0\0" + (3).to_bytes(4, "little"), given)
            assert await get(told) == ("accepted", True)
            verb, status, result = await get(told)
            assert (verb, status) == ("finished", 4)
            assert types.types.deserialize(f"{ACTION}_Result", result) == {"sequence": [0, 1, 1, 2, 3]}
            for row in fed:
                if row["payload_hex"][8:40] == GOAL_ID.hex():
                    feedback.publish(bytes.fromhex(row["payload_hex"]))  # of a goal that has ended: nobody is told
            other = bytes.fromhex("434274a56e7040a28fa47910bee838ba")
            goals.cancel(other, telling("cancelled"))
            assert await get(told) == ("cancelled", 0, True, "")
            assert set(asked) <= set(answers)
            assert asked[0] == queries[0]["payload_hex"]
        finally:
            await asyncio.to_thread(session.close)
