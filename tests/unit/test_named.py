"""Messages between named agents: the pure parts."""

from __future__ import annotations

from contextlib import suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st

from macs_zenoh.errors import BadField, BadJson, BadSizes, UsageError, WireError
from macs_zenoh.protocol import named
from macs_zenoh.protocol.key_fields import NameFields
from macs_zenoh.protocol.keyexpr import NAME, WANTED
from macs_zenoh.protocol.named import (
    Arrivals,
    Copies,
    Envelope,
    LastValues,
    Named,
    Names,
    Outcome,
    RateLimits,
    check_word,
)
from macs_zenoh.protocol.wire import encode_message


@given(st.text(min_size=1, max_size=64), st.integers(0, 2**53), st.none() | st.floats(0.001, 1e6), st.binary())
def test_a_message_is_what_was_encoded(session: str, number: int, deadline_s: float | None, data: bytes) -> None:
    """`decode` of `encode` is the identity."""
    envelope = Envelope(session, number, deadline_s)
    assert named.decode(named.encode(envelope, data)) == (envelope, data)


def test_the_envelope_on_the_wire() -> None:
    """The bytes are those that keyexpr_map.md describes."""
    assert named.encode(Envelope("ab", 7, 1.5), b"x") == encode_message(
        b'{"session":"ab","number":7,"deadlineS":1.5}', b"x"
    )


@pytest.mark.parametrize(
    ("payload", "error"),
    [
        (b"", BadSizes),
        (b"\x05\0\0\0ab", BadSizes),
        (encode_message(b"{", b""), BadJson),
        (encode_message(b"\xff", b""), BadJson),
        (encode_message(b"{}", b""), BadField),
        (encode_message(b'{"session":"a","number":-1}', b""), BadField),
        (encode_message(b'{"session":"","number":1}', b""), BadField),
    ],
)
def test_what_is_no_message_is_a_wire_error(payload: bytes, error: type[WireError]) -> None:
    """Wrong sizes, JSON and fields each have their error."""
    with pytest.raises(error):
        named.decode(payload)


@given(st.binary())
def test_any_bytes_give_a_message_or_a_wire_error(payload: bytes) -> None:
    """Nothing that arrives raises anything else."""
    with suppress(WireError):
        named.decode(payload)


@pytest.mark.parametrize("word", ["drone0", "a/b", "two words", "Дрон", "🤖", "@x", "*", "%2F", "x" * 200])
def test_any_text_may_be_a_name(word: str) -> None:
    """Slashes, spaces, wildcards and Unicode are allowed, and a key brings them back."""
    check_word("agent name", word)
    fields = NameFields(word, type=1, id=7, zid="a")
    assert NAME.parse(NAME.of(**fields._asdict())) == fields


@pytest.mark.parametrize("word", ["", "x" * 201, "\ud800"])
def test_what_cannot_be_a_name(word: str) -> None:
    """Empty, too long or no text: the error says what."""
    with pytest.raises(UsageError, match="message type"):
        check_word("message type", word)


def test_names_come_and_go() -> None:
    """Tokens make the list; a token that says nothing new changes nothing."""
    names = Names()
    key = NAME.of(name="a/b", type=1, id=7, zid="1")
    assert names.token(key, True) == "a/b"
    assert names.token(key, True) is None
    assert list(names) == [Named("a/b", 1, 7, "1")]
    assert "a/b" in names
    assert names.token(NAME.of(name="a/b", type=1, id=8, zid="2"), True) == "a/b"
    assert names.claimants("a/b") == ["1", "2"]
    assert names.token(key, False) == "a/b"
    assert names.token(key, False) is None
    assert [agent.id for agent in names] == [8]
    assert names.token("macs/all/ros/7", True) is None


def test_types_are_taken_by_names() -> None:
    """Who takes a type is known per name; two sessions of one name count as one."""
    names = Names()
    names.token(NAME.of(name="a", type=1, id=7, zid="1"), True)
    for zid in ("1", "2"):
        names.token(WANTED.of(name="a", message_type="std_msgs/String", zid=zid), True)
    assert names.takes("a", "std_msgs/String")
    assert names.types("a") == names.types("a") == ["std_msgs/String"]
    assert list(names.takers("std_msgs/String")) == ["a"]
    assert names.token(WANTED.of(name="a", message_type="std_msgs/String", zid="1"), False) is None
    assert names.token(WANTED.of(name="a", message_type="std_msgs/String", zid="2"), False) == "a"
    assert not names.takes("a", "std_msgs/String")
    assert list(names.takers("std_msgs/String")) == []


