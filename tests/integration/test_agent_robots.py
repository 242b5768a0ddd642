"""An agent and several robots: those that refuse, are silent, come late, or lose their router. Without ROS."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Awaitable

import pytest

import macs_zenoh
from macs_zenoh import late, nodes
from macs_zenoh.agent import Agent
from macs_zenoh.errors import Refused
from macs_zenoh.held import Room
from macs_zenoh.protocol.messages import (
    AddNode,
    Metadata,
    NodeType,
    RemoveNode,
    StreamData,
    decode_data,
    encode_data,
    encode_management,
)
from macs_zenoh.protocol.robot_state import Offered, TopicQos
from macs_zenoh.protocol.wire import encode_frame, encode_message
from macs_zenoh.streams import Streams
from macs_zenoh.timeouts import within
from tests.support.local import patient
from tests.support.routers import Router
from tests.support.waiting import PATIENCE_S, until

TOPIC = "/chatter"
STRING = "std_msgs/String"


class Robot:
    """A robot that registers whoever asks, or refuses, and publishes its topic again and again."""

    def __init__(self, agent: Agent, refusal: str = "") -> None:
        self.agent = agent
        self.registrants: set[int] = set()
        self.asked: list[AddNode | RemoveNode] = []
        self.refusal = refusal
        self.may_answer = asyncio.Event()
        self.may_answer.set()
        self._streams = Streams(agent)
        agent.serve("add_node", self._add)
        agent.serve("remove_node", self._remove)

    async def _add(self, call: macs_zenoh.Call) -> bytes:
        node = decode_data(AddNode, call.data)
        self.asked.append(node)
        await self.may_answer.wait()
        if self.refusal:
            raise Refused(self.refusal)
        self.registrants.add(node.registrant_agent_id)
        return b""

    async def _remove(self, call: macs_zenoh.Call) -> bytes:
        node = decode_data(RemoveNode, call.data)
        self.asked.append(node)
        self.registrants.discard(node.registrant_agent_id)
        return b""

    async def chatter(self) -> None:
        while True:
            metadata = Metadata(1, self.agent.id, 0, StreamData.manager, NodeType.SUBSCRIBER, "nd__chatter", STRING)
            management = encode_management(StreamData({"2": sorted(self.registrants)}))
            text = encode_message(metadata.encode(), f"robot {self.agent.id}".encode())
            self._streams.publish("nd__chatter", encode_frame(1, management=management, message=text))
            await asyncio.sleep(0.02)


@contextlib.asynccontextmanager
async def robot(router: str, number: int, group: int = 3, refusal: str = "") -> AsyncIterator[Robot]:
    async with macs_zenoh.join("ros", id=number, group=group, settings=patient(router)) as agent:
        robot = Robot(agent, refusal)
        talking = asyncio.create_task(robot.chatter())
        try:
            yield robot
        finally:
            talking.cancel()


async def knows(agent: Agent, *robots: int) -> None:
    await until(lambda: agent.directory.ids(1) == list(robots), PATIENCE_S)


async def hears(subscription: macs_zenoh.TopicSubscription, *robots: int) -> None:
    """Wait until a message of each of these robots has come, taken from what comes from now on."""
    heard: set[int] = set()
    while not heard >= set(robots):
        message = await asyncio.wait_for(subscription.receive(), PATIENCE_S)
        assert message.data == f"robot {message.robot}".encode()
        heard.add(message.robot)


async def test_some_may_refuse_and_all_may_not(router: str) -> None:
    """Of a group, the robots that let it send; the others are in ``refused``. When all refuse, it raises."""
    async with (
        robot(router, 1),
        robot(router, 2, refusal="not this one") as second,
        macs_zenoh.join("unity", id=300, settings=patient(router)) as agent,
    ):
        await knows(agent, 1, 2)
        some = await agent.subscribe(TOPIC, group=3, type=STRING)
        await hears(some, 1)
        await until(lambda: some.refused == {2: "not this one"}, PATIENCE_S)
        with pytest.raises(macs_zenoh.Refused, match=r"^not this one$"):
            await agent.subscribe(TOPIC, robot=2, type=STRING)
        await hears(some, 1)

        told: list[tuple[int, str]] = []
        some.on_refused(lambda robot, reason: told.append((robot, reason)))
        async with robot(router, 3, refusal="nor this") as third:
            await until(lambda: (3, "nor this") in told, PATIENCE_S)
            third.refusal = second.refusal = ""
            both = await agent.subscribe(TOPIC, robot=[2, 3], type=STRING)
            await hears(both, 2, 3)
            assert both.refused == {}
        some.close()
        both.close()
        await until(lambda: not second.registrants, PATIENCE_S)


async def test_a_refusal_concerns_whom_it_is_about(router: str, caplog: pytest.LogCaptureFixture) -> None:
    """What one robot refuses is no matter of who uses another; a callback that fails costs nothing else."""
    async with (
        robot(router, 1) as first,
        robot(router, 2) as second,
        macs_zenoh.join("unity", id=300, settings=patient(router)) as agent,
    ):
        await knows(agent, 1, 2)
        one, two = [await agent.subscribe(TOPIC, robot=number, type=STRING) for number in (1, 2)]
        told: list[str] = []

        def fail(robot: int, reason: str) -> None:
            told.append("two")
            raise RuntimeError("the program's own fault")

        one.on_refused(lambda robot, reason: told.append("one"))
        two.on_refused(fail)
        second.refusal = "no more"
        with pytest.raises(macs_zenoh.Refused):
            await agent.subscribe(TOPIC, robot=2, type=STRING, depth=20)
        assert set(told) == {"two"}
        assert (one.refused, two.refused) == ({}, {2: "no more"})
        assert "a callback of /chatter failed" in caplog.text
        second.refusal = ""
        await hears(await agent.subscribe(TOPIC, robot=2, type=STRING), 2)
        await until(lambda: first.registrants == second.registrants == {300}, PATIENCE_S)


async def test_reasons_are_told_by_robot(router: str) -> None:
    """Robots that refuse for different reasons are named with them."""
    async with (
        robot(router, 1, refusal="too full"),
        robot(router, 2, refusal="not this one"),
        macs_zenoh.join("unity", id=300, settings=patient(router)) as agent,
    ):
        await knows(agent, 1, 2)
        with pytest.raises(macs_zenoh.Refused, match=r"^ros/1: too full; ros/2: not this one$"):
            await agent.subscribe(TOPIC, robot=[1, 2], type=STRING)


async def test_a_silent_robot_is_a_timeout_and_leaves_nothing(router: str) -> None:
    """A robot that does not answer costs the time that was given, and is asked no more after that."""
    async with (
        macs_zenoh.join("ros", id=1, settings=patient(router)),
        macs_zenoh.join("unity", id=300, settings=patient(router)) as agent,
    ):
        await knows(agent, 1)
        with pytest.raises(TimeoutError, match="registration of /chatter on ros/1"):
            await agent.subscribe(TOPIC, robot=1, type=STRING, timeout_s=0.5)
        with pytest.raises(macs_zenoh.Unreachable):
            await agent.subscribe(TOPIC, robot=1, timeout_s=0.5)


async def test_what_waited_for_its_registration_is_no_burst(router: str) -> None:
    """Of commands that were published while the robot did not answer the newest is sent, in front of what comes then,
    over one registration; the others are counted."""
    async with robot(router, 1) as one, macs_zenoh.join("unity", settings=patient(router)) as agent:
        received: list[bytes] = []
        one.agent.on_message(lambda message: received.append(bytes(message.data)))
        await until(lambda: (1, 1) in agent.directory)
        one.may_answer.clear()

        async def publish(number: int) -> None:
            await agent.publish("/drive", b"\0\1\0\0%02d" % number, robot=1, type=STRING, timeout_s=PATIENCE_S)

        waiting = [asyncio.create_task(publish(number)) for number in range(20)]
        await until(lambda: one.asked)
        one.may_answer.set()
        await asyncio.gather(*waiting)
        await publish(20)
        await until(lambda: received and received[-1].endswith(b"20"))
        assert received == [b"\0\1\0\x0019", b"\0\1\0\x0020"]
        assert len(one.asked) == 1
        assert agent.drops["too_old"] == 19


async def test_one_of_several_users_leaves(router: str) -> None:
    """Only what nobody else here uses is taken back."""
    async with (
        robot(router, 1) as first,
        robot(router, 2) as second,
        macs_zenoh.join("unity", id=300, settings=patient(router)) as agent,
    ):
        await knows(agent, 1, 2)
        one = await agent.subscribe(TOPIC, robot=1, type=STRING)
        both = await agent.subscribe(TOPIC, robot=[1, 2], type=STRING)
        await hears(one, 1)
        await hears(both, 1, 2)
        both.close()
        await until(lambda: not second.registrants, PATIENCE_S)
        assert first.registrants == {300}
        await hears(one, 1)
        assert not any(isinstance(node, RemoveNode) for node in first.asked)
        group = await agent.subscribe(TOPIC, group=3, type=STRING)
        one.close()
        await hears(group, 1, 2)
        assert first.registrants == {300}


async def test_many_subscribe_at_once(router: str) -> None:
    """Users that come at the same moment share the node as well, also where it has to be asked for its type first."""
    async with robot(router, 1) as first, macs_zenoh.join("unity", id=300, settings=patient(router)) as agent:

        async def offers(call: macs_zenoh.Call) -> bytes:
            await asyncio.sleep(0.05)
            return b'{"publishers": {"/chatter": "std_msgs/msg/String"}}'

        first.agent.serve("offers", offers)
        await knows(agent, 1)
        users = await asyncio.gather(*(agent.subscribe(TOPIC, robot=1) for _ in range(20)))
        assert {user.type for user in users} == {STRING}
        for user in users:
            await hears(user, 1)
        for user in users:
            user.close()
        await until(lambda: not first.registrants, PATIENCE_S)


async def test_the_last_other_may_leave_while_one_subscribes(router: str) -> None:
    """Whoever comes meanwhile shares its node, and keeps it when that one leaves."""
    async with robot(router, 1) as first, macs_zenoh.join("unity", id=300, settings=patient(router)) as agent:
        asked, may_say = asyncio.Event(), asyncio.Event()

        async def offers(call: macs_zenoh.Call) -> bytes:
            asked.set()
            await may_say.wait()
            return b"{}"

        first.agent.serve("offers", offers)
        await knows(agent, 1)
        other = await agent.subscribe(TOPIC, robot=1, type=STRING)
        await hears(other, 1)
        subscribing = asyncio.create_task(agent.subscribe(TOPIC, robot=1, type=STRING, timeout_s=PATIENCE_S))
        await asyncio.wait_for(asked.wait(), PATIENCE_S)
        other.close()
        third = await agent.subscribe(TOPIC, robot=1, type=STRING, timeout_s=PATIENCE_S)
        may_say.set()
        second = await subscribing
        await hears(third, 1)
        await hears(second, 1)
        second.close()
        while third._waiting:
            await third.receive()
        await hears(third, 1)
        third.close()
        await until(lambda: not first.registrants, PATIENCE_S)


async def test_who_does_not_say_what_it_holds_is_asked_once(router: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """It costs one later subscription a moment, which is counted, and the next ones nothing."""
    monkeypatch.setattr(late, "OFFERS_S", 0.2)
    async with robot(router, 1) as first, macs_zenoh.join("unity", id=300, settings=patient(router)) as agent:
        asked: list[int] = []

        async def offers(call: macs_zenoh.Call) -> bytes:
            asked.append(1)
            await asyncio.Event().wait()
            return b""

        first.agent.serve("offers", offers)
        await knows(agent, 1)
        for _ in range(3):
            await hears(await agent.subscribe(TOPIC, robot=1, type=STRING, timeout_s=PATIENCE_S), 1)
        assert (len(asked), agent.drops["not_held"]) == (1, 1)


async def test_what_has_no_room_is_counted(router: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A later subscription of a latched topic whose messages are not held goes on without them, and it is counted."""
    monkeypatch.setattr(late, "Room", lambda: Room(3))
    async with robot(router, 1) as first, macs_zenoh.join("unity", id=300, settings=patient(router)) as agent:

        async def offers(call: macs_zenoh.Call) -> bytes:
            return encode_data(Offered(qos={TOPIC: TopicQos("reliable", "transient_local")}))

        first.agent.serve("offers", offers)
        await knows(agent, 1)
        await hears(await agent.subscribe(TOPIC, robot=1, type=STRING), 1)
        assert agent.drops["not_held"] == 0
        await hears(await agent.subscribe(TOPIC, robot=1, type=STRING), 1)
        assert agent.drops["not_held"] == 1


