"""What waits for a slow agent is bounded, calls come first and in order, and every message is accounted for."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import pytest
from hypothesis import given
from hypothesis import strategies as st

from macs_zenoh.protocol.outbox import Chunk, Outbox

LIMIT = 100
NODES = {"camera": (3, False), "pose": (1, False), "log": (2, True), "odd": (0, False)}
"""Depth and drop_new of the nodes in the tests below; a depth of 0 keeps one message."""


class Waiting(NamedTuple):
    """A message: its content tells its class and its number."""

    node: str | None
    number: int

    @staticmethod
    def of(chunk: Chunk) -> Waiting:
        """Read a message that `message` made."""
        name, number = bytes(chunk).split(b".")[:2]
        return Waiting(name.decode() or None, int(number))


def message(node: str | None, number: int, size: int) -> bytes:
    """A message of about ``size`` bytes that can be recognised."""
    return b"%s.%d." % ((node or "").encode(), number) + bytes(size)


steps = st.lists(
    st.tuples(st.just("call"), st.integers(0, 60))
    | st.tuples(st.sampled_from(sorted(NODES)), st.integers(0, 60) | st.integers(90, 130))
    | st.tuples(st.just("take"), st.integers(1, 150)),
    max_size=40,
)


class Story:
    """An outbox and what was done with it, step by step."""

    def __init__(self, limit: int = LIMIT) -> None:
        self.outbox = Outbox(limit)
        self.put: list[Waiting] = []
        self.refused: list[Waiting] = []
        self.taken: list[Waiting] = []

    def happen(self, what: str, size: int) -> list[Chunk]:
        """One message is put, or some are taken; returns those taken."""
        if what == "take":
            chunks = self.outbox.take(size)
            self.taken += map(Waiting.of, chunks)
            return chunks
        waiting = Waiting(None if what == "call" else what, len(self.put))
        chunk = message(*waiting, size)
        self.put.append(waiting)
        if waiting.node is not None:
            depth, drop_new = NODES[what]
            self.outbox.put_stream(what, chunk, depth=depth, drop_new=drop_new)
        elif not self.outbox.put_call(chunk):
            self.refused.append(waiting)
        return []

    def take_all(self) -> list[Waiting]:
        """Empty the outbox."""
        before = len(self.taken)
        while self.outbox:
            self.happen("take", 1)
        return self.taken[before:]


@given(steps)
def test_the_limit_holds(story_steps: list[tuple[str, int]]) -> None:
    """Waiting bytes are never above the limit, but for one message that waits alone or is a call above it; `bytes` is
    what really waits."""
    story = Story()
    for what, size in story_steps:
        story.happen(what, size)
        large = [len(chunk) for chunk in story.outbox._calls if len(chunk) > LIMIT]
        assert story.outbox.bytes - sum(large) <= LIMIT or len(story.outbox) == 1
        assert len(large) <= 1
        streams = story.outbox._streams
        assert story.outbox._stream_bytes == {node: sum(map(len, each)) for node, each in streams.items() if each}
        assert bool(story.outbox) == (len(story.outbox) > 0)
    waiting, counted = story.outbox.bytes, len(story.outbox)
    chunks = story.outbox.take(1 << 30)
    assert (sum(map(len, chunks)), len(chunks)) == (waiting, counted)
    assert (story.outbox.bytes, len(story.outbox)) == (0, 0)


@given(steps)
def test_every_message_is_taken_or_counted(story_steps: list[tuple[str, int]]) -> None:
    """Each message put is taken once, or its loss is counted under a name."""
    story = Story()
    for step in story_steps:
        story.happen(*step)
    story.take_all()
    assert len(set(story.taken)) == len(story.taken)
    assert set(story.taken) <= set(story.put)
    assert len(story.put) - len(story.taken) == story.outbox.drops.total()
    assert set(story.outbox.drops) <= {"node_full_oldest", "node_full_newest", "outbox_full"}


@given(steps)
def test_calls_are_all_taken_in_order_and_first(story_steps: list[tuple[str, int]]) -> None:
    """Calls that were accepted come out in order, none is missing, and no topic data comes out while one waits."""
    story = Story()
    for step in story_steps:
        accepted = [waiting for waiting in story.put if waiting.node is None and waiting not in story.refused]
        pending = len(accepted) - sum(waiting.node is None for waiting in story.taken)
        kinds = [Waiting.of(chunk).node is None for chunk in story.happen(*step)]
        assert kinds == sorted(kinds, reverse=True)
        assert all(kinds) or sum(kinds) == pending
    story.take_all()
    calls = [waiting for waiting in story.put if waiting.node is None]
    assert [waiting for waiting in story.taken if waiting.node is None] == [
        call for call in calls if call not in story.refused
    ]


@given(steps)
def test_a_node_keeps_its_order_and_its_depth(story_steps: list[tuple[str, int]]) -> None:
    """Topic data of each node comes out in order, and never more of it waits than the node's depth."""
    story = Story()
    for step in story_steps:
        story.happen(*step)
    rest = story.take_all()
    for node, (depth, _) in NODES.items():
        numbers = [waiting.number for waiting in story.taken if waiting.node == node]
        assert numbers == sorted(numbers)
        assert sum(waiting.node == node for waiting in rest) <= max(1, depth)


