"""Traffic rules on a real router: what passes is what arrives, what does not is counted, and priorities are real."""

from __future__ import annotations

import asyncio
import itertools
import logging
import threading
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from contextlib import AsyncExitStack
from pathlib import Path
from typing import Any

import pytest
import zenoh
from zenoh import CongestionControl, Priority

import macs_zenoh
from bridge.headset.client import Headset
from macs_zenoh import awareness
from macs_zenoh.config import MeshSettings, TrafficRule
from macs_zenoh.errors import OutOfRange
from macs_zenoh.mesh import Mesh, Sample, Traffic
from macs_zenoh.mesh.outgoing import Outgoing
from macs_zenoh.protocol.keyexpr import NAMED, STREAM, UNICAST
from macs_zenoh.protocol.messages import Metadata, NodeRefused, NodeType, StreamData, decode_data, encode_management
from macs_zenoh.protocol.named import Outcome
from macs_zenoh.protocol.policing import BURST_S
from macs_zenoh.protocol.wire import encode_frame, encode_message, parse_frames
from tests.support.given import Connect, StartGateway
from tests.support.links import counted
from tests.support.local import patient
from tests.support.programs import Program
from tests.support.routers import Router
from tests.support.sockets import socket
from tests.support.waiting import PATIENCE_S, until

CAMERA = STREAM.of(type="ros", id=7, node="nd__camera_front")
OTHER_CAMERA = STREAM.of(type="ros", id=7, node="nd__camera_back")
CAMERAS = "macs/from/ros/*/nd__camera$*"
MAP = STREAM.of(type="ros", id=7, node="nd__map")
MARKER = STREAM.of(type="ros", id=7, node="nd__marker")

Sender = Callable[..., Awaitable[Mesh]]


class Taker:
    """Everything that arrives on some keys, in order."""

    def __init__(self, mesh: Mesh, key: str = "macs/**") -> None:
        self.samples: list[Sample] = []
        self.subscription = mesh.subscribe(key, self.samples.extend)

    def count(self, key: str) -> int:
        return sum(1 for arrived, _ in self.samples if arrived == key)

    async def all_of(self, sender: Mesh, traffic: Traffic = Traffic.CALL) -> None:
        """Wait until all has arrived that ``sender`` has put so far as this traffic: a marker comes after it."""
        before = self.count(MARKER)
        sender.put(MARKER, b"", traffic)
        await until(lambda: self.count(MARKER) > before)


@pytest.fixture
async def router() -> AsyncIterator[str]:
    """A router as a process, zenohd where it is installed; its endpoint."""
    async with Router() as router:
        yield router.endpoint


@pytest.fixture
async def sender(router: str) -> AsyncIterator[Sender]:
    """Opens sessions that send, known to the router and to whom they send; with rules."""
    async with AsyncExitStack() as stack:

        async def open_mesh(taker: Taker, *rules: TrafficRule) -> Mesh:
            mesh = await stack.enter_async_context(await Mesh.open(patient(router), traffic=rules))
            while not taker.count(MARKER):
                mesh.put(MARKER, b"")
                await asyncio.sleep(0.01)
            await taker.all_of(mesh)
            mesh.drops.clear()
            return mesh

        yield open_mesh


@pytest.fixture
async def taker(router: str) -> AsyncIterator[Taker]:
    async with await Mesh.open(MeshSettings(connect=[router])) as mesh:
        yield Taker(mesh)


# -- limits ----------------------------------------------------------------------------------------------------------


async def test_what_is_above_the_rate_is_dropped_and_counted(
    sender: Sender, taker: Taker, caplog: pytest.LogCaptureFixture
) -> None:
    """Of 1000 messages sent at once on each of two keys, the rate's share arrives for each, and all others are counted
    and logged in one line."""
    mesh = await sender(taker, TrafficRule(match=CAMERAS, max_hz=50))
    begin = time.monotonic()
    for _ in range(1000):
        mesh.put(CAMERA, b"image")
        mesh.put(OTHER_CAMERA, b"image")
        mesh.put(MAP, b"map")
    most = 1 + 50 * (time.monotonic() - begin + BURST_S)
    await taker.all_of(mesh)
    for key in (CAMERA, OTHER_CAMERA):
        assert 1 + 50 * BURST_S <= taker.count(key) <= most
        assert mesh.policer.drops[CAMERAS, "over_rate", key] == 1000 - taker.count(key)
    assert mesh.drops == {"over_rate": 2000 - taker.count(CAMERA) - taker.count(OTHER_CAMERA)}
    assert taker.count(MAP) == 1000
    (warning,) = [record.message for record in caplog.records if record.levelno >= logging.WARNING]
    assert warning.startswith(f"{CAMERA} is dropped by a traffic rule: above max_hz 50 of {CAMERAS} (logged once")


