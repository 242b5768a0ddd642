"""`macs record` beside real robots and headsets: what is in the file, and who can read it."""

from __future__ import annotations

import asyncio
import importlib
import json
import signal
import sys
from collections import Counter
from collections.abc import AsyncIterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("mcap", reason="needs the extra record: pip install 'macs-zenoh[record]'")

from geometry_msgs.msg import Twist
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message, serialize_message
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import Reader
from std_msgs.msg import String

import macs_zenoh
from bridge.headset.client import Headset
from bridge.recording import recorder
from bridge.recording.bag import Bag
from bridge.recording.conditions import Condition, Event
from bridge.recording.disk import Entry
from bridge.recording.repair import problems, repair
from macs_zenoh.agent import Agent
from macs_zenoh.mesh import Mesh
from macs_zenoh.protocol.keyexpr import STREAM
from macs_zenoh.protocol.messages import Metadata, StreamData, decode_management
from macs_zenoh.protocol.robot_state import RobotStatus, StreamCount
from macs_zenoh.protocol.wire import parse_frames
from tests.support.lichtblick import THERE, lichtblick
from tests.support.programs import Program, ended, macs
from tests.support.ros_peer import Peer, say_hello
from tests.support.routers import Router
from tests.support.thorough import some
from tests.support.waiting import get, until

SETTINGS = """
[robot]
id = 7
max_nodes = 1000

[[robot.rules]]
match = "/cmd_vel"
exclusive = true
hold_s = 60
deadman_s = 0.3
deadman_message = { linear = { z = -1 } }
"""
SHARE = Path(sys.prefix) / "share"
PACKAGES = ("std", "geometry", "sensor", "nav", "diagnostic", "shape", "stereo", "trajectory", "visualization")
STANDARD = sorted(
    f"{path.parts[-3]}/msg/{path.stem}" for package in PACKAGES for path in SHARE.glob(f"{package}_msgs/msg/*.msg")
)
OWN = "as2_ca_msgs/msg/InterAgentMessage"


class Recording(Program):
    """`macs record`, and what its agent answers."""

    async def told(self, agent: Agent) -> dict[str, Any]:
        """How it is getting on."""
        me = int(self.ready.split()[2].removeprefix("unity/"))
        told: dict[str, Any] = json.loads(await agent.call("unity", me, "record"))
        return told

    async def has(self, site: Site, *, messages: int = 0, topics: int = 0) -> None:
        """Wait until it has so much."""
        async with macs_zenoh.join("unity", connect=[site.endpoint]) as agent:

            async def there() -> bool:
                told = await self.told(agent)
                return bool(told["messages"] >= messages and told["topics"] >= topics)

            await until(there, every_s=0.1)


@dataclass
class Site:
    """A router, and robot 7 beside a ROS node."""

    endpoint: str
    folder: Path

    def record(self, *options: str) -> Recording:
        """A recording that goes on."""
        return Recording("record", "-e", self.endpoint, "-o", str(self.folder / "a.mcap"), *options)


@pytest.fixture
async def site(domain: int, tmp_path: Path) -> AsyncIterator[Site]:
    settings = tmp_path / "macs.toml"
    settings.write_text(SETTINGS)
    async with (
        Router() as router,
        Program("agent", "--settings", str(settings), "-e", router.endpoint, env={"ROS_DOMAIN_ID": str(domain)}),
    ):
        yield Site(router.endpoint, tmp_path)


def message_class(name: str) -> Any:
    package, kind, short = name.split("/")
    return getattr(importlib.import_module(f"{package}.{kind}"), short)


def topic_of(name: str) -> str:
    return "/" + name.replace("/", "_").lower()


def json_lines(path: Path, topic: str) -> list[dict[str, Any]]:
    with Bag(path) as bag:
        return [json.loads(message.data) for message in bag.messages(lambda channel: channel.topic == topic)]


def counts(path: Path) -> Counter[str]:
    with Bag(path) as bag:
        return Counter({channel.topic: bag.counts.get(channel.id, 0) for channel in bag.channels.values()})


def recorded(folder: Path) -> set[str]:
    """The channels that have messages by now, in a file that is being written: seen in a copy that has an end."""
    copy = folder / "copy.mcap"
    copy.unlink(missing_ok=True)
    repair(folder / "a.mcap", copy)
    return {topic for topic, count in counts(copy).items() if count}


