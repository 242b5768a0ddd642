"""A folder of recordings has a size: what is written in it ends there, and nothing more begins."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

pytest.importorskip("mcap", reason="needs the extra record: pip install 'macs-zenoh[record]'")

from bridge.recording.bag import Bag
from bridge.recording.disk import Disk, Entry, Plan
from bridge.recording.room import FULL, taken
from macs_zenoh.errors import ConfigError
from tests.support.bags import BEGIN, string_channel
from tests.support.waiting import until

MIB = 1 << 20


def put(disk: Disk, mib: int) -> None:
    channel = string_channel()
    for _ in range(4 * mib):
        disk.put(Entry(channel, channel.next(MIB // 4), BEGIN, os.urandom(MIB // 4)))


def test_a_file_ends_where_its_folder_is_full(tmp_path: Path) -> None:
    """With 3 MiB of others there and 8 allowed it gets 5: the file is whole, and says what it lost."""
    (tmp_path / "other.mcap").write_bytes(bytes(3 * MIB))
    (tmp_path / "other.txt").write_bytes(bytes(8 * MIB))
    (tmp_path / "link.mcap").symlink_to(tmp_path / "other.txt")
    reasons: list[str] = []
    disk = Disk(Plan(tmp_path / "a.mcap", "none", folder_bytes=8 * MIB), reasons.append)
    disk.start()
    put(disk, 12)
    disk.stop()
    assert reasons == [FULL]
    assert 8 * MIB <= taken(tmp_path) < 9 * MIB
    with Bag(tmp_path / "a.mcap") as bag:
        assert bag.messages_in_all == disk.messages
    assert disk.lost["after_end"] == 4 * 12 - disk.messages
    with pytest.raises(ConfigError, match="folder_bytes"):
        Disk(Plan(tmp_path / "b.mcap", folder_bytes=8 * MIB)).start()
    assert not (tmp_path / "b.mcap").exists()


async def test_two_files_share_a_folder(tmp_path: Path) -> None:
    """What one has written the other may not have, also when that began first."""
    reasons: list[str] = []
    plans = [Plan(tmp_path / f"{name}.mcap", "none", folder_bytes=8 * MIB) for name in "ab"]
    first, second = (Disk(plan, reasons.append) for plan in plans)
    first.start()
    second.start()
    put(second, 6)
    await until(lambda: taken(tmp_path) >= 5 * MIB)

    def is_full() -> bool:
        if first.waiting_bytes < MIB:
            put(first, 1)
        return first.has_ended

    await until(is_full, every_s=0.2)
    first.stop()
    second.stop()
    assert FULL in reasons
    assert taken(tmp_path) < 11 * MIB
