"""`macs replay`: a recorded robot that headsets, agents and ROS nodes take for one, and commands sent once more."""

from __future__ import annotations

import asyncio
import json
import re
import threading
import time
from collections.abc import AsyncIterator, Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("mcap", reason="needs the extra record: pip install 'macs-zenoh[record]'")

from geometry_msgs.msg import Twist
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.serialization import serialize_message
from std_msgs.msg import String

import macs_zenoh
from bridge.headset.client import Headset
from bridge.headset.nodes import Subscription
from bridge.recording.bag import Bag
from bridge.recording.mcap_file import McapFile
from bridge.recording.mcap_records import Message
from bridge.recording.streams import CDR, OFFERS, PRESENCE, Channel, command_topic, robot_channel
from bridge.replay.player import Player
from bridge.replay.recorded import recorded_robots
from bridge.replay.timeline import Timeline
from macs_zenoh.protocol.robot_state import TopicQos
from tests.support.bags import BEGIN, STRING, cdr
from tests.support.programs import Program, ended, macs
from tests.support.ros_peer import Peer
from tests.support.routers import Router
from tests.support.waiting import PATIENCE_S, get, until

TWIST = f"Vector3 linear\nVector3 angular\n{'=' * 80}\nMSG: geometry_msgs/Vector3\nfloat64 x\nfloat64 y\nfloat64 z\n"


def twist(x: float) -> bytes:
    message = Twist()
    message.linear.x = float(x)
    return bytes(serialize_message(message))


class Writing:
    """A recording that a test makes."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.file = McapFile(path)
        self._ids: dict[str, int] = {}

    def add(self, channel: Channel, at_s: float, data: bytes) -> None:
        if channel.topic not in self._ids:
            schema = self.file.schema(channel.type, "ros2msg", channel.schema.encode()) if channel.schema else 0
            self._ids[channel.topic] = self.file.channel(channel.topic, channel.encoding, schema, channel.metadata)
        at_ns = BEGIN + int(at_s * 1e9)
        self.file.add(self._ids[channel.topic], channel.next(len(data)), at_ns, at_ns, data)

    def say(self, topic: str, at_s: float, value: dict[str, Any]) -> None:
        self.add(Channel(topic), at_s, json.dumps(value).encode())


def text_topic(robot: int, topic: str, durability: str = "volatile") -> Channel:
    return robot_channel(robot, topic, "std_msgs/msg/String", STRING, "RIHS01_x", TopicQos("reliable", durability))


async def following(subscription: Subscription) -> Any:
    """The next message of a headset's subscription."""
    return await asyncio.wait_for(anext(aiter(subscription)), 60)


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """Robot 7 says who it is once, and something a hundred times a second for two seconds; headset 256 drove it."""
    writing = Writing(tmp_path / "a.mcap")
    writing.say(PRESENCE, 0, {"agent": "ros/7", "group": 3, "online": True})
    offers = {"subscribers": {"/cmd_vel": "geometry_msgs/msg/Twist"}, "services": {"/set": "std_srvs/srv/SetBool"}}
    writing.say(OFFERS, 0, {"robot": 7, "offers": offers})
    writing.add(text_topic(7, "/name", "transient_local"), 0, cdr("seven"))
    chatter = text_topic(7, "/chatter")
    for number in range(200):
        writing.add(chatter, number / 100, cdr(f"message {number}"))
    metadata = {"as": "sent", "robot": "7", "topic": "/cmd_vel", "sender": "unity/256"}
    sent = Channel(command_topic("unity/256", "7", "/cmd_vel"), CDR, "geometry_msgs/msg/Twist", TWIST, metadata)
    for number in range(10):
        writing.add(sent, number / 10, twist(number))
    writing.file.close()
    return writing.path


@pytest.fixture
async def router() -> AsyncIterator[Router]:
    async with Router() as router:
        yield router


def replay(recording: Path, endpoint: str, *options: str, env: dict[str, str] | None = None) -> Program:
    return Program("replay", str(recording), "-e", endpoint, *options, env=env)


