"""Metadata judged by what was judged before says what it says when it is judged for the first time."""

from __future__ import annotations

import json
import os
import random
from collections.abc import Sequence

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from macs_zenoh.errors import BadField, WireError
from macs_zenoh.protocol.existing import readable
from macs_zenoh.protocol.judging import Judge, Judged, judge
from macs_zenoh.protocol.messages import UNITY, Metadata, correct_sender
from tests.support.thorough import examples

SENDER = (UNITY, 513)
ORDERS = (
    ("senderAgentType", "senderAgentId", "messageManager", "requestId", "nodeType", "nodeName", "dataExchangeType"),
    ("senderAgentType", "senderAgentId", "requestId", "messageManager", "nodeType", "nodeName", "dataExchangeType"),
    ("requestId", "nodeName", "senderAgentId"),
    ("requestId", "RequestId", "nodeName", "request_id"),
    ("nodeName", "requestId", "new", 'x"requestId', "requestId"),
    ("REQUESTID", "requestId", "senderagentid", "senderAgentId"),
)
TRICKS = (
    b'"requestId":5', b'\\"requestId":5,', b'{"requestId":5}', b'"requestId":5,', b",", b"}", b"0", b"-", b".5", b"e3",
    b" ", b'"', b"\\", b"\xff", b"null", b"[[[[", b"4294967296", b"requestId", b"senderAgentId", b"\x00",
)  # fmt: skip
CASES = int(os.environ.get("MACS_JUDGED", "3000"))
"""How many generated metadata are judged both ways; the slow tier asks for a million."""


def plainly(raw: bytes, sender: tuple[int, int]) -> Judged | type[WireError]:
    """The plain way, which remembers nothing."""
    try:
        return judge(raw, *sender)
    except WireError as error:
        return type(error)


def remembering(judging: Judge, raw: bytes) -> Judged | type[WireError]:
    """The way of who has seen much."""
    try:
        return judging(raw)
    except WireError as error:
        return type(error)


def value(chance: random.Random, key: str) -> object:
    """Some value for a key."""
    if key.lower().endswith("requestid") or key == "request_id":
        return chance.choice(
            [0, 1, 7, 8, 10, 77, 4294967295, 4294967296, chance.randrange(1 << 33), -1, 1.0, "5", None]
        )
    if key.lower().startswith("senderagent"):
        return chance.choice([UNITY, 513, 513, 0, 7, None])
    if key == "nodeType":
        return chance.choice([0, 1, 2, 3, 300])
    return chance.choice(["", "nd__x", '"requestId":5,', {"requestId": 6}, [{"requestId": 7}], "\\", "ä", 5])


def usual(chance: random.Random, order: Sequence[str]) -> bytes:
    """Metadata as programs write it, with values that mostly make sense."""
    sensible = {"senderAgentType": UNITY, "senderAgentId": 513, "nodeType": 0, "messageManager": "", "nodeName": "n"}
    fields = [(key, sensible.get(key, "") if chance.random() < 0.9 else value(chance, key)) for key in order]
    number = chance.choice([chance.randrange(20), chance.randrange(1 << 32), value(chance, "requestId")])
    named = [(key, number if key == "requestId" else field) for key, field in fields]
    colon, comma = chance.choice([(":", ","), (":", ","), (": ", ", ")])
    return ("{" + comma.join(json.dumps(key) + colon + json.dumps(field) for key, field in named) + "}").encode()


def mutated(chance: random.Random, raw: bytes) -> bytes:
    """The same with some bytes put in, left out or changed."""
    for _ in range(chance.choice([0, 0, 0, 1, 1, 2])):
        at = chance.randrange(len(raw) + 1)
        raw = raw[:at] + chance.choice(TRICKS) + raw[at + chance.randrange(3) :]
    return raw


def test_what_was_seen_before_changes_nothing() -> None:
    """Over generated and mutated metadata both ways say the same, or refuse it for the same reason."""
    chance = random.Random(15)
    judging, templates = Judge(*SENDER), [usual(chance, order) for order in ORDERS]
    short = 0
    for _ in range(CASES):
        raw = usual(chance, chance.choice(ORDERS)) if chance.random() < 0.7 else chance.choice(templates)
        raw = mutated(chance, raw)
        expected = plainly(raw, SENDER)
        for _ in range(2):
            assert remembering(judging, raw) == expected, raw
        short += raw not in judging._known and not isinstance(expected, type)
    assert short > CASES // 20  # the short way was taken


@settings(max_examples=examples(300), deadline=None)
@given(
    parts=st.lists(
        st.sampled_from([*TRICKS, b"{", b'"requestId":', b"1", b"23", b'"nodeName":"n"', b":"]), max_size=9
    ),
    numbers=st.lists(st.integers(0, 1 << 33), min_size=3, max_size=5),
)
def test_any_bytes_around_a_number(parts: list[bytes], numbers: list[int]) -> None:
    """Whatever surrounds what looks like a request id, no number is read that is none."""
    judging = Judge(*SENDER)
    middle = len(parts) // 2
    for number in numbers:
        raw = b"".join((*parts[:middle], b'"requestId":%d' % number, *parts[middle:]))
        assert remembering(judging, raw) == plainly(raw, SENDER), raw


@pytest.mark.parametrize("order", ORDERS[:2])
def test_a_known_shape_needs_no_parser(order: Sequence[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """From the third request id on, metadata as the C# and the Python programs write it is read by its number."""
    judging = Judge(*SENDER)
    fields = {"senderAgentType": 2, "senderAgentId": 513, "nodeType": 0}
    raw = [
        json.dumps({key: fields.get(key, n if key == "requestId" else "") for key in order}).replace(" ", "").encode()
        for n in (1, 22, 333)
    ]
    expected = [judge(each, *SENDER) for each in raw]
    assert [judging(each) for each in raw[:2]] == expected[:2]
    monkeypatch.setattr("macs_zenoh.protocol.judging.judge", None)
    assert judging(raw[2]) == expected[2]
    assert expected[2].readable
    assert expected[2].true == raw[2]


def test_a_false_sender_is_put_right_in_a_known_shape() -> None:
    """A headset that writes id 0 is put right also where only the number was read."""
    judging = Judge(*SENDER)
    for number in range(1, 6):
        raw = Metadata(UNITY, 0, number, "", 0, "n").encode()
        judged = judging(raw)
        assert judged.true == correct_sender(raw, *SENDER)
        assert (judged.metadata.sender_agent_id, judged.metadata.request_id) == (513, number)
        assert readable(judged.true)


def test_a_number_that_is_too_large_is_refused() -> None:
    """Also in a shape that is known."""
    judging = Judge(*SENDER)
    for number in range(5):
        judging(Metadata(*SENDER, number).encode())
    with pytest.raises(BadField):
        judging(Metadata(*SENDER, 5).encode().replace(b":5,", b":4294967296,"))


def test_what_is_remembered_is_bounded() -> None:
    """Who sends chooses metadata, not how much of it is kept."""
    judging = Judge(*SENDER)
    for number in range(3 * Judge.LIMIT):
        judging(Metadata(*SENDER, 1, "", 0, f"n{number}").encode())
    assert len(judging._known) <= Judge.LIMIT
    assert len(judging._shapes) <= Judge.LIMIT
    judging(Metadata(*SENDER, 1, "a" * 200, 0, "b" * 250, "c" * 250).encode().replace(b"{", b"{" + b" " * 600))
    assert all(len(raw) <= Judge.BYTES for raw in judging._known)
