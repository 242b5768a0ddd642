"""The Python headset against recorded router bytes, and against faults that the real gateway does not have."""

from __future__ import annotations

import asyncio
import contextlib
import json
import socket
from collections.abc import AsyncIterator

import pytest

from bridge.headset.client import Headset, Link
from bridge.headset.nodes import ServiceRequest
from macs_zenoh.errors import CallTimeout, TooManyDestinations, Unreachable, UsageError
from macs_zenoh.protocol.messages import EXTENSIONS, Metadata, NodeType, node_name
from macs_zenoh.protocol.wire import Frame, encode_message, parse_frame
from tests.support.waiting import PATIENCE_S
from tests.unit.scripted_router import WELCOME, ScriptedRouter, recorded, welcome

STRING = "std_msgs/String"
SET_BOOL = "std_srvs/SetBool"


@pytest.fixture
async def router() -> AsyncIterator[ScriptedRouter]:
    async with ScriptedRouter() as router:
        yield router


@pytest.fixture
async def headset(router: ScriptedRouter) -> AsyncIterator[Headset]:
    async with await Headset.connect("127.0.0.1", router.port, extensions=0) as headset:  # as in the recordings
        await router.until(lambda: bool(router.frames))
        yield headset


def node_message(kind: int, tos_name: str, data: bytes, *, sender: int = 1, request_id: int = 0) -> bytes:
    """A message of a node as a robot sends it."""
    metadata = Metadata(1, sender, request_id, "", kind, node_name(tos_name), STRING)
    return encode_message(metadata.encode(), data)


def plain_message(data: bytes, *, sender: int | None = 3, sender_type: int | None = 2) -> bytes:
    """A message outside nodes."""
    return encode_message(Metadata(sender_type, sender, message_manager="SomeManager").encode(), data)


# --- the handshake ---


@pytest.mark.parametrize("group", [0, 3])
async def test_the_handshake_is_the_recorded_one(router: ScriptedRouter, group: int) -> None:
    """The headset takes the id it is given and answers with its group, as recorded."""
    async with await Headset.connect("127.0.0.1", router.port, group=group, extensions=0) as headset:
        await router.until(lambda: bool(router.frames))
        assert headset.id == 7
        assert router.frames == recorded(f"handshake_group{group}", "agent->router")


async def test_it_says_that_it_is_newer(router: ScriptedRouter) -> None:
    """Unless told otherwise the headset says which extensions it understands, and again with every other group."""
    async with await Headset.connect("127.0.0.1", router.port) as headset:
        await headset.set_group(3)
        await router.until(lambda: len(router.frames) == 2)
        said = [json.loads(parse_frame(frame).management) for frame in router.frames]
        assert [(frame["groupId"], frame["extensions"]) for frame in said] == [(0, EXTENSIONS), (3, EXTENSIONS)]


async def test_going_offline_is_the_recorded_frame(router: ScriptedRouter, headset: Headset) -> None:
    """Closing says goodbye as recorded and then ends the connection; a second close does nothing."""
    await headset.go_offline()
    await router.until(lambda: router.ended == 1)
    assert router.frames[1:] == recorded("stop_go_offline_group0", "agent->router")
    await headset.close()
    assert await headset.wait_ended() == "closed here"


async def test_vanishing_says_nothing(router: ScriptedRouter, headset: Headset) -> None:
    """A headset that loses power sends no goodbye."""
    await headset.abort()
    await router.until(lambda: router.ended == 1)
    assert len(router.frames) == 1


async def test_nobody_listens(unused_tcp_port: int) -> None:
    """Where nobody listens the headset says so at once."""
    with pytest.raises(Unreachable, match=f"127.0.0.1:{unused_tcp_port} cannot be reached"):
        await Headset.connect("127.0.0.1", unused_tcp_port)


@pytest.mark.parametrize(
    ("greeting", "why"),
    [
        (b"", "sent no id within 0.1 s"),
        (WELCOME[:50], "sent no id within 0.1 s"),
        (plain_message(b"hello"), "not 'AgentConfigurer'"),
        (encode_message(b"", b""), "metadata is not valid JSON"),
        (b"\xff" * 40, "bytes was declared"),
        (encode_message(Metadata(message_manager="AgentConfigurer").encode(), b"{}"), "gives no id"),
    ],
    ids=["silence", "half", "other", "empty", "huge", "no id"],
)
async def test_a_wrong_greeting_ends_it(greeting: bytes, why: str) -> None:
    """A router whose first message gives no id in time is not one, and its connection is closed."""
    async with ScriptedRouter(greeting) as router:
        with pytest.raises(Unreachable, match=why):
            await Headset.connect("127.0.0.1", router.port, handshake_timeout_s=0.1)
        await router.until(lambda: router.ended == 1)