async def test_what_a_file_says_of_its_robots(recording: Path) -> None:
    """Topics, types, QoS, group, what it offered besides, and what was latched before the place to begin at."""
    robots = recorded_robots(recording, lambda topic: True, start_s=1.0)
    assert set(robots) == {7}
    robot = robots[7]
    assert robot.group == 3
    offers = robot.offers()
    assert offers.publishers == {"/name": "std_msgs/msg/String", "/chatter": "std_msgs/msg/String"}
    assert offers.subscribers == {"/cmd_vel": "geometry_msgs/msg/Twist"}
    assert offers.services == {"/set": "std_srvs/srv/SetBool"}
    assert offers.qos["/name"] == TopicQos("reliable", "transient_local")
    assert robot.topics["/name"].last == cdr("seven")
    assert robot.definitions["std_msgs/msg/String"].hash == "RIHS01_x"


async def test_a_headset_takes_it_for_a_robot(recording: Path, router: Router) -> None:
    """Online with its group, it offers its topics, sends what was recorded in order, and late ones what was latched;
    services and commands are refused with the reason."""
    async with (
        Program("gateway", "--port", "0", "-e", router.endpoint) as gateway,
        await Headset.connect("127.0.0.1", gateway.port) as headset,
    ):
        chatter = await headset.subscribe("/chatter", "std_msgs/String", agents=[7])
        async with replay(recording, router.endpoint, "--loop") as playing:
            assert playing.ready == f"playing {recording} as robot 7 to mesh"
            (row,) = [row for row in await macs("ls", "-v", "--json", "-e", router.endpoint) if row["type"] == "ros"]
            assert (row["id"], row["group"]) == (7, 3)
            assert row["offers"]["publishers"] == {"/chatter": "std_msgs/msg/String", "/name": "std_msgs/msg/String"}
            received = [(await following(chatter)).data for _ in range(150)]
            first = int(received[0].rstrip(b"\0").rpartition(b" ")[2])
            assert received == [cdr(f"message {(first + number) % 200}") for number in range(150)]
            name = await headset.subscribe("/name", "std_msgs/String", agents=[7])
            assert (await following(name)).data == cdr("seven")
            with pytest.raises(macs_zenoh.Refused, match="is a recording"):
                await headset.call("/set", "std_srvs/SetBool", 7, b"\x00\x01\x00\x00\x01", failures=True)
            async with macs_zenoh.join("unity", connect=[router.endpoint]) as agent:
                with pytest.raises(macs_zenoh.Refused, match="is a recording"):
                    await agent.publish("/cmd_vel", twist(1), robot=7, type="geometry_msgs/Twist")
                with pytest.raises(macs_zenoh.Refused, match="not in the recording"):
                    await agent.subscribe("/other", robot=7, type="std_msgs/String")
                with pytest.raises(macs_zenoh.Refused, match="is a recording"):
                    await agent.call("ros", 7, "stop", b"true")
                told = json.loads(await agent.call("ros", 7, "definitions"))
                assert told["definitions"]["std_msgs/msg/String"]["text"] == STRING
    # and nothing is left


async def test_it_leaves_nothing_behind(recording: Path, router: Router) -> None:
    """At its end, and after a signal: the robot has left."""
    async with macs_zenoh.join("unity", connect=[router.endpoint]) as agent:
        async with replay(recording, router.endpoint, "--as-robot", "7:17") as playing:
            await until(lambda: (1, 17) in agent.directory)
            assert (1, 7) not in agent.directory
            assert await playing.wait() == 0
        await until(lambda: (1, 17) not in agent.directory)
        async with replay(recording, router.endpoint, "--loop"):
            await until(lambda: (1, 7) in agent.directory)
            code, _, errors = await ended("replay", str(recording), "-e", router.endpoint)
            assert code == 2
            assert "already online" in errors
        await until(lambda: (1, 7) not in agent.directory)


