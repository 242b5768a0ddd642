"""What agents of a gateway are told when what they want is not done, and what of it is recorded: their tokens do not
permit it, or there is no router."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Collection

from macs_zenoh.protocol.messages import AccessRefused, DataRefused, Metadata
from macs_zenoh.protocol.recipient import to_agent
from macs_zenoh.protocol.rights import Grant
from macs_zenoh.protocol.tcp_agent import Event, Forbidden

from .connection import Connection
from .door import Door
from .record import Record

log = logging.getLogger("macs.gateway")

NO_ROUTE = "no_route"
"""As the mesh counts it."""


class Refusing:
    """For the agents of one gateway."""

    def __init__(self, door: Door, record: Record, drops: Counter[str]) -> None:
        self._door = door
        self._record = record
        self._drops = drops

    def tell(self, connection: Connection, refused: AccessRefused) -> None:
        """In a message of its own."""
        connection.send_call(to_agent(refused))

    def not_let_in(self, connection: Connection) -> None:
        """Who joined showed no valid token."""
        count = self._door.failed(connection.entrance, connection.host)
        if count:  # or who knocks all day would push what was done out of the record
            told = "no valid token" if count == 1 else f"no valid token, {count} times by now"
            self._record.address("refused", connection.address, "join", told)
        self.tell(connection, AccessRefused("no_token", "a valid token is wanted here"))

    def request(self, host: str, count: int) -> None:
        """Who showed the web port no valid token has no connection of an agent that would count it."""
        self._drops["NotAdmitted"] += 1
        if count:
            told = "no valid token" if count == 1 else f"no valid token, {count} times by now"
            self._record.address("refused", host, "web request", told)

    def not_resumed(self, connection: Connection) -> None:
        """Who came back as somebody did not show that one's secret."""
        connection.drops["not_resumed"] += 1
        count = self._door.failed(connection.entrance, connection.host, "session of its own", "not_resumed")
        if count:
            self._record.address("refused", connection.address, "resume", f"{count} times by now")

    def forbidden(self, connection: Connection, event: Forbidden) -> None:
        """A message was not let pass: say so, in the way that robots say it to who knows that."""
        about, kind = event.metadata, "not_permitted"
        if not connection.may_tell(
            (about.node_type, about.node_name, about.message_manager, event.robots, event.reason)
        ):
            return
        what = f"type {about.node_type} {about.node_name}" if about.node_name else about.message_manager or "message"
        self._record.agent("message", connection, what, event.reason)
        if not (about.node_name and connection.peer.extensions):
            self.tell(connection, AccessRefused(kind, event.reason, about.request_id))
            return
        self._not_taken(connection, about, event.robots, kind, event.reason)

    def no_router(self, connection: Connection, about: Metadata, robots: Collection[int]) -> None:
        """A command goes nowhere, as this gateway has no router: who holds on would drive on by himself once there is
        one, though the robot has stood still. ``robots`` is empty for those of a group."""
        if connection.peer.extensions and connection.may_tell((NO_ROUTE, about.node_name, tuple(robots))):
            self._not_taken(connection, about, robots, NO_ROUTE, "the gateway has no router now")

    def _not_taken(
        self, connection: Connection, about: Metadata, robots: Collection[int], kind: str, reason: str
    ) -> None:
        """In the place of these robots; 0 stands for those that are not known."""
        topic = connection.peer.topic_of(about.node_type, about.node_name)
        for robot in robots or (0,):
            refused = DataRefused(robot, about.node_type, about.node_name, topic, kind, reason)
            connection.send_call(to_agent(refused))

    def changed(self, connection: Connection, grant: Grant) -> list[Event]:
        """A token has other rights: they hold at once. Returns what comes of that."""
        log.info("%s has other rights: its token %s has changed", connection, grant.name)
        self._record.agent("rights_changed", connection)
        events = connection.peer.rights_change(grant)
        self.tell(connection, AccessRefused("changed", "the rights of this token have changed"))
        return events

    def ended(self, connection: Connection) -> None:
        """A token holds no longer, and so do the connections of who came in by it."""
        self._record.agent("token_ended", connection)
        self.tell(connection, AccessRefused("ended", "this token holds no longer"))
        connection.close("its token holds no longer")