async def test_what_is_too_large_is_dropped_and_counted(sender: Sender, taker: Taker) -> None:
    """A message of the largest size arrives, one byte more does not, whatever its class."""
    mesh = await sender(taker, TrafficRule(match=CAMERAS, max_bytes=200_000))

    async def arrives(size: int, traffic: Traffic) -> None:
        before = taker.count(CAMERA)

        def again() -> bool:
            mesh.put(CAMERA, bytes(size), traffic)
            return taker.count(CAMERA) > before

        await until(again, every_s=0.2)  # large topic data may find no room on a busy machine

    for size in (10, 200_000, 200_001, 300_000, 1):
        for traffic in (Traffic.STREAM, Traffic.CALL):
            if size <= 200_000:
                await arrives(size, traffic)
            else:
                mesh.put(CAMERA, bytes(size), traffic)
    for traffic in (Traffic.STREAM, Traffic.CALL):
        await taker.all_of(mesh, traffic)
    assert {len(payload) for key, payload in taker.samples if key == CAMERA} == {10, 200_000, 1}
    assert mesh.drops == {"over_size": 4}


async def test_a_budget_holds_for_all_keys_of_its_rule(sender: Sender, taker: Taker) -> None:
    """What arrives on two keys of a rule together stays within its bytes per second; the others are counted."""
    mesh = await sender(taker, TrafficRule(match=CAMERAS, max_bytes_per_s=1_000_000))
    begin = time.monotonic()
    for _ in range(500):
        mesh.put(CAMERA, bytes(10_000))
        mesh.put(OTHER_CAMERA, bytes(10_000))
    most = 1_000_000 * (time.monotonic() - begin + BURST_S) + 10_000
    await taker.all_of(mesh)
    arrived = taker.count(CAMERA) + taker.count(OTHER_CAMERA)
    assert 10 <= arrived <= most / 10_000
    assert mesh.drops == {"over_budget": 1000 - arrived}