async def test_a_recording_is_played_into_ros(recording: Path, router: Router, peer: Peer, domain: int) -> None:
    """An rclpy subscription gets each message, and a late one what is latched."""
    received = await peer.subscription(String, "/replay/robot_7/chatter", 1000)
    own = await peer.subscription(String, "/chatter", 1000)
    env = {"ROS_DOMAIN_ID": str(domain)}
    async with replay(recording, router.endpoint, "--to", "ros", "--loop", env=env):
        first = int((await get(received)).data.rpartition(" ")[2])
        for number in range(1, 150):
            assert (await get(received)).data == f"message {(first + number) % 200}"
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        assert (await get(await peer.subscription(String, "/replay/robot_7/name", latched))).data == "seven"
    assert own.empty()


DRIVING = ["/cmd_vel", "/emergency_stop", "/robot7/emergency_stop", "/speed", "/tf"]
"""What nodes of the robot listened to, its stop, and what only a recording of commands has."""


@pytest.fixture
def driven(tmp_path: Path) -> Path:
    """A recording of commands as robot 7 carried them out: its navigation drove it, and its stop was released."""
    writing = Writing(tmp_path / "driven.mcap")
    listened = {"/cmd_vel": "std_msgs/msg/String", "/tf": "std_msgs/msg/String"}
    published = dict.fromkeys(["/chatter", "/cmd_vel", "/tf"], "std_msgs/msg/String")
    writing.say(OFFERS, 0, {"robot": 7, "offers": {"subscribers": listened, "publishers": published}})
    for number in range(100):
        for topic in (*DRIVING, "/chatter"):
            writing.add(text_topic(7, topic), number / 100, cdr(f"{number}"))
    writing.file.close()
    return writing.path


async def test_nothing_that_may_move_a_robot_is_played_into_ros_unasked(
    driven: Path, router: Router, peer: Peer, domain: int
) -> None:
    """Without its id twice no topic has its own name; with it those that moved it are left out, unless named."""
    env = {"ROS_DOMAIN_ID": str(domain)}
    heard = {topic: await peer.subscription(String, topic, 1000) for topic in (*DRIVING, "/chatter")}
    shown = await peer.subscription(String, "/replay/robot_7/cmd_vel", 1000)
    async with replay(driven, router.endpoint, "--to", "ros", "--loop", env=env):
        for _ in range(100):
            await get(shown)
    assert all(queue.empty() for queue in heard.values())
    for options in (["--own-names", "7"], ["--own-names", "7", "--confirm", "8"]):
        code, out, errors = await ended("replay", str(driven), "--to", "ros", *options)
        assert (code, out) == (2, "")
        assert "named twice" in errors or "--confirm 7" in errors
    named = ("--topics", "/tf", "--topics", "/emer*", "--topics", "/robot7/emergency_stop")
    own = ("--to", "ros", "--own-names", "7", "--confirm", "7")
    async with replay(driven, router.endpoint, *own, "--loop", env=env) as playing:
        for _ in range(100):
            await get(heard["/chatter"])
        assert all(heard[topic].empty() for topic in DRIVING)
        assert all(any(f"{topic} is not played" in line for line in playing.log) for topic in DRIVING)
    async with replay(driven, router.endpoint, *own, "--loop", *named, env=env):
        for _ in range(100):
            await get(heard["/tf"])
        assert all(heard[topic].empty() for topic in DRIVING if topic != "/tf")


