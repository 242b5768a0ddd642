"""Reliable keys on real routers that are killed: nothing is lost, twice or out of order; what is gone is counted."""

from __future__ import annotations

import asyncio
import itertools
import logging
import signal
import time
from collections.abc import AsyncIterator, Callable
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path
from typing import Any

import pytest
import zenoh

import macs_zenoh
from bridge.gateway import Gateway
from bridge.headset.client import Headset
from bridge.settings import GatewaySettings
from macs_zenoh import awareness
from macs_zenoh.agent import Agent
from macs_zenoh.config import MeshSettings, TrafficRule
from macs_zenoh.mesh import Mesh, Traffic
from macs_zenoh.mesh import reliable as recovered
from macs_zenoh.mesh.arrivals import Arrivals
from macs_zenoh.mesh.declared import OnBatch
from macs_zenoh.mesh.outgoing import Outgoing
from macs_zenoh.protocol.keyexpr import NAMED_ALL
from macs_zenoh.protocol.messages import AddNode, Metadata, NodeType, StreamData, decode_data, encode_management
from macs_zenoh.protocol.named import Outcome
from macs_zenoh.protocol.wire import encode_frame, encode_message
from macs_zenoh.serving import Call
from macs_zenoh.streams import Streams
from tests.support.matching import matched
from tests.support.numbers import HZ, Numbers, Stream
from tests.support.programs import free_port
from tests.support.routers import Router
from tests.support.waiting import PATIENCE_S, until

RULES = Path(__file__).parents[2] / "config" / "router-access.json5"

KEPT = "macs/from/ros/7/nd__log"
PLAIN = "macs/from/ros/7/nd__pose"
KEEP_ALL = [TrafficRule(match="macs/from/ros/*/nd__log", cache=5000)]


class Routers:
    """Two routers, linked with each other."""

    def __init__(self) -> None:
        self.endpoints = [f"tcp/127.0.0.1:{free_port()}" for _ in range(2)]
        first, second = self.endpoints
        self._routers = [Router(listen=[first], connect=[second]), Router(listen=[second], connect=[first])]

    async def start(self) -> None:
        await asyncio.gather(*(router.start() for router in self._routers))

    async def kill(self) -> None:
        """Kill -9 both."""
        await asyncio.gather(*(router.stop(signal.SIGKILL) for router in self._routers))

    async def stop(self) -> None:
        await asyncio.gather(*(router.stop() for router in self._routers))

    async def outage(self, seconds: float) -> None:
        """Kill -9 both, and have them back after so long."""
        await self.kill()
        await asyncio.sleep(seconds)
        await self.start()


@pytest.fixture
async def routers() -> AsyncIterator[Routers]:
    """Two routers."""
    routers = Routers()
    await routers.start()
    try:
        yield routers
    finally:
        await routers.stop()


@asynccontextmanager
async def robot_and_receiver(
    routers: Routers, rules: list[TrafficRule]
) -> AsyncIterator[tuple[Mesh, Mesh, Numbers, Numbers]]:
    """A source, a receiver, and what it hears of a reliable and of a plain key. Each prefers another router."""
    first, second = routers.endpoints
    async with (
        await Mesh.open(MeshSettings(connect=[first, second]), traffic=rules) as source,
        await Mesh.open(MeshSettings(connect=[second, first])) as receiver,
    ):
        kept, plain = Numbers(), Numbers()
        subscriptions = [
            receiver.subscribe(KEPT, kept.take, reliable=True, on_miss=kept.miss),
            receiver.subscribe(PLAIN, plain.take, reliable=True, on_miss=plain.miss),
        ]
        yield source, receiver, kept, plain
        for subscription in subscriptions:
            subscription.close()


async def test_nothing_is_lost_while_both_routers_are_away(routers: Routers) -> None:
    """Both routers are killed -9 for 5 s: of a reliable 200 Hz stream nothing is lost, twice or out of order; a plain
    one beside it loses the outage, and what it hears is in order."""
    async with robot_and_receiver(routers, KEEP_ALL) as (source, receiver, kept, plain):
        async with Stream(source, KEPT, PLAIN) as stream:
            await until(lambda: kept.heard and plain.heard)
            await routers.outage(5.0)
            back = stream.sent
            await until(lambda: kept.heard[-1] >= back and plain.heard[-1] >= back)
        await until(lambda: kept.heard[-1] == stream.sent - 1)
        assert kept.heard == list(range(kept.heard[0], stream.sent))
        assert kept.missed == []
        lost = plain.heard[-1] - plain.heard[0] + 1 - len(plain.heard)
        assert 4 * HZ < lost < back + HZ
        assert plain.heard == sorted(set(plain.heard))
        assert source.drops["no_route"] <= lost + HZ // 10  # the first after the outage go before we hear of the link
        assert receiver.drops["missed"] == 0


