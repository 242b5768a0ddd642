"""The TCP agents of one gateway: connections by id, and who of them is online in which group."""

from __future__ import annotations

from collections.abc import Iterator, KeysView

from macs_zenoh.mesh import Token
from macs_zenoh.protocol.directory import AgentInfo
from macs_zenoh.protocol.ids import Epochs
from macs_zenoh.protocol.messages import UNITY
from macs_zenoh.protocol.registrations import AgentKey

from .connection import Connection

Group = tuple[int, int]
"""(agent type, group id)."""


class Agents:
    """Every connection from its handshake on. An agent is *online* once it has told its type and group."""

    def __init__(self) -> None:
        self._by_id: dict[int, Connection] = {}
        self._tokens: dict[Connection, Token] = {}
        self._ended: list[Token] = []
        """Of those who have left just now."""
        self._groups: dict[Group, set[Connection]] = {}
        self._group_of: dict[Connection, Group] = {}
        self.former: dict[AgentKey, Connection] = {}
        """Who had an id until a moment ago: answers to it may be on their way."""
        self._epochs = Epochs()

    def __len__(self) -> int:
        return len(self._by_id)

    @property
    def ids(self) -> KeysView[int]:
        """Ids that our connections have."""
        return self._by_id.keys()

    def connections(self) -> list[Connection]:
        """All connections."""
        return list(self._by_id.values())

    def online(self) -> Iterator[Connection]:
        """Those that are configured."""
        return iter(list(self._tokens))

    def enter(self, agent_id: int, connection: Connection) -> None:
        """A connection was given an id."""
        self._by_id[agent_id] = connection

    def join(self, connection: Connection, token: Token) -> tuple[Token | None, Group | None]:
        """An agent told its type and group, maybe another one than before; its presence is ``token``.

        Returns its presence before, for the caller to close, and a group that has lost its last member.
        """
        before, emptied = self._unjoin(connection)
        self._tokens[connection] = token
        if connection.peer.group:
            group = (connection.peer.agent_type, connection.peer.group)
            self._group_of[connection] = group
            self._groups.setdefault(group, set()).add(connection)
        return before, emptied if emptied not in self._groups else None

    def epoch(self, connection: Connection) -> int:
        """Which of those that had its id it is, as others see it."""
        return self._epochs.of(connection.key, connection.peer.connection_number)

    def group_of(self, connection: Connection) -> int:
        """The group that others see an agent in, 0 for none: while it changes often, not always the last one."""
        return self._group_of.get(connection, (0, 0))[1]

    def renumber(self, connection: Connection, agent_id: int) -> None:
        """An agent has another id from now on; its former one stays known until `forget_former`."""
        self.former[connection.key] = connection
        del self._by_id[connection.agent_id]
        self._by_id[agent_id] = connection
        connection.peer.renumber(agent_id)

    def presence(self, connection: Connection) -> Token | None:
        """Of an online agent."""
        return self._tokens.get(connection)

    def replace_token(self, connection: Connection, token: Token) -> Token:
        """The presence of an online agent is ``token`` now. Returns the one before, for the caller to close."""
        before, self._tokens[connection] = self._tokens[connection], token
        return before

    def forget_former(self, agent: AgentKey, connection: Connection) -> None:
        """Nobody answers this agent under its former id any more."""
        if self.former.get(agent) is connection:
            del self.former[agent]

    def needs_block(self, agent_id: int) -> bool:
        """Whether this id is a headset's, or may become one's: those are reached through their block."""
        connection = self._by_id.get(agent_id)
        return connection is not None and connection.peer.agent_type in (0, UNITY)

    def leave(self, connection: Connection) -> tuple[bool, Group | None]:
        """A connection ended; its presence does with `end_presences`. Returns whether it was online, and a group that
        lost its last member."""
        self._by_id.pop(connection.agent_id, None)
        token, emptied = self._unjoin(connection)
        if token is not None:
            self._ended.append(token)
        return token is not None, emptied

    def end_presences(self) -> None:
        """Those of all who have left end, together: one by itself wakes Zenoh's sending thread, and is a
        packet of its own."""
        ended, self._ended = self._ended, []
        for token in ended:
            token.close()

    def never_mind(self, agent_id: int) -> None:
        """Who was given this id is an agent that has another one."""
        self._by_id.pop(agent_id, None)

    def find(self, agent_type: object, agent_id: object) -> Connection | None:
        """The online agent with this type and id, if it is ours."""
        connection = self._by_id.get(agent_id)  # type: ignore[call-overload]
        if connection in self._tokens and connection.peer.agent_type == agent_type:
            return connection  # type: ignore[no-any-return]
        return None

    def is_here(self, agent: AgentInfo, zid: str) -> bool:
        """Whether it is one of ours, whose session that is: when its presence changes twice in a moment, it can seem
        to be gone."""
        connection = self.find(agent.type, agent.id) if agent.zid == zid else None
        return connection is not None and self.epoch(connection) == agent.epoch

    def members(self, agent_type: int, group: int) -> list[Connection]:
        """Our online agents of a type in a group."""
        return list(self._groups.get((agent_type, group), ()))

    def _unjoin(self, connection: Connection) -> tuple[Token | None, Group | None]:
        token = self._tokens.pop(connection, None)
        group = self._group_of.pop(connection, None)
        if group is None:
            return token, None
        members = self._groups[group]
        members.discard(connection)
        if members:
            return token, None
        del self._groups[group]
        return token, group
