"""JSON of others: how much of it is read at all, in which spelling, and what that may cost."""

from __future__ import annotations

import tracemalloc
from contextlib import suppress

import msgspec
import pytest

from macs_zenoh.errors import BadField, BadJson, TooLong, WireError
from macs_zenoh.protocol import json_fields, messages
from macs_zenoh.protocol.limits import (
    ANSWER_BYTES,
    CONFIGURATION_BYTES,
    JSON_FIELDS,
    MANAGEMENT_BYTES,
    METADATA_BYTES,
    NESTING,
    REQUEST_BYTES,
)
from macs_zenoh.protocol.messages import (
    AddNode,
    Configuration,
    Functionality,
    Heartbeat,
    Metadata,
    StreamData,
    decode_data,
    decode_management,
    encode_management,
)


class Point(msgspec.Struct, rename="camel"):
    """Something that is read."""

    from_left: int
    from_top: int = 0


@pytest.mark.parametrize("key", ["fromLeft", "FromLeft", "from_left"])
def test_keys_are_read_in_every_spelling(key: str) -> None:
    """A field is found however its key is spelled; keys that nobody knows are left out, wrong values told."""
    fields = json_fields.snake_object("a point", b'{"%s":3,"new":[]}' % key.encode())
    assert json_fields.converted("a point", fields, Point) == Point(3)
    with pytest.raises(BadField, match="a point"):
        json_fields.converted("a point", {"from_left": "x"}, Point)
    assert json_fields.fields_of(Point(3)) == {"fromLeft": 3, "fromTop": 0}


def test_what_lies_too_deep_is_refused() -> None:
    """As many objects and lists in each other as are allowed, and one more."""
    for levels, is_deep in ((NESTING, False), (NESTING + 1, True)):
        data = b'{"a":' + b"[" * (levels - 1) + b"0" + b"]" * (levels - 1) + b"}"
        assert json_fields.is_deep(msgspec.json.decode(data)) == is_deep
        if is_deep:
            with pytest.raises(BadJson, match="in each other"):
                json_fields.json_object("data", data)
        else:
            assert json_fields.json_object("data", data)
    assert len(json_fields.json_object("data", b"{%s}" % b",".join(b'"%d":0' % n for n in range(JSON_FIELDS))))


def test_long_keys_are_forgotten() -> None:
    """Keys that a peer makes up cost memory only while its frame is read."""
    decode_management(b'{"messageManager":"HeartbeatHandler"}')
    tracemalloc.start()
    try:
        for number in range(20):
            raw = b'{"messageManager":"HeartbeatHandler","%d%s":1}' % (number, b"x" * 60_000)
            assert decode_management(raw) == Heartbeat()
        assert tracemalloc.get_traced_memory()[0] < 1_000_000
    finally:
        tracemalloc.stop()