def filled(kind: Any) -> Any:
    """A message whose lists of large numbers are not empty: behind those rclpy leaves bytes that rosbags refuses."""
    message = kind()
    for field, of_type in kind.get_fields_and_field_types().items():
        if of_type in ("sequence<double>", "sequence<int64>", "sequence<uint64>"):
            setattr(message, field, [1, 2] if "int" in of_type else [1.0, 2.0])
    return message


async def publish_each(peer: Peer, names: list[str]) -> dict[str, bytes]:
    """Latch one message of each type, on a topic named for it. Their bytes."""
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    published: dict[str, bytes] = {}
    for name in names:
        publisher = await peer.publisher(message_class(name), topic_of(name), latched)
        published[name] = bytes(serialize_message(filled(message_class(name))))
        publisher.publish(published[name])
    return published


async def test_every_type_is_recorded_as_it_was_published(site: Site, peer: Peer) -> None:
    """One message of every standard type and of a type of one's own: mcap-ros2-support, rosbags, rclpy and what
    Lichtblick reads files with read it, byte for byte what was published, and no schema is empty."""
    assert len(STANDARD) > 100
    names = [*some(STANDARD), OWN]
    published = await publish_each(peer, names)
    topics = [f"/7{topic_of(name)}" for name in names]
    async with site.record() as recording:
        await recording.has(site, topics=len(topics))
        await until(lambda: set(topics) <= recorded(site.folder), every_s=0.5)
    path = site.folder / "a.mcap"
    assert problems(path) == []
    with Bag(path) as bag:
        found = {bag.channels[message.channel].topic: message.data for message in bag.messages()}
        for channel in bag.channels.values():
            schema = bag.schema_of(channel)
            assert channel.encoding == "json" or (schema is not None and schema.data.strip()), channel.topic
            assert channel.encoding == "json" or channel.metadata["topic_type_hash"].startswith("RIHS01_")
    assert [name for name in names if not _same(found[f"/7{topic_of(name)}"], published[name])] == []
    _read_by_mcap(path, topics)
    _read_by_rosbags(path, topics)
    if THERE:
        channels = lichtblick(path)["channels"]
        assert {topic: channels[topic]["type"] for topic in topics} == dict(zip(topics, names, strict=True))
    code, _, errors = await ended("bag", "to-rosbag2", str(path), "-o", str(site.folder / "bag"))
    assert code == 0, errors
    with AnyReader([site.folder / "bag"]) as reader:
        read = {c.topic: (c.msgtype, bytes(data)) for c, _, data in reader.messages()}
    for name in names:
        of_type, data = read[f"/robot_7{topic_of(name)}"]
        assert of_type == name
        assert _same(data, published[name])
        deserialize_message(data, message_class(of_type))


async def test_every_kind_of_field_is_recorded(site: Site, peer: Peer, kinds: Any) -> None:
    """Wide text, bounds and structures without fields, in a package that only the robot has: whole in the file and in
    the bag made of it."""
    name = "macs_kinds_msgs/msg/Kinds"
    published = await publish_each(peer, [name])
    async with site.record("--topics", topic_of(name)) as recording:
        await recording.has(site, topics=2, messages=6)
    path = site.folder / "a.mcap"
    with Bag(path) as bag:
        (message,) = bag.messages(lambda channel: channel.topic == f"/7{topic_of(name)}")
        schema = bag.schema_of(bag.channels[message.channel])
    assert schema is not None
    assert schema.data.startswith((Path(__file__).parent / "macs_kinds_msgs/msg/Kinds.msg").read_bytes().rstrip())
    assert b"MSG: macs_kinds_msgs/Nothing\n" in schema.data
    assert _same(message.data, published[name])
    code, _, errors = await ended("bag", "to-rosbag2", str(path), "-o", str(site.folder / "bag"))
    assert code == 0, errors
    with Reader(site.folder / "bag") as reader:
        (read,) = [bytes(data) for c, _, data in reader.messages() if c.msgtype == name]
    assert deserialize_message(read, kinds.Kinds) == deserialize_message(published[name], kinds.Kinds)


def _same(recorded: bytes, published: bytes) -> bool:
    """Whether they are the same but for what DDS fills a message up with, to four bytes."""
    rest = recorded[len(published) :]
    return recorded.startswith(published) and len(rest) < 4 and not any(rest)


