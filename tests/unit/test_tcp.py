"""What the kernel is asked of a socket."""

from __future__ import annotations

import socket

from bridge.gateway.tcp import is_gone, waiting_bytes


def test_of_a_closed_socket_nothing_waits_and_nobody_is_gone() -> None:
    """A connection's timer may come between its end and the word of it."""
    closed = socket.socket()
    closed.close()
    assert waiting_bytes(closed) == 0
    assert not is_gone(closed)