async def test_small_frames_leave_at_once(headset: Headset) -> None:
    """Nagle's algorithm is off: commands are small and must not wait for each other."""
    raw = headset._connection._stream._writer.get_extra_info("socket")  # type: ignore[union-attr]
    assert raw.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)


async def test_a_later_id_is_taken_and_answered(router: ScriptedRouter, headset: Headset) -> None:
    """The router may give a new id at any time; what follows carries it."""
    router.send(welcome(12, 5))
    reply = parse_frame((await router.received(1))[0])
    assert json.loads(reply.management) == {
        "agentType": 2,
        "agentId": 12,
        "groupId": 0,
        "requestId": 5,
        "messageManager": "AgentclientConfigurer",
    }
    await headset.send(b"x")
    assert Metadata.decode(parse_frame((await router.received(2))[1]).metadata).sender_agent_id == 12


async def test_moving_to_a_group_answers_again(router: ScriptedRouter, headset: Headset) -> None:
    """Another group is a second configuration reply with the first request id."""
    await headset.set_group(3)
    assert await router.received(1) == recorded("handshake_group3", "agent->router")


# --- what it says ---


async def test_it_registers_as_recorded(router: ScriptedRouter, headset: Headset) -> None:
    """Topics and services of every kind are registered with the recorded bytes, in order."""
    await headset.subscribe("/chatter", STRING, agents=[1])
    await headset.subscribe("camera/image", "sensor_msgs/CompressedImage", agents=[1, 2])
    await headset.subscribe("~/pose", "geometry_msgs/Pose", groups=[4])
    await headset.subscribe("/cmd_vel", "geometry_msgs/Twist", groups=[4, 5], buffer_size=1, drop_new=True)
    await headset.advertise("/talk", STRING, agents=[1])
    await headset.advertise("/goal", "geometry_msgs/Pose", groups=[4])
    await headset.advertise("/img", "sensor_msgs/CompressedImage", agents=[1], groups=[4], latched=True, buffer_size=3)
    expected = recorded("register", "agent->router")
    assert await router.received(7) == expected[:7]
    await headset.serve("/serve", SET_BOOL, lambda _: b"", agents=[1])
    await headset.serve("/serveg", SET_BOOL, lambda _: b"", groups=[4])
    assert (await router.received(9))[7:] == expected[9:]


async def test_it_registers_only_where_it_is_not_yet(router: ScriptedRouter, headset: Headset) -> None:
    """More robots and groups on a known node are registered alone, as recorded."""
    chatter = await headset.subscribe("/chatter", STRING, agents=[1])
    talk = await headset.advertise("/talk", STRING, agents=[1])
    await chatter.register(agents=[2])
    await chatter.register(agents=[2, 3])
    await chatter.register(groups=[4])
    await talk.register(agents=[2, 3])
    await talk.register(groups=[4, 5])
    await talk.register(agents=[3], groups=[4])
    await headset.send(b"")
    sent = await router.received(8)
    assert sent[2:7] == recorded("register_more", "agent->router")[:5]
    assert not parse_frame(sent[7]).has_management


async def test_it_leaves_agents_and_groups(router: ScriptedRouter, headset: Headset) -> None:
    """Leaving some robots is one message, closing a node two: agents, then groups, as recorded."""
    expected = recorded("deregister", "agent->router")
    chatter = await headset.subscribe("/chatter", STRING, agents=[1, 2])
    talk = await headset.advertise("/talk", STRING, agents=[1, 2, 3], groups=[4, 5])
    await chatter.deregister(agents=[2])
    await talk.close()
    sent = await router.received(5)
    assert sent[2:] == [expected[0], expected[4], expected[5]]
    assert [node.spec.tos_name for node in headset.nodes] == ["/chatter"]