async def test_what_the_source_has_no_more_is_counted(routers: Routers, caplog: pytest.LogCaptureFixture) -> None:
    """With fewer messages kept than an outage takes, the rest is missed: told with the exact count, logged once."""
    rules = [TrafficRule(match=KEPT, cache=50)]
    caplog.set_level(logging.WARNING, "macs.mesh")
    async with robot_and_receiver(routers, rules) as (source, receiver, kept, _), Stream(source, KEPT):
        await until(lambda: kept.heard)
        for _ in range(2):
            told = len(kept.missed)
            await routers.outage(1.5)
            await until(lambda: len(kept.missed) > told)  # noqa: B023 - awaited at once
        lost = kept.heard[-1] - kept.heard[0] + 1 - len(kept.heard)
        assert kept.heard == sorted(set(kept.heard))
        assert {key for key, _ in kept.missed} == {KEPT}
        assert sum(count for _, count in kept.missed) == lost == receiver.drops["missed"] > HZ
        assert len([record for record in caplog.records if "missed" in record.message]) == 1


async def test_an_outage_during_recovery_costs_nothing(routers: Routers) -> None:
    """When the routers are killed again as soon as the first messages are back, nothing is lost all the same."""
    async with (
        robot_and_receiver(routers, KEEP_ALL) as (source, _, kept, _),
        Stream(source, KEPT, size=4096) as stream,
    ):
        await until(lambda: kept.heard)
        for _ in range(2):
            await routers.outage(1.5)
            heard = len(kept.heard)
            await until(lambda: len(kept.heard) > heard)  # noqa: B023 - awaited at once
            await routers.outage(0.3)
        back = stream.sent
        await until(lambda: kept.heard[-1] >= back)
        assert kept.heard == list(range(kept.heard[0], kept.heard[-1] + 1))
        assert kept.missed == []


async def test_replies_that_there_was_no_room_for_are_asked_for_again(
    routers: Routers, monkeypatch: pytest.MonkeyPatch
) -> None:
    """When the first replies to a question are dropped because the receiver is behind, nothing counts as missed."""
    really, dropped = Arrivals.receiver, [3]

    def receiver(arrivals: Arrivals, on_batch: OnBatch, *args: Any, **options: Any) -> Callable[[zenoh.Sample], bool]:
        receive = really(arrivals, on_batch, *args, **options)

        def behind(sample: zenoh.Sample) -> bool:
            if dropped[0] == 3:
                return receive(sample)
            dropped[0] += 1
            return False

        return behind if on_batch is recovered._ignore else receive

    monkeypatch.setattr(Arrivals, "receiver", receiver)
    async with robot_and_receiver(routers, KEEP_ALL) as (source, _, kept, _), Stream(source, KEPT) as stream:
        await until(lambda: len(kept.heard) > HZ)  # the question for the sources that exist has long ended
        dropped[0] = 0
        await routers.outage(0.5)
        back = stream.sent
        await until(lambda: kept.heard[-1] >= back)
        assert dropped == [3]
        assert kept.heard == list(range(kept.heard[0], kept.heard[-1] + 1))
        assert kept.missed == []


async def test_the_last_message_before_silence_is_recovered(routers: Routers) -> None:
    """A message that is put while there is no router, and that nothing follows, arrives when there is one again."""
    async with robot_and_receiver(routers, KEEP_ALL) as (source, _, kept, _):
        await matched(source, KEPT)
        await routers.kill()
        await until(lambda: not source.linked)
        for number in range(3):  # the first messages that this source puts at all
            source.put(KEPT, number.to_bytes(8, "big"), Traffic.STREAM)
        await routers.start()
        await until(lambda: kept.heard == [0, 1, 2])


async def test_who_subscribes_late_gets_what_comes_next(routers: Routers) -> None:
    """What a source keeps is for those who were there: a new subscription begins with the next message."""
    async with robot_and_receiver(routers, KEEP_ALL) as (source, receiver, kept, _):
        async with Stream(source, KEPT) as stream:
            await until(lambda: len(kept.heard) > 10)
        await until(lambda: kept.heard[-1] == stream.sent - 1)
        late = Numbers()
        receiver.subscribe(KEPT, late.take, reliable=True)
        await asyncio.sleep(3 * Outgoing.HEARTBEAT_S)  # heartbeats tell of all that is kept
        source.put(KEPT, stream.sent.to_bytes(8, "big"), Traffic.STREAM)
        await until(lambda: late.heard)
        assert late.heard == [stream.sent] == kept.heard[-1:]


