"""A second way into a TCP agent's socket, past its transport, for threads that are not the event loop's."""

from __future__ import annotations

import errno
import os
import socket

from .listener import descriptors


class DirectWriter:
    """Writes into a socket that somebody else owns, as much as it takes at once. Its callers see to the order.

    It has a descriptor of its own: the owner may close his at any time, and its number can be another socket's then.
    """

    def __init__(self, sock: socket.socket) -> None:
        """Raises OSError when there are no descriptors left."""
        self._descriptor = os.dup(sock.fileno())
        if self._descriptor >= descriptors():
            os.close(self._descriptor)
            raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))

    def send(self, message: bytes) -> int:
        """How many bytes the socket took. Of one that has failed, all: its owner will notice."""
        try:
            return os.write(self._descriptor, message)
        except BlockingIOError:
            return 0
        except OSError:
            return len(message)

    def close(self) -> None:
        """Give the descriptor back: until then the other side does not see the end of the connection."""
        os.close(self._descriptor)
