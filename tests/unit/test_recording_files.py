"""Recordings as files: what is written is read by others, mended, merged and cut, with bounded memory."""

from __future__ import annotations

import itertools
import os
import resource
import struct
import subprocess
import sys
import time
from pathlib import Path

import pytest

pytest.importorskip("mcap", reason="needs the extra record: pip install 'macs-zenoh[record]'")

from mcap.reader import make_reader
from rosbags.highlevel import AnyReader

from bridge.recording import repair as repairing
from bridge.recording.bag import BadBag, Bag, Unfinished
from bridge.recording.disk import Disk, Plan
from bridge.recording.mcap_file import CHUNK_BYTES, COMPRESSIONS, LARGE_BYTES, MAGIC, McapFile
from bridge.recording.rosbag2 import ros_name
from bridge.recording.serving.folder import Folder
from bridge.recording.streams import (
    command_topic,
    qos_of,
    qos_text,
    robot_topic,
    split_topic,
)
from bridge.replay.timeline import Timeline
from macs_zenoh.errors import ConfigError
from macs_zenoh.protocol.robot_state import TopicQos
from tests.support.bags import BEGIN, STRING, S, cdr, fill, string_channel, texts, write
from tests.support.lichtblick import lichtblick, needs_lichtblick
from tests.support.programs import ROOT
from tests.support.thorough import some

# -- names -----------------------------------------------------------------------------------------------------------


def test_names_of_channels() -> None:
    """A robot's topic is found in a channel's name; commands, JSON channels and others' names are no robot's."""
    assert robot_topic(7, "/camera/image") == "/7/camera/image"
    assert split_topic("/7/camera/image") == (7, "/camera/image")
    for name in ("/macs/presence", command_topic("unity/256", "7", "/cmd_vel"), "/7", "/", "", "/7777777/x"):
        assert split_topic(name) is None, name
    assert command_topic("unity/256", "7", "/cmd_vel") == "/sent/unity/256/7/cmd_vel"
    assert ros_name("/7/camera") == "/robot_7/camera"
    assert ros_name("/sent/unity/256/7/cmd_vel") == "/sent/unity/id_256/id_7/cmd_vel"


@pytest.mark.parametrize("reliability", ["reliable", "best_effort"])
@pytest.mark.parametrize("durability", ["volatile", "transient_local"])
def test_qos_in_metadata(reliability: str, durability: str) -> None:
    """What rosbags reads of our QoS is what was said, and we read what others write in words."""
    from rosbags.rosbag2.metadata import parse_qos

    qos = TopicQos(reliability, durability)
    (read,) = parse_qos(qos_text(qos))
    assert (read.reliability.name.lower(), read.durability.name.lower()) == (reliability, durability)
    assert qos_of({"offered_qos_profiles": qos_text(qos)}) == qos
    words = f"- history: keep_last\n  reliability: {reliability}\n  durability: {durability}\n  depth: 1"
    assert qos_of({"offered_qos_profiles": words}) == qos


