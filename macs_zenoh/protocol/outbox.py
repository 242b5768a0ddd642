"""What waits for one slow TCP agent: bounded, calls before topic data, every drop named. Pure."""

from __future__ import annotations

from collections import Counter, OrderedDict, deque

Chunk = bytes | bytearray | memoryview

NONE: deque[Chunk] = deque(maxlen=0)
"""No messages, for all who never had one that waited: an empty queue of one's own takes 600 bytes."""


class Outbox:
    """Messages that wait until their agent reads again.

    Calls, management and messages between agents are kept in order and go first. Topic data is kept per node: the
    last ``depth`` messages, or the first with ``drop_new``, nodes taking turns. ``limit_bytes`` bounds all of it:
    topic data gives way to anything, calls to nothing. One message may always wait, however large, and
    beside a call that is larger than the limit others have as much as without it: what is small is not lost for it.

    ``drops`` counts ``node_full_oldest``, ``node_full_newest`` and ``outbox_full``.
    """

    def __init__(self, limit_bytes: int) -> None:
        self.limit_bytes = limit_bytes
        self.bytes = 0
        self.drops: Counter[str] = Counter()
        self.calls_taken = 0
        """How many of what `take` gave last are calls: those come first."""
        self._calls = NONE
        self._call_bytes = 0
        self._large = 0
        """Size of a waiting call that is larger than the limit."""
        self._streams: OrderedDict[str, deque[Chunk]] = OrderedDict()
        self._stream_bytes: dict[str, int] = {}
        """Of each node that something waits of."""

    def __len__(self) -> int:
        return len(self._calls) + sum(map(len, self._streams.values()))

    def __bool__(self) -> bool:
        return bool(self._calls or self._streams)

    def put_call(self, message: Chunk, beyond_bytes: int = 0) -> bool:
        """Keep a message in order. False when the limit is reached even without any topic data: this message is
        dropped and counted, and those that wait stay. So many bytes ``beyond`` the limit may wait as well: of senders
        that are slowing down."""
        self._make_room(len(message))
        if self._over(len(message) - beyond_bytes):
            self.drops["outbox_full"] += 1
            return False
        if self._calls is NONE:
            self._calls = deque()
        self._calls.append(message)
        self._call_bytes += len(message)
        if len(message) > self.limit_bytes:
            self._large = len(message)
        self.bytes += len(message)
        return True

    def put_stream(self, node: str, message: Chunk, *, depth: int, drop_new: bool) -> None:
        """Keep topic data of one node, as its registration says."""
        depth = max(1, depth)
        if drop_new and len(self._streams.get(node, ())) >= depth:
            self.drops["node_full_newest"] += 1
            return
        if self._over(len(message)) and (drop_new or not self._fits_beside_calls(len(message))):
            self.drops["outbox_full"] += 1
            return
        waiting = self._streams.setdefault(node, deque())
        while len(waiting) >= depth:
            self._drop_oldest(node, "node_full_oldest", keep=node)
        self._make_room(len(message), keep=node)
        waiting.append(message)
        self._stream_bytes[node] = self._stream_bytes.get(node, 0) + len(message)
        self.bytes += len(message)

    def take(self, limit_bytes: int) -> list[Chunk]:
        """The next messages to send, in order, up to about ``limit_bytes`` (at least one, if any)."""
        taken: list[Chunk] = []
        size = self.calls_taken = 0
        while self and size < limit_bytes:
            self.calls_taken += bool(self._calls)
            chunk = self._next_call() if self._calls else self._next_stream()
            taken.append(chunk)
            size += len(chunk)
        self.bytes -= size
        return taken

    def _next_call(self) -> Chunk:
        chunk = self._calls.popleft()
        self._call_bytes -= len(chunk)
        if len(chunk) > self.limit_bytes:
            self._large = 0
        return chunk

    def _next_stream(self) -> Chunk:
        node, waiting = next(iter(self._streams.items()))
        chunk = waiting.popleft()
        del self._streams[node]
        self._count_out(node, chunk)
        if waiting:
            self._streams[node] = waiting  # to the back: nodes take turns
        return chunk

    def _count_out(self, node: str, chunk: Chunk) -> None:
        left = self._stream_bytes[node] - len(chunk)
        if left:
            self._stream_bytes[node] = left
        else:
            del self._stream_bytes[node]

    def _over(self, size: int) -> bool:
        return self.bytes > 0 and (
            self.bytes - self._large + size > self.limit_bytes or (self._large > 0 and size > self.limit_bytes)
        )

    def _fits_beside_calls(self, size: int) -> bool:
        return not self._calls or self._call_bytes - self._large + size <= self.limit_bytes

    def _make_room(self, size: int, keep: str | None = None) -> None:
        """Let the node with the most bytes give up its oldest message until the new one fits."""
        while self._streams and self._over(size):
            heaviest = max(self._streams, key=lambda node: self._stream_bytes.get(node, 0))
            self._drop_oldest(heaviest, "outbox_full", keep)

    def _drop_oldest(self, node: str, name: str, keep: str | None = None) -> None:
        """Drop a node's oldest message, and the node with its last one. ``keep`` is the node whose next message is
        about to be put: it keeps its turn."""
        waiting = self._streams[node]
        dropped = waiting.popleft()
        self.bytes -= len(dropped)
        self._count_out(node, dropped)
        if not waiting and node != keep:
            del self._streams[node]
        self.drops[name] += 1