def _read_by_mcap(path: Path, topics: list[str]) -> None:
    with path.open("rb") as stream:
        decoded = list(make_reader(stream, decoder_factories=[DecoderFactory()]).iter_decoded_messages(topics))
    assert {channel.topic for _, channel, _, _ in decoded} == set(topics)


def _read_by_rosbags(path: Path, topics: list[str]) -> None:
    with AnyReader([path]) as reader:
        for connection, _, data in reader.messages(
            [connection for connection in reader.connections if connection.topic in topics]
        ):
            reader.deserialize(data, connection.msgtype)


async def test_commands_are_recorded_as_sent_and_as_judged(site: Site, peer: Peer) -> None:
    """Who drove, what was carried out, who stopped, what was refused after that and why, and when a dead-man acted."""
    driven = await peer.subscription(Twist, "/cmd_vel")
    twist = Twist()
    twist.linear.x = 0.5
    cdr = bytes(serialize_message(twist))
    async with (
        Program("gateway", "--port", "0", "-e", site.endpoint) as gateway,
        site.record("--commands") as recording,
        await Headset.connect("127.0.0.1", gateway.port) as headset,
        macs_zenoh.join("unity", connect=[site.endpoint]) as agent,
    ):
        commands = await headset.advertise("/cmd_vel", "geometry_msgs/Twist", agents=[7])
        await peer.sees("/cmd_vel", publishers=1, subscriptions=2)
        await recording.has(site, topics=2)
        await commands.publish(cdr)
        assert (await get(driven)).linear.x == 0.5
        assert (await get(driven)).linear.z == -1  # the dead-man
        await macs("stop", "7", "--json", "-e", site.endpoint)
        await commands.publish(cdr)

        async def refused() -> bool:
            told = json.loads(await agent.call("ros", 7, "status"))
            return bool(told["drops"].get("stopped"))

        await until(refused)
        before = (await recording.told(agent))["messages"]

        async def seen() -> bool:
            return bool((await recording.told(agent))["messages"] > before)

        await until(seen)
        me = headset.id
    path = site.folder / "a.mcap"
    sent = f"/sent/unity/{me}/7/cmd_vel"
    found = counts(path)
    assert found[sent] == 2
    with Bag(path) as bag:
        (channel,) = [channel for channel in bag.channels.values() if channel.topic == sent]
        schema = bag.schema_of(channel)
        assert schema is not None
        assert schema.name == "geometry_msgs/msg/Twist"
        assert channel.metadata["sender"] == f"unity/{me}"
        carried_out = [
            deserialize_message(message.data, Twist).linear
            for message in bag.messages(lambda channel: channel.topic == "/7/cmd_vel")
        ]
    assert (carried_out[0].x, carried_out[1].z) == (0.5, -1)
    assert any(stop["stopped"] and stop["by"] == "operator/0" for stop in json_lines(path, "/macs/stops"))
    assert [line["topic"] for line in json_lines(path, "/macs/deadman")] == ["/cmd_vel"]
    assert json_lines(path, "/macs/control")[0]["holder"] == f"unity/{me}"
    presence = [(line["agent"], line["online"]) for line in json_lines(path, "/macs/presence")]
    assert ("ros/7", True) in presence
    assert (f"unity/{me}", True) in presence
    assert any(not online for _, online in presence)  # the agents of this test that only asked


async def test_a_ring_is_written_at_a_stop_and_when_asked(site: Site, peer: Peer) -> None:
    """The last seconds before a stop are in a file of their own, and so are those before a signal."""
    publisher = await peer.publisher(String, "/chatter")
    talking = asyncio.create_task(say_hello(peer, publisher))
    settings = site.folder / "record.toml"
    settings.write_text('[record]\non = ["stop"]\nafter_s = 0.5\n')
    try:
        async with site.record("--ring", "30s", "--settings", str(settings)) as recording:
            await until(lambda: publisher.get_subscription_count())
            await recording.has(site, messages=30)
            await macs("stop", "7", "--json", "-e", site.endpoint)
            await until(lambda: list(site.folder.glob("a_stop_*.mcap")))
            await until(lambda: any("a_stop_" in line for line in recording.said))
            recording.send_signal(signal.SIGUSR1)
            await until(lambda: any("a_asked_" in line for line in recording.said))
    finally:
        talking.cancel()
    (stopped,) = site.folder.glob("a_stop_*.mcap")
    (asked,) = site.folder.glob("a_asked_*.mcap")
    for path in (stopped, asked):
        assert problems(path) == []
        assert counts(path)["/7/chatter"] >= 20
        assert any(line["stopped"] for line in json_lines(path, "/macs/stops"))
    assert not (site.folder / "a.mcap").exists()


