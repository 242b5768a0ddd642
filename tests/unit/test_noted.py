"""What a robot remembers for a moment of those who have left."""

from __future__ import annotations

from collections.abc import Iterator

from bridge.ros.nodes import GONE_S, _note


class Looked(dict[int, float]):
    """Counts how often somebody looks through it."""

    looks = 0

    def __iter__(self) -> Iterator[int]:
        self.looks += 1
        return super().__iter__()


def test_noting_costs_the_same_however_many_there_are() -> None:
    """Each is forgotten when its time is over, once, and what is noted again counts from then on."""
    table = Looked()
    for number in range(5000):
        _note(table, number, number * GONE_S / 1024)
        assert len(table) <= 1024
    assert table.looks <= 2 * 5000
    _note(table, 4500, 5000 * GONE_S / 1024)
    _note(table, 1, 5999 * GONE_S / 1024)
    assert list(table) == [*range(4976, 5000), 4500, 1]
