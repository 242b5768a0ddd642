"""Recordings of 10 GB: their index is read and a few chunks are in memory. The files of the tests have holes."""

from __future__ import annotations

import struct
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("mcap", reason="needs the extra record: pip install 'macs-zenoh[record]'")

from mcap.records import ChunkIndex

from bridge.recording.bag import Bag
from bridge.recording.mcap_file import McapFile
from bridge.recording.serving.folder import Folder
from tests.support.bags import BEGIN
from tests.support.programs import ROOT

SIZE = 10 << 30
PICTURE = 2 << 20
TOPICS = 30

MEASURED = """
import re, sys
{what}
# not getrusage: what it tells begins with the memory of who started the program
print(int(re.search(r"VmHWM:\\s+(\\d+) kB", open("/proc/self/status").read())[1]) // 1024, file=sys.stderr)
"""
INFO = "from bridge.cli import main; main(['bag', 'info', '--json', {path!r}])"
PLAYED = """
from bridge.replay.timeline import Timeline
from pathlib import Path
timeline = Timeline(Path({path!r}), lambda channel: True)
timeline.start()
seen = 0
for due in timeline:
    seen += len(due.message.data)
    if seen > 1 << 30:
        break
timeline.close()
"""


@pytest.fixture(scope="module")
def large(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One picture of 2 MiB, empty, in each chunk, on one of 30 topics."""
    path = tmp_path_factory.mktemp("large") / "large.mcap"
    file = McapFile(path)
    schema = file.schema("std_msgs/msg/UInt8MultiArray", "ros2msg", b"uint8[] data\n")
    for number in range(TOPICS):
        file.channel(f"/{number + 1}/camera", "cdr", schema, {})
    at = path.stat().st_size
    size = PICTURE + 31
    with path.open("r+b") as raw:
        while at < SIZE:
            number = len(file.index.chunks)
            channel, time_ns = number % TOPICS + 1, BEGIN + number * 1_000_000
            raw.seek(at)
            raw.write(struct.pack("<BQQQQII", 6, 40 + size, time_ns, time_ns, size, 0, 0) + struct.pack("<Q", size))
            raw.write(struct.pack("<BQHIQQ", 5, size - 9, channel, number, time_ns, time_ns))
            index_at = at + 9 + 40 + size
            raw.seek(index_at)
            raw.write(struct.pack("<BQHIQQ", 7, 22, channel, 16, time_ns, 0))
            file.index.add_chunk(
                ChunkIndex(
                    chunk_length=9 + 40 + size,
                    chunk_start_offset=at,
                    compression="",
                    compressed_size=size,
                    message_end_time=time_ns,
                    message_index_length=31,
                    message_index_offsets={channel: index_at},
                    message_start_time=time_ns,
                    uncompressed_size=size,
                ),
                {channel: 1},
            )
            at = index_at + 31
        raw.seek(at)
        raw.write(file.index.end(at))
    file.abandon()
    return path


def megabytes(what: str, path: Path) -> tuple[str, int]:
    """What a program says, and how much memory it took."""
    done = subprocess.run(
        [sys.executable, "-c", MEASURED.format(what=what.format(path=str(path)))],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
        timeout=100,
    )
    return done.stdout, int(done.stderr.split()[-1])


def test_it_is_listed(large: Path) -> None:
    """All of its index, with little memory."""
    said, used = megabytes(INFO, large)
    assert f'"bytes": {large.stat().st_size}' in said
    assert '"messages": 5120' in said or '"messages": 51' in said
    assert used < 100


def test_of_ten_gigabytes_the_index_is_read(large: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """To list it, and to say what it has, a few hundred kilobytes are read, whatever its size: that takes no time."""
    really, read = Bag._read, []

    def counted(bag: Bag, at: int, size: int) -> bytes:
        read.append(size)
        return really(bag, at, size)

    monkeypatch.setattr(Bag, "_read", counted)
    (listed,) = Folder(large.parent).listed(())
    assert (listed["state"], listed["bytes"], listed["channels"]) == ("whole", large.stat().st_size, TOPICS)
    assert listed["messages"] > SIZE // (PICTURE + 1000)
    assert 0 < sum(read) < 1 << 20


def test_it_is_played(large: Path) -> None:
    """A gigabyte of it is read ahead of its time, a few chunks at a time."""
    _, used = megabytes(PLAYED, large)
    assert used < 100


def test_one_moment_of_it_is_found(large: Path) -> None:
    """Only the chunks of that time are read."""
    with Bag(large) as bag:
        found = list(bag.messages(start_ns=BEGIN + 4_000_000_000, end_ns=BEGIN + 4_003_000_000))
        assert [message.sequence for message in found] == [4000, 4001, 4002]
