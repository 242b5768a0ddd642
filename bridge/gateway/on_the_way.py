"""Topics of robots that agents of this gateway receive, and what of them was lost between the robot and here.

Zenoh drops topic data where a link is full or a router is busy, and tells nobody. A robot agent tells behind it how
much it has put (`macs_zenoh.streams`), to nobody who is registered; existing robot programs do not.
"""

from __future__ import annotations

from collections import Counter
from typing import NamedTuple

from macs_zenoh.losses import Losses
from macs_zenoh.protocol.came import Came
from macs_zenoh.protocol.messages import Metadata, NodeType, decode_data
from macs_zenoh.protocol.registrations import AgentKey
from macs_zenoh.protocol.robot_state import StreamCount

SUBSCRIBER = int(NodeType.SUBSCRIBER)
BEFORE = "before_gateway"
KNOWN = ("topics_behind", "loop_behind", "missed")
"""By these names the session counts what did come, or was known to be missing."""


class Stream(NamedTuple):
    """Topic data of one robot under one node, and who of ours is registered there."""

    robot: AgentKey
    node: str
    registrants: set[AgentKey]
    came: Came

    @classmethod
    def of(cls, robot: AgentKey, node: str, registrants: set[AgentKey], known: Stream | None) -> Stream:
        """One that is listened to, for as long as it was ``known``."""
        return cls(robot, node, registrants, known.came if known is not None else Came())

    def carries(self, metadata: Metadata) -> bool:
        """Whether metadata is of this node; who sent it is looked at before."""
        return metadata.node_name == self.node and metadata.node_type == SUBSCRIBER


class OnTheWay:
    """What was lost of all streams, counted in ``drops``; ``session`` has the losses of the session."""

    def __init__(self, drops: Losses, session: Counter[str]) -> None:
        self._drops = drops
        self._session = session
        self._not_come = 0

    def told(self, key: str, stream: Stream, data: bytes) -> None:
        """A robot has told how much it has put. Raises WireError."""
        stream.came.samples -= 1  # that was none
        self._not_come += stream.came.count(decode_data(StreamCount, data))
        more = self._not_come - sum(self._session[name] for name in KNOWN) - self._drops[BEFORE]
        if more > 0:
            self._drops.once(BEFORE, "%s: some of what the robot puts does not come here", key, about=key, count=more)