def test_a_rate_is_kept_per_type_and_receiver() -> None:
    """Of ten messages in a second at 2 Hz two pass, for each receiver; other types are not limited."""
    limits = RateLimits({"pose": 2.0})
    for receiver in ("a", "b"):
        assert [limits.admit("pose", receiver, n / 10) for n in range(10)].count(True) == 2
    assert all(limits.admit("plan", "a", n / 10) for n in range(10))


def test_the_rate_table_is_bounded() -> None:
    """Receivers from long ago are forgotten."""
    limits = RateLimits({"pose": 2.0})
    for number in range(3 * RateLimits.LIMIT):
        assert limits.admit("pose", str(number), float(number))
    assert len(limits._paces) <= RateLimits.LIMIT


def test_last_values_are_bounded_in_bytes() -> None:
    """The newest of each type is kept; the type longest unsent gives way; one too large is not kept."""
    last = LastValues(limit_bytes=10)
    assert last.keep("a", b"12345")
    assert last.keep("b", b"12345")
    assert last.keep("a", b"1234")
    assert last.keep("c", b"12")
    assert (last.get("a"), last.get("b"), last.get("c")) == (b"1234", None, b"12")
    assert not last.keep("a", bytes(11))
    assert (last.get("a"), last.bytes) == (None, 2)


def test_a_repetition_is_recognised() -> None:
    """The same session and number are one message; another life of the sender starts again."""
    arrivals = Arrivals()
    assert arrivals.fresh("a", "t", Envelope("1", 5))
    assert not arrivals.fresh("a", "t", Envelope("1", 5))
    assert arrivals.fresh("a", "t", Envelope("1", 4))
    assert arrivals.fresh("b", "t", Envelope("1", 5))
    assert arrivals.fresh("a", "t", Envelope("2", 5))


def test_what_is_remembered_is_bounded() -> None:
    """Neither many messages nor many senders make it grow without end."""
    arrivals = Arrivals()
    for number in range(3000):
        assert arrivals.fresh("a", "t", Envelope("1", number))
        assert arrivals.fresh(str(number), "t", Envelope("1", 1))
        arrivals.fresh("a", "t", Envelope("1", number))
    assert len(arrivals._seen) <= Arrivals.SENDERS
    assert max(len(order) for order, _ in arrivals._seen.values()) <= Arrivals.NUMBERS


def test_a_last_value_is_news_or_not() -> None:
    """An older last value than what has come is none; of another type or life it is."""
    arrivals = Arrivals()
    arrivals.fresh("a", "t", Envelope("1", 5))
    assert not arrivals.newer("a", "t", Envelope("1", 5))
    assert not arrivals.newer("a", "t", Envelope("1", 4))
    assert arrivals.newer("a", "t", Envelope("1", 6))
    assert arrivals.newer("a", "other", Envelope("1", 4))
    assert arrivals.newer("a", "t", Envelope("2", 1))


@given(st.lists(st.tuples(st.sampled_from("xy"), st.booleans(), st.booleans()), max_size=30), st.randoms())
def test_each_message_on_two_paths_is_passed_on_once(sent: list[tuple[str, bool, bool]], order: object) -> None:
    """Whatever each path carries, in any interleaving: of each content as many as the better path carries."""
    mesh = [("mesh", data.encode()) for data, on_mesh, _ in sent if on_mesh]
    topic = [("topic", data.encode()) for data, _, on_topic in sent if on_topic]
    arriving = mesh + topic
    order.shuffle(arriving)  # type: ignore[attr-defined]
    copies = Copies()
    passed = [data for path, data in arriving if copies.first(path, "a", "t", data, 0.0)]
    for data in (b"x", b"y"):
        expected = max(mesh.count(("mesh", data)), topic.count(("topic", data)))
        assert passed.count(data) == expected


def test_copies_are_forgotten_after_a_while() -> None:
    """After the window a message of the same content is a new one, and nothing is kept."""
    copies = Copies()
    assert copies.first("mesh", "a", "t", b"x", 0.0)
    assert not copies.first("topic", "a", "t", b"x", 1.0)
    assert copies.first("topic", "a", "t", b"x", 20.0)
    assert len(copies._counts) == len(copies._times) == 1


