"""The last minute, in memory, until somebody asks for it or something happens."""

from __future__ import annotations

from collections import Counter, deque

from bridge.recording.disk import KEPT, Disk, Entry


class Ring:
    """Keeps messages of so many seconds and of at most so many bytes; of each name that is to be kept the newest.

    What has no room is no loss as long as it is older than the ring is long; ``lost`` counts what had to go earlier.
    """

    def __init__(self, seconds: float, max_bytes: int) -> None:
        self.lost: Counter[str] = Counter()
        self._keeps_ns = int(seconds * 1e9)
        self._max_bytes = max_bytes
        self._entries: deque[Entry] = deque()
        self._bytes = 0
        self._kept: dict[str, Entry] = {}
        self._fed: list[Disk] = []

    def __len__(self) -> int:
        return len(self._entries)

    @property
    def bytes(self) -> int:
        """How much it holds."""
        return self._bytes

    def put(self, entry: Entry) -> None:
        """Keep a message, and let files that are being written have it."""
        self._entries.append(entry)
        self._bytes += len(entry.data)
        oldest = entry.log_ns - self._keeps_ns
        while self._entries and (self._entries[0].log_ns < oldest or self._bytes > self._max_bytes):
            gone = self._entries.popleft()
            self._bytes -= len(gone.data)
            if gone.log_ns >= oldest:
                self.lost["ring_full"] += 1
            if gone.keep and (gone.keep in self._kept or len(self._kept) < KEPT):
                self._kept[gone.keep] = gone
        for disk in self._fed:
            disk.put(entry)

    def write(self, disk: Disk) -> int:
        """Give a file what is here, and from now on what comes, until `release`. How many messages it got."""
        start = self._entries[0].log_ns if self._entries else 0
        newer = {entry.keep for entry in self._entries if entry.keep}
        before = [
            entry._replace(log_ns=start or entry.log_ns, publish_ns=entry.log_ns)
            for name, entry in self._kept.items()
            if name not in newer
        ]
        for entry in [*before, *self._entries]:
            disk.put(entry, must=True)
        disk.lost += self.lost
        self._fed.append(disk)
        return len(before) + len(self._entries)

    def release(self, disk: Disk) -> None:
        """Let a file have no more."""
        if disk in self._fed:
            self._fed.remove(disk)
