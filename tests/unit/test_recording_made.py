"""Recordings as they are made: the thread that writes, its limits, the ring; and others made of them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import cast

import pytest

pytest.importorskip("mcap", reason="needs the extra record: pip install 'macs-zenoh[record]'")

from rosbags.highlevel import AnyReader

from bridge.recording import repair as repairing
from bridge.recording.bag import Bag
from bridge.recording.copying import cut, merge
from bridge.recording.disk import CHANNELS, Disk, Entry, Plan
from bridge.recording.mcap_file import McapFile
from bridge.recording.ring import Ring
from bridge.recording.rosbag2 import to_rosbag2
from bridge.recording.schema_source import Schemas
from bridge.recording.sent import KNOWN_OF_ONE, OTHERS, SentCommands
from bridge.recording.streams import CDR, CONTROL, JSON, LOST, STOPS, Channel
from bridge.recording.traffic import Sent
from macs_zenoh.agent import Agent
from macs_zenoh.errors import ConfigError
from tests.support.bags import BEGIN, S, cdr, entries, fill, string_channel, texts
from tests.support.waiting import until

# -- the thread that writes ------------------------------------------------------------------------------------------


def test_splitting_loses_nothing(tmp_path: Path) -> None:
    """Each message is in one file, and each file begins with what its latched topics said last."""
    disk = Disk(Plan(tmp_path / "a.mcap", max_bytes=100_000, split=True, compression="none"))
    disk.start()
    latched, channel = string_channel(topic="/map", durability="transient_local"), string_channel()
    disk.put(Entry(latched, latched.next(8), BEGIN, cdr("the map"), keep=latched.topic))
    for entry in entries(channel, 10_000, start=BEGIN + 1):
        disk.put(entry)
    disk.stop()
    assert len(disk.files) > 3
    assert [path.name for path in disk.files[:2]] == ["a_0.mcap", "a_1.mcap"]
    found: list[bytes] = []
    for path in disk.files:
        assert repairing.problems(path) == []
        with Bag(path) as bag:
            messages = list(bag.messages())
            found += [message.data for message in messages if message.data != cdr("the map")]
            assert messages[0].data == cdr("the map")
            assert messages[0].publish_ns == BEGIN
    assert found == [cdr(f"message {number}") for number in range(10_000)]
    assert not disk.lost


@pytest.mark.parametrize("limits", [{"max_bytes": 50_000}, {"max_s": 10.0}])
def test_a_limit_ends_a_recording(tmp_path: Path, limits: dict[str, float]) -> None:
    """Without splitting it ends there, says why, and counts what comes after."""
    reasons: list[str] = []
    disk = Disk(Plan(tmp_path / "a.mcap", compression="none", **limits), reasons.append)  # type: ignore[arg-type]
    disk.start()
    for entry in entries(string_channel(), 5000):
        disk.put(entry)
    disk.stop()
    assert reasons == ["the recording has the size or length that it may have"]
    assert disk.messages + disk.lost["after_end"] == 5000
    assert 0 < disk.messages < 5000
    with Bag(tmp_path / "a.mcap") as bag:
        assert bag.messages_in_all == disk.messages


def test_what_the_disk_cannot_follow_is_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """More than the queue holds is lost by name, in the file too."""
    from bridge.recording import disk as module

    monkeypatch.setattr(module, "QUEUE_BYTES", 10_000)
    disk = Disk(Plan(tmp_path / "a.mcap"))
    for entry in entries(string_channel(), 2000):  # before it takes any
        disk.put(entry)
    lost = disk.lost["disk_behind"]
    assert lost > 0
    disk.start()
    disk.stop()
    assert disk.messages == 2000 - lost
    with Bag(tmp_path / "a.mcap") as bag:
        assert dict(bag.metadata())["macs.lost"] == {"disk_behind": str(lost)}


def test_a_ring_keeps_the_last_seconds(tmp_path: Path) -> None:
    """A file made of it has what is not older than the ring is long, what was latched before, and what comes after."""
    ring, channel = Ring(10.0, 1 << 30), string_channel()
    latched = string_channel(topic="/map", durability="transient_local")
    ring.put(Entry(latched, latched.next(8), BEGIN, cdr("the map"), keep=latched.topic))
    for entry in entries(channel, 6000, start=BEGIN + 1):  # a minute
        ring.put(entry)
    assert not ring.lost
    disk = Disk(Plan(tmp_path / "a.mcap"))
    disk.start()
    assert ring.write(disk) == len(ring) + 1
    late = Entry(channel, channel.next(1), BEGIN + 61 * S, cdr("after"))
    ring.put(late)
    ring.release(disk)
    ring.put(late._replace(data=cdr("too late")))
    disk.stop()
    with Bag(tmp_path / "a.mcap") as bag:
        found = texts(bag)
    assert found[0] == cdr("the map")
    assert found[-1] == cdr("after")
    assert found[1:-1] == [cdr(f"message {number}") for number in range(4999, 6000)]


def test_a_ring_has_a_size(tmp_path: Path) -> None:
    """What had to go before its time is counted, and told with the file."""
    ring = Ring(10.0, 5000)
    for entry in entries(string_channel(), 1000):
        ring.put(entry)
    assert ring.bytes <= 5000
    assert ring.lost["ring_full"] > 0
    disk = Disk(Plan(tmp_path / "a.mcap"))
    disk.start()
    ring.write(disk)
    disk.stop()
    assert disk.lost["ring_full"] == ring.lost["ring_full"]


def test_names_that_somebody_makes_up_end_no_recording(tmp_path: Path) -> None:
    """A channel that the file cannot have is counted; others, and what is said of the mesh, go on."""
    disk = Disk(Plan(tmp_path / "a.mcap", compression="none"))
    first = Channel("/7/chatter", JSON)
    disk.start()
    disk.put(Entry(first, 0, BEGIN, b"{}"))
    for number in range(CHANNELS + 9):
        disk.put(Entry(Channel(f"/sent/{number}", JSON), 0, BEGIN, b"{}"))
    disk.put(Entry(first, 1, BEGIN, b"{}"))
    disk.put(Entry(Channel(STOPS), 0, BEGIN, b"{}"))
    disk.stop()
    assert disk.problem is None
    assert disk.lost == {"too_many_channels": 10}
    with Bag(tmp_path / "a.mcap") as bag:
        found = {channel.topic for channel in bag.channels.values()}
        assert {"/7/chatter", STOPS, LOST} <= found
        assert bag.messages_in_all == CHANNELS - 1 + 3 + 1  # the last tells the loss


def test_a_ring_keeps_so_many_names(monkeypatch: pytest.MonkeyPatch) -> None:
    """The newest of each, and no name more than it may have."""
    monkeypatch.setattr("bridge.recording.ring.KEPT", 10)
    ring = Ring(1.0, 1 << 20)
    for second in range(3):
        for number in range(20):
            channel = Channel(CONTROL)
            ring.put(Entry(channel, 0, BEGIN + 10 * second * S + number, b"%d" % second, keep=f"control {number}"))
    assert set(ring._kept) == {f"control {number}" for number in range(10)}
    assert {entry.data for entry in ring._kept.values()} == {b"1"}


class Taken:
    """A sink that keeps what it is given."""

    def __init__(self) -> None:
        self.entries: list[Entry] = []

    def put(self, entry: Entry) -> None:
        self.entries.append(entry)


async def test_a_headset_that_makes_up_names_blinds_no_recording() -> None:
    """All its commands are recorded, few in channels of their own; others' are in theirs as before."""
    sink = Taken()
    sent = SentCommands(sink, Schemas(cast(Agent, None)), {})  # nobody is followed: nobody is asked
    for number in range(2000):
        sent.put(Sent("unity/300", "7", f"nd__{number}", f"a_msgs/T{number}", b"bad"), BEGIN)
        sent.put(Sent("unity/256", "7", "nd__cmd_vel", "geometry_msgs/Twist", b"good"), BEGIN)
    await until(lambda: len(sink.entries) == 4000)
    channels = {entry.channel.topic: entry.channel for entry in sink.entries}
    assert len(channels) == KNOWN_OF_ONE + 2
    mine = [
        json.loads(entry.data)["data"] for entry in sink.entries if entry.channel.topic.startswith("/sent/unity/256/")
    ]
    assert len(mine) == 2000
    others = [json.loads(entry.data) for entry in sink.entries if entry.channel.topic == OTHERS]
    assert len(others) == 2000 - KNOWN_OF_ONE
    assert (others[-1]["from"], others[-1]["node"], others[-1]["bytes"]) == ("unity/300", "nd__1999", 3)
    sent.put(Sent("unity/257", "7", "nd__cmd_vel", "geometry_msgs/Twist", b"waits"), BEGIN)
    sent.close()  # before its channel is there
    assert json.loads(sink.entries[-1].data)["from"] == "unity/257"