async def test_it_leaves_groups_as_groups(router: ScriptedRouter, headset: Headset) -> None:
    """Leaving one group names it as a group; the C# program names it as an agent."""
    talk = await headset.advertise("/talk", STRING, groups=[4, 5])
    await talk.deregister(groups=[4])
    management = json.loads(parse_frame((await router.received(2))[1]).management)
    assert (management["registrarAgentIds"], management["registrarGroupIds"]) == ([], [4])
    assert talk.groups == {5}


async def test_it_publishes_as_recorded(router: ScriptedRouter, headset: Headset) -> None:
    """Publishing registers once, then sends the recorded frames to where the topic is registered."""
    talk = await headset.advertise("/talk", STRING, agents=[1, 2, 3], groups=[4, 5])
    expected = recorded("publish", "agent->router")
    for frame in expected[:3]:
        await talk.publish(bytes(parse_frame(frame).body))
    assert (await router.received(4))[1:] == expected[:3]


async def test_publishing_registers_first(router: ScriptedRouter, headset: Headset) -> None:
    """One call of publish is a registration and the message; the next one only the message, to those it names."""
    await headset.publish("/talk", STRING, b"1", agents=[1])
    await headset.publish("/talk", STRING, b"2", agents=[1])
    await headset.publish("/talk", STRING, b"3", agents=[2])
    sent = [parse_frame(data) for data in await router.received(5)]
    assert [frame.has_management for frame in sent] == [True, False, False, True, False]
    assert [frame.header.ids for frame in sent] == [(), (1,), (1,), (), (2,)]


async def test_publishing_to_nobody_is_refused(headset: Headset) -> None:
    """A publisher without robots and groups does not pretend to send; neither does one with too many."""
    talk = await headset.advertise("/talk", STRING)
    with pytest.raises(UsageError, match="no robot and no group"):
        await talk.publish(b"")
    await talk.register(agents=range(1, 12))
    with pytest.raises(TooManyDestinations):
        await talk.publish(b"")


async def test_it_sends_as_recorded(router: ScriptedRouter, headset: Headset) -> None:
    """Data for ids and groups of both types is sent with the recorded bytes."""
    await headset.send(b"hi", to=1, ids=[5], manager="SomeManager")
    await headset.send(b"hi", to=2, ids=[5, 6], manager="SomeManager")
    await headset.send(b"hi", to=1, groups=[4], manager="SomeManager")
    await headset.send(b"hi", to=0, groups=[4, 5], manager="SomeManager")
    await headset.send(b"hi", to=1, ids=[5], manager="SomeManager", request_id=2)
    assert await router.received(5) == recorded("communicator", "agent->router")


async def test_a_second_node_of_a_kind_is_refused(headset: Headset) -> None:
    """Two subscriptions whose names collide on the wire are refused and the first one stays."""
    await headset.subscribe("/a/b", STRING, agents=[1])
    with pytest.raises(UsageError, match="/a_b: there is a node of this kind for /a/b"):
        await headset.subscribe("/a_b", STRING, agents=[1])
    await headset.advertise("/a/b", STRING, agents=[1])
    assert len(headset.nodes) == 2


async def test_heartbeats_come_only_in_silence(router: ScriptedRouter) -> None:
    """After the set time without other output there is a heartbeat, again and again, and never before."""
    async with await Headset.connect("127.0.0.1", router.port, heartbeat_s=0.1) as headset:
        loop = asyncio.get_running_loop()
        for _ in range(2):
            heartbeats = router.heartbeats
            await headset.send(b"x")
            sent_at = loop.time()
            await router.until(lambda before=heartbeats: router.heartbeats > before)
            assert loop.time() - sent_at >= 0.09


# --- what it hears ---


async def test_online_is_the_recorded_dialogue(router: ScriptedRouter, headset: Headset) -> None:
    """Requests count from 0 and each gets its recorded answer."""
    answers = iter(recorded("online_agents", "router->agent"))

    async def answer(frame: Frame) -> bytes | None:
        return next(answers) if b"OnlineAgentsGetter" in frame.management else None

    router.answer = answer
    for _ in range(2):
        reply = await headset.online()
        assert (reply.ros_agent_ids, reply.unity_agent_ids) == ([1, 2], [7])
    assert await router.received(2) == recorded("online_agents", "agent->router")


async def test_an_unanswered_question_times_out(headset: Headset) -> None:
    """Without an answer the question fails in time, and the next one may succeed."""
    with pytest.raises(CallTimeout, match=r"no answer within 0\.01 s"):
        await headset.online(timeout_s=0.01)