@given(st.lists(st.sampled_from(sorted(NODES)) | st.just("take"), max_size=60))
def test_a_node_keeps_the_newest_or_the_oldest(story_steps: list[str]) -> None:
    """While bytes are plenty, a node keeps its last messages, or with drop_new its first, and nothing else is lost."""
    story = Story(1 << 20)
    expected: dict[str, deque[int]] = {node: deque() for node in NODES}
    for step in story_steps:
        if step == "take":
            for chunk in story.happen("take", 1):
                node, number = Waiting.of(chunk)
                assert expected[node or ""].popleft() == number
            continue
        story.happen(step, 1)
        kept, (depth, drop_new) = expected[step], NODES[step]
        if len(kept) < max(1, depth):
            kept.append(story.put[-1].number)
        elif not drop_new:
            kept.popleft()
            kept.append(story.put[-1].number)
    for waiting in story.take_all():
        assert expected[waiting.node or ""].popleft() == waiting.number
    assert not any(expected.values())
    assert "outbox_full" not in story.outbox.drops


@given(steps, st.integers(1, 300))
def test_taking_gives_about_what_was_asked(story_steps: list[tuple[str, int]], limit: int) -> None:
    """`take` gives something whenever something waits, stops at the message that reaches the limit, and stops no
    sooner."""
    story = Story()
    for step in story_steps:
        story.happen(*step)
    waiting = story.outbox.bytes
    sizes = [len(chunk) for chunk in story.outbox.take(limit)]
    assert sum(sizes[:-1]) < limit
    assert sum(sizes) >= min(limit, waiting)


# -- examples --------------------------------------------------------------------------------------------------------


def test_nodes_take_turns() -> None:
    """A node with much waiting does not keep another one from its turn."""
    outbox = Outbox(1000)
    for node, count in (("a", 3), ("b", 1), ("c", 2)):
        for number in range(count):
            outbox.put_stream(node, message(node, number, 0), depth=9, drop_new=False)
    assert [Waiting.of(chunk) for chunk in outbox.take(1000)] == [
        ("a", 0),
        ("b", 0),
        ("c", 0),
        ("a", 1),
        ("c", 1),
        ("a", 2),
    ]


def test_a_node_of_depth_1_gets_its_turn() -> None:
    """A node whose only message is replaced before it could be sent keeps its place: fresh poses arrive although a
    camera always has something waiting."""
    outbox = Outbox(1000)
    taken = []
    outbox.put_stream("camera", b"camera", depth=5, drop_new=False)
    for _ in range(10):
        outbox.put_stream("pose", b"pose", depth=1, drop_new=False)
        outbox.put_stream("camera", b"camera", depth=5, drop_new=False)
        taken += outbox.take(1)
    assert taken.count(b"pose") >= 4


def test_a_smaller_depth_counts_at_once() -> None:
    """When a headset registers again with a smaller buffer, no more than that waits after the next message."""
    outbox = Outbox(1000)
    for number in range(5):
        outbox.put_stream("a", message("a", number, 0), depth=5, drop_new=False)
    outbox.put_stream("a", message("a", 5, 0), depth=2, drop_new=False)
    assert [Waiting.of(chunk).number for chunk in outbox.take(1000)] == [4, 5]


