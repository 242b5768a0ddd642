"""What is written into a TCP agent's socket, by the loop or past it by a thread of Zenoh's: whole messages, in order.

All that two threads share of a connection is here, under one lock.
"""

from __future__ import annotations

import asyncio
import errno
import os
import socket
import threading
import time
from collections.abc import Sequence
from contextlib import suppress

from bridge.pieces import small_joined
from macs_zenoh.protocol.kept import Kept
from macs_zenoh.protocol.outbox import Chunk, Outbox

from .listener import descriptors

COPY_BYTES = 16 << 10
"""A piece of a sample that is no larger than this is kept as a copy, and not with all of the sample."""

RECORD_BYTES = 16 << 10
"""As much as TLS encrypts at once."""

BUFFER_BYTES = 256 << 10
"""What the transport may hold before messages wait in the outbox, where a call can still overtake topic data."""


class Writer:
    """One connection's. What it cannot write waits in its ``outbox``, which its owner fills while it is `full`."""

    def __init__(self, outbox: Outbox) -> None:
        self.paused_at: float | None = None
        """Since when the transport takes nothing more."""
        self.resumed = 0
        """How often it has taken something again."""
        self.written_bytes = 0
        """Of everything."""
        self.kept: Kept[Chunk] | None = None
        """What may have to be sent again over another connection; None: there will be none."""
        self._to_keep: list[tuple[Sequence[Chunk], bool]] = []
        """Of what is gathered: in the same order, and whether it is kept, or only counted."""
        self._outbox = outbox
        self._transport: asyncio.Transport
        self._gathered: list[Chunk] = []
        self._gathered_bytes = 0
        self._direct: DirectWriter | None = None
        self._wants_direct = False
        self.encrypts = False
        """Whether TLS does, each piece for itself: so what is written together is made one."""
        self._lock = threading.RLock()
        """Held by whoever writes, the loop or a thread of Zenoh's, as long as older messages are on their way."""
        self._rest = b""
        """What the socket did not take of a message sent past the loop: nothing else may come before it."""

    def attach(self, transport: asyncio.Transport) -> None:
        """The connection is there."""
        self._transport = transport
        self.encrypts = bool(transport.get_extra_info("sslcontext"))
        transport.set_write_buffer_limits(high=BUFFER_BYTES)

    def detach(self) -> None:
        """It has ended."""
        with self._lock:
            self._transport = ENDED

    def fall_asleep(self) -> None:
        """It has ended, and there will be another: until then everything waits. What was gathered is kept, or lost."""
        with self._lock:
            self.flush()
            self.close_direct()
            self.detach()
            self._rest = b""
            self.pause()

    def wake(self, transport: asyncio.Transport, first: bytes, again: Sequence[Chunk]) -> None:
        """There is another: write this first, then again what has not arrived, then what waits."""
        with self._lock:
            self._rest = b""
            self.attach(transport)
            if self._wants_direct:
                self.open_direct()
            self.paused_at = None
            self.write([first])
            self._keep(again)
            self.write(list(again))
            if self.paused_at is None:
                self.resume()

    # -- past the loop -------------------------------------------------------------------------------------------

    def open_direct(self) -> None:
        """Let threads write past the loop, if a descriptor is left and what is written goes out as it is, which
        it does not over TLS and WebSocket: else topics take the usual way."""
        self._wants_direct = True
        plain = not any(map(self._transport.get_extra_info, ("sslcontext", "websocket")))
        if plain and self._direct is None and not self._transport.is_closing():
            with suppress(OSError):
                self._direct = DirectWriter(self._transport.get_extra_info("socket"))

    def close_direct(self) -> None:
        """The connection has ended."""
        with self._lock:
            direct, self._direct = self._direct, None
            if direct is not None:
                direct.close()

    @property
    def free(self) -> bool:
        """Whether nothing waits to be written, so that `write_now` can be tried. From any thread."""
        return (
            self._direct is not None
            and self.paused_at is None
            and not (self._gathered or self._rest or self._transport.is_closing())
            and not self._transport.get_write_buffer_size()
        )

    def write_now(self, message: bytes) -> bool:
        """Write past the loop. False when something is left, for the loop to `flush` soon."""
        with self._lock:
            if self.kept is not None:
                self.kept.skip()
            sent = self._direct.send(message) if self.free and self._direct is not None else 0
            self.written_bytes += sent
            if sent == len(message):
                return True
            self._rest += message[sent:]
        return False

    # -- on the loop ---------------------------------------------------------------------------------------------

    @property
    def full(self) -> bool:
        """Whether what is sent now has to wait in the outbox."""
        return self.paused_at is not None

    def gather(self, messages: Sequence[Chunk], size: int, *, keep: bool = False) -> bool:
        """Have ready for the next `flush`, but no more than the transport may hold. Whether it is the first. ``keep``:
        it must also reach who comes back over another connection."""
        first = not self._gathered
        self._gathered += messages
        if self.kept is not None:
            self._to_keep.append((messages, keep))
        self._gathered_bytes += size
        if self._gathered_bytes > BUFFER_BYTES:
            self.flush()
        return first

    def flush(self) -> None:
        """Write what was gathered, in one go."""
        with self._lock:
            gathered, self._gathered = self._gathered, []
            size, self._gathered_bytes = self._gathered_bytes, 0
            if self._to_keep:
                self._keep_gathered()
            self.write(gathered, size)

    def _keep_gathered(self) -> None:
        """Number what is written now: with the lock, since who writes past the loop counts as well."""
        to_keep, self._to_keep = self._to_keep, []
        for messages, keep in to_keep:
            if keep:
                self._keep(messages)
            elif self.kept is not None:
                self.kept.skip(len(messages))

    def _keep(self, messages: Sequence[Chunk]) -> None:
        if self.kept is None:
            return
        for message in messages:
            small = type(message) is memoryview and len(message) <= COPY_BYTES
            self.kept.put(bytes(message) if small else message, len(message))

    def write(self, chunks: list[Chunk], size: int | None = None) -> None:
        """Write at once, ``size`` bytes together, behind what is left of a message that went past the loop."""
        with self._lock:
            size = sum(map(len, chunks)) if size is None else size
            rest, self._rest = self._rest, b""
            if rest:
                chunks, size = [rest, *chunks], size + len(rest)
            if chunks and not self._transport.is_closing():
                self.written_bytes += size
                self._transport.writelines(joined(chunks) if self.encrypts and len(chunks) > 1 else chunks)

    def pause(self) -> None:
        """The transport takes nothing more."""
        self.paused_at = time.monotonic()

    def resume(self) -> None:
        """It does again: write what waits, as far as it goes."""
        with self._lock:
            self.resumed += 1
            self.paused_at = None
            while self._outbox and self.paused_at is None:  # writing may pause us again
                taken = self._outbox.take(BUFFER_BYTES)
                if self.kept is not None:
                    calls = self._outbox.calls_taken
                    self._keep(taken[:calls])
                    self.kept.skip(len(taken) - calls)
                self.write(taken)

    def close(self, most_s: float) -> None:
        """Write what is gathered, then FIN. Who does not read is cut, at once or after ``most_s``, since a transport
        that still has something to write waits for ever."""
        with self._lock:
            self.flush()
            if self.paused_at is None:
                self._transport.close()
                if self._transport.get_write_buffer_size():  # else it ends by itself, and nothing is to be kept for it
                    asyncio.get_running_loop().call_later(most_s, self._transport.abort)
            else:
                self._transport.abort()

    def finish(self) -> None:
        """Write all that waits, then FIN."""
        with self._lock:
            self.flush()
            self.write(self._outbox.take(self._outbox.bytes))
            self._transport.close()


def joined(chunks: Sequence[Chunk]) -> list[Chunk]:
    """Small pieces that follow each other as one: TLS encrypts each by itself. A large one takes several of TLS's
    records anyway, and costs less than its copy."""
    return small_joined(chunks, RECORD_BYTES)


class _Ended(asyncio.Transport):
    """In the place of a transport that has ended. TLS's and its protocol know each other for ever, which would keep
    what a connection has until Python looks for circles."""

    def is_closing(self) -> bool:
        return True

    def get_write_buffer_size(self) -> int:
        return 0

    def abort(self) -> None:
        pass

    def close(self) -> None:
        pass


ENDED = _Ended()


class _Nobody(asyncio.Protocol):
    """Who a socket talks to that is given up: it hears nothing."""


NOBODY = _Nobody()


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
