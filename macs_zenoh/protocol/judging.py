"""Metadata with its true sender, judged once; of metadata in which only the request id changes, without a JSON parser.

Pure. `judge` is the plain way. `Judge` remembers what is around the request id: when two of a shape were judged alike
in everything else, the next ones are read by their number alone.
"""

from __future__ import annotations

import re
from contextlib import suppress
from typing import NamedTuple

from ..errors import WireError
from .existing import readable
from .messages import Metadata, correct_sender

_REQUEST_ID = re.compile(rb'"requestId":(0|[1-9][0-9]{0,9})(?=[,}])')
_LARGEST = 0xFFFFFFFF
ZERO = ord("0")


class Judged(NamedTuple):
    """Metadata that may go on."""

    metadata: Metadata
    """With its true sender."""
    true: bytes
    """The same as JSON, itself where nothing had to be put right."""
    readable: bool
    """Whether existing programs find in it what we find."""


def judge(raw: bytes, agent_type: int, agent_id: int) -> Judged:
    """What metadata of this sender says. Raises TooLong, BadJson, BadField."""
    metadata = Metadata.decode(raw)
    sender = (metadata.sender_agent_type, metadata.sender_agent_id)
    # written as we write it, there is nothing in it that another reader may take for the sender
    if sender == (agent_type, agent_id) and metadata.encode() == raw:
        return Judged(metadata, raw, True)
    true = correct_sender(raw, agent_type, agent_id)
    if true is not raw:
        metadata = Metadata.decode(true)
    return Judged(metadata, true, readable(true))


class _Shape(NamedTuple):
    metadata: Metadata
    before: bytes
    after: bytes
    """What is around the request id in what goes on."""
    same: bool
    """Whether that is what came."""
    readable: bool

    def numbered(self, raw: bytes, number: bytes) -> Judged:
        """What ``raw`` says, which is of this shape, with this request id in it."""
        usual = self.metadata
        metadata = Metadata(
            usual.sender_agent_type,
            usual.sender_agent_id,
            int(number),
            usual.message_manager,
            usual.node_type,
            usual.node_name,
            usual.data_exchange_type,
            usual.clock,
        )
        return Judged(metadata, raw if self.same else self.before + number + self.after, self.readable)


class Judge:
    """Judges the metadata of one sender. What comes again is looked up; of what was seen with different request ids
    only the number is read."""

    LIMIT = 512
    BYTES = 1024
    """Longer metadata is never remembered: who sends chooses it, and no existing program needs half of that."""

    def __init__(self, agent_type: int, agent_id: int, limit: int = LIMIT) -> None:
        self._sender = agent_type, agent_id
        self._limit = limit
        self._known: dict[bytes, Judged] = {}
        self._shapes: dict[tuple[bytes, bytes], _Shape | None] = {}
        """By what is around the request id; None for what was seen once, or is no shape."""
        self._last: tuple[bytes, bytes, _Shape] | None = None
        """What was around the last request id that only its number was read of: it is the next one's most often."""

    def __call__(self, raw: bytes) -> Judged:
        """`judge`, of this sender."""
        known = self._known.get(raw)
        if known is not None:
            return known
        if len(raw) > self.BYTES:
            return judge(raw, *self._sender)
        if self._last is not None:
            before, after, usual = self._last
            if raw.startswith(before) and raw.endswith(after):
                number = raw[len(before) : len(raw) - len(after)]
                if number.isdigit() and len(number) < 10 and number[0] != ZERO:
                    return usual.numbered(raw, number)
        found = _REQUEST_ID.search(raw)
        if found is None:
            return self._remember(raw, judge(raw, *self._sender))
        at, end = found.span(1)
        around = raw[:at], raw[end:]
        shape = self._shapes.get(around)
        if shape is None:
            judged = self._remember(raw, judge(raw, *self._sender))
            self._learn(around, found[1], judged)
            return judged
        if int(found[1]) > _LARGEST:
            return judge(raw, *self._sender)  # which refuses it
        self._last = *around, shape
        return shape.numbered(raw, found[1])

    def known(self, raw: bytes) -> Judged | None:
        """What these very bytes were judged to be, if that is remembered."""
        return self._known.get(raw)

    def _remember(self, raw: bytes, judged: Judged) -> Judged:
        if len(self._known) >= self._limit:
            self._known.clear()
        self._known[raw] = judged
        return judged

    def _learn(self, around: tuple[bytes, bytes], number: bytes, judged: Judged) -> None:
        """What was seen once is noted; the second time it is tried whether the number changes nothing else."""
        if around not in self._shapes:
            if len(self._shapes) >= self._limit:
                self._shapes.clear()
            self._shapes[around] = None
            return
        shape = _shape(judged, number, around)
        other = b"7" if number != b"7" else b"8"
        if shape is not None:
            with suppress(WireError):  # as far as we know it cannot be: then it is no shape
                if shape == _shape(judge(other.join(around), *self._sender), other, around):
                    self._shapes[around] = shape


def _shape(judged: Judged, number: bytes, around: tuple[bytes, bytes]) -> _Shape | None:
    """What is judged, without its request id; None when that is not the number that was found."""
    metadata, true = judged.metadata, judged.true
    found = _REQUEST_ID.search(true)
    if found is None or found[1] != number or metadata.request_id != int(number):
        return None
    at, end = found.span(1)
    before, after = true[:at], true[end:]
    return _Shape(metadata.numbered(0), before, after, (before, after) == around, judged.readable)
