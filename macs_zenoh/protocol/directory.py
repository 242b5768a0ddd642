"""Who is online, as told by presence tokens. Pure: tokens and link changes in, joins and leaves out.

A watcher that loses its own router is told that everybody left. So while the link is down, and for ``grace_s`` after
it came back, a token that ends is only remembered; its agent leaves when the grace is over and it has not returned.
"""

from __future__ import annotations

from collections.abc import Iterator
from hashlib import blake2b
from typing import NamedTuple

from .agent_id import AgentId
from .keyexpr import PRESENCE, type_name
from .messages import ROS
from .room import Room

EPOCH = "."
"""Between a Zenoh id and an epoch. No Zenoh id has one."""
ASLEEP = ".asleep"
"""Behind an epoch, and before a number. Programs from before there were sessions do not know such a key: for them the
agent has left."""


def published(zid: str) -> str:
    """What a Zenoh id is in our keys. Whoever knows the id itself could open a session with it while a router starts
    again, and so keep out whose it is."""
    return blake2b(zid.encode(), digest_size=16, person=b"macs session").hexdigest()


class AgentInfo(NamedTuple):
    """One agent as the mesh sees it.

    ``type`` is the number; ``group`` 0 means none. ``zid`` is the Zenoh session that declared it, the agent's own or
    its gateway's, as it is `published`. ``epoch`` tells those apart that had this id in that session one after the
    other (`ids.Epochs`): what belongs to one of them does not belong to the next. ``asleep``, if it is not 0: its
    connection has ended for the so many-th time, and it is expected back; nothing that it does goes on.
    """

    type: int
    id: int
    group: int
    zid: str
    epoch: int = 0
    asleep: int = 0

    @classmethod
    def parse(cls, key: str) -> AgentInfo | None:
        """Of a presence key; None for other keys."""
        fields = PRESENCE.parse(key)
        if fields is None:
            return None
        session, _, asleep = fields.zid.partition(ASLEEP)
        zid, _, epoch = session.partition(EPOCH)
        for number in (epoch, asleep):
            if number and not (number.isascii() and number.isdigit() and len(number) < 20):
                return None
        return cls(fields.type, fields.id, fields.group, zid, int(epoch or 0), int(asleep or 0))

    @property
    def presence(self) -> str:
        """The key of its token."""
        session = f"{self.zid}{EPOCH}{self.epoch}" if self.epoch else self.zid
        if self.asleep:
            session += f"{ASLEEP}{self.asleep}"
        return PRESENCE.of(type=self.type, id=self.id, group=self.group, zid=session)

    @property
    def session(self) -> tuple[str, int]:
        """Who it is among all that have or had its id."""
        return (self.zid, self.epoch)

    @property
    def type_name(self) -> str:
        """``ros``, ``unity`` or the number."""
        return type_name(self.type)

    @property
    def key(self) -> AgentId:
        """What identifies the agent: type and id."""
        return AgentId(self.type, self.id)


class Change(NamedTuple):
    """An agent came (or changed its group) or left."""

    agent: AgentInfo
    online: bool
    same: bool = False
    """Whether it fell asleep or is awake again, and all else is as it was."""


