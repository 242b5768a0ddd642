"""How much of a robot's topic has come to a gateway, beside how much the robot has put."""

from __future__ import annotations

import logging
from collections import Counter

from bridge.gateway.on_the_way import BEFORE, OnTheWay, Stream
from macs_zenoh.losses import Losses
from macs_zenoh.protocol.came import Came
from macs_zenoh.protocol.messages import encode_data
from macs_zenoh.protocol.robot_state import StreamCount


def test_what_has_not_come_is_lost() -> None:
    """Once, when it is told, however much was put before anybody listened."""
    came = Came()
    came.samples = 3
    assert came.count(StreamCount(1, 103)) == 0
    came.samples = 8
    assert came.count(StreamCount(1, 112)) == 4
    assert came.count(StreamCount(1, 112)) == 0
    came.samples = 10
    assert came.count(StreamCount(1, 115)) == 1
    assert came.lost == 5


def test_a_robot_that_was_started_again_has_lost_nothing_by_that() -> None:
    """It counts from none."""
    came = Came()
    for samples, told in ((90, (1, 100)), (95, (1, 105)), (97, (2, 2)), (99, (2, 4))):
        came.samples = samples
        assert came.count(StreamCount(*told)) == 0
    came.samples = 100
    assert came.count(StreamCount(2, 8)) == 3


def test_what_is_counted_by_another_name_is_not_counted_twice() -> None:
    """A session that is behind says so itself; a count is no message, and the first loss of a topic is logged."""
    drops, session = Losses(logging.getLogger("macs.gateway")), Counter(topics_behind=2)
    on_the_way = OnTheWay(drops, session)
    stream = Stream.of((1, 7), "nd__pose", set(), None)

    def told(samples: int, put: int) -> None:
        stream.came.samples += samples + 1
        on_the_way.told("key", stream, encode_data(StreamCount(1, put)))

    told(1, 1)
    told(2, 5)
    assert not drops
    told(1, 9)
    assert drops == {BEFORE: 3}
    assert stream.came.samples == 4
    assert Stream.of((1, 7), "nd__pose", {(2, 5)}, stream).came is stream.came