@pytest.mark.parametrize("replays", [False, True])
async def test_a_recording_gets_into_no_live_robot_unasked(
    recording: Path, router: Router, peer: Peer, domain: int, tmp_path: Path, replays: bool
) -> None:
    """A robot that mirrors robot 7 mirrors no recording of it, and says so, unless its rule takes those."""
    settings = tmp_path / "mirror.toml"
    taken = "replays = true" if replays else ""
    settings.write_text(f'[[robot.mirror]]\nfrom = "ros/7"\ntopics = ["/chatter"]\nas = "/seven{{topic}}"\n{taken}\n')
    received = await peer.subscription(String, "/seven/chatter", 1000)
    env = {"ROS_DOMAIN_ID": str(domain)}
    command = ("agent", "--id", "2", "--settings", str(settings), "-e", router.endpoint)
    async with Program(*command, env=env) as live, replay(recording, router.endpoint, "--loop"):
        if replays:
            assert (await get(received)).data.startswith("message")
        else:
            await until(lambda: any("recording that is played; replays = true" in line for line in live.log))
            assert received.empty()
            assert peer.session.node.count_publishers("/seven/chatter") == 0


async def test_a_recording_is_played_to_a_gateway(recording: Path, router: Router) -> None:
    """As an existing robot program it is there under an id that the gateway has set aside for robots."""
    async with (
        Program("gateway", "--port", "0", "-e", router.endpoint, "--robots", "7") as gateway,
        await Headset.connect("127.0.0.1", gateway.port) as headset,
    ):
        chatter = await headset.subscribe("/chatter", "std_msgs/String", agents=[7])
        async with replay(recording, router.endpoint, "--to", "gateway", f"127.0.0.1:{gateway.port}", "--loop"):
            received = [(await following(chatter)).data for _ in range(100)]
            first = int(received[0].rstrip(b"\0").rpartition(b" ")[2])
            assert received == [cdr(f"message {(first + number) % 200}") for number in range(100)]


async def test_commands_go_only_to_a_robot_that_was_named_twice(
    recording: Path, router: Router, peer: Peer, domain: int
) -> None:
    """Without its id a second time nothing is sent; with it the robot gets each command as it was recorded."""
    driven = await peer.subscription(Twist, "/cmd_vel", 100)
    async with Program("agent", "--id", "7", "-e", router.endpoint, env={"ROS_DOMAIN_ID": str(domain)}):
        for options in ([], ["--confirm", "8"]):
            command = ("replay", str(recording), "-e", router.endpoint, "--commands-to", "7", *options)
            code, out, errors = await ended(*command)
            assert (code, out) == (2, "")
            assert "named twice" in errors or "--confirm 7" in errors
        assert driven.empty()
        code, out, errors = await ended(
            "replay", str(recording), "-e", router.endpoint, "--commands-to", "7", "--confirm", "7"
        )
        assert code == 0, errors
        sent = re.search(r"^(\d+) messages", out, re.MULTILINE)
        late = re.search(r"(\d+) left out, as they were too late", out)  # on a busy machine
        assert sent
        assert int(sent[1]) + (int(late[1]) if late else 0) == 10
        speeds: list[float] = []

        def at_its_end() -> bool:
            while not driven.empty():
                speeds.append(driven.get_nowait().linear.x)
            return speeds[-1:] > [5.0]  # the first may come before ROS has found the subscription, the last too late

        await until(at_its_end)
        assert speeds == sorted(set(speeds))
        assert set(speeds) <= set(range(10))


@pytest.fixture
def mixed(tmp_path: Path) -> Path:
    """Two headsets drove robot 7 on two topics, for a minute, and one of them released its stop all the time."""
    writing = Writing(tmp_path / "mixed.mcap")
    for number in range(600):
        for sender, topic, of_type, text, data in (
            ("unity/256", "/cmd_vel", "geometry_msgs/msg/Twist", TWIST, twist(number)),
            ("unity/257", "/cmd_vel", "geometry_msgs/msg/Twist", TWIST, twist(-1)),
            ("unity/256", "/arm", "geometry_msgs/msg/Twist", TWIST, twist(5)),
            ("unity/256", "/emergency_stop", "std_msgs/msg/Bool", "bool data\n", b"\0\1\0\0\0"),
            ("unity/256", "/robot7/emergency_stop", "std_msgs/msg/Bool", "bool data\n", b"\0\1\0\0\0"),
        ):
            metadata = {"as": "sent", "robot": "7", "topic": topic, "sender": sender}
            sent = Channel(command_topic(sender, "7", topic), CDR, of_type, text, metadata)
            writing.add(sent, number / 10, data)
    writing.file.close()
    return writing.path


