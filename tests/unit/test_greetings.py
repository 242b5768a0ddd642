"""Who is there, by the first bytes of a connection: recorded from Zenoh 1.10, our gateway, and others."""

from __future__ import annotations

import pytest

from macs_zenoh.protocol import greetings
from macs_zenoh.protocol.messages import Metadata, Welcome, encode_data
from macs_zenoh.protocol.wire import encode_frame, encode_message

INIT_SYN = bytes.fromhex("1900c109f2833e982bfd0db45cd0616d888075c66b0ac8ff812701")
INIT_ACK = bytes.fromhex(
    "4b00e109f03d1344eb3def6d2e73781f83760900530a00c03130343f8bc38b0ca5ae5b4cc006a8b21c6bc750e37240414bbde9c015652e64"
    "77b858120d9b8f7d84072d6c041c96734126812701"
)
CLOSE = bytes.fromhex("02000302")
WELCOME = encode_message(Metadata(request_id=5, message_manager=Welcome.manager).encode(), encode_data(Welcome(5)))
TLS_ALERT = bytes.fromhex("15030300020232")
OTHERS = [b"", b"SSH-2.0-OpenSSH_9.6\r\n", b"HTTP/1.1 400 Bad Request\r\n\r\n", TLS_ALERT, bytes(64)]


@pytest.mark.parametrize("said", [INIT_ACK, CLOSE, INIT_SYN])
def test_zenoh_is_recognised(said: bytes) -> None:
    """An answer, or the beginning of a client, in whole and not before."""
    assert greetings.is_zenoh(said)
    assert not any(greetings.is_zenoh(said[:size]) for size in range(len(said)))
    assert not greetings.is_gateway(said)


def test_a_gateway_is_recognised() -> None:
    """The message with an id that it greets everybody with."""
    assert greetings.is_gateway(WELCOME)
    assert not greetings.is_zenoh(WELCOME)


@pytest.mark.parametrize("said", OTHERS)
def test_others_are_neither(said: bytes) -> None:
    """Other servers, TLS, silence."""
    assert not greetings.is_zenoh(said)
    assert not greetings.is_gateway(said)
    assert not greetings.begins_as_client(said)


def test_a_gateway_knows_a_zenoh_program() -> None:
    """By one InitSyn and nothing more; no frame of an agent begins so."""
    assert greetings.begins_as_client(INIT_SYN)
    assert greetings.begins_as_client(greetings.INIT_SYN)
    for frame in (encode_frame(), encode_frame(1, (7,), message=WELCOME), encode_frame(management=b"{}")):
        assert not any(greetings.begins_as_client(frame[:size]) for size in range(len(frame) + 1))
