"""Calls for several agents in one query: whose they may be, how their answers are read, and which go together."""

from __future__ import annotations

import pytest

from macs_zenoh.calls_together import Question, came_of, in_order
from macs_zenoh.errors import MacsError, Refused, WireError
from macs_zenoh.protocol import together
from macs_zenoh.protocol.guard import Guard, Limits
from macs_zenoh.protocol.keyexpr import CALL, CALLS
from macs_zenoh.protocol.messages import ROS, UNITY, Metadata
from macs_zenoh.protocol.routing import call_of
from macs_zenoh.protocol.wire import MACS, encode_message

KEY = CALLS.of(type=ROS, id=7, verb="add_node", from_type=UNITY, from_block=1)


def frame(agent_type: int | None, agent_id: int | None, data: bytes = b"data") -> bytes:
    """A call of somebody, as it is written."""
    message = encode_message(Metadata(agent_type, agent_id, message_manager="m").encode(), data)
    return call_of((ROS, 7), "add_node", (UNITY, 300), message)[1]


def test_calls_are_read_as_they_were_written() -> None:
    """Each with its caller and its data, in their order; no bytes are no calls."""
    calls = together.read_calls(KEY, frame(UNITY, 256, b"a") + frame(UNITY, 511, b"bc") + frame(UNITY, 256), MACS)
    assert [(call.sender, call.data) for call in calls] == [
        ((UNITY, 256), b"a"),
        ((UNITY, 511), b"bc"),
        ((UNITY, 256), b"data"),
    ]
    assert calls[0].metadata.message_manager == "m"
    assert calls[0].size == len(frame(UNITY, 256, b"a"))
    assert together.read_calls(KEY, b"", MACS) == []


@pytest.mark.parametrize("who", [(UNITY, 255), (UNITY, 512), (UNITY, 0), (UNITY, None), (None, 300), (ROS, 300)])
def test_nobody_is_spoken_for_who_is_not_of_the_block(who: tuple[int | None, int | None]) -> None:
    """An agent of another block or type, or none: then no call of all these is made."""
    with pytest.raises(Refused):
        together.read_calls(KEY, frame(UNITY, 256) + frame(*who), MACS)


def test_a_visitor_is_not_of_block_0() -> None:
    """Who has not joined has id 0, as whom every gateway may look: nobody speaks for it with others."""
    key = CALLS.of(type=ROS, id=7, verb="add_node", from_type=UNITY, from_block=0)
    with pytest.raises(Refused):
        together.read_calls(key, frame(UNITY, 0), MACS)
    assert len(together.read_calls(key, frame(UNITY, 1), MACS)) == 1


def test_too_many_calls_and_what_is_none_are_refused() -> None:
    """More than are taken, and bytes that are no frames."""
    assert len(together.read_calls(KEY, frame(UNITY, 256) * together.MOST_READ, MACS)) == together.MOST_READ
    with pytest.raises(Refused):
        together.read_calls(KEY, frame(UNITY, 256) * (together.MOST_READ + 1), MACS)
    for payload in (b"?", frame(UNITY, 256)[:-1], frame(UNITY, 256) + b"\0"):
        with pytest.raises(WireError):
            together.read_calls(KEY, payload, MACS)
    with pytest.raises(Refused):
        together.read_calls("macs/call/ros/7/add_node/unity/256", b"", MACS)


def test_answers_are_read_as_they_were_written() -> None:
    """One for each call, and nothing else is taken for that."""
    answers: list[together.CameTo] = [None, {"refused": "no", "holder": "2/300"}, {"failed": "why"}]
    assert together.read_answers(together.write_answers(answers), 3) == answers
    assert together.read_answers(b"[]", 0) == []
    for wrong in (b"", b"[]", b"[null,null]", b"{}", b"[1,2,3]", b"null", b"[" * 5000):
        with pytest.raises(WireError):
            together.read_answers(wrong, 3)


def test_a_certificate_for_one_agent_covers_no_block() -> None:
    """The pattern by which routers know one headset includes no key of calls for a block."""
    import zenoh

    for agent_id in (1, 256):
        key = CALLS.of(type=ROS, id=7, verb="add_node", from_type=UNITY, from_block=min(255, agent_id))
        assert not zenoh.KeyExpr(f"macs/**/unity/{agent_id}").intersects(zenoh.KeyExpr(key))


# -- which go together -----------------------------------------------------------------------------------------------


def question(agent_id: int, verb: str = "add_node", size: int = 10, *, alone: bool = False) -> Question[str]:
    """A call of a headset."""
    return Question(f"{verb[0]}{agent_id}", (UNITY, agent_id), 7, verb, "key", bytes(size), alone)


def test_what_goes_together_is_of_one_block_and_one_verb() -> None:
    """Whatever the order in which it was wanted."""
    wanted = [question(256), question(600), question(257), question(601), question(258, "remove_node")]
    assert [[each.of for each in some] for some in in_order(wanted)] == [["a256", "a257"], ["a600", "a601"], ["r258"]]


def test_an_agents_own_calls_stay_in_their_order() -> None:
    """What it takes back after it has registered goes behind all that went before, and what it registers then behind
    that."""
    wanted = [question(256), question(257), question(256, "remove_node"), question(258), question(256)]
    assert [[each.of for each in some] for some in in_order(wanted)] == [
        ["a256", "a257"],
        ["r256"],
        ["a258"],
        ["a256"],
    ]


def test_one_query_brings_no_more_than_is_read() -> None:
    """Frames that are larger together go one after the other."""
    wanted = [question(256 + number, size=30_000) for number in range(5)]
    assert [len(some) for some in in_order(wanted)] == [2, 2, 1]


def test_what_is_tried_again_goes_alone() -> None:
    """It has a group of its own, without a key."""
    wanted = [question(256), question(257, alone=True), question(258)]
    assert [[each.of for each in some] for some in in_order(wanted)] == [["a256", "a258"], ["a257"]]
    assert wanted[1].together_key == ""
    assert wanted[0].together_key == KEY


def test_what_is_no_answer_says_nothing_of_any() -> None:
    """Neither a refusal of all nor too few answers refuses one."""
    for answer in (Refused("no"), b"", b"[null]", b"[null,null,null]"):
        assert isinstance(came_of(KEY, answer, 2), MacsError)
    came = came_of(KEY, b'[null,{"refused":"no"}]', 2)
    assert isinstance(came, list)
    assert came[0] == b""
    assert isinstance(came[1], Refused)


# -- how much --------------------------------------------------------------------------------------------------------


def test_a_query_for_a_block_uses_up_no_agents_credit() -> None:
    """It has its own, before it is known whose calls it brings; and that has an end."""
    guard = Guard(Limits(requests_per_s=10), MACS)
    single = CALL.of(type=ROS, id=7, verb="add_node", from_type=UNITY, from_id=300)
    for _ in range(3):
        assert guard.admits(KEY, 10_000, False, 100.0)
    assert guard.admits(single, 400, False, 100.0)
    admitted = sum(guard.admits(KEY, 10_000, False, 100.0) for _ in range(1000))
    assert admitted < 100
    assert guard.admits(single, 400, False, 100.0)