# -- one file --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("compression", COMPRESSIONS)
def test_others_read_what_is_written(tmp_path: Path, compression: str) -> None:
    """mcap's own reader, with all checksums, and rosbags find each message, its times, number and bytes."""
    path = write(tmp_path / "a.mcap", 3000, compression=compression, chunk_bytes=10_000)
    expected = [cdr(f"message {number}") for number in range(3000)]
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        assert summary.statistics.message_count == 3000
        assert len(summary.chunk_indexes) > 5
        found = list(reader.iter_messages())
    assert [message.data for _, _, message in found] == expected
    assert [message.sequence for _, _, message in found] == list(range(1, 3001))
    assert {channel.topic for _, channel, _ in found} == {"/7/chatter"}
    assert {channel.metadata["robot"] for _, channel, _ in found} == {"7"}
    with AnyReader([path]) as any_reader:
        assert [bytes(data) for _, _, data in any_reader.messages()] == expected
        assert any_reader.deserialize(expected[5], "std_msgs/msg/String").data == "message 5"  # type: ignore[attr-defined]
    with Bag(path) as bag:
        assert texts(bag) == expected
        assert (bag.start_ns, bag.end_ns) == (BEGIN, BEGIN + 2999 * S // 100)
        assert texts(bag, start_ns=BEGIN + 10 * S, end_ns=BEGIN + 11 * S) == expected[1000:1100]


@pytest.mark.parametrize("compression", COMPRESSIONS)
@pytest.mark.parametrize("noisy", [True, False])
def test_large_messages_are_read_among_small_ones(tmp_path: Path, compression: str, noisy: bool) -> None:
    """Also where several share a chunk, and one is more than a chunk: in their order, with the chunks' checksums."""
    path = tmp_path / "a.mcap"
    file = McapFile(path, compression=compression)
    channel = file.channel("/7/image", "json", 0, {})
    sizes = [
        10,
        LARGE_BYTES,
        100,
        200,
        LARGE_BYTES + 1,
        LARGE_BYTES,
        2 * CHUNK_BYTES,
        *[50] * 3000,
        LARGE_BYTES * 3,
        1,
        0,
    ]
    messages = [os.urandom(size) if noisy else b"\x07" * size for size in sizes]
    for number, data in enumerate(messages):
        file.add(channel, number, BEGIN + number, 0, data)
    file.close()
    with path.open("rb") as stream:
        read = [message.data for _, _, message in make_reader(stream, validate_crcs=True).iter_messages()]
    assert read == messages
    assert (path.stat().st_size < sum(sizes) // 2) == (not noisy and compression != "none")


@pytest.mark.parametrize("compression", ["zstd", "lz4"])
def test_what_gets_no_smaller_is_written_as_it_is(tmp_path: Path, compression: str) -> None:
    """Small messages of which much could be saved do not have the noisy pictures beside them compressed for nothing,
    nor does a noisy one keep those from it that get smaller."""
    noise, plain = os.urandom(900_000), bytes(900_000)
    file = McapFile(tmp_path / "a.mcap", compression=compression, chunk_bytes=4 << 20)
    channel = file.channel("/a", "cdr", 0, {})
    for pictures in ([noise, noise], [noise, plain, plain]):
        for picture in pictures:
            for number in range(200):
                file.add(channel, number, number, number, bytes(100))
            file.add(channel, number, number, number, picture)
        file.flush()
    file.close()
    assert [chunk.compression for chunk in file.index.chunks] == ["", compression]


def test_others_files_are_read(tmp_path: Path) -> None:
    """Files of mcap's own writer, with chunks and without, channels in chunks, and messages out of order."""
    from mcap.writer import CompressionType, Writer

    for number, (chunks, compression) in enumerate(itertools.product((True, False), CompressionType)):
        path = tmp_path / f"{number}.mcap"
        with path.open("wb") as stream:
            writer = Writer(stream, chunk_size=500, compression=compression, use_chunking=chunks)
            writer.start(profile="ros2", library="another")
            schema = writer.register_schema("std_msgs/msg/String", "ros2msg", STRING.encode())
            channel = writer.register_channel("/a", "cdr", schema)
            for at in range(100):
                time_ns = BEGIN + (at ^ 3) * S  # each four the other way round
                writer.add_message(channel, time_ns, cdr(str(at)), time_ns, at)
            writer.finish()
        with Bag(path) as bag:
            times = [message.log_ns for message in bag.messages()]
            assert len(times) == 100
            assert times == sorted(times) or not chunks
            assert bag.library.startswith("another")
        assert repairing.problems(path) == []


def test_chunks_that_overlap_are_read_by_time(tmp_path: Path) -> None:
    """However chunks lie over each other, messages come by time, and only so much is kept in memory."""
    file = McapFile(tmp_path / "a.mcap", compression="none")
    channel = file.channel("/a", "json", 0, {})
    for start in range(50):
        for step in range(20):
            file.add(channel, 0, BEGIN + (start + 50 * step) * S, 0, b"x" * 1000)
        file.flush()
    file.close()
    with Bag(tmp_path / "a.mcap", cache_bytes=50_000) as bag:
        times = [message.log_ns for message in bag.messages()]
        assert times == [BEGIN + number * S for number in range(1000)]
        assert not bag._cache


def test_nothing_is_written_over(tmp_path: Path) -> None:
    """A file that exists stays what it is."""
    path = tmp_path / "a.mcap"
    path.write_bytes(b"mine")
    with pytest.raises(FileExistsError):
        McapFile(path)
    with pytest.raises(ConfigError, match="nothing is written over"):
        Disk(Plan(path)).start()
    assert path.read_bytes() == b"mine"


@pytest.mark.parametrize(
    ("content", "error"),
    [
        (b"", BadBag),
        (b"text", BadBag),
        (b"\x89MCAP0\r\n", BadBag),
        (b"\x89MCAP0\r\n\x01\xff\xff\xff\xff\xff\xff\xff\x7f", BadBag),
        (b"\x89MCAP0\r\n" + b"\x01" + struct.pack("<Q", 8) + bytes(8), Unfinished),
    ],
)
def test_what_is_no_recording_is_told(tmp_path: Path, content: bytes, error: type[Exception]) -> None:
    """One line says what is wrong with a file, and nothing that it declares is believed."""
    path = tmp_path / "a.mcap"
    path.write_bytes(content)
    with pytest.raises(error) as raised:
        Bag(path)
    assert str(path) in str(raised.value)


def test_an_index_that_makes_no_sense_is_told(tmp_path: Path) -> None:
    """A table of half a row, and metadata at an offset that no file has: one such file ends nobody who lists them."""
    whole = write(tmp_path / "a.mcap", 3).read_bytes()
    data_end = whole.rindex(struct.pack("<BQ", 15, 4))
    header = whole[:data_end]

    def file(name: str, *records: tuple[int, bytes]) -> Path:
        summary = b"".join(struct.pack("<BQ", opcode, len(data)) + data for opcode, data in records)
        end = header + struct.pack("<BQI", 15, 4, 0)
        footer = struct.pack("<BQQQI", 2, 20, len(end), 0, 0) + MAGIC
        path = tmp_path / name
        path.write_bytes(end + summary + footer)
        return path

    numbers = struct.pack("<QHIIIIQQ", 0, 0, 0, 0, 0, 0, 0, 0)
    with pytest.raises(Unfinished):
        Bag(file("half.mcap", (11, numbers + struct.pack("<I", 7) + bytes(7))))
    name = struct.pack("<I", 1) + b"x"
    far = (13, struct.pack("<QQ", (1 << 64) - 1, 9) + name)
    chunk = (8, struct.pack("<QQQQIQIQQ", 0, 9, (1 << 64) - 5, 9, 0, 0, 0, 0, 0))
    with Bag(file("far.mcap", (11, numbers + bytes(4)), far, chunk)) as bag:
        with pytest.raises(BadBag):
            bag.metadata()
        with pytest.raises(BadBag):
            list(bag.messages())
    told = {each["name"]: each["state"] for each in Folder(tmp_path).listed(())}
    assert told == {"a.mcap": "whole", "half.mcap": "unfinished", "far.mcap": "bad"}


def test_what_is_no_file_is_not_waited_for(tmp_path: Path) -> None:
    """A FIFO with the name of a recording, which nobody ever writes to."""
    path = tmp_path / "a.mcap"
    os.mkfifo(path)
    for read in (Bag, repairing.problems, lambda path: repairing.repair(path, tmp_path / "b.mcap")):
        with pytest.raises(ConfigError, match="is no file"):
            read(path)


def test_every_damaged_byte_is_survived(tmp_path: Path) -> None:
    """Any byte of a small file may be another: reading and mending it end with an error of ours or with messages."""
    whole = write(tmp_path / "a.mcap", 20, compression="zstd").read_bytes()
    path = tmp_path / "b.mcap"
    for at in (*range(17), *some(range(17, len(whole)))):
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 0xFF]) + whole[at + 1 :])
        try:
            with Bag(path) as bag:
                assert len(texts(bag)) <= 20
        except BadBag:
            pass
        out = tmp_path / "c.mcap"
        try:
            repairing.repair(path, out)
        except BadBag:
            assert at < 17  # it is no MCAP file then, or has a header whose length is wrong
        else:
            found = repairing.problems(out)
            assert all("schema" in problem for problem in found), (at, found)
            out.unlink()