def test_outcomes_have_counters() -> None:
    """Each outcome counts under a name of its own."""
    assert Outcome.NO_SUCH_AGENT.counter == "no_such_agent"
    assert len({outcome.counter for outcome in Outcome}) == len(Outcome)


def test_an_envelope_is_small_and_flat() -> None:
    """What is too long, nests without end or is no text is the sender's fault, told as that."""
    deep = b'{"session":"s","number":1,"x":' + b"[" * 900 + b"]" * 900 + b"}"  # no version of Python minds that
    for envelope in (
        deep,
        b'{"session":"s","number":1,"x":"\xff"',
        b" " * 5000 + b"{}",
        b'{"x":"' + b"y" * 10_000_000 + b'"}',
    ):
        with pytest.raises(WireError):
            named.decode(encode_message(envelope, b"data"))


def test_names_and_types_are_bounded() -> None:
    """Of one session so many names and types count, and so many sessions that say the same: the smallest, and one's
    own. Others have room, and those that are known go when their tokens do."""
    names = Names("own", mine="ff")
    for number in range(Names.TYPES + 10):
        names.token(WANTED.of(name=f"greedy{number // 512}", message_type=f"t{number}", zid="1"), True)
    for number in range(Names.NAMES + 10):
        names.token(NAME.of(name=f"n{number}", type=1, id=7, zid="1"), True)
    assert sum(len(names.types(f"greedy{number}")) for number in range(4)) == Names.TYPES
    assert (len(list(names)), names.left_out) == (Names.NAMES, 20)
    assert names.token(WANTED.of(name="modest", message_type="t", zid="f1"), True) == "modest"
    zids = [f"{number:02x}f" for number in range(Names.SESSIONS + 5)]
    for zid in reversed(zids):
        names.token(WANTED.of(name="modest", message_type="t", zid=zid), True)
        names.token(NAME.of(name="modest", type=1, id=7, zid=zid), True)
    assert names.claimants("modest") == zids[: Names.SESSIONS]
    names.token(NAME.of(name="modest", type=1, id=7, zid="ff"), True)
    assert names.claimants("modest") == [*zids[: Names.SESSIONS], "ff"]
    for zid in zids:
        names.token(WANTED.of(name="modest", message_type="t", zid=zid), False)
        names.token(NAME.of(name="modest", type=1, id=7, zid=zid), False)
    assert names.claimants("modest") == ["ff"]
    assert names.types("modest") == []


def test_a_name_that_is_our_own_is_always_known(monkeypatch: pytest.MonkeyPatch) -> None:
    """That another has our name is seen however many names there are."""
    monkeypatch.setattr(Names, "NAMES_IN_ALL", 40)
    names = Names("own", mine="ff")
    for number in range(60):
        names.token(NAME.of(name=f"n{number}", type=1, id=7, zid=f"{number:02x}"), True)
    assert len(list(names)) == 40
    assert names.token(NAME.of(name="own", type=1, id=7, zid="ee"), True) == "own"
    assert names.token(NAME.of(name="n99", type=1, id=7, zid="ff"), True) == "n99"


def test_who_came_before_there_was_room_is_known_when_told_of_again() -> None:
    """A robot that takes a type while one session has said so for 32 names and 512 types takes it; one that was left
    out does when it is told of again, and it is known that there is room."""
    names = Names()
    for number in range(32 * 512):
        names.token(WANTED.of(name=f"n{number // 512}", message_type=f"t{number % 512}", zid="1"), True)
    assert names.token(WANTED.of(name="arm", message_type="std_msgs/String", zid="2"), True) == "arm"
    assert names.takes("arm", "std_msgs/String")
    early = WANTED.of(name="late", message_type="t", zid="1")
    assert names.token(early, True) is None
    assert not names.has_room()
    names.token(WANTED.of(name="n0", message_type="t0", zid="1"), False)
    assert names.has_room()
    assert not names.has_room()
    assert not names.knows(early)
    assert names.token(early, True) == "late"
    assert names.knows(early)
    assert names.knows("macs/all/ros/7")


def test_a_site_of_three_hundred_robots_has_room() -> None:
    """300 robots with 55 types each, each in a session of its own, all count."""
    names = Names()
    for robot in range(300):
        names.token(NAME.of(name=f"r{robot}", type=1, id=7, zid=f"{robot:x}f"), True)
        for number in range(55):
            names.token(WANTED.of(name=f"r{robot}", message_type=f"t{number}", zid=f"{robot:x}f"), True)
    assert names.left_out == 0
    assert len(list(names.takers("t54"))) == 300
