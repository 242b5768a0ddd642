"""Messages that are longer than the bounds of their type: they do not come into a robot."""

from __future__ import annotations

import struct

import pytest

from bridge.rmw_zenoh.types import KnownMessage, KnownTypes
from bridge.ros.shapes import Number, Sequence
from bridge.ros.side import MessageType
from bridge.ros.types import resolve, shape_of

BOUNDED = """string<=8 name
wstring<=4 wide
int32[<=3] numbers
string<=2[<=2] words
float64[] endless
"""
NAME = "own_msgs/msg/Bounded"


@pytest.fixture(scope="module")
def bounded(tmp_path_factory: pytest.TempPathFactory) -> KnownMessage:
    folder = tmp_path_factory.mktemp("own") / "own_msgs" / "msg"
    folder.mkdir(parents=True)
    (folder / "Bounded.msg").write_text(BOUNDED, encoding="utf-8")
    types = KnownTypes([folder.parents[1]])
    message = types.message(NAME, NAME, "", lambda *_: None)
    assert isinstance(message, KnownMessage)
    return message


def cdr(name: str = "", wide: str = "", numbers: int = 0, words: tuple[str, ...] = (), endless: int = 0) -> bytes:
    """A message of it, as ROS writes it."""
    out = bytearray()

    def length(count: int) -> None:
        out.extend(bytes(-len(out) % 4) + struct.pack("<I", count))

    def text(value: str) -> None:
        raw = value.encode() + b"\0"
        length(len(raw))
        out.extend(raw)

    text(name)
    length(len(wide))
    for letter in wide:
        out.extend(struct.pack("<I", ord(letter)))
    length(numbers)
    out.extend(bytes(4 * numbers))
    length(len(words))
    for word in words:
        text(word)
    length(endless)
    out.extend((bytes(-len(out) % 8) if endless else b"") + bytes(8 * endless))
    return b"\0\1\0\0" + bytes(out)


@pytest.mark.parametrize(
    "message",
    [
        cdr(),
        cdr("12345678", "1234", 3, ("ab", "cd"), 9),
        cdr("üüüüüüüü"),  # eight letters of two bytes
        cdr(words=("ü€",)),
    ],
)
def test_what_keeps_to_its_bounds(bounded: MessageType, message: bytes) -> None:
    """As long as it may be, also where letters have several bytes."""
    assert bounded.problem(message) is None


@pytest.mark.parametrize(
    ("message", "what"),
    [
        (cdr("123456789"), "a text of 9 letters is in it, where its type has 8 at most"),
        (cdr(wide="12345"), "a text of 5 letters is in it, where its type has 4 at most"),
        (cdr(numbers=4), "a sequence of 4 items is in it, where its type has 3 at most"),
        (cdr(words=("a", "b", "c")), "a sequence of 3 items is in it, where its type has 2 at most"),
        (cdr(words=("a", "abc")), "a text of 3 letters is in it, where its type has 2 at most"),
    ],
)
def test_what_does_not(bounded: MessageType, message: bytes, what: str) -> None:
    """It is refused, and who sent it hears why."""
    assert bounded.problem(message) == what


def test_types_of_rclpy_have_theirs() -> None:
    """ROS's own classes say their bounds, too."""
    pytest.importorskip("rclpy", reason="types of ROS need ROS")
    primitive = shape_of(resolve("shape_msgs/msg/SolidPrimitive"))
    assert Sequence(Number(8), most=3) in primitive.fields