async def test_other_keys_are_not_kept(routers: Routers) -> None:
    """A rule for all keys keeps topic data and messages to all, and no commands: an old command must not come late."""
    rules = [TrafficRule(match="**", cache=100)]
    command = "macs/to/ros/0/7/unity/256"
    async with robot_and_receiver(routers, rules) as (source, receiver, kept, _):
        commands = Numbers()
        receiver.subscribe(command, commands.take, reliable=True)
        for key in (KEPT, command):
            await matched(source, key)
        await routers.kill()
        await until(lambda: not source.linked)
        source.put(command, b"old", Traffic.COMMAND)
        source.put(KEPT, b"kept", Traffic.STREAM)
        await routers.start()
        await until(lambda: kept.heard)
        assert commands.heard == []


# -- to a headset ----------------------------------------------------------------------------------------------------


class Robot:
    """An agent that takes registrations of one topic and puts numbers on it."""

    def __init__(self, agent: Agent) -> None:
        self.agent = agent
        self.registrants: set[int] = set()
        agent.serve("add_node", self._add)

    async def _add(self, call: Call) -> bytes:
        self.registrants.add(decode_data(AddNode, call.data).registrant_agent_id)
        return b""

    def publish(self, number: int) -> None:
        metadata = Metadata(1, self.agent.id, node_type=NodeType.SUBSCRIBER, node_name="nd__log")
        frame = encode_frame(
            1,
            management=encode_management(StreamData({"2": sorted(self.registrants)})),
            message=encode_message(metadata.encode(), number.to_bytes(8, "big")),
        )
        Streams(self.agent).publish("nd__log", frame)


async def test_a_headset_gets_every_message(routers: Routers) -> None:
    """Through a 5 s outage of both routers, a headset on a gateway that has no rules gets all messages of a topic that
    its robot keeps, in order and once."""
    first, second = routers.endpoints
    async with AsyncExitStack() as stack:
        agent = await stack.enter_async_context(
            macs_zenoh.join("ros", id=7, connect=[first, second], traffic=KEEP_ALL)
        )
        mesh = await stack.enter_async_context(await Mesh.open(MeshSettings(connect=[second, first])))
        gateway = Gateway(mesh, GatewaySettings(port=0))
        stack.push_async_callback(gateway.close)
        await gateway.start()
        headset = await stack.enter_async_context(await Headset.connect("127.0.0.1", gateway.port))
        robot = Robot(agent)
        topic = await headset.subscribe("/log", "std_msgs/String", agents=[7], buffer_size=5000)
        await until(lambda: robot.registrants)
        heard: list[int] = []

        async def listen() -> None:
            async for message in topic:
                heard.append(int.from_bytes(message.data, "big"))

        async def talk() -> None:
            start = time.monotonic()
            for number in itertools.count():
                robot.publish(number)
                due = start + number / HZ
                await asyncio.sleep(max(0.0, due - time.monotonic()))

        tasks = [asyncio.create_task(listen()), asyncio.create_task(talk())]
        try:
            await until(lambda: heard)
            await routers.outage(5.0)
            outage_ends = heard[-1] + 5 * HZ
            await until(lambda: heard[-1] > outage_ends)
            assert heard == list(range(heard[0], heard[-1] + 1))
            assert headset.connected
        finally:
            for task in tasks:
                task.cancel()


# -- between named agents --------------------------------------------------------------------------------------------


