"""A disk that is really full: the recording ends and says so, the file is whole, and the mesh goes on."""

from __future__ import annotations

import asyncio
import os
import subprocess
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

pytest.importorskip("mcap", reason="needs the extra record: pip install 'macs-zenoh[record]'")

import macs_zenoh
from bridge.recording.bag import Bag
from bridge.recording.repair import problems
from bridge.recording.streams import MESSAGES
from tests.support.programs import Program
from tests.support.routers import Router
from tests.support.waiting import until

SIZE = 4 << 20


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 4 MiB of its own."""
    place = tmp_path / "disk"
    place.mkdir()
    words = ["mount", "-t", "tmpfs", "-o", f"size={SIZE}", "none", str(place)]
    try:
        subprocess.run(words, check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("nothing may be mounted here")
    try:
        yield place
    finally:
        with suppress(OSError, subprocess.CalledProcessError):
            subprocess.run(["umount", "-l", str(place)], check=True, capture_output=True)


async def test_a_full_disk(small_disk: Path) -> None:
    """Agents send each other more than the disk takes: none of it is lost between them."""
    file = small_disk / "a.mcap"
    async with (
        Router() as router,
        macs_zenoh.join("unity", connect=[router.endpoint]) as sender,
        macs_zenoh.join("unity", connect=[router.endpoint]) as receiver,
        Program("record", "--headsets", "--compress", "none", "-o", str(file), "-e", router.endpoint) as recording,
    ):
        await until(lambda: receiver.key in sender.directory)
        sent, ended = 0, asyncio.create_task(recording.wait())
        while not ended.done():
            data = os.urandom(16 << 10)
            sender.send(data, to="unity", ids=[receiver.id])
            assert (await asyncio.wait_for(receiver.receive(), 60)).data == data
            sent += 1
        assert await ended == 1
        said = recording.said
    assert sent * (16 << 10) > SIZE / 2
    assert "No space left on device" in said[-1]
    assert problems(file) == []
    with Bag(file) as bag:
        (messages,) = (channel for channel in bag.channels.values() if channel.topic == MESSAGES)
        lost = dict(bag.metadata())["macs.lost"]
        assert bag.counts[messages.id] > 0
        assert int(lost["disk_full"]) > 0