@pytest.mark.parametrize("why", ["silence", "it left", "its publisher went"])
async def test_a_ring_is_written_when_a_dead_man_acts(site: Site, peer: Peer, why: str) -> None:
    """By the settings, whatever ended the commands: the file says on which topic and why, and has the stop message."""
    settings = site.folder / "record.toml"
    settings.write_text('[record]\non = ["stop", "deadman"]\nafter_s = 0.5\n')
    driven = await peer.subscription(Twist, "/cmd_vel")
    twist = Twist()
    twist.linear.x = 0.5
    async with (
        Program("gateway", "--port", "0", "-e", site.endpoint) as gateway,
        site.record("--commands", "--ring", "30s", "--settings", str(settings)) as recording,
    ):
        headset = await Headset.connect("127.0.0.1", gateway.port)
        commands = await headset.advertise("/cmd_vel", "geometry_msgs/Twist", agents=[7])
        await peer.sees("/cmd_vel", publishers=1, subscriptions=2)
        await recording.has(site, topics=2)
        await commands.publish(bytes(serialize_message(twist)))
        assert (await get(driven)).linear.x == 0.5
        if why == "it left":
            await headset.close()
        elif why == "its publisher went":
            await commands.close()
        assert (await get(driven)).linear.z == -1
        await until(lambda: any("a_deadman_" in line for line in recording.said))
        await headset.close()
    (path,) = site.folder.glob("a_deadman_*.mcap")
    assert problems(path) == []
    (acted,) = json_lines(path, "/macs/deadman")
    assert (acted["robot"], acted["topic"]) == (7, "/cmd_vel")
    assert acted["why"]
    with Bag(path) as bag:
        carried_out = [
            deserialize_message(message.data, Twist).linear.z
            for message in bag.messages(lambda channel: channel.topic == "/7/cmd_vel")
        ]
    assert -1 in carried_out


async def test_a_recording_ends_for_nobody_who_is_not_named(site: Site) -> None:
    """Others than those of [record] allow neither end it nor have its ring written; those do, one file at a time, and
    no more files than ring_files."""
    settings = site.folder / "record.toml"
    settings.write_text('[record]\nafter_s = 0.2\nring_files = 1\nallow = ["operator/5"]\n')
    write, stop = b'{"action": "write"}', b'{"action": "stop"}'
    async with (
        site.record("--ring", "30s", "--settings", str(settings)) as recording,
        macs_zenoh.join("unity", connect=[site.endpoint]) as other,
        macs_zenoh.join("operator", id=5, connect=[site.endpoint]) as named,
    ):
        me = int(recording.ready.split()[2].removeprefix("unity/"))
        await until(lambda: (2, me) in other.directory and (2, me) in named.directory)
        for request in (write, stop):
            with pytest.raises(macs_zenoh.Refused, match="allow does not name it"):
                await other.call("unity", me, "record", request)
        assert not list(site.folder.glob("a_asked_*"))
        answers = await asyncio.gather(
            *(named.call("unity", me, "record", write) for _ in range(20)), return_exceptions=True
        )
        files = {json.loads(answer)["file"] for answer in answers if isinstance(answer, bytes)}
        assert len(files) == 1
        await until(lambda: any("a_asked_" in line for line in recording.said))

        async def refused() -> str:
            try:
                await named.call("unity", me, "record", write)
            except macs_zenoh.Refused as refusal:
                return refusal.reason
            return ""

        assert "s ago" in await refused() or "ring_files" in await refused()

        async def is_full() -> bool:
            return "ring_files" in await refused()

        await until(is_full, every_s=0.2)
        await named.call("unity", me, "record", stop)
        assert await recording.wait() == 0
    assert len(list(site.folder.glob("a_asked_*"))) == 1