async def test_a_reliable_type_reaches_everybody_afterwards(routers: Routers) -> None:
    """What is sent to all without a router is kept if its type is reliable, and arrives in order and once, also where
    the last value is asked for; of other types it is lost."""
    async with (
        macs_zenoh.join("ros", connect=routers.endpoints) as one,
        macs_zenoh.join("ros", connect=routers.endpoints[::-1]) as two,
        awareness.join(one, "a", cache={"planning": 50}) as a,
        awareness.join(two, "b", cache={"planning": 50}) as b,
    ):
        heard: list[tuple[str, bytes]] = []
        for message_type in ("planning", "other"):
            b.register(
                message_type,
                lambda message: heard.append((message.type, message.data)),
                last_value=message_type == "planning",
            )
            await a.wait_for("b", message_type, timeout_s=PATIENCE_S)
        assert a.send("", "planning", b"0") is Outcome.SENT
        await until(lambda: heard == [("planning", b"0")])
        await routers.kill()
        await until(lambda: not a.mesh.linked)
        assert [a.send("", "planning", str(n).encode()) for n in range(1, 5)] == [Outcome.KEPT] * 4
        assert a.send("", "other", b"lost") is Outcome.NO_ROUTER
        assert a.send("b", "planning", b"lost") is Outcome.NO_ROUTER
        await asyncio.sleep(1.0)
        await routers.start()
        await until(lambda: len(heard) >= 5)
        await a.wait_for("b", "planning", timeout_s=PATIENCE_S)
        a.send("", "planning", b"5")
        await until(lambda: heard[-1] == ("planning", b"5"))
        assert heard == [("planning", str(n).encode()) for n in range(6)]


async def test_zenohs_own_subscriber_recovers_as_well(routers: Routers) -> None:
    """Other programs get what is kept with Zenoh's advanced subscriber: the source is Zenoh's."""
    zenoh = pytest.importorskip("zenoh")
    ext = pytest.importorskip("zenoh.ext")
    key = NAMED_ALL.of(message_type="t", from_name="a")
    rules = [TrafficRule(match="macs/ca/all/t/**", cache=10)]
    async with await Mesh.open(MeshSettings(connect=routers.endpoints), traffic=rules) as source:
        config = zenoh.Config()
        config.insert_json5("mode", '"client"')
        config.insert_json5("connect/endpoints", f'["{routers.endpoints[1]}"]')
        any_key = zenoh.ReplyKeyExpr.ANY
        heard: list[bytes] = []
        with await asyncio.to_thread(zenoh.open, config) as session:
            callback = zenoh.handlers.Callback(lambda s: heard.append(s.payload.to_bytes()), indirect=False)
            for n in range(5):
                source.put(key, str(n).encode())
            while not [reply for reply in session.get(f"{key}/@adv/pub/**", accept_replies=any_key) if reply.ok]:
                await asyncio.sleep(0.05)  # until the second router knows the source
            history = ext.HistoryConfig(max_samples=3)
            subscriber = ext.declare_advanced_subscriber(session, "macs/ca/all/t/by/**", callback, history=history)
            await until(lambda: len(heard) == 3)
            source.put(key, b"5")
            await until(lambda: len(heard) == 4)
            assert heard == [b"2", b"3", b"4", b"5"]
            subscriber.undeclare()


# -- with access rules -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("allowed", [True, False], ids=["allowed", "not allowed"])
async def test_the_access_rules_let_missed_messages_be_asked_for(allowed: bool, tmp_path: Path) -> None:
    """With the shipped rules a gateway gets what it missed; where they leave that out, messages pass as ever, and what
    was missed is given up and counted."""
    text = RULES.read_text().replace("cert_common_names", "usernames")
    rules, passwords = tmp_path / "rules.json5", tmp_path / "passwords"
    rules.write_text(text if allowed else text.replace("@adv", "@other"))
    passwords.write_text("".join(f"{user}:secret\n" for user in ("robot-7", "gateway-1", "observer")))
    router = Router(
        rules,
        listen=[f"tcp/127.0.0.1:{free_port()}"],
        overrides=[f"transport/auth/usrpwd/dictionary_file:'{passwords}'", *_credentials("observer")],
    )
    async with router:
        settings = {
            user: MeshSettings(connect=[router.endpoint], overrides=_credentials(user))
            for user in ("robot-7", "gateway-1")
        }
        async with (
            await Mesh.open(settings["robot-7"], traffic=[TrafficRule(match="**", cache=5000)]) as source,
            await Mesh.open(settings["gateway-1"]) as receiver,
            Stream(source, KEPT) as stream,
        ):
            kept = Numbers()
            receiver.subscribe(KEPT, kept.take, reliable=True, on_miss=kept.miss)
            await until(lambda: kept.heard)
            await router.stop(signal.SIGKILL)
            await asyncio.sleep(1.0)
            await router.start()
            back = stream.sent
            await until(lambda: kept.heard[-1] >= back)
            missing = kept.heard[-1] - kept.heard[0] + 1 - len(kept.heard)
            assert (missing == 0) == allowed
            await until(lambda: receiver.drops["missed"] == missing)


def _credentials(user: str) -> list[str]:
    return [f"transport/auth/usrpwd/user:'{user}'", "transport/auth/usrpwd/password:'secret'"]