def test_a_chunk_that_grows_without_end_is_refused(tmp_path: Path) -> None:
    """What a chunk says of its size bounds what is made of it."""
    import zstandard

    from bridge.recording.mcap_records import decompressed

    bomb = zstandard.ZstdCompressor().compress(bytes(100 << 20))
    for size in (1000, 1 << 40):
        with pytest.raises(ValueError, match=r"size|bytes"):
            decompressed(bomb, "zstd", size)
    import lz4.frame

    with pytest.raises(ValueError, match="bytes"):
        decompressed(lz4.frame.compress(bytes(100 << 20)), "lz4", 1000)


# -- killed, damaged, full -------------------------------------------------------------------------------------------


def test_a_file_that_is_cut_anywhere_is_mended(tmp_path: Path) -> None:
    """All messages before the cut are there, those of the chunk that was cut as far as they go."""
    whole = write(tmp_path / "a.mcap", 2000, compression="none", chunk_bytes=20_000).read_bytes()
    with Bag(tmp_path / "a.mcap") as bag:
        ends = [chunk.offset + chunk.length for chunk in bag.chunks]
        counts = [len(texts(bag, end_ns=chunk.end_ns + 1)) for chunk in bag.chunks]
    path, out = tmp_path / "b.mcap", tmp_path / "c.mcap"
    for at in [*ends, *(end - 5000 for end in ends), *(end + 3 for end in ends), len(whole) - 40]:
        path.write_bytes(whole[:at])
        with pytest.raises(Unfinished, match="macs bag repair"):
            Bag(path)
        done = repairing.repair(path, out)
        least = max((count for end, count in zip(ends, counts, strict=True) if end <= at), default=0)
        assert done.messages >= least
        assert repairing.problems(out) == []
        with Bag(out) as bag:
            assert texts(bag) == [cdr(f"message {number}") for number in range(done.messages)]
        out.unlink()


