"""Services both ways on real ROS nodes: who asks gets the answer, and what fails is told in time."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import AsyncIterator
from typing import Any

import pytest
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message, serialize_message
from std_msgs.msg import String
from std_srvs.srv import Empty, SetBool, Trigger

from bridge.ros.early import EarlyMessages
from bridge.ros.interface import Registrant, Robot
from bridge.ros.nodes import InterfaceNodes
from bridge.ros.rules import Rules
from bridge.ros.served import ServiceNode
from bridge.ros.services import ClientNode
from bridge.ros.session import RosSession
from bridge.settings import RobotSettings, TopicRule
from macs_zenoh.errors import Refused
from macs_zenoh.protocol.messages import CallFailure, Metadata, NodeType, decode_data, encode_data, node_name
from macs_zenoh.protocol.reading import Message
from tests.support.delays import Delays
from tests.support.ros_peer import Peer, adding, reaches, removing
from tests.support.thorough import some
from tests.support.waiting import PATIENCE_S, get, until

DEADLINE_S = 0.5
IN_VAIN = ("/hangs", "/nowhere", "/silent", "/empty", "/every_third")
"""Services that let callers wait for their deadline."""
SET = "std_srvs/SetBool"


class Headsets:
    """What robot 7 sends to headsets."""

    def __init__(self) -> None:
        self.sent: asyncio.Queue[tuple[Registrant, Metadata, bytes]] = asyncio.Queue()
        self.answer: Any = None
        """Called with (metadata, data) of each message, if set, in place of the queue."""

    def send(self, to: Registrant, metadata: Metadata, data: bytes) -> None:
        if self.answer is not None:
            self.answer(to, metadata, data)
        else:
            self.sent.put_nowait((to, metadata, data))


@pytest.fixture
async def headsets() -> Headsets:
    return Headsets()


@pytest.fixture
async def nodes(session: RosSession, headsets: Headsets) -> AsyncIterator[InterfaceNodes]:
    rules = Rules(
        RobotSettings(
            call_timeout_s=PATIENCE_S,
            rules=[
                TopicRule(match="/code", call_timeout_s=DEADLINE_S, error_response={"message": "E1"}),
                *(TopicRule(match=match, call_timeout_s=DEADLINE_S) for match in IN_VAIN),
            ],
        )
    )
    nodes = InterfaceNodes(Robot(session, 7, lambda node, frame: None, send=headsets.send, rules=rules))
    yield nodes
    nodes.close()


def request(
    service: str, data: Any, *, number: int = 0, sender: int = 5, node_type: int = NodeType.CLIENT, manager: str = ""
) -> Message:
    """A headset's request (type 3) or answer (type 4); ``data`` is CDR or a ROS message."""
    cdr = data if isinstance(data, bytes) else bytes(serialize_message(data))
    metadata = Metadata(2, sender, number, manager, node_type, node_name(service), SET)
    return Message("unity", sender, metadata, cdr)


def said(request: Any, response: Any) -> Any:
    response.success = request.data
    response.message = f"robot says {request.data}"
    return response


# -- type 3: a headset calls -----------------------------------------------------------------------------------------


async def test_a_headset_calls_a_ros_service(nodes: InterfaceNodes, headsets: Headsets, peer: Peer) -> None:
    """The answer goes to who asked, registered or not, with its request id, node and an empty manager."""
    await peer.service(SetBool, "/set", said, nodes.robot.session)
    await nodes.add(adding("/set", SET, node_type=3))
    nodes.deliver(request("/set", SetBool.Request(data=True), number=0))
    nodes.deliver(request("/set", SetBool.Request(data=False), number=1, sender=900))
    answers = sorted([await get(headsets.sent) for _ in range(2)])
    for (to, metadata, data), sender, number in zip(answers, (5, 900), (0, 1), strict=True):
        assert to == Registrant(2, sender)
        assert metadata == Metadata(1, 7, number, "", NodeType.CLIENT, "nd__set", SET)
        assert deserialize_message(data, SetBool.Response).message == f"robot says {number == 0}"