async def test_threads_share_a_rate_on_the_mesh(sender: Sender, taker: Taker) -> None:
    """Threads that put on one key at once get no more through than one, and arrivals and drops are all there were."""
    mesh = await sender(taker, TrafficRule(match=CAMERAS, max_hz=100))
    begin = time.monotonic()
    threads = [threading.Thread(target=lambda: [mesh.put(CAMERA, b"") for _ in range(500)]) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        await asyncio.to_thread(thread.join)
    most = 1 + 100 * (time.monotonic() - begin + BURST_S)
    await taker.all_of(mesh)
    assert taker.count(CAMERA) <= most
    assert taker.count(CAMERA) + mesh.drops["over_rate"] == 2000


async def test_what_a_limit_drops_of_a_reliable_key_is_not_asked_for(router: str, sender: Sender) -> None:
    """A key that is reliable and limited delivers what passes, in order, and what was dropped counts as no miss."""
    async with await Mesh.open(MeshSettings(connect=[router])) as receiver:
        taker = Taker(receiver, MARKER)
        arrived: list[Sample] = []
        receiver.subscribe(CAMERA, arrived.extend, reliable=True)
        mesh = await sender(taker, TrafficRule(match=CAMERAS, cache=100, max_bytes=10))
        for number in range(50):
            mesh.put(CAMERA, bytes([number]) * (11 if number % 5 == 0 else 1), Traffic.STREAM)
        await until(lambda: len(arrived) >= 40)
        await asyncio.sleep(2 * Outgoing.HEARTBEAT_S)  # in which a miss would be noticed
        assert [payload[0] for _, payload in arrived] == [number for number in range(50) if number % 5]
        assert mesh.drops == {"over_size": 10}
        assert not receiver.drops


async def test_a_call_that_is_too_large_is_refused(router: str) -> None:
    """A call above the size of a rule raises OutOfRange with size and limit, and is counted; no rate drops calls."""

    async def answer(call: macs_zenoh.Call) -> bytes:
        return b"yes"

    rule = TrafficRule(match="macs/call/**", max_bytes=1000, max_hz=1)
    async with (
        macs_zenoh.join("ros", id=7, connect=[router]) as robot,
        macs_zenoh.join("unity", id=300, connect=[router], traffic=[rule]) as headset,
    ):
        robot.serve("ask", answer)
        await until(lambda: (1, 7) in headset.directory)
        for _ in range(10):
            assert await headset.call("ros", 7, "ask") == b"yes"
        with pytest.raises(OutOfRange, match=r"macs/call/ros/7/ask/unity/300 is 1\d\d\d, allowed is 0\.\.1000"):
            await headset.call("ros", 7, "ask", bytes(1000), timeout_s=PATIENCE_S)
        assert headset.mesh.drops == {"over_size": 1}


# -- from a headset ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sizes", [(8,), (8, 9, 10)], ids=["alike", "different"])
async def test_frames_of_a_headset_count_one_by_one(
    router: str, start_gateway: StartGateway, connect: Connect, sizes: Sequence[int]
) -> None:
    """Frames that come in one read and would go as one message are held to the rate each, in their order; what is
    not limited still goes together."""
    gateway = await start_gateway(traffic=[TrafficRule(match="macs/to/ros/*/7/**", max_hz=50)])
    headset = await connect(gateway)
    async with (
        macs_zenoh.join("ros", id=7, connect=[router]) as limited,
        macs_zenoh.join("ros", id=8, connect=[router]) as free,
    ):
        while not {7, 8} <= set((await headset.online()).ros_agent_ids):
            await asyncio.sleep(0.01)
        metadata = Metadata(2, headset.id, message_manager="Test").encode()

        def frames(robot: int) -> bytes:
            return b"".join(
                encode_frame(1, (robot,), message=encode_message(metadata, number.to_bytes(size, "big")))
                for number, size in zip(range(500), itertools.cycle(sizes), strict=False)
            )

        begin = time.monotonic()
        await headset.send_frame(frames(7))
        await headset.send_frame(frames(8))
        await headset.send(b"end")

        async def numbers(robot: macs_zenoh.Agent) -> list[int]:
            got = []
            async for message in robot:
                if message.data == b"end":
                    return got
                got.append(int.from_bytes(message.data, "big"))
            return got

        arrived, all_arrived = await asyncio.wait_for(asyncio.gather(numbers(limited), numbers(free)), PATIENCE_S)
        assert arrived == sorted(set(arrived))
        assert 1 + 50 * BURST_S <= len(arrived) <= 1 + 50 * (time.monotonic() - begin + BURST_S)
        assert gateway.mesh.drops == {"over_rate": 500 - len(arrived)}
        assert all_arrived == list(range(500))


async def test_topic_data_of_a_tcp_robot_is_limited(router: str, start_gateway: StartGateway) -> None:
    """The rules hold for an existing robot program behind a gateway: by rate, by size, message by message."""
    gateway = await start_gateway(traffic=[TrafficRule(match="macs/from/**", max_hz=20, max_bytes=1000)])
    async with await Mesh.open(MeshSettings(connect=[router])) as mesh, socket(gateway) as robot:
        robot.configure(agent_type=1)
        while robot.id not in (await robot.online())[0]:
            await asyncio.sleep(0.01)
        taker = Taker(mesh, STREAM.every(type=1, id=robot.id))
        management = encode_management(StreamData({"2": [256]}))

        def image(number: int, node: str = "nd__camera", size: int = 10) -> bytes:
            metadata = Metadata(1, robot.id, 0, StreamData.manager, NodeType.SUBSCRIBER, node, "sensor_msgs/Image")
            message = encode_message(metadata.encode(), number.to_bytes(size, "big"))
            return encode_frame(1, management=management, message=message)

        first = STREAM.of(type=1, id=robot.id, node="nd__first")
        while not taker.count(first):  # until the gateway knows of our subscription
            robot.writer.write(image(0, "nd__first"))
            await robot.online()
        gateway.mesh.drops.clear()
        robot.writer.write(image(0, size=1000) + b"".join(image(number) for number in range(300)))
        robot.writer.write(image(0, "nd__last"))
        await until(lambda: taker.count(STREAM.of(type=1, id=robot.id, node="nd__last")))
        camera = STREAM.of(type=1, id=robot.id, node="nd__camera")
        arrived = [payload for key, payload in taker.samples if key == camera]
        assert all(len(parse_frames(payload)) == 1 for payload in arrived)
        assert gateway.mesh.drops["over_size"] == 1
        assert len(arrived) + gateway.mesh.drops["over_rate"] == 300
        assert len(arrived) >= 1 + 20 * BURST_S


async def test_a_registration_that_is_too_large_is_told(
    router: str, start_gateway: StartGateway, connect: Connect
) -> None:
    """A rule for calls that is too tight for registrations shows at the headset as a refusal that says so."""
    gateway = await start_gateway(traffic=[TrafficRule(match="macs/call/**", max_bytes=50)])
    async with macs_zenoh.join("ros", id=1, connect=[router]):
        headset = await connect(gateway)
        await headset.subscribe("/map", "nav_msgs/OccupancyGrid", agents=[1])
        refused = decode_data(NodeRefused, (await headset.receive(PATIENCE_S)).data)
    assert "allowed is 0..50" in refused.reason


async def test_messages_by_name_are_limited(router: str) -> None:
    """A rule holds for messages between robots by name, beside the rates of the awareness itself."""
    rule = TrafficRule(match=NAMED.every(name="b"), max_hz=20)
    async with (
        macs_zenoh.join("ros", id=1, connect=[router], traffic=[rule]) as one,
        macs_zenoh.join("ros", id=2, connect=[router]) as two,
        awareness.join(one, "a") as a,
        awareness.join(two, "b") as b,
    ):
        arrived: list[bytes] = []
        b.register("t", lambda message: arrived.append(message.data))
        await a.wait_for("b", "t", timeout_s=PATIENCE_S)
        for number in range(100):
            a.send("b", "t", b"%d" % number)
        assert await a.deliver("b", "t", b"end", deadline_s=PATIENCE_S) is Outcome.DELIVERED
        await until(lambda: arrived[-1] == b"end")
        assert len(arrived) - 1 + one.mesh.drops["over_rate"] == 100
        assert len(arrived) >= 1 + 20 * BURST_S


async def test_the_last_words_of_a_gateway_tell_what_its_rules_dropped(router: str, tmp_path: Path) -> None:
    """Rules of a settings file hold in `macs gateway`, which logs at its end what they dropped and where."""
    settings = tmp_path / "macs.toml"
    settings.write_text('[[traffic]]\nmatch = "macs/to/**"\nmax_hz = 1\n')
    gateway = Program("gateway", "--port", "0", "-e", router, "--settings", str(settings))
    async with gateway, macs_zenoh.join("ros", id=7, connect=[router]) as robot:
        async with await Headset.connect("127.0.0.1", gateway.port) as headset:
            while 7 not in (await headset.online()).ros_agent_ids:
                await asyncio.sleep(0.01)
            for _ in range(20):
                await headset.send(b"x", to=1, ids=[7])
            await headset.send(b"end")
            while (await asyncio.wait_for(robot.receive(), PATIENCE_S)).data != b"end":
                pass
        key = UNICAST.of(type=1, block=0, id=7, from_type=2, from_id=headset.id)
        await gateway.stop()
    said = [line.partition("macs.mesh: ")[2] for line in gateway.log if "macs.mesh: " in line]
    assert any(line.startswith(f"{key} is dropped by a traffic rule") for line in said)
    (report,) = [line for line in said if line.startswith("traffic rule macs/to/**: over_rate 1")]
    assert report.partition(", on ")[2].split()[0] == key


# -- priority --------------------------------------------------------------------------------------------------------


async def priorities(
    router: str, mesh: Mesh, puts: Sequence[tuple[str, Traffic]]
) -> list[tuple[Priority, CongestionControl, bool]]:
    """Priority, congestion control and express of one sample for each put, as a Zenoh subscriber gets them."""
    config = zenoh.Config()
    for path, value in (
        ("mode", '"client"'),
        ("connect/endpoints", f'["{router}"]'),
        ("scouting/multicast/enabled", "false"),
    ):
        config.insert_json5(path, value)
    arrived: list[zenoh.Sample] = []
    session = await asyncio.to_thread(zenoh.open, config)
    try:
        subscriber = session.declare_subscriber("macs/**", zenoh.handlers.Callback(arrived.append, indirect=False))
        found = []
        for number, (key, traffic) in enumerate(puts):
            payload = b"%d" % number  # of what was put before more may come

            def came(payload: bytes = payload) -> zenoh.Sample | None:
                return next((sample for sample in list(arrived) if sample.payload.to_bytes() == payload), None)

            while (sample := came()) is None:  # until the router has told the sender of the subscription
                mesh.put(key, payload, traffic)
                await asyncio.sleep(0.01)
            found.append((sample.priority, sample.congestion_control, sample.express))
        subscriber.undeclare()
    finally:
        await asyncio.to_thread(session.close)
    return found


@pytest.mark.parametrize(
    ("rules", "warned"),
    [
        ([("macs/to/ros/0/7/**", "data")], ["macs/to/ros/0/7/**"]),
        ([("macs/from/**", "data_low"), ("**", "interactive_high")], ["**"]),
        ([("macs/to/ros/**", "real_time"), ("macs/to/**", "data")], []),
        ([("macs/from/**", "real_time"), ("macs/to/unity/**", "data"), ("macs/call/**", "data")], []),
    ],
)
async def test_a_rule_that_lowers_commands_is_warned_of(
    router: str, rules: list[tuple[str, Any]], warned: list[str], caplog: pytest.LogCaptureFixture
) -> None:
    """Routers let nobody wait at the priority that commands have by default, and at no other."""
    traffic = [TrafficRule(match=match, priority=priority) for match, priority in rules]
    async with await Mesh.open(MeshSettings(connect=[router]), traffic=traffic):
        pass
    said = [record.message for record in caplog.records if "gives commands the priority" in record.message]
    assert [message.split()[2] for message in said] == warned


async def test_a_rule_gives_a_priority_and_leaves_the_rest(router: str) -> None:
    """A key of a rule travels at its priority, with the congestion control and the express flag of its class; other
    keys at the priority of their class; what a topic asks for by itself wins, as long as it does."""
    rules = [TrafficRule(match=CAMERAS, priority="background"), TrafficRule(match="macs/to/**", priority="data_high")]
    command = UNICAST.of(type=1, block=0, id=7, from_type=2, from_id=256)
    async with await Mesh.open(MeshSettings(connect=[router]), traffic=rules) as mesh:
        puts = [(CAMERA, Traffic.STREAM), (MAP, Traffic.STREAM), (command, Traffic.COMMAND), (command, Traffic.CALL)]
        assert await priorities(router, mesh, puts) == [
            (Priority.BACKGROUND, CongestionControl.DROP, False),
            (Priority.DATA, CongestionControl.DROP, False),
            (Priority.DATA_HIGH, CongestionControl.DROP, True),
            (Priority.DATA_HIGH, CongestionControl.BLOCK, True),
        ]
        mesh.prioritise(CAMERA, "interactive_low")
        mesh.prioritise(MAP, "real_time")
        found = await priorities(router, mesh, puts[:2])
        assert found == [
            (Priority.INTERACTIVE_LOW, CongestionControl.DROP, False),
            (Priority.REAL_TIME, CongestionControl.DROP, False),
        ]
        for key in (CAMERA, MAP):
            mesh.prioritise(key, None)
        found = await priorities(router, mesh, puts[:2])
        assert found == [
            (Priority.BACKGROUND, CongestionControl.DROP, False),
            (Priority.DATA, CongestionControl.DROP, False),
        ]


@pytest.mark.alone
@pytest.mark.parametrize("ruled", [True, False], ids=["ruled", "unruled"])
async def test_a_high_priority_overtakes_a_camera_on_a_full_link(router: str, ruled: bool) -> None:
    """While a camera fills a link, messages of a topic with a higher priority all arrive, and before images that were
    sent before them; without rules they come after those images or find no room."""
    rules = [TrafficRule(match=CAMERAS, priority="data_low"), TrafficRule(match=MAP, priority="data_high")]
    async with (
        await Mesh.open(MeshSettings(connect=[router])) as receiver,
        counted(router, buffer_bytes=32 << 10) as link,
        await Mesh.open(
            MeshSettings(connect=[link.endpoint], lease_ms=20_000), traffic=rules if ruled else []
        ) as robot,
    ):
        taker = Taker(receiver)
        while not all(taker.count(key) for key in (CAMERA, MAP, MARKER)):
            for key in (CAMERA, MAP, MARKER):
                robot.put(key, b"", Traffic.STREAM)
            await asyncio.sleep(0.01)
        for traffic in (Traffic.STREAM, Traffic.CALL):
            await taker.all_of(robot, traffic)
        taker.samples.clear()
        link.hold()
        for number in range(20):  # 2 MB: more than queues and kernel hold
            await asyncio.to_thread(robot.put, CAMERA, bytes([number]) * 100_000, Traffic.STREAM)
        for number in range(5):
            robot.put(MAP, bytes([number]), Traffic.STREAM)
        link.release()
        while not any(payload == b"last" for _, payload in taker.samples):
            robot.put(CAMERA, b"last", Traffic.STREAM)
            await asyncio.sleep(0.01)
        sent_before = [key for key, payload in taker.samples if payload != b"last"]
        images = sent_before.count(CAMERA)
        if ruled:
            assert sent_before.count(MAP) == 5
            assert sent_before[-1] == CAMERA, "the topic waited for every image"
        else:
            assert sent_before[:images] == [CAMERA] * images, "the topic was in time without rules"
        assert 0 < images < 20
