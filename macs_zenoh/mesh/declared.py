"""What goes over the mesh and how, and what is declared on it."""

from __future__ import annotations

import logging
from collections.abc import Awaitable, Callable, Iterator
from enum import Enum
from typing import Any, Protocol

import zenoh

from .panics import call

log = logging.getLogger("macs.mesh")

Payload = bytes | bytearray


class Outlet(Protocol):
    """What puts with one key go through: a publisher of Zenoh's, or what stands for one."""

    def put(self, payload: Payload) -> None:
        """Publish."""


class Traffic(Enum):
    """How a sample travels: Zenoh priority, what happens when a link is full, and whether it may wait for others."""

    COMMAND = (zenoh.Priority.REAL_TIME, zenoh.CongestionControl.DROP, True)
    """Commands to robots: first in line, never waits, the next one replaces a lost one."""
    CALL = (zenoh.Priority.INTERACTIVE_HIGH, zenoh.CongestionControl.BLOCK, True)
    """Services, management, messages between agents: kept, in order."""
    REGISTRATION = (zenoh.Priority.INTERACTIVE_HIGH, zenoh.CongestionControl.BLOCK, False)
    """As calls, but nobody waits for one so much that it must have a packet of its own: they come in hundreds."""
    STREAM = (zenoh.Priority.DATA, zenoh.CongestionControl.DROP, False)
    """Topic data: dropped when a link is full."""
    PROBE = (zenoh.Priority.BACKGROUND, zenoh.CongestionControl.BLOCK, False)
    """Measurements: after everything else."""
    INSISTING = (zenoh.Priority.REAL_TIME, zenoh.CongestionControl.BLOCK, True)
    """What no program of ours should send: to try whether a router lets it wait."""

    __hash__ = object.__hash__  # Enum's own is a Python call, and each put needs it


Sample = tuple[str, Payload]
"""What a subscription receives: key and payload. Not to be changed: others may have the same payload."""

OnBatch = Callable[[Iterator[Sample]], None]
"""Takes samples one after the other: each leaves the queue when it is asked for."""
Aged = tuple[str, Payload, float, float]
"""Key, payload, how old the sample is in s, and the time now: of what passes a gate."""
OnAged = Callable[[Iterator[Aged]], None]
OnMiss = Callable[[str, int], None]
AtOnce = Callable[[str, Payload], bool]
"""Takes one sample, by key and payload, in a thread of Zenoh's: soon, and without waiting for the loop. False: it has
done nothing, the loop shall."""
Handler = Callable[[str, bytes], Awaitable[bytes | None]]
"""Answers a query, by its key and payload. None: not at all, as if nobody were here."""

Numbered = tuple[str, Payload, str, int]
"""Key, payload, source and number of a sample that its source keeps."""
OnNumbered = Callable[[Iterator[Numbered]], None]


class Subscription:
    """Something declared on the mesh, until `close`. Keep it: Zenoh undeclares what nobody refers to."""

    def __init__(self, *declared: Any) -> None:
        self._declared = declared

    def close(self) -> None:
        """Undeclare it. Closing twice, or after the mesh, is allowed."""
        declared, self._declared = self._declared, ()
        for entity in declared:
            try:
                call(entity.undeclare)
            except zenoh.ZError as error:
                log.debug("undeclare: %s", error)

    @property
    def is_open(self) -> bool:
        """Whether it has not been closed here."""
        return bool(self._declared)

    def become(self, other: Subscription) -> None:
        """Undeclare this and be ``other`` from now on, for whoever holds this."""
        self.close()
        self._declared, other._declared = other._declared, ()


Token = Subscription
"""A liveliness token: it lives until `close`, or until its process is gone."""
