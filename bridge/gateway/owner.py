"""What a connection needs of its gateway."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

from macs_zenoh.protocol.rate_limit import Pace
from macs_zenoh.protocol.tcp_agent import Event, Sent

if TYPE_CHECKING:
    from .connection import Connection


class Owner(Protocol):
    """Takes what a connection brings."""

    def pace(self) -> Pace:
        """What a new connection may send to robots."""

    def opened(self, connection: Connection) -> bool:
        """A socket connected: False refuses it; otherwise it is greeted, now or soon."""

    def forward(self, connection: Connection, sent: Sent) -> None:
        """The agent sent a frame to others."""

    def handle(self, connection: Connection, event: Event) -> None:
        """The agent did something else."""

    def received(self, connection: Connection) -> None:
        """All events of one read were passed on."""

    def sleeps(self, connection: Connection) -> bool:
        """The socket is gone, or nothing comes of it: whether the agent may come back over another. It is asleep
        then."""

    def closed(self, connection: Connection) -> None:
        """The agent is gone."""
