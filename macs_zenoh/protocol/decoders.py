"""Byte streams of TCP connections, in whatever pieces they come, cut into frames or messages. No I/O, no clock.

What comes in is cut by `FrameDecoder`, where a gateway reads, and by `MessageDecoder`, where an agent does. `wire` has
the format.
"""

from __future__ import annotations

from typing import NamedTuple

from ..errors import FrameTooLarge, TooLong, WireError
from .limits import CONFIGURATION_BYTES, METADATA_BYTES, RUN_BYTES
from .wire import (
    MACS,
    MAX_FRAME_BYTES,
    MESSAGE_OVERHEAD,
    SIZES,
    U32,
    Buffer,
    Frame,
    Frames,
    Layout,
    Run,
    data_at,
    run_end,
)


class FrameDecoder:
    """Cuts a byte stream, in whatever pieces it comes, into whole frames whose sizes add up. In the place of one that
    cannot be used there is the error that says why: BadSizes or TooLong.

    Two ways in: `feed` takes bytes; `space` and `advance` let a socket receive straight into the decoder, so a big
    frame is copied nowhere. Declared sizes are judged before anything is reserved for them, and memory grows with
    the bytes that really came, never with the bytes that were promised.

    A frame above the limit finishes the decoder, because the next one cannot be found: the frames before it are
    still returned, `error` is set, and whatever follows is ignored.

    A frame whose management data or metadata alone is more than any needs is not stored: its bytes are skipped as they
    come.
    """

    SPACE_BYTES = 256 << 10
    """The most that is received at once."""
    PARTIAL_BYTES = 64 << 10
    """So much is reserved at once for a frame that has begun; then as much again as has come."""

    def __init__(
        self,
        max_frame_bytes: int = MAX_FRAME_BYTES,
        layout: Layout = MACS,
        scratch: bytearray | None = None,
        *,
        runs: bool = False,
    ) -> None:
        """``scratch`` is where `space` receives small frames; decoders that are never filled at the same time
        (connections of one event loop) may share one. ``runs`` gives frames that begin alike as one
        run; it may be changed at any time."""
        self.max_frame_bytes = max_frame_bytes
        self.layout = layout
        self.error: FrameTooLarge | None = None
        self.runs = runs
        self._received = scratch if scratch is not None else bytearray(self.SPACE_BYTES)
        self._scratch = memoryview(self._received)
        self._partial = bytearray()  # a frame that has begun; its length is what is reserved, not what has come
        self._filled = 0
        self._message_at = 0
        self._wanted = 0  # size of the whole partial frame; 0 while its header is incomplete
        self._judged = True  # whether the size of its metadata was looked at
        self._skip = 0  # bytes of a refused frame that are still to come

    @property
    def begun(self) -> int:
        """How much has come of a frame that has begun and is not whole; 0 when there is none."""
        return self._filled or len(self._partial)

    @property
    def begun_header(self) -> bytes:
        """What has come of a header that is not whole."""
        return b"" if self._wanted else bytes(self._partial)

    @property
    def partial_bytes(self) -> int:
        """How much memory a frame that has begun has."""
        return len(self._partial)

    def feed(self, data: bytes | bytearray | memoryview) -> list[Frames | WireError]:
        """Take the next bytes of the stream and return the frames that are now whole."""
        frames: list[Frames | WireError] = []
        view = memoryview(data)
        while len(view) and not self.error:
            space = self.space()
            size = min(len(space), len(view))
            space[:size] = view[:size]
            del space  # an exported view would keep the partial frame from growing
            frames += self.advance(size)
            view = view[size:]
        return frames

    def space(self) -> memoryview:
        """Where the next bytes of the stream belong. Never empty; give it back before calling `advance`.

        Never large either: an event loop may fill it many times before anything else gets its turn.
        """
        if not self._wanted:
            return self._scratch[: self._skip] if self._skip else self._scratch
        if self._filled == len(self._partial):
            self._partial.extend(bytes(min(self._wanted, 2 * self._filled) - self._filled))
        return memoryview(self._partial)[self._filled : self._filled + self.SPACE_BYTES]

    def advance(self, size: int) -> list[Frames | WireError]:
        """``size`` bytes were written to the start of `space`: return the frames that are now whole."""
        if self.error:
            return []
        if self._wanted:
            self._filled += size
            if self._filled == self._wanted:
                return [self._finish()]
            return [] if self._judged else self._judge(memoryview(self._partial)[: self._filled])
        if self._skip:
            self._skip -= size
            self._filled = self._filled + size if self._skip else 0
            return []
        if self._partial:  # of a header
            begun = self._partial + self._scratch[:size]
            self._partial = bytearray()
            return self._cut(begun, len(begun))
        return self._cut(self._received, size)

    def _cut(self, data: bytearray, end: int) -> list[Frames | WireError]:
        """Cut whole frames off ``data`` up to ``end`` and keep the rest as the beginning of the next one. What is kept
        is copied, once."""
        layout = self.layout
        header_bytes = layout.header_bytes
        sizes_at = layout.destination_bytes
        frames: list[Frames | WireError] = []
        view = memoryview(data)
        start = 0
        while end - start >= header_bytes:
            management_bytes, message_bytes = SIZES.unpack_from(data, start + sizes_at)
            message_at = header_bytes + management_bytes
            size = message_at + message_bytes
            if size > self.max_frame_bytes:
                self.error = FrameTooLarge(size, self.max_frame_bytes)
                return frames
            if management_bytes > CONFIGURATION_BYTES:
                frames.append(TooLong("management data", management_bytes, CONFIGURATION_BYTES))
                self._skip_rest(size, end - start)
                start = min(start + size, end)
                continue
            stop = start + size
            if stop > end:
                return [*frames, *self._begin(view[start:end], size, message_at)]
            try:
                body_at = data_at(data, start + message_at, stop)
            except WireError as error:
                frames.append(error.with_traceback(None))
                start = stop
                continue
            # most frames that begin differently differ in their headers, which are short
            following = data[stop : stop + header_bytes]
            if self.runs and not management_bytes and following == data[start : start + header_bytes]:
                stop = run_end(data, start, body_at, size, min(end, start + RUN_BYTES))
            piece = bytes(view[start:stop])
            if stop - start == size:
                frames.append(Frame(piece, layout, message_at, body_at - start))
            else:
                frames.append(Run(piece, layout, message_at, body_at - start, size))
            start = stop
        if start != end:
            self._partial = bytearray(view[start:end])
        return frames

    def _begin(self, data: memoryview, wanted: int, message_at: int) -> list[Frames | WireError]:
        """Keep the beginning of a frame, unless it says enough already to be refused."""
        begun = len(data)
        self._partial = bytearray(min(wanted, max(2 * begun, self.PARTIAL_BYTES)))
        self._partial[:begun] = data
        self._filled = begun
        self._message_at = message_at
        self._wanted = wanted
        self._judged = False
        return self._judge(data)

    def _judge(self, data: memoryview) -> list[Frames | WireError]:
        """Look at the size of the metadata of the partial frame as soon as it has come."""
        at = self._message_at
        if len(data) < at + 4:
            return []
        self._judged = True
        metadata_bytes = U32.unpack_from(data, at)[0]
        if not METADATA_BYTES < metadata_bytes <= self._wanted - at - MESSAGE_OVERHEAD:  # else its sizes do not add up
            return []
        self._skip_rest(self._wanted, len(data))
        return [TooLong("metadata", metadata_bytes, METADATA_BYTES)]

    def _skip_rest(self, size: int, available: int) -> None:
        """Let go of a frame of which so much is there."""
        self._skip = max(0, size - available)
        self._filled = available if self._skip else 0
        self._wanted = 0
        self._partial = bytearray()

    def _finish(self) -> Frame | WireError:
        data, message_at = self._partial, self._message_at
        self._partial = bytearray()
        self._filled = self._wanted = 0
        try:
            return Frame(data, self.layout, message_at, data_at(data, message_at, len(data)))
        except WireError as error:
            return error.with_traceback(None)


