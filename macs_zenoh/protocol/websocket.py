"""How the protocol is carried by a WebSocket: names that both ends know. Pure.

A binary message is any piece of the same stream of bytes that TCP would carry; where messages begin and end means
nothing. So a frame may come in several messages, and several frames in one.
"""

from __future__ import annotations

WEBSOCKET_PATH = "/macs"
"""Where a gateway's web port has it."""

SUBPROTOCOL = "macs.v1"
TOKEN_SUBPROTOCOL = "macs.token."  # noqa: S105 - what comes before one
"""A browser cannot set headers of a WebSocket, but it can offer subprotocols: the token is the rest of one."""

MESSAGE_BYTES = 1 << 20
"""What one message may have: a gateway ends a connection that sends a larger one."""