async def test_calls_are_the_recorded_dialogue(router: ScriptedRouter, headset: Headset) -> None:
    """Calls register once per robot, count requests from 0 and take the recorded answers."""
    answers = iter(recorded("call_service", "router->agent"))

    async def answer(frame: Frame) -> bytes | None:
        return None if frame.has_management else next(answers)

    router.answer = answer
    true, false = b"\x00\x01\x00\x00\x01", b"\x00\x01\x00\x00\x00"
    expected = b"\x00\x01\x00\x00\x01\x00\x00\x00\x03\x00\x00\x00ok\x00"
    assert await headset.call("/set", SET_BOOL, 1, true) == expected
    assert await headset.call("/set", SET_BOOL, 2, false) == expected
    assert await headset.call("/set", SET_BOOL, 1, true) == expected
    sent = await router.received(5)
    assert [sent[1], sent[3], sent[4]] == recorded("call_service", "agent->router")
    assert sent[0] == recorded("register", "agent->router")[7]


async def test_an_answer_goes_to_its_own_call(router: ScriptedRouter, headset: Headset) -> None:
    """Answers that overtake each other reach the calls they belong to; other robots' answers reach none."""
    calls = [asyncio.create_task(headset.call("/set", SET_BOOL, robot, b"")) for robot in (1, 2, 1)]
    await router.received(5)
    router.send(node_message(NodeType.CLIENT, "/set", b"not asked", sender=9, request_id=0))
    for sender, request_id in ((1, 2), (2, 1), (1, 0)):
        data = b"%d" % request_id
        router.send(node_message(NodeType.CLIENT, "/set", data, sender=sender, request_id=request_id))
    assert await asyncio.gather(*calls) == [b"0", b"1", b"2"]


async def test_a_call_times_out_alone(router: ScriptedRouter, headset: Headset) -> None:
    """A call without an answer fails in time; its late answer disturbs nobody."""
    with pytest.raises(CallTimeout, match="service /set of robot 1"):
        await headset.call("/set", SET_BOOL, 1, b"", timeout_s=0.01)
    router.send(node_message(NodeType.CLIENT, "/set", b"late", request_id=0))
    router.send(plain_message(b"after"))
    assert (await headset.receive(PATIENCE_S)).data == b"after"


async def test_it_serves_as_recorded(router: ScriptedRouter, headset: Headset) -> None:
    """A request of a robot is answered to that robot with its request id, as recorded."""
    requests: list[ServiceRequest] = []

    async def done(request: ServiceRequest) -> bytes:
        requests.append(request)
        return b"\x00\x01\x00\x00\x01\x00\x00\x00\x05\x00\x00\x00done\x00"

    await headset.serve("/serve", SET_BOOL, done, agents=[1])
    await headset.serve("/serveg", SET_BOOL, lambda _: b"\x00\x01\x00\x00" + bytes(4) + b"\x01" + bytes(4))
    incoming = recorded("serve_service", "router->agent")
    expected = recorded("serve_service", "agent->router")
    router.send(incoming[0])
    assert (await router.received(2))[1:] == expected[:1]
    router.send(incoming[1])
    assert (await router.received(3))[2:] == expected[1:]
    assert requests == [ServiceRequest(1, 17, b"\x00\x01\x00\x00\x01")]


async def test_a_faulty_service_costs_one_answer(
    router: ScriptedRouter, headset: Headset, caplog: pytest.LogCaptureFixture
) -> None:
    """A handler that fails is logged and the next request is served."""

    def handler(request: ServiceRequest) -> bytes:
        if request.request_id == 0:
            raise ValueError("broken")
        return b"fine"

    await headset.serve("/ask", SET_BOOL, handler, agents=[1])
    for request_id in (0, 1):
        router.send(node_message(NodeType.SERVICE, "/ask", b"", request_id=request_id))
    answer = parse_frame((await router.received(2))[1])
    assert bytes(answer.body) == b"fine"
    assert "the handler of /ask failed" in caplog.text


async def test_it_receives_recorded_topic_data(router: ScriptedRouter, headset: Headset) -> None:
    """Topic data arrives with and without a manager's name, because the node's name counts first."""
    chatter = await headset.subscribe("/chatter", STRING, agents=[1, 2])
    for message in recorded("subscribe_data", "router->agent"):
        router.send(message)
    got = [await chatter.__anext__() for _ in range(2)]
    assert [message.sender_id for message in got] == [1, 2]
    assert [message.data[8:-1] for message in got] == [b"from ros", b"no manager"]