async def test_the_time_is_for_all_of_it(router: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """What it took to learn the type is gone when the registration is waited for."""
    waits: list[float] = []

    async def recorded(awaitable: Awaitable[object], timeout_s: float) -> object:
        waits.append(timeout_s)
        return await within(awaitable, timeout_s)

    monkeypatch.setattr(nodes, "within", recorded)
    async with robot(router, 1) as first, macs_zenoh.join("unity", id=300, settings=patient(router)) as agent:

        async def offers(call: macs_zenoh.Call) -> bytes:
            await asyncio.sleep(0.3)
            return b'{"publishers": {"/chatter": "std_msgs/msg/String"}}'

        first.agent.serve("offers", offers)
        await knows(agent, 1)
        await agent.subscribe(TOPIC, robot=1, timeout_s=PATIENCE_S)
        assert waits
        assert max(waits) <= PATIENCE_S - 0.3


async def test_registrations_survive_the_router() -> None:
    """After the router was killed and has come back, topics go on without anybody asking."""
    async with (
        Router() as router,
        robot(router.endpoint, 1) as first,
        macs_zenoh.join("unity", id=300, connect=[router.endpoint]) as agent,
    ):
        await knows(agent, 1)
        chatter = await agent.subscribe(TOPIC, robot=1, type=STRING)
        await hears(chatter, 1)
        first.registrants.clear()  # as a robot that has seen the agent leave
        await router.stop()
        await until(lambda: not agent.mesh.linked, PATIENCE_S)
        await router.start()
        await until(lambda: first.registrants == {300}, PATIENCE_S)
        while chatter._waiting:
            await chatter.receive()
        await hears(chatter, 1)


async def test_what_is_given_is_checked(router: str) -> None:
    """What cannot be sent is refused here, by name, before anything goes out."""
    async with robot(router, 1) as first, macs_zenoh.join("unity", id=300, settings=patient(router)) as agent:
        await knows(agent, 1)
        drive = await agent.advertise("/cmd_vel", robot=1, type="geometry_msgs/Twist")
        with pytest.raises(macs_zenoh.UsageError, match=r"bytes .*or a value with its fields, not str"):
            drive.publish("forward")  # type: ignore[arg-type]
        with pytest.raises(macs_zenoh.BadValue, match=r"linear\.x"):
            drive.publish({"linear": {"x": "fast"}})
        with pytest.raises(macs_zenoh.UnknownType):
            await agent.publish("/thing", {}, robot=1, type="no_such_msgs/Thing")
        with pytest.raises(macs_zenoh.OutOfRange, match="group is 256"):
            await agent.subscribe(TOPIC, group=256, type=STRING)
        with pytest.raises(macs_zenoh.UsageError, match="depth"):
            await agent.subscribe(TOPIC, robot=1, type=STRING, depth=0)
        with pytest.raises(macs_zenoh.Refused, match="at most 1024 robots"):
            await agent.subscribe(TOPIC, robot=range(1, 1026), type=STRING)
        drive.close()
        with pytest.raises(macs_zenoh.Closed):
            drive.publish({})
        await until(lambda: isinstance(first.asked[-1], RemoveNode), PATIENCE_S)
