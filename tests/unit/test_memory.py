"""What a program that serves does with its memory."""

from __future__ import annotations

import gc
import platform
import subprocess
import sys
import tracemalloc
from collections.abc import Iterator
from typing import Any

import pytest

from bridge.cli import running
from bridge.gateway.connection import Connection
from bridge.gateway.memory import Memory
from macs_zenoh.protocol.decoders import FrameDecoder
from macs_zenoh.protocol.tcp_agent import TcpAgent


@pytest.fixture
def thawed() -> Iterator[None]:
    """Nothing is frozen before, and afterwards what a test run has frozen is again."""
    gc.unfreeze()
    yield
    gc.freeze()


def test_who_is_ready_is_not_gone_through_again(thawed: None, capsys: pytest.CaptureFixture[str]) -> None:
    """What a program was built of when it says that it is ready costs the collector nothing from then on."""
    assert not gc.get_freeze_count()
    running.say_ready("somebody")
    assert gc.get_freeze_count() > 1000
    assert capsys.readouterr().out == "ready: somebody\n"


async def test_a_connection_that_only_looks_takes_little() -> None:
    """A connection for which nothing waits, and that has asked for nothing, has no queues of its own (12 KB with)."""
    memory, scratch = Memory(1 << 20, 1 << 20), bytearray(FrameDecoder.SPACE_BYTES)

    def connection(number: int) -> tuple[Connection, TcpAgent]:
        owner: Any = None
        bare = Connection(owner, memory=memory, outbox_bytes=1 << 20, write_timeout_s=1.0)
        return bare, TcpAgent(number, number, 0.0, scratch=scratch)

    first = [connection(number) for number in range(100)]
    tracemalloc.start()
    try:
        others = [connection(number) for number in range(1000, 1100)]
        each = tracemalloc.get_traced_memory()[0] / len(others)
    finally:
        tracemalloc.stop()
    assert len(first) == 100
    assert each < 9000


COPIES = """
import resource, threading, time
from bridge import memory
from macs_zenoh.mesh.copies import copied

SIZE = 24 << 20


class Payload:
    def __len__(self):
        return SIZE

    def to_bytes(self):
        before = faults()
        made = b"x" * SIZE
        self.faults = faults() - before
        return made


def faults():
    return resource.getrusage(resource.RUSAGE_THREAD).ru_minflt


def kept():
    return int(open("/proc/self/status").read().split("VmRSS:")[1].split()[0]) << 10


memory.give_back()
payload, before = Payload(), kept()
payload.to_bytes()
alone = payload.faults
each = []


def copy():
    for _ in range(3):
        assert len(copied(payload)) == SIZE
        each.append(payload.faults)
    done.set()
    ends.wait()


done, ends = threading.Event(), threading.Event()
threading.Thread(target=copy).start()  # it has a heap of its own, as threads of Zenoh's have
done.wait()
deadline = time.monotonic() + 20
while kept() - before > 4 << 20 and time.monotonic() < deadline:
    time.sleep(0.01)
print(alone, max(each), kept() - before)
ends.set()
"""


@pytest.mark.skipif(sys.platform != "linux" or platform.libc_ver()[0] != "glibc", reason="glibc's heap on Linux")
def test_who_copies_a_large_payload_waits_for_no_page() -> None:
    """The kernel has made the pages of a large copy before it begins, and what it took is given back."""
    printed = subprocess.run([sys.executable, "-c", COPIES], capture_output=True, text=True, check=True).stdout
    alone, most, kept = map(int, printed.split())
    assert alone > 5000  # so that there is something to spare
    assert most < 200
    assert kept <= 4 << 20


NO_THREAD = """
import threading
from bridge import memory
from macs_zenoh.mesh.copies import copied


class Payload(bytearray):
    def to_bytes(self):
        return bytes(self)


def none(thread):
    raise RuntimeError("can't start new thread")


def waiting():
    return [each.name for each in threading.enumerate()].count("macs-heap")


memory.give_back()
payload, start = Payload(20 << 20), threading.Thread.start
threading.Thread.start = none
print(len(copied(payload)), waiting())
threading.Thread.start = start
print(len(copied(payload)), waiting())
"""


def test_a_large_payload_comes_where_there_is_no_thread_to_be_had() -> None:
    """It is copied all the same, and what it took is given back behind a later one."""
    printed = subprocess.run([sys.executable, "-c", NO_THREAD], capture_output=True, text=True, check=True).stdout
    assert printed.splitlines()[0].split() == [str(20 << 20), "0"]
    assert printed.splitlines()[1].split()[0] == str(20 << 20)
    if platform.libc_ver()[0] == "glibc":
        assert printed.splitlines()[1].split()[1] == "1"