async def test_messages_in_pieces_are_whole(router: ScriptedRouter, headset: Headset) -> None:
    """Messages that arrive byte by byte, or many at once, come out whole and in order."""
    messages = [plain_message(b"%d" % number) for number in range(50)]
    for byte in messages[0]:
        router.send(bytes([byte]))
    router.send(b"".join(messages[1:]))
    got = [(await headset.receive(PATIENCE_S)).data for _ in messages]
    assert got == [b"%d" % number for number in range(50)]


async def test_a_callback_gets_every_message(router: ScriptedRouter, headset: Headset) -> None:
    """A callback sees all messages, and one that fails costs only its own message."""
    seen: list[bytes] = []

    def callback(message: object) -> None:
        seen.append(message.data)  # type: ignore[attr-defined]
        if len(seen) == 1:
            raise ValueError("broken")

    await headset.subscribe("/chatter", STRING, agents=[1], callback=callback)
    router.send(b"".join(node_message(1, "/chatter", b"%d" % number) for number in range(100)))
    router.send(plain_message(b"end"))
    await headset.receive(PATIENCE_S)
    assert seen == [b"%d" % number for number in range(100)]


@pytest.mark.parametrize(("drop_new", "kept"), [(False, [7, 8, 9]), (True, [0, 1, 2])])
async def test_a_slow_taker_costs_no_memory(
    router: ScriptedRouter, headset: Headset, drop_new: bool, kept: list[int]
) -> None:
    """Without a taker the last messages stay, or the first ones, and the others are counted."""
    chatter = await headset.subscribe("/chatter", STRING, agents=[1], buffer_size=3, drop_new=drop_new)
    router.send(b"".join(node_message(1, "/chatter", b"%d" % number) for number in range(10)))
    router.send(plain_message(b"end"))
    await headset.receive(PATIENCE_S)
    assert [int((await chatter.__anext__()).data) for _ in range(3)] == kept
    assert chatter.dropped == 7


async def test_a_waiting_taker_loses_nothing(router: ScriptedRouter, headset: Headset) -> None:
    """A taker that is as fast as the socket gets every message of a burst larger than its buffer."""
    chatter = await headset.subscribe("/chatter", STRING, agents=[1], buffer_size=2)
    seen: list[int] = []

    async def take() -> None:
        async for message in chatter:
            seen.append(int(message.data))
            if len(seen) == 500:
                return

    taking = asyncio.create_task(take())
    router.send(b"".join(node_message(1, "/chatter", b"%d" % number) for number in range(500)))
    await asyncio.wait_for(taking, PATIENCE_S)
    assert seen == list(range(500))


@pytest.mark.parametrize(
    "bad",
    [
        encode_message(b"", b"data"),
        encode_message(b"{not json", b""),
        encode_message(b"[]", b""),
        encode_message(b'{"nodeType": "x"}', b""),
        encode_message(Metadata(2, 3, 0, "", 1, "nd__chatter", STRING).encode(), b"from a headset"),
    ],
    ids=["no metadata", "no JSON", "no object", "wrong type", "node data from a headset"],
)
async def test_bad_messages_are_survived(router: ScriptedRouter, headset: Headset, bad: bytes) -> None:
    """A bad message is counted and the next one arrives; the C# program goes deaf on some of these."""
    chatter = await headset.subscribe("/chatter", STRING, agents=[1])
    router.send(bad + node_message(1, "/chatter", b"good"))
    assert (await chatter.__anext__()).data == b"good"
    assert headset.bad_messages == 1


async def test_a_pausing_headset_reads_nothing(router: ScriptedRouter, headset: Headset) -> None:
    """Paused, the headset leaves data in the socket but goes on sending; resumed, it has lost nothing."""
    router.send(plain_message(b"first"))
    await headset.receive(PATIENCE_S)
    headset.pause()
    router.send(plain_message(b"one read was under way"))
    await headset.receive(PATIENCE_S)
    router.send(plain_message(b"second"))
    await headset.send(b"still here")
    await router.received(1)
    with pytest.raises(CallTimeout):
        await headset.receive(0.05)
    headset.resume()
    assert (await headset.receive(PATIENCE_S)).data == b"second"


# --- its end ---