async def test_a_recording_rides_on_what_is_sent_anyway(site: Site, peer: Peer) -> None:
    """A robot puts each message once, for a headset and a recording alike."""
    publisher = await peer.publisher(String, "/chatter")
    samples: list[tuple[int, list[list[int]]]] = []

    def take(batch: Any) -> None:
        for _, payload in batch:
            frames = parse_frames(payload)
            if Metadata.decode(frames[0].metadata).message_manager == StreamCount.manager:
                continue  # now and then, for the recording alone
            listed = [decode_management(frame.management) for frame in frames]
            samples.append((len(frames), [len(each.targets()) for each in listed if isinstance(each, StreamData)]))  # type: ignore[arg-type]

    settings = macs_zenoh.MeshSettings(connect=[site.endpoint])
    async with (
        Program("gateway", "--port", "0", "-e", site.endpoint) as gateway,
        await Mesh.open(settings) as mesh,
        await Headset.connect("127.0.0.1", gateway.port) as headset,
        site.record(),
    ):
        await headset.subscribe("/chatter", "std_msgs/String", agents=[7])

        async def both() -> bool:
            (robot,) = [row for row in await macs("ls", "--json", "-e", site.endpoint) if row["type"] == "ros"]
            nodes = [node for node in robot["status"]["nodes"] if node["name"] == "/chatter"]
            return bool(nodes and len(nodes[0]["registrants"]) == 2)

        await until(both)
        mesh.subscribe(STREAM.of(type=1, id=7, node="nd__chatter"), take)
        await until(lambda: _tell(publisher) or samples, every_s=0.1)
    assert all(frames == 1 and listed == [2] for frames, listed in samples)


def _tell(publisher: Any) -> None:
    publisher.publish(String(data="hello"))


async def test_best_effort_topics_and_their_qos(site: Site, peer: Peer) -> None:
    """A sensor's topic is recorded, with its QoS in the metadata."""
    best_effort = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
    publisher = await peer.publisher(String, "/sensor", best_effort)
    talking = asyncio.create_task(say_hello(peer, publisher))
    try:
        async with site.record("--topics", "/sensor") as recording:
            await recording.has(site, messages=15)
    finally:
        talking.cancel()
    with AnyReader([site.folder / "a.mcap"]) as reader:
        (connection,) = [connection for connection in reader.connections if connection.topic == "/7/sensor"]
        (qos,) = connection.ext.offered_qos_profiles  # type: ignore[union-attr]
    assert qos.reliability.name == "BEST_EFFORT"
    assert {topic for topic in counts(site.folder / "a.mcap") if topic.startswith("/7/")} == {
        "/7/sensor",
        "/7/emergency_stop",
    }


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--split"], "--split when"),
        (["--on", "stop"], "for --ring"),
        (["--ring", "60s", "--max-size", "1GB"], "--ring says"),
        (["--max-size", "much"], "no size"),
        (["--as", "observer"], "is online"),
    ],
)
async def test_wrong_options_are_told(options: list[str], says: str) -> None:
    """Exit code 2, and one line that says what is wrong."""
    code, out, errors = await ended("record", *options)
    assert (code, out) == (2, "")
    assert says in errors


async def test_a_file_that_cannot_be_written_is_told(site: Site) -> None:
    """Before anything is recorded."""
    code, _, errors = await ended("record", "-e", site.endpoint, "-o", str(site.folder / "none" / "a.mcap"))
    assert code == 2
    assert "cannot be written" in errors


async def test_an_idle_mesh_costs_nothing(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    """A robot that is asked how it is five hundred times, and is as it was, adds nothing to a recording."""
    asked = 0
    entries: list[Entry] = []

    class Sink:
        def put(self, entry: Entry) -> None:
            entries.append(entry)

    def tell(self: Condition, status: RobotStatus) -> list[Event]:
        nonlocal asked
        asked += 1
        return told(self, status)

    told = Condition.tell
    monkeypatch.setattr(Condition, "tell", tell)
    monkeypatch.setattr(recorder, "STATUS_S", 0.001)
    async with macs_zenoh.join("unity", connect=[site.endpoint]) as agent:
        recording = recorder.Recorder(agent, Sink(), recorder.Wanted(commands=True, headsets=True))
        recording.start()
        try:
            await until(lambda: recording.topics == 1 and asked > 100)
            before, since = len(entries), asked
            await until(lambda: asked > since + 500)
            assert entries[before:] == []
            assert sum(len(entry.data) for entry in entries) < 20_000
        finally:
            recording.close()