async def is_stopped(endpoint: str) -> bool:
    async with macs_zenoh.join("unity", connect=[endpoint]) as agent:
        return bool(json.loads(await agent.call("ros", 7, "status"))["stopped"])


async def test_no_more_commands_are_sent_than_were_asked_for(
    mixed: Path, router: Router, peer: Peer, domain: int
) -> None:
    """One headset's, of the topics that were named; a stop ends it, and no recorded release ends the stop."""
    driven, arm = await peer.subscription(Twist, "/cmd_vel", 1000), await peer.subscription(Twist, "/arm", 1000)
    command = ("replay", str(mixed), "-e", router.endpoint, "--commands-to", "7", "--confirm", "7")
    code, out, errors = await ended(*command)
    assert (code, out) == (2, "")
    assert "unity/256, unity/257; say whose: --sender" in errors
    code, out, errors = await ended(*command, "--topics", "/emergency_stop", "--topics", "/robot7/emergency_stop")
    assert (code, out) == (2, "")
    assert "no commands to robot 7" in errors
    async with Program("agent", "--id", "7", "-e", router.endpoint, env={"ROS_DOMAIN_ID": str(domain)}):
        async with Program(*command, "--sender", "unity/256", "--topics", "/cmd_vel") as playing:
            assert playing.ready.endswith("to robot 7: /cmd_vel")
            speeds = [(await get(driven)).linear.x for _ in range(5)]
            await macs("stop", "7", "--json", "-e", router.endpoint)
            assert await playing.wait() == 1
        assert await is_stopped(router.endpoint)
        assert speeds == [speeds[0] + number for number in range(5)]
        assert arm.empty()
        # all topics of one who released the stop again and again: the robot stays stopped, and that ends it too
        code, out, errors = await ended(*command, "--sender", "unity/256")
        assert code == 1
        assert "refused" in out + errors
        assert await is_stopped(router.endpoint)


def test_what_is_late_is_left_out(tmp_path: Path) -> None:
    """Where that is wanted, as for commands: a program that was stopped and continued sends nothing overdue."""
    writing = Writing(tmp_path / "a.mcap")
    for number in range(100):
        writing.add(text_topic(7, "/chatter"), number / 100, cdr(str(number)))
    writing.file.close()
    played: list[bytes] = []
    errors: list[object] = []

    def play(message: Message) -> None:
        if not played:
            time.sleep(0.6)
        played.append(message.data)

    player = Player(Timeline(writing.path, lambda channel: True), play, errors.append, max_late_s=0.2)
    player.start()
    wait_for(lambda: errors)
    player.stop()
    assert errors == [None]
    assert played[0] == cdr("0")
    assert player.left_out >= 35
    assert len(played) + player.left_out == 100
    assert played[1:] == [cdr(str(number)) for number in range(100)][-len(played) + 1 :]


def test_what_cannot_be_played_is_told(tmp_path: Path) -> None:
    """Whatever fails, the end is an error and not the end of the recording."""
    writing = Writing(tmp_path / "a.mcap")
    writing.add(text_topic(7, "/chatter"), 0, cdr("a"))
    writing.file.close()
    errors: list[object] = []

    def fail(message: Message) -> None:
        raise ValueError("the middleware has had enough")

    player = Player(Timeline(writing.path, lambda channel: True), fail, errors.append)
    player.start()
    wait_for(lambda: errors)
    player.stop()
    assert isinstance(errors[0], macs_zenoh.MacsError)
    assert "has had enough" in str(errors[0])