class Directory:
    """Everybody online. Several sessions may claim one (type, id), as after two parts of a mesh met that had both
    given it out; the smallest Zenoh id's claim counts, so that everybody who sees them all sees the same. A claim in
    doubt counts last: it may be of an earlier life.

    There is `room` for so many claims. A robot that nobody else claims to be is there however many others there are:
    who is not there is not asked to stop. ``mine`` is the own Zenoh id.
    """

    PER_SESSION = 16 << 10
    """Agents of one Zenoh session: a gateway has as many as it has connections."""
    PER_AGENT = 16
    """Sessions that claim the same one: where parts of a mesh meet there are two."""
    IN_ALL = 128 << 10
    """Claims of all; there are 64 Ki ids."""

    def __init__(self, grace_s: float = 2.0, *, mine: str = "") -> None:
        self.grace_s = grace_s
        self.room: Room[tuple[int, int]] = Room(
            mine, sessions=self.PER_AGENT, each=self.PER_SESSION, total=self.IN_ALL
        )
        self._claims: dict[tuple[int, int], dict[str, AgentInfo]] = {}
        self._ids: dict[int, set[int]] = {}
        self._contested: set[tuple[int, int]] = set()
        self._doubtful: set[AgentInfo] = set()
        self._linked = True
        self._settled_at = 0.0

    def __len__(self) -> int:
        return len(self._claims)

    def __iter__(self) -> Iterator[AgentInfo]:
        """All agents, by type and id."""
        return (self._current(key) for key in sorted(self._claims))

    def __contains__(self, key: object) -> bool:
        return key in self._claims

    def get(self, agent_type: int, agent_id: int) -> AgentInfo | None:
        """The agent, or None when it is not online."""
        key = (agent_type, agent_id)
        return self._current(key) if key in self._claims else None

    def ids(self, agent_type: int) -> list[int]:
        """Ids of all agents of a type, ascending."""
        return sorted(self._ids.get(agent_type, ()))

    def is_elsewhere(self, agent_id: int, zid: str) -> bool:
        """Whether an agent of any type has this id in another Zenoh session than this one."""
        return any(
            agent_id in ids and not self._claims[kind, agent_id].keys() <= {zid} for kind, ids in self._ids.items()
        )

    def of_type(self, agent_type: int) -> list[AgentInfo]:
        """All agents of a type, by id."""
        return [self._current((agent_type, agent_id)) for agent_id in self.ids(agent_type)]

    def claimants(self, agent_type: int, agent_id: int) -> list[AgentInfo]:
        """Everybody who holds a token for this (type, id): more than one is a conflict."""
        return list(self._claims.get((agent_type, agent_id), {}).values())

    def claims(self) -> list[AgentInfo]:
        """Every claim, by type, id and session: an agent that is there twice is listed twice."""
        return sorted(agent for claims in self._claims.values() for agent in claims.values())

    @property
    def is_contested(self) -> bool:
        """Whether any (type, id) is claimed by several sessions."""
        return bool(self._contested)

    def contested(self, zid: str) -> dict[tuple[int, int], list[str]]:
        """What a session holds and others hold without doubt as well: (type, id) and the others' Zenoh ids."""
        return {
            key: [other for other, claim in self._claims[key].items() if other != zid and claim not in self._doubtful]
            for key in self._contested
            if zid in self._claims[key]
        }

    def token(self, key: str, alive: bool, now: float) -> list[Change]:
        """A presence token appeared or ended. Keys that are no presence keys are ignored."""
        agent = AgentInfo.parse(key)
        if agent is None:
            return []
        if alive:
            return self._claim(agent) if self._has_room(agent) else []
        if not self._linked or now < self._settled_at:
            return self._doubt(agent)
        return self._release(agent)

    def link(self, up: bool, now: float) -> None:
        """Our own connection to the routers was lost, or is back."""
        if up and self._linked:
            return
        self._linked = up
        self._settled_at = now + self.grace_s

    def next_deadline(self) -> float | None:
        """When `tick` has something to do, None when it has not."""
        return self._settled_at if self._doubtful and self._linked else None

    def tick(self, now: float) -> list[Change]:
        """Let agents leave that were in doubt and have not come back within the grace."""
        if not self._linked or now < self._settled_at:
            return []
        changes = [change for agent in sorted(self._doubtful) for change in self._release(agent)]
        self._doubtful.clear()
        return changes

    def knows(self, key: str) -> bool:
        """Whether a token's session is known as that agent, whatever its group; so is what is no presence key."""
        agent = AgentInfo.parse(key)
        return agent is None or agent.zid in self._claims.get(agent.key, ())

    def _has_room(self, agent: AgentInfo) -> bool:
        """Whether a claim counts. Another one may have to go for it."""
        claims = self._claims.get(agent.key, {})
        if agent.zid in claims:
            return True
        out = self.room.take(agent.key, agent.zid, claims, always=agent.type == ROS and not claims)
        if out is not None and out != agent.zid:
            self._doubtful.discard(claims.pop(out))
        return out != agent.zid

    def _current(self, key: tuple[int, int]) -> AgentInfo:
        claims = self._claims[key]
        if len(claims) == 1:
            return next(iter(claims.values()))
        return min(claims.values(), key=lambda claim: (claim in self._doubtful, claim.zid))

    def _doubt(self, agent: AgentInfo) -> list[Change]:
        if self._claims.get(agent.key, {}).get(agent.zid) != agent:
            return []
        before = self._current(agent.key)
        self._doubtful.add(agent)
        current = self._current(agent.key)
        return [] if current == before else [Change(current, online=True)]

    def _claim(self, agent: AgentInfo) -> list[Change]:
        claims = self._claims.setdefault(agent.key, {})
        own = claims.get(agent.zid)
        if own is not None and own.epoch == agent.epoch and 0 < agent.asleep < own.asleep:
            return []  # news of an earlier sleep, which routers bring us of what we said ourselves
        before = self._current(agent.key) if claims else None
        replaced = before is not None and before.zid == agent.zid and before.epoch != agent.epoch
        self._doubtful.discard(agent)
        claims[agent.zid] = agent
        if len(claims) > 1:
            self._contested.add(agent.key)
        self._ids.setdefault(agent.type, set()).add(agent.id)
        current = self._current(agent.key)
        gone = [Change(before, online=False)] if before is not None and replaced else []
        same = before is not None and before._replace(asleep=current.asleep) == current
        return [] if before == current else [*gone, Change(current, online=True, same=same)]

    def _release(self, agent: AgentInfo) -> list[Change]:
        claims = self._claims.get(agent.key, {})
        if claims.get(agent.zid) != agent:
            return []  # already replaced, e.g. by the same agent in another group
        before = self._current(agent.key)
        del claims[agent.zid]
        self.room.release(agent.key, agent.zid)
        if len(claims) < 2:
            self._contested.discard(agent.key)
        if not claims:
            del self._claims[agent.key]
            self._ids[agent.type].discard(agent.id)
            return [Change(agent, online=False)]
        current = self._current(agent.key)
        return [] if current == before else [Change(current, online=True)]