_NO_SIZE = 1 << 31
"""Nobody sends so much: existing programs take it for a negative number. Who waited for it would hear nothing more."""


class Skipped(NamedTuple):
    """A message that was too large: its size, and its metadata."""

    size: int
    metadata: bytes


class MessageDecoder:
    """Cuts the stream that a TCP agent receives into whole messages (they have no header and no outer size).

    With ``skip_large`` a message whose data is too large is let go of unread, for `skipped`; otherwise it is an error.
    """

    def __init__(self, max_message_bytes: int = MAX_FRAME_BYTES, *, skip_large: bool = False) -> None:
        self.max_message_bytes = max_message_bytes
        self.skipped: list[Skipped] = []
        """Messages that were too large; whoever reads takes them out."""
        self._skip_large = skip_large
        self._skip_bytes = 0
        self._buffer = bytearray()

    def feed(self, data: Buffer) -> list[bytes]:
        """Take the next bytes and return the messages that are now whole. Raises FrameTooLarge."""
        if self._skip_bytes:
            data = memoryview(data)
            skipped = min(self._skip_bytes, len(data))
            self._skip_bytes -= skipped
            data = data[skipped:]
        self._buffer += data
        messages = []
        start = 0
        while (size := self._message_size(start)) is not None:
            if size > self.max_message_bytes:
                self.skipped.append(self._metadata_of(start, size))
                self._skip_bytes = max(0, size - (len(self._buffer) - start))
            elif len(self._buffer) - start >= size:
                messages.append(bytes(memoryview(self._buffer)[start : start + size]))
            else:
                break
            start = min(start + size, len(self._buffer))
        del self._buffer[:start]
        return messages

    def _metadata_of(self, at: int, size: int) -> Skipped:
        metadata_bytes: int = U32.unpack_from(self._buffer, at)[0]
        return Skipped(size, bytes(memoryview(self._buffer)[at + 4 : at + 4 + metadata_bytes]))

    def _message_size(self, at: int) -> int | None:
        """Size of the message at ``at``, None while that is not known yet."""
        available = len(self._buffer) - at
        if available < 4:
            return None
        metadata_bytes: int = U32.unpack_from(self._buffer, at)[0]
        self._judge(MESSAGE_OVERHEAD + metadata_bytes)
        if available < MESSAGE_OVERHEAD + metadata_bytes:
            return None
        data_bytes: int = U32.unpack_from(self._buffer, at + 4 + metadata_bytes)[0]
        if not self._skip_large or data_bytes >= _NO_SIZE:
            self._judge(MESSAGE_OVERHEAD + metadata_bytes + data_bytes)
        return MESSAGE_OVERHEAD + metadata_bytes + data_bytes

    def _judge(self, size: int) -> None:
        if size > self.max_message_bytes:
            raise FrameTooLarge(size, self.max_message_bytes)
