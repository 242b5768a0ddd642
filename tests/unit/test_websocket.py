"""What both ends of a WebSocket know."""

from __future__ import annotations

import os
import re

from macs_zenoh.protocol.limits import SAMPLE_BYTES
from macs_zenoh.protocol.tokens import new_secret
from macs_zenoh.protocol.websocket import MESSAGE_BYTES, SUBPROTOCOL, TOKEN_SUBPROTOCOL


def test_a_token_is_a_subprotocol() -> None:
    """What is offered has only characters that a subprotocol may have (RFC 7230, 3.2.6), whatever its random bytes."""
    for content in (bytes(32), b"\xff" * 32, *(os.urandom(32) for _ in range(100))):
        for offered in (SUBPROTOCOL, TOKEN_SUBPROTOCOL + new_secret(content)):
            assert re.fullmatch(r"[!#$%&'*+.^_`|~0-9A-Za-z-]+", offered)
    assert not SUBPROTOCOL.startswith(TOKEN_SUBPROTOCOL)


def test_a_message_has_room() -> None:
    """A burst of frames that goes through the mesh as one sample fits into one message."""
    assert MESSAGE_BYTES >= SAMPLE_BYTES
