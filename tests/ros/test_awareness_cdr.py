"""The CDR written by hand is what rclpy reads, and the other way round."""

from __future__ import annotations

import array

import pytest
from as2_ca_msgs.msg import LocalGenericMessage
from hypothesis import given
from hypothesis import strategies as st
from rclpy.serialization import deserialize_message, serialize_message

from bridge.awareness import cdr

TEXTS = st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]), max_size=20)


@given(TEXTS, TEXTS, st.binary(max_size=50))
def test_both_codecs_agree(agent: str, kind: str, data: bytes) -> None:
    """rclpy reads what we write, and we read what rclpy writes, whatever the lengths and the padding."""
    message = deserialize_message(cdr.write(agent, kind, data), LocalGenericMessage)
    assert (message.agent, message.type, bytes(message.data)) == (agent, kind, data)
    theirs = bytes(serialize_message(LocalGenericMessage(agent=agent, type=kind, data=array.array("B", data))))
    assert cdr.read(theirs) == cdr.read(cdr.write(agent, kind, data)) == (agent, kind, data)


@given(st.binary(max_size=60))
def test_any_bytes_are_read_or_refused(data: bytes) -> None:
    """Nothing raises anything but ValueError, and big endian is left to rclpy."""
    try:
        message = cdr.read(data)
    except ValueError:
        return
    assert message is not None or data[:2] != cdr.LITTLE_ENDIAN


def test_a_message_cut_short_is_refused() -> None:
    """Wherever it is cut, it is no message; with bytes behind it, it is."""
    whole = cdr.write("drone0", "planning", b"12345")
    for end in range(4, len(whole)):
        with pytest.raises(ValueError, match=r"missing|declared"):
            cdr.read(whole[:end])
    assert cdr.read(whole + b"\0\0\0") == ("drone0", "planning", b"12345")