@pytest.mark.parametrize("node", ["a", "b"])
def test_topic_data_that_cannot_fit_costs_no_other(node: str) -> None:
    """A topic message that does not fit beside the waiting calls is dropped alone; what waits stays."""
    outbox = Outbox(100)
    outbox.put_call(bytes(60))
    outbox.put_stream("a", bytes(30), depth=1, drop_new=False)
    outbox.put_stream(node, bytes(50), depth=1, drop_new=False)
    assert [len(chunk) for chunk in outbox.take(1000)] == [60, 30]
    assert outbox.drops == {"outbox_full": 1}


def test_topic_data_gives_way_to_calls() -> None:
    """A call makes room for itself among the topic data, from the node with the most bytes, oldest first."""
    outbox = Outbox(100)
    for node, size in (("a", 20), ("b", 30), ("b", 31)):
        outbox.put_stream(node, bytes(size), depth=5, drop_new=False)
    assert outbox.put_call(bytes(40))
    assert [len(chunk) for chunk in outbox.take(1000)] == [40, 20, 31]
    assert outbox.drops == {"outbox_full": 1}


def test_calls_give_way_to_nothing() -> None:
    """A call above the limit is refused and counted; those that wait stay, and there is room again once they went."""
    outbox = Outbox(100)
    assert outbox.put_call(bytes(60))
    assert not outbox.put_call(bytes(41))
    assert outbox.put_call(bytes(40))
    assert outbox.drops == {"outbox_full": 1}
    assert [len(chunk) for chunk in outbox.take(1000)] == [60, 40]
    assert outbox.put_call(bytes(41))


class Measured(bytes):
    """A message that counts how often its size is asked for."""

    asked = 0

    def __len__(self) -> int:
        Measured.asked += 1
        return super().__len__()


@pytest.mark.parametrize("waiting", [100, 1600])
def test_a_drop_costs_no_more_when_more_waits(waiting: int) -> None:
    """What a full outbox does for a message does not grow with what waits in it."""
    outbox = Outbox(100 * waiting)
    for _ in range(waiting):
        outbox.put_stream("camera", Measured(100), depth=1 << 20, drop_new=False)
    Measured.asked = 0
    for _ in range(10):
        outbox.put_stream("camera", Measured(100), depth=1 << 20, drop_new=False)
    assert outbox.drops == {"outbox_full": 10}
    assert Measured.asked <= 10 * 12


@pytest.mark.parametrize("kind", ["call", "stream"])
def test_one_message_may_always_wait(kind: str) -> None:
    """A single message above the limit waits when nothing else does: a 20 MiB camera frame arrives after all."""
    outbox = Outbox(100)
    if kind == "call":
        assert outbox.put_call(bytes(500))
    else:
        outbox.put_stream("a", bytes(500), depth=1, drop_new=True)
    assert outbox.bytes == 500
    assert not outbox.drops
    assert [len(chunk) for chunk in outbox.take(1)] == [500]


def test_beside_a_large_call_there_is_room_for_others() -> None:
    """While a message above the limit waits, small ones wait behind it; a second one like it is refused."""
    outbox = Outbox(100)
    assert outbox.put_call(bytes(500))
    assert outbox.put_call(bytes(60))
    assert not outbox.put_call(bytes(300))
    outbox.put_stream("a", bytes(40), depth=1, drop_new=False)
    assert not outbox.put_call(bytes(101))
    assert outbox.put_call(bytes(39))
    assert [len(chunk) for chunk in outbox.take(1000)] == [500, 60, 39]
    assert outbox.put_call(bytes(500))


def test_messages_are_not_copied() -> None:
    """A view into a frame waits as it is and comes out as it is."""
    outbox = Outbox(100)
    view = memoryview(b"0123456789")[2:]
    outbox.put_call(view)
    outbox.put_stream("a", view, depth=1, drop_new=False)
    first, second = outbox.take(1000)
    assert first is view
    assert second is view