def test_it_can_be_stopped_while_the_disk_is_slow(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Who waits for the first message waits no longer once it is stopped."""
    writing = Writing(tmp_path / "a.mcap")
    writing.add(text_topic(7, "/chatter"), 0, cdr("a"))
    writing.file.close()
    reading, go_on = threading.Event(), threading.Event()

    def slow(*args: object, **options: object) -> Iterator[Message]:
        reading.set()
        go_on.wait()
        return iter(())

    monkeypatch.setattr(Bag, "messages", slow)
    timeline = Timeline(writing.path, lambda channel: True)
    player = Player(timeline, lambda message: None, lambda error: None)
    player.start()
    reading.wait(PATIENCE_S)
    stopping = threading.Thread(target=player.stop, daemon=True)
    stopping.start()
    wait_for(lambda: timeline._closed)
    go_on.set()
    stopping.join(PATIENCE_S)
    assert not stopping.is_alive()


def wait_for(condition: Callable[[], object]) -> None:
    """The same as `until`, in a test without a loop."""
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_messages_are_played_at_their_time(tmp_path: Path) -> None:
    """A thousand a second: each at its time or a little later, none before, and none is left out."""
    writing = Writing(tmp_path / "a.mcap")
    channel = text_topic(7, "/chatter")
    for number in range(2000):
        writing.add(channel, number / 1000, cdr(f"message {number}"))
    writing.file.close()
    played: list[tuple[float, bytes]] = []
    errors: list[object] = []
    player = Player(
        Timeline(writing.path, lambda channel: True),
        lambda message: played.append((time.monotonic(), message.data)),
        errors.append,
    )
    player.start()
    while not errors:
        time.sleep(0.01)
    player.stop()
    assert errors == [None]
    assert [data for _, data in played] == [cdr(f"message {number}") for number in range(2000)]
    assert min(player.late_s) >= 0
    began = played[0][0]
    assert all(at - began >= number / 1000 - 0.001 - player.late_s[0] for number, (at, _) in enumerate(played))


@pytest.mark.parametrize(("rate", "loop"), [(10.0, False), (100.0, True)])
def test_rate_and_loop(tmp_path: Path, rate: float, loop: bool) -> None:
    """It is played so many times as fast, and again and again if that is wanted, until it is stopped."""
    writing = Writing(tmp_path / "a.mcap")
    channel = text_topic(7, "/chatter")
    for number in range(20):
        writing.add(channel, number, cdr(str(number)))
    writing.file.close()
    played: list[bytes] = []
    errors: list[object] = []
    timeline = Timeline(writing.path, lambda channel: True, start_s=10.0, rate=rate, loop=loop)
    player = Player(timeline, lambda message: played.append(message.data), errors.append)
    player.start()
    while not (errors or len(played) >= 35):
        time.sleep(0.01)
    player.stop()
    expected = [cdr(str(number)) for number in range(10, 20)]
    assert played[:10] == expected
    assert (played[10:20] == expected) is loop
    assert errors == ([] if loop else [None])


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--rate", "0"], "no rate"),
        (["--as-robot", "7"], "OLD:NEW"),
        (["--to", "moon"], "--to gateway HOST:PORT"),
        (["--to", "gateway"], "--to gateway HOST:PORT"),
        (["--topics", "/none"], "no topics"),
        (["--own-names", "7"], "with --to ros"),
        (["--commands-to", "7", "--confirm", "7", "--robot", "7"], "--as-robot"),
        (["--commands-to", "7", "--confirm", "7", "--topics", "/none"], "no commands to robot 7"),
        (["--commands-to", "7", "--confirm", "7", "--sender", "unity/9"], "others sent some: unity/256"),
        (["--sender", "unity/9"], "with --commands-to"),
        (["--to", "ros", "--own-names", "9", "--confirm", "9"], "no topics of robot 9"),
        (["--commands-to", "9", "--confirm", "9"], "no commands to robot 9"),
    ],
)
async def test_wrong_options_are_told(recording: Path, options: list[str], says: str) -> None:
    """Exit code 2, and one line that says what is wrong."""
    code, out, errors = await ended("replay", str(recording), *options)
    assert (code, out) == (2, "")
    assert says in errors