async def test_it_tells_when_the_router_ends_it(router: ScriptedRouter) -> None:
    """When the router closes, every wait ends, whoever asks hears why, and the link's watcher too."""
    links: list[Link] = []
    headset = await Headset.connect("127.0.0.1", router.port, on_link=links.append)
    chatter = await headset.subscribe("/chatter", STRING, agents=[1])
    call = asyncio.create_task(headset.call("/set", SET_BOOL, 1, b""))
    await router.received(3)
    router.close()
    assert await asyncio.wait_for(headset.wait_ended(), PATIENCE_S) == "the router closed the connection"
    assert [message async for message in chatter] == []
    with pytest.raises(Unreachable, match="closed the connection"):
        await call
    with pytest.raises(Unreachable, match="closed the connection"):
        await headset.receive()
    with pytest.raises(Unreachable):
        await headset.send(b"x")
    assert [link.up for link in links] == [True, False]
    await headset.close()


async def test_lost_framing_ends_it(router: ScriptedRouter, headset: Headset) -> None:
    """A size that cannot be true ends the connection, since the next message cannot be found."""
    router.send(b"\xff\xff\xff\xff")
    assert "4294967303 bytes was declared" in await asyncio.wait_for(headset.wait_ended(), PATIENCE_S)


async def test_it_comes_back_and_registers_everything() -> None:
    """With reconnect a lost connection is made again, with a new id, and all nodes are registered anew."""
    links: list[Link] = []
    async with ScriptedRouter(welcome(3, 1)) as router:
        async with await Headset.connect(
            "127.0.0.1", router.port, group=4, reconnect=True, on_link=links.append
        ) as headset:
            chatter = await headset.subscribe("/chatter", STRING, agents=[2, 1], groups=[5])
            await headset.advertise("/talk", STRING, agents=[1])
            await router.received(2)
            router.greeting = welcome(8, 2)
            router.frames.clear()
            router.cut()
            configuration, *nodes = (parse_frame(data) for data in [*await router.received(2), router.frames[0]][::-1])
            assert json.loads(configuration.management)["agentId"] == 8
            assert json.loads(configuration.management)["groupId"] == 4
            managements = sorted((json.loads(node.management) for node in nodes), key=lambda m: m["nodeType"])
            assert [m["tosName"] for m in managements] == ["/chatter", "/talk"]
            assert (managements[0]["registrarAgentIds"], managements[0]["registrarGroupIds"]) == ([1, 2], [5])
            assert all(m["registrantAgentId"] == 8 for m in managements)
            router.send(node_message(1, "/chatter", b"again"))
            assert (await chatter.__anext__()).data == b"again"
        assert [link.up for link in links] == [True, False, True, False]


async def test_what_is_asked_for_while_away_is_done_later() -> None:
    """A subscription made without a connection is registered with the next one; a message is refused."""
    async with ScriptedRouter() as router:
        port = router.port
        lost = asyncio.Event()
        headset = await Headset.connect(
            "127.0.0.1", port, reconnect=True, on_link=lambda link: None if link.up else lost.set()
        )
        router._server.close()
        router.cut()
        await asyncio.wait_for(lost.wait(), PATIENCE_S)
        assert headset.reconnecting
        await headset.subscribe("/chatter", STRING, agents=[1])
        with pytest.raises(Unreachable):
            await headset.send(b"x")
    later = ScriptedRouter()
    later.port = port
    async with later:
        (registration,) = await later.received(1)
        assert registration == recorded("register", "agent->router")[0]
        await headset.close()


async def test_closing_while_away_ends_at_once(router: ScriptedRouter) -> None:
    """A headset that is trying to reconnect can be closed."""
    headset = await Headset.connect("127.0.0.1", router.port, reconnect=True)
    router._server.close()
    router.cut()
    await asyncio.wait_for(headset.close(), PATIENCE_S)
    assert await headset.wait_ended() == "closed here"


async def test_closing_ends_what_swallows_a_cancellation(headset: Headset) -> None:
    """A task that a first cancellation does not end, as asyncio's own wait_for can bring about, holds up no close."""

    async def stubborn() -> None:
        with contextlib.suppress(asyncio.CancelledError):
            await asyncio.sleep(60)
        await asyncio.sleep(60)

    headset._tasks.append(asyncio.create_task(stubborn()))
    await asyncio.sleep(0)
    await asyncio.wait_for(headset.close(), PATIENCE_S)