@pytest.mark.parametrize("compression", ["zstd", "lz4"])
def test_a_compressed_chunk_that_is_cut_is_kept_as_far_as_it_goes(tmp_path: Path, compression: str) -> None:
    """What can be decompressed of the last chunk is in the mended file."""
    file = McapFile(tmp_path / "a.mcap", compression=compression, chunk_bytes=4 << 20)
    channel = file.channel("/a", "json", 0, {})
    for number in range(300):
        file.add(channel, number, BEGIN + number, 0, os.urandom(2000))
    file.close()
    with Bag(tmp_path / "a.mcap") as bag:
        (chunk,) = bag.chunks
    (tmp_path / "b.mcap").write_bytes((tmp_path / "a.mcap").read_bytes()[: chunk.offset + chunk.length * 3 // 4])
    done = repairing.repair(tmp_path / "b.mcap", tmp_path / "c.mcap")
    assert 100 < done.messages < 300
    assert done.damaged == 1
    assert repairing.problems(tmp_path / "c.mcap") == []


def test_a_damaged_chunk_costs_itself(tmp_path: Path) -> None:
    """What follows a chunk with a wrong checksum is kept, and it is told which one it was."""
    path = write(tmp_path / "a.mcap", 2000, compression="none", chunk_bytes=20_000)
    with Bag(path) as bag:
        chunk = bag.chunks[1]
    data = bytearray(path.read_bytes())
    data[chunk.offset + chunk.length // 2] ^= 1
    path.write_bytes(data)
    assert any("checksum" in problem for problem in repairing.problems(path))
    with Bag(path) as bag, pytest.raises(BadBag, match="macs bag repair"):
        texts(bag)
    done = repairing.repair(path, tmp_path / "b.mcap")
    assert done.damaged == 1
    assert 1800 < done.messages <= 2000  # of that chunk as far as its messages' sizes are right
    assert repairing.problems(tmp_path / "b.mcap") == []


KILLED = """
import sys, time
from pathlib import Path
from bridge.recording.disk import Disk, Entry, Plan, now_ns
from bridge.recording.streams import Channel
disk = Disk(Plan(Path(sys.argv[1])))
disk.start()
channel = Channel("/a", "json")
while True:
    data = b'{"at": %d}' % time.time_ns()
    disk.put(Entry(channel, channel.next(len(data)), now_ns(), data))
    print(channel.count, flush=True)
    time.sleep(0.001)
"""


def test_a_killed_program_loses_less_than_a_second(tmp_path: Path) -> None:
    """kill -9 in the middle of writing: all but the last second is there after repair."""
    path = tmp_path / "a.mcap"
    process = subprocess.Popen(
        [sys.executable, "-c", KILLED, str(path)], cwd=ROOT, stdout=subprocess.PIPE, text=True, bufsize=1
    )
    assert process.stdout is not None
    seen = [int(process.stdout.readline()) for _ in range(2000)]
    killed_ns = time.time_ns()
    process.kill()
    process.wait()
    done = repairing.repair(path, tmp_path / "b.mcap")
    with Bag(tmp_path / "b.mcap") as bag:
        times = [message.log_ns for message in bag.messages()]
    assert done.messages == len(times) > 0
    assert seen[-1] >= 2000
    assert killed_ns - times[-1] < S
    assert repairing.problems(tmp_path / "b.mcap") == []


FULL = """
import sys, time, os
from pathlib import Path
from bridge.recording.disk import Disk, Entry, Plan, now_ns
from bridge.recording.streams import Channel
reasons = []
disk = Disk(Plan(Path(sys.argv[1]), compression="none"), reasons.append)
disk.start()
channel = Channel("/a", "json")
while not disk.has_ended:
    for _ in range(20):
        disk.put(Entry(channel, channel.next(1000), now_ns(), os.urandom(1000)))
    time.sleep(0.001)
disk.stop()
print(len(reasons), reasons[0])
print(channel.count, disk.messages, sum(disk.lost.values()))
"""


def test_a_full_disk_ends_a_recording_that_stays_readable(tmp_path: Path) -> None:
    """The reason is told once, each message is in the file or counted, there as well, and the file is whole."""
    path = tmp_path / "a.mcap"

    def limited() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (10_000_000, 10_000_000))  # writing more is an error, as when full

    done = subprocess.run(
        [sys.executable, "-c", FULL, str(path)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        preexec_fn=limited,
        check=True,
        timeout=60,
    )
    reason, numbers = done.stdout.splitlines()
    assert reason.startswith("1 the disk takes no more: ")
    put, written, lost = map(int, numbers.split())
    assert put == written + lost
    assert lost > 0
    assert path.stat().st_size <= 10_000_000
    assert repairing.problems(path) == []
    with Bag(path) as bag:
        assert bag.messages_in_all in (written, written + bag.counts.get(_id(bag, "/macs/lost"), 0))
        told = dict(bag.metadata())["macs.lost"]
        assert 0 < int(told["disk_full"]) <= lost


def _id(bag: Bag, topic: str) -> int:
    return next((channel.id for channel in bag.channels.values() if channel.topic == topic), -1)


def test_a_message_that_is_too_short_is_told(tmp_path: Path) -> None:
    """Its record has a time and no more: reading and playing end with an error, not as if that were all."""
    path = write(tmp_path / "a.mcap", 10, compression="none")
    whole = path.read_bytes()
    text = cdr("message 4")
    at = whole.index(text) - 22  # channel, number and two times are before it
    (length,) = struct.unpack_from("<Q", whole, at - 8)
    left = length - 14 - 9
    short = struct.pack("<Q", 14) + whole[at : at + 14] + struct.pack("<BQ", 0x80, left) + bytes(left)
    damaged = bytearray(whole[: at - 8] + short + whole[at + length :])
    with Bag(path) as bag:
        checksum = bag.chunks[0].offset + 9 + 3 * 8
    damaged[checksum : checksum + 4] = bytes(4)  # none
    path.write_bytes(damaged)
    with Bag(path) as bag, pytest.raises(BadBag, match="cut off"):
        list(bag.messages())
    timeline = Timeline(path, lambda channel: True)
    timeline.start()
    with pytest.raises(BadBag, match="cut off"):
        list(timeline)
    timeline.close()


@needs_lichtblick
@pytest.mark.parametrize("compression", COMPRESSIONS)
def test_lichtblick_opens_it(tmp_path: Path, compression: str) -> None:
    """By its index, each message decoded by its schema, however it is compressed; also what was repaired."""
    found = lichtblick(write(tmp_path / "a.mcap", 1000, compression=compression))
    assert found["profile"] == "ros2"
    assert found["statistics"]["messageCount"] == 1000
    channel = found["channels"]["/7/chatter"]
    assert (channel["type"], channel["count"]) == ("std_msgs/msg/String", 1000)
    assert (channel["first"], channel["last"]) == ({"data": "message 0"}, {"data": "message 999"})
    cut = tmp_path / "cut.mcap"
    file = McapFile(cut, compression=compression)
    fill(file, string_channel(), 1000)
    file.flush()
    file.abandon()
    repairing.repair(cut, tmp_path / "whole.mcap")
    assert lichtblick(tmp_path / "whole.mcap")["channels"]["/7/chatter"]["count"] == 1000