async def test_many_calls_are_open_at_once(nodes: InterfaceNodes, headsets: Headsets, peer: Peer) -> None:
    """Two hundred calls of three headsets are all answered, each to its own."""
    await peer.service(SetBool, "/slow", said, nodes.robot.session, depth=1000)
    await nodes.add(adding("/slow", SET, node_type=3))
    asked = {(5 + number % 3, number) for number in range(200)}
    for sender, number in asked:
        nodes.deliver(request("/slow", SetBool.Request(data=True), number=number, sender=sender))
    answers = [await get(headsets.sent) for _ in asked]
    assert {(to.id, metadata.request_id) for to, metadata, _ in answers} == asked


@pytest.mark.parametrize("asks", [True, False])
async def test_an_absent_service_is_told_to_who_asks_for_that(
    nodes: InterfaceNodes, headsets: Headsets, asks: bool
) -> None:
    """A program that knows failures hears of one before the deadline; an existing one hears nothing, and times out."""
    await nodes.add(adding("/nowhere", SET, node_type=3))
    manager = CallFailure.manager if asks else ""
    nodes.deliver(request("/nowhere", SetBool.Request(), number=3, manager=manager))
    await until(lambda: nodes.drops["call_absent"] == 1)
    if not asks:
        assert headsets.sent.empty()
        return
    _, metadata, data = await get(headsets.sent)
    assert metadata == Metadata(1, 7, 3, CallFailure.manager, NodeType.CLIENT, "nd__nowhere", SET)
    failure = decode_data(CallFailure, data)
    assert failure.kind == "absent"
    assert "there is no service /nowhere" in failure.reason


async def test_a_service_that_comes_late_is_called(nodes: InterfaceNodes, headsets: Headsets, peer: Peer) -> None:
    """A call shortly before its service starts is answered."""
    await nodes.add(adding("/slow", SET, node_type=3))
    nodes.deliver(request("/slow", SetBool.Request(data=True)))
    await peer.service(SetBool, "/slow", said, nodes.robot.session)
    _, _, data = await get(headsets.sent)
    assert deserialize_message(data, SetBool.Response).success


async def test_a_slow_service_times_out_and_others_go_on(
    nodes: InterfaceNodes, headsets: Headsets, peer: Peer, domain: int
) -> None:
    """A service that hangs costs its own callers the deadline and nobody else anything."""
    wake = threading.Event()
    slow = Peer(domain, "slow")

    def hang(request: Any, response: Any) -> Any:
        wake.wait(60)
        return response

    try:
        await slow.service(SetBool, "/hangs", hang, nodes.robot.session)
        await peer.service(SetBool, "/set", said, nodes.robot.session)
        for service in ("/hangs", "/set"):
            await nodes.add(adding(service, SET, node_type=3))
        began = time.monotonic()
        nodes.deliver(request("/hangs", SetBool.Request(), number=1, manager=CallFailure.manager))
        nodes.deliver(request("/set", SetBool.Request(data=True), number=2))
        assert (await get(headsets.sent))[1].request_id == 2
        _, metadata, data = await get(headsets.sent)
        assert metadata.request_id == 1
        assert decode_data(CallFailure, data).kind == "timeout"
        assert time.monotonic() - began >= DEADLINE_S
    finally:
        wake.set()
        slow.session.close()


@pytest.mark.parametrize("bad", [b"", b"\x00", b"\x00\x01\x00\x00", b"\xff" * 30, b"\x01\x00\x00\x00\x01"])
async def test_a_bad_request_is_refused(nodes: InterfaceNodes, headsets: Headsets, peer: Peer, bad: bytes) -> None:
    """What is no request never reaches the service, is told, and the next request is answered."""
    await peer.service(SetBool, "/set", said, nodes.robot.session)
    await nodes.add(adding("/set", SET, node_type=3))
    nodes.deliver(request("/set", bad, number=1, manager=CallFailure.manager))
    assert decode_data(CallFailure, (await get(headsets.sent))[2]).kind == "invalid"
    nodes.deliver(request("/set", SetBool.Request(data=True), number=2))
    assert (await get(headsets.sent))[1].request_id == 2


