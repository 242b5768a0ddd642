"""What an agent receives: whose messages a sample holds, and that nothing remembered changes what is read."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from macs_zenoh.errors import WireError
from macs_zenoh.protocol.keyexpr import BROADCAST, GROUP
from macs_zenoh.protocol.messages import ROS, UNITY, Metadata
from macs_zenoh.protocol.reading import Message, Reader
from macs_zenoh.protocol.routing import unicast_key
from macs_zenoh.protocol.wire import MACS, encode_frame, encode_message

ME = (ROS, 7)
INBOX = unicast_key(*ME, UNITY, 256)
OTHER_INBOX = unicast_key(*ME, UNITY, 257)


class Reading(Reader):
    """A reader that notes what could not be used."""

    def __init__(self) -> None:
        super().__init__(MACS, lambda _key, error: self.bad.append(error))
        self.bad: list[WireError] = []

    def one(self, key: str, payload: bytes | bytearray, *, by_group: bool = False) -> list[Message]:
        """As `read` for robot 7."""
        return self.read(key, payload, ME, by_group=by_group)


def frame(data: bytes = b"x", *, raw: bytes | None = None, ids: tuple[int, ...] = (7,), **metadata: Any) -> bytes:
    """To robot 7, from whom the metadata says."""
    raw = Metadata(**metadata).encode() if raw is None else raw
    return encode_frame(ROS, ids, (), message=encode_message(raw, data), layout=MACS)


@pytest.fixture
def reader() -> Reading:
    return Reading()


def test_the_sender_is_the_one_of_the_key(reader: Reading) -> None:
    payload = frame(b"drive", node_name="cmd_vel", sender_agent_type=UNITY, sender_agent_id=9)
    for _ in range(2):
        [message] = reader.one(INBOX, payload)
        assert (message.sender_type, message.sender_id, message.data) == ("unity", 256, b"drive")
        assert (message.metadata.sender_agent_id, message.metadata.node_name) == (256, "cmd_vel")
    [message] = reader.one(OTHER_INBOX, payload)
    assert (message.sender_id, message.metadata.sender_agent_id) == (257, 257)


def test_several_frames_of_one_sample_are_several_messages(reader: Reading) -> None:
    messages = reader.one(INBOX, frame(b"one") + frame(b"two", node_name="n") + frame(b"three"))
    assert [message.data for message in messages] == [b"one", b"two", b"three"]


def test_a_frame_that_cannot_be_used_costs_itself(reader: Reading) -> None:
    messages = reader.one(INBOX, frame(b"one") + frame(b"two", raw=b"{no json") + frame(b"three"))
    assert [message.data for message in messages] == [b"one", b"three"]
    assert len(reader.bad) == 1


def test_sizes_that_do_not_add_up_cost_the_sample(reader: Reading) -> None:
    assert reader.one(INBOX, frame(b"one") + frame(b"two")[:-1]) == []
    assert len(reader.bad) == 1


def test_own_broadcasts_are_not_heard(reader: Reading) -> None:
    payload = encode_frame(0, (), (), message=encode_message(Metadata().encode(), b"x"), layout=MACS)
    assert not reader.one(BROADCAST.of(from_type=ROS, from_id=7), payload)
    assert reader.one(BROADCAST.of(from_type=UNITY, from_id=7), payload)
    assert reader.one(BROADCAST.of(from_type=ROS, from_id=8), payload)


def test_who_is_named_by_id_drops_the_copy_for_the_group(reader: Reading) -> None:
    key = GROUP.of(group=3, type=ROS, from_type=UNITY, from_id=256)
    assert not reader.one(key, frame(ids=(7,)), by_group=True)
    assert reader.one(key, frame(ids=(8,)), by_group=True)


def test_a_key_of_nobodys_says_nothing(reader: Reading) -> None:
    assert reader.one("macs/elsewhere", frame()) == []
    assert reader.reread("macs/elsewhere", frame()) is None


def test_what_is_new_is_not_reread(reader: Reading) -> None:
    assert reader.reread(INBOX, frame(b"1")) is None
    reader.one(INBOX, frame(b"1"))
    assert reader.reread(OTHER_INBOX, frame(b"2")) is None
    assert reader.reread(INBOX, frame(b"2", node_name="n")) is None
    again = reader.reread(INBOX, frame(b"3"))
    assert again is not None
    assert again.data == b"3"


@given(st.data())
def test_rereading_is_reading(data: st.DataObject) -> None:
    """Whatever comes after two known messages: reread leaves it alone, or finds what reading anew finds."""
    reader = Reading()
    known = [frame(b"0123456789", node_name="cmd_vel"), frame(b"", node_name="other")]
    for payload in known:
        reader.one(INBOX, payload)
        assert reader.reread(INBOX, payload) == reader.one(INBOX, payload)[0]
    payload = bytearray(data.draw(st.sampled_from(known)))
    for _ in range(data.draw(st.integers(0, 3))):
        payload[data.draw(st.integers(0, len(payload) - 1))] = data.draw(st.integers(0, 255))
    payload += data.draw(st.sampled_from([b"", b"x", bytes(known[0])]))
    message = reader.reread(INBOX, payload)
    if message is not None:
        assert [message] == Reading().one(INBOX, payload)


def test_memory_is_bounded(reader: Reading) -> None:
    for number in range(2 * Reader.KNOWN + 10):
        key = unicast_key(*ME, UNITY, 1 + number)
        reader.one(key, frame(node_name=f"n{number}"))
        reader.reread(key, frame(node_name=f"n{number}"))
    reader.one(INBOX, frame(node_name="n" * 2 * Reader.KNOWN_BYTES))
    assert reader.reread(INBOX, frame(node_name="n" * 2 * Reader.KNOWN_BYTES)) is None
    for known in (reader._senders, reader._metadata, reader._seen):
        assert 0 < len(known) <= Reader.KNOWN