# -- out of others ---------------------------------------------------------------------------------------------------


def test_merging_is_by_time(tmp_path: Path) -> None:
    """Messages of several files are in one, by time; a channel that is the same in both is one."""
    one, two = tmp_path / "1.mcap", tmp_path / "2.mcap"
    for path, start, robot in ((one, BEGIN, 7), (two, BEGIN + S // 200, 7)):
        file = McapFile(path, chunk_bytes=3000)
        fill(file, string_channel(robot), 500, start)
        file.close()
    out = tmp_path / "both.mcap"
    assert merge([one, two], out) == 1000
    assert repairing.problems(out) == []
    with Bag(out) as bag:
        times = [message.log_ns for message in bag.messages()]
        assert times == sorted(times)
        assert len(bag.channels) == 1
    with pytest.raises(ConfigError):
        merge([one, two], out)


def test_cutting_keeps_what_was_latched(tmp_path: Path) -> None:
    """A part has the messages of its time, and before them what latched topics said last."""
    file = McapFile(tmp_path / "a.mcap")
    latched = string_channel(topic="/map", durability="transient_local")
    schema = file.schema(latched.type, "ros2msg", latched.schema.encode())
    number = file.channel(latched.topic, CDR, schema, latched.metadata)
    for text in ("old map", "the map"):
        file.add(number, 0, BEGIN, BEGIN, cdr(text))
    fill(file, string_channel(), 1000)
    file.close()
    count = cut(
        tmp_path / "a.mcap", tmp_path / "b.mcap", lambda channel: True, start_ns=BEGIN + 5 * S, end_ns=BEGIN + 6 * S
    )
    assert count == 101
    with Bag(tmp_path / "b.mcap") as bag:
        assert texts(bag) == [cdr("the map"), *(cdr(f"message {number}") for number in range(500, 600))]


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_a_bag_of_ros_has_every_message(tmp_path: Path, storage: str) -> None:
    """Under names that ROS takes, with the same bytes, times and QoS; JSON is text there."""
    file = McapFile(tmp_path / "a.mcap")
    fill(file, string_channel(), 100)
    number = file.channel("/macs/stops", JSON, 0, {})
    file.add(number, 1, BEGIN, BEGIN, b'{"robot": 7}')
    file.close()
    assert to_rosbag2(tmp_path / "a.mcap", tmp_path / "bag", storage) == 101
    with AnyReader([tmp_path / "bag"]) as reader:
        found = {connection.topic: connection for connection in reader.connections}
        assert set(found) == {"/robot_7/chatter", "/macs/stops"}
        read = [(c.topic, t, bytes(data)) for c, t, data in reader.messages()]
        assert [entry for entry in read if entry[0] != "/macs/stops"] == [
            ("/robot_7/chatter", BEGIN + number * S // 100, cdr(f"message {number}")) for number in range(100)
        ]
        text = next(data for topic, _, data in read if topic == "/macs/stops")
        assert json.loads(reader.deserialize(text, "std_msgs/msg/String").data) == {"robot": 7}  # type: ignore[attr-defined]
    with pytest.raises(ConfigError):
        to_rosbag2(tmp_path / "a.mcap", tmp_path / "bag", storage)