async def test_a_call_that_nobody_registered_is_refused(
    nodes: InterfaceNodes, headsets: Headsets, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A call of a node that does not come is told after the time that it waits for its registration."""
    monkeypatch.setattr(EarlyMessages, "HOLD_S", 0.02)
    nodes.deliver(request("/none", SetBool.Request(), manager=CallFailure.manager))
    assert decode_data(CallFailure, (await get(headsets.sent))[2]).kind == "refused"


async def test_every_call_before_its_registration_is_answered(
    nodes: InterfaceNodes, headsets: Headsets, peer: Peer
) -> None:
    """Twenty first calls at once, which overtake the registration, have twenty answers."""
    await peer.service(SetBool, "/slow", said, nodes.robot.session)
    for number in range(20):
        nodes.deliver(request("/slow", SetBool.Request(data=True), number=number, manager=CallFailure.manager))
    await nodes.add(adding("/slow", SET, node_type=3))
    answers = [await get(headsets.sent) for _ in range(20)]
    assert {metadata.request_id for _, metadata, _ in answers} == set(range(20))
    assert all(deserialize_message(data, SetBool.Response).success for _, _, data in answers)


async def test_calls_wait_for_a_node_that_opens_slowly(
    nodes: InterfaceNodes, headsets: Headsets, peer: Peer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A call is not given up while its node is being made, however long that takes."""
    monkeypatch.setattr(EarlyMessages, "HOLD_S", 0.02)
    await peer.service(SetBool, "/slow", said, nodes.robot.session)
    settle = ClientNode.settle

    async def slowly(node: ClientNode) -> None:
        await settle(node)
        await asyncio.sleep(0.3)

    monkeypatch.setattr(ClientNode, "settle", slowly)
    adding_it = asyncio.create_task(nodes.add(adding("/slow", SET, node_type=3)))
    await asyncio.sleep(0)
    nodes.deliver(request("/slow", SetBool.Request(data=True), manager=CallFailure.manager))
    await adding_it
    assert deserialize_message((await get(headsets.sent))[2], SetBool.Response).success


async def test_no_call_is_lost_without_a_word(
    nodes: InterfaceNodes, headsets: Headsets, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Those that are more than can wait for a registration are told, whatever room they lacked."""
    monkeypatch.setattr(EarlyMessages, "CALLS_PER_NODE", 3)
    for number in range(5):
        nodes.deliver(request("/none", SetBool.Request(), number=number, manager=CallFailure.manager))
    monkeypatch.setattr(EarlyMessages, "BYTES", 0)
    nodes.deliver(request("/none", SetBool.Request(), number=5, manager=CallFailure.manager))
    told = [await get(headsets.sent) for _ in range(6)]
    assert [metadata.request_id for _, metadata, _ in told] == [0, 1, 5, 2, 3, 4]
    assert {decode_data(CallFailure, data).kind for _, _, data in told} == {"refused"}


async def test_a_service_of_another_type_is_refused(nodes: InterfaceNodes, peer: Peer) -> None:
    """A service that exists with another type cannot be registered, and the reason names its type."""
    await peer.service(SetBool, "/set", said, nodes.robot.session)
    await until(lambda: nodes.robot.session.node.count_services("/set") == 1)
    with pytest.raises(Refused, match="/set has type std_srvs/srv/SetBool on this robot, not std_srvs/srv/Trigger"):
        await nodes.add(adding("/set", "std_srvs/Trigger", node_type=3))


async def test_open_calls_end_with_their_node(nodes: InterfaceNodes, headsets: Headsets) -> None:
    """Who waits when the last registrant leaves is told at once."""
    await nodes.add(adding("/slow", SET, node_type=3))
    nodes.deliver(request("/slow", SetBool.Request(), manager=CallFailure.manager))
    nodes.remove(removing("/slow", node_type=3))
    assert decode_data(CallFailure, (await get(headsets.sent))[2]).kind in {"refused"}


# -- type 4: a headset serves ----------------------------------------------------------------------------------------


class Caller:
    """Calls a service from another ROS node."""

    def __init__(self, peer: Peer, kind: Any, service: str) -> None:
        self._peer, self._kind = peer, kind
        self.client = peer.session.node.create_client(kind, service, qos_profile=QoSProfile(depth=100))
        self._loop = asyncio.get_running_loop()

    async def ready(self) -> None:
        await until(self.client.service_is_ready)

    def call(self, request: Any) -> asyncio.Future[tuple[Any, float]]:
        """The response, and the time it took."""
        done: asyncio.Future[tuple[Any, float]] = self._loop.create_future()
        began = time.monotonic()

        def send() -> None:
            self.client.call_async(request).add_done_callback(
                lambda future: self._loop.call_soon_threadsafe(
                    done.set_result, (future.result(), time.monotonic() - began)
                )
            )

        self._peer.session.submit(send)
        return done


async def caller_of(nodes: InterfaceNodes, peer: Peer, service: str, kind: Any = SetBool) -> Caller:
    """A headset's service, and who calls it."""
    await nodes.add(adding(service, f"std_srvs/{kind.__name__}", node_type=4))
    caller = await peer.session.run(lambda: None) or Caller(peer, kind, service)
    await caller.ready()
    return caller


@pytest.mark.parametrize("manager", ["", CallFailure.manager], ids=["plain", "copies the manager"])
async def test_a_ros_node_calls_a_headset(nodes: InterfaceNodes, headsets: Headsets, peer: Peer, manager: str) -> None:
    """The headset gets the request, and its answer with that request id is the response, whatever manager it names."""
    caller = await caller_of(nodes, peer, "/ask")
    response = caller.call(SetBool.Request(data=True))
    to, metadata, data = await get(headsets.sent)
    assert to == Registrant(2, 5)
    assert metadata == Metadata(1, 7, metadata.request_id, CallFailure.manager, NodeType.SERVICE, "nd__ask", SET)
    assert deserialize_message(data, SetBool.Request).data
    answer = SetBool.Response(success=True, message="headset says")
    nodes.deliver(request("/ask", answer, number=metadata.request_id, node_type=4, manager=manager))
    assert (await asyncio.wait_for(response, PATIENCE_S))[0] == answer


async def test_a_second_headset_cannot_serve_the_same(nodes: InterfaceNodes, headsets: Headsets, peer: Peer) -> None:
    """It is refused with a reason, its answers count for nothing, and it can register when the first has left."""
    caller = await caller_of(nodes, peer, "/ask")
    with pytest.raises(Refused, match="/ask is already registered by another agent, and service has only one"):
        await nodes.add(adding("/ask", SET, node_type=4, registrant=6))
    response = caller.call(SetBool.Request())
    _, metadata, _ = await get(headsets.sent)
    for sender, text in ((6, "intruder"), (5, "headset")):
        answer = SetBool.Response(message=text)
        nodes.deliver(request("/ask", answer, number=metadata.request_id, node_type=4, sender=sender))
    assert (await asyncio.wait_for(response, PATIENCE_S))[0].message == "headset"
    nodes.forget(Registrant(2, 5))
    await nodes.add(adding("/ask", SET, node_type=4, registrant=6))


@pytest.mark.parametrize(
    ("service", "kind", "reason"),
    [("/silent", SetBool, "no answer from unity/5"), ("/silent", Trigger, "no answer"), ("/code", SetBool, "E1")],
)
async def test_a_silent_headset_is_an_error_at_the_deadline(
    nodes: InterfaceNodes, headsets: Headsets, peer: Peer, service: str, kind: Any, reason: str
) -> None:
    """The ROS caller gets a response that says no success and why, or what the settings say."""
    caller = await caller_of(nodes, peer, service, kind)
    response, took_s = await asyncio.wait_for(caller.call(kind.Request()), PATIENCE_S)
    assert not response.success
    assert reason in response.message
    assert took_s >= DEADLINE_S


async def test_a_type_without_fields_is_answered_too(nodes: InterfaceNodes, headsets: Headsets, peer: Peer) -> None:
    """std_srvs/Empty has no place for a reason; its caller goes on all the same."""
    caller = await caller_of(nodes, peer, "/empty", Empty)
    assert (await asyncio.wait_for(caller.call(Empty.Request()), PATIENCE_S))[0] == Empty.Response()


BAD_ANSWERS = [b"", b"\x00", b"\x00\x01\x00\x00", b"\xff" * 20, b"\x00\x01\x00\x00\x01\x00\x00\x00\xff\xff\xff\x7f"]


@pytest.mark.parametrize("bad", BAD_ANSWERS)
async def test_an_answer_that_is_none_is_an_error_at_once(
    nodes: InterfaceNodes, headsets: Headsets, peer: Peer, bad: bytes
) -> None:
    """Bytes that are no response give the caller an error, and the next call is answered."""
    caller = await caller_of(nodes, peer, "/slow")
    response = caller.call(SetBool.Request())
    number = (await get(headsets.sent))[1].request_id
    nodes.deliver(request("/slow", bad, number=number, node_type=4))
    assert "is no std_srvs/srv/SetBool" in (await asyncio.wait_for(response, PATIENCE_S))[0].message
    response = caller.call(SetBool.Request())
    number = (await get(headsets.sent))[1].request_id
    nodes.deliver(request("/slow", SetBool.Response(success=True), number=number, node_type=4))
    assert (await asyncio.wait_for(response, PATIENCE_S))[0].success


async def test_a_headset_can_say_that_it_failed(nodes: InterfaceNodes, headsets: Headsets, peer: Peer) -> None:
    """Its reason is the caller's, without waiting for the deadline."""
    caller = await caller_of(nodes, peer, "/slow")
    response = caller.call(SetBool.Request())
    number = (await get(headsets.sent))[1].request_id
    failure = encode_data(CallFailure("failed", "nobody wears me"))
    nodes.deliver(request("/slow", failure, number=number, node_type=4, manager=CallFailure.manager))
    assert "unity/5 failed: nobody wears me" in (await asyncio.wait_for(response, PATIENCE_S))[0].message


async def test_a_headset_that_vanishes_ends_its_calls(nodes: InterfaceNodes, headsets: Headsets, peer: Peer) -> None:
    """Callers hear at once that the headset has left, and the service is gone."""
    caller = await caller_of(nodes, peer, "/slow")
    responses = [caller.call(SetBool.Request()) for _ in range(3)]
    for _ in responses:
        await get(headsets.sent)
    nodes.forget(Registrant(2, 5))
    for response in responses:
        assert "has left" in (await asyncio.wait_for(response, PATIENCE_S))[0].message
    await until(lambda: not caller.client.service_is_ready())


async def test_what_a_service_answers_at_its_end_is_read(
    nodes: InterfaceNodes, headsets: Headsets, peer: Peer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is there until the last answer has arrived, also when that takes a while."""
    monkeypatch.setattr(ServiceNode, "LINGER_S", 2.0)
    caller = await caller_of(nodes, peer, "/slow")
    response = caller.call(SetBool.Request())
    await get(headsets.sent)
    peer.session.submit(lambda: time.sleep(0.2))  # the caller is busy
    nodes.forget(Registrant(2, 5))
    assert "has left" in (await asyncio.wait_for(response, PATIENCE_S))[0].message
    assert caller.client.service_is_ready()
    await until(lambda: not caller.client.service_is_ready())


async def test_a_service_at_its_end_is_not_kept_by_callers(
    nodes: InterfaceNodes, headsets: Headsets, peer: Peer
) -> None:
    """Who calls it meanwhile hears that it is over; it goes all the same, and the next headset serves."""
    caller = await caller_of(nodes, peer, "/ask")
    first = caller.call(SetBool.Request())
    await get(headsets.sent)
    nodes.forget(Registrant(2, 5))
    assert "has left" in (await asyncio.wait_for(first, PATIENCE_S))[0].message
    deadline = time.monotonic() + PATIENCE_S
    while caller.client.service_is_ready():
        assert time.monotonic() < deadline
        caller.call(SetBool.Request())
        await asyncio.sleep(0.02)
    assert headsets.sent.empty()
    await nodes.add(adding("/ask", SET, node_type=4, registrant=6))
    await caller.ready()
    response = caller.call(SetBool.Request())
    to, metadata, _ = await get(headsets.sent)
    assert to == Registrant(2, 6)
    answer = SetBool.Response(success=True, message="next")
    nodes.deliver(request("/ask", answer, number=metadata.request_id, node_type=4, sender=6))
    assert (await asyncio.wait_for(response, PATIENCE_S))[0].message == "next"


async def test_a_thousand_calls_with_every_third_unanswered(
    nodes: InterfaceNodes, headsets: Headsets, peer: Peer
) -> None:
    """Two of three are answered, every third gets its error within the deadline and 0.2 s, and topics go on."""
    caller = await caller_of(nodes, peer, "/every_third")
    await nodes.add(adding("/talk", node_type=NodeType.PUBLISHER))
    heard = await peer.subscription(String, "/talk")
    await reaches(nodes, "/talk")

    def answer(to: Registrant, metadata: Metadata, data: bytes) -> None:
        if metadata.request_id % 3:
            reply = SetBool.Response(success=True, message=str(metadata.request_id))
            nodes.deliver(request("/every_third", reply, number=metadata.request_id, node_type=4))

    headsets.answer = answer
    late: list[tuple[float, float]] = []
    answered = failed = 0
    rounds = some(range(20))
    with Delays() as delays:
        for _ in rounds:
            calls: list[asyncio.Future[tuple[Any, float]]] = []
            for _ in range(10):
                calls += [caller.call(SetBool.Request(data=True)) for _ in range(5)]
                await asyncio.sleep(0.01)
            delay_s = 0.0
            for call in calls:
                response, took_s = await asyncio.wait_for(call, PATIENCE_S)
                if response.success:
                    answered += 1
                else:
                    failed += 1
                    delay_s += delays.s()
                    late.append((took_s - DEADLINE_S, delay_s))
    assert (answered, failed) == (len(rounds) * 50 * 2 // 3, (len(rounds) * 50 + 2) // 3)
    assert all(-0.001 <= late_s < 0.2 + delay_s for late_s, delay_s in late), late
    talk = Metadata(2, 5, node_type=NodeType.PUBLISHER, node_name="nd__talk", data_exchange_type="std_msgs/String")
    nodes.deliver(Message("unity", 5, talk, bytes(serialize_message(String(data="still here")))))
    assert (await get(heard)).data == "still here"


async def test_calls_beyond_the_limit_are_refused(session: RosSession, headsets: Headsets, peer: Peer) -> None:
    """When as many calls are open as allowed, the next gets its error at once."""
    nodes = InterfaceNodes(
        Robot(
            session,
            7,
            lambda node, frame: None,
            send=headsets.send,
            rules=Rules(RobotSettings(max_calls=2, call_timeout_s=PATIENCE_S)),
        )
    )
    caller = await caller_of(nodes, peer, "/ask")
    calls = [caller.call(SetBool.Request()) for _ in range(3)]
    done, _ = await asyncio.wait(calls, return_when=asyncio.FIRST_COMPLETED, timeout=PATIENCE_S)
    (first,) = done
    assert "takes no calls now" in first.result()[0].message
    nodes.close()
    await asyncio.gather(*calls)