def filled(
    part: bytes, size: int, before: bytes = b'{"messageManager":"HeartbeatHandler","x":[', after: bytes = b"0]}"
) -> bytes:
    """JSON of about this size, full of one part."""
    return before + part * ((size - len(before) - len(after)) // len(part)) + after


COSTLY = {
    "lists": b"[],",
    "objects": b"{},",
    "objects with a key": b'{"":0},',
    "numbers": b"0,",
    "texts": b'"",',
    "nested": b"[[[[]]]],",
}


@pytest.mark.parametrize("part", COSTLY.values(), ids=COSTLY)
def test_what_may_be_parsed_costs_little_memory(part: bytes) -> None:
    """Management data of the largest size, made of whatever costs most, is refused or takes a few MB for a moment."""
    data = filled(part, MANAGEMENT_BYTES)
    tracemalloc.start()
    try:
        with suppress(WireError):
            decode_management(data)
        assert tracemalloc.get_traced_memory()[1] < 2 << 20
    finally:
        tracemalloc.stop()


def test_unknown_keys_are_few() -> None:
    """A thousand keys in one object are not what anybody means."""
    keys = ",".join(f'"k{number}":0' for number in range(1000))
    for data in (
        b'{"messageManager":"HeartbeatHandler",%s}' % keys.encode(),
        b"{%s}" % keys[:4000].rpartition(",")[0].encode(),
    ):
        with pytest.raises(BadJson, match="keys"):
            decode_management(data)
    with pytest.raises(WireError):
        Metadata.decode(b"{%s}" % keys[:4000].rpartition(",")[0].encode())


def test_sizes_are_judged_before_anything_is_parsed() -> None:
    """What is too long is told as that, though it is no JSON either."""
    for read, limit in (
        (decode_management, MANAGEMENT_BYTES),
        (Metadata.decode, METADATA_BYTES),
        (lambda data: messages.correct_sender(data, 1, 1), METADATA_BYTES),
        (lambda data: decode_data(AddNode, data), REQUEST_BYTES),
        (lambda data: decode_management(data, {}, CONFIGURATION_BYTES), CONFIGURATION_BYTES),
    ):
        with pytest.raises(TooLong) as raised:
            read(b"[" * (limit + 1))
        assert (raised.value.size, raised.value.limit) == (limit + 1, limit)


def test_a_robot_with_thousands_of_topics_can_say_so() -> None:
    """A configuration with 2 000 topics of usual names is read."""
    topics = {
        f"/robot/sensing/camera_{n}/image_rect_color/compressed": "sensor_msgs/msg/CompressedImage"
        for n in range(2000)
    }
    said = Configuration(1, 7, functionality=Functionality(publishers=topics))
    assert decode_management(encode_management(said), {}, CONFIGURATION_BYTES) == said


def test_a_list_of_registrants_may_be_long() -> None:
    """9 000 registrants of one topic fit."""
    said = StreamData({"2": list(range(10_000, 19_000))})
    assert decode_management(encode_management(said)) == said


def test_json_that_is_passed_on_is_judged_like_that_which_is_read() -> None:
    """Data that goes to a program which parses it is an object, of a size and of parts that may be parsed."""
    assert messages.is_json_object(b'{"subscribers":{}}')
    for data in (
        b"[]",
        b"{",
        b"",
        b'{"a":' + b"[" * 2000 + b"]" * 2000 + b"}",
        filled(b"[],", 200_000),
        filled(b"0,", 31 << 20),
    ):
        assert not messages.is_json_object(memoryview(data))


@pytest.mark.parametrize(
    "answer",
    [
        b"[]",
        b"NaN",
        b'{"a":NaN}',
        b'{"a":-Infinity}',
        b'{"a":1e999}',
        b'{"a":"\\ud800"}',
        b'{"\xff":1}',
        b'{"a":1%s}' % (b"0" * 5000),
        b'{"a":%s}' % (b"[" * 100_000),
        b'{"a":%s0%s}' % (b"[" * NESTING, b"]" * NESTING),
        filled(b"[],", ANSWER_BYTES),
        filled(b"0,", ANSWER_BYTES),
        filled(b'"":0,', ANSWER_BYTES, b"{", b'"":0}'),
        filled(b"0,", ANSWER_BYTES + 100),
    ],
    ids=lambda answer: answer[:20].decode(errors="replace"),
)
def test_an_answer_is_read_as_others_would_read_it(answer: bytes) -> None:
    """What somebody answers is passed on as JSON, to pages and programs: it has to be some, and of a size."""
    with pytest.raises(WireError):
        json_fields.answered("an answer", answer)


def test_an_answer_may_be_long() -> None:
    """All ids that there are, and all that a robot with thousands of topics offers."""
    said = {"ids": list(range(1, 1 << 16)), "camelCase": {f"/topic_{n}": "sensor_msgs/msg/Image" for n in range(5000)}}
    assert json_fields.answered("an answer", msgspec.json.encode(said)) == said
