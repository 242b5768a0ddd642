"""Who is online, followed on the mesh: tokens, our own link, and the time that a return may take. Asyncio.

Agents and gateways see the same mesh through this one class; `directory` has the rules.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence

from .anew import AT_ONCE, Anew
from .deadline import Deadline
from .mesh import GatheredTokens, Mesh, Subscription, Token
from .mesh.followed import CONFIRM_S
from .protocol.directory import AgentInfo, Change, Directory
from .protocol.keyexpr import PRESENCE

log = logging.getLogger("macs.presence")

CONTESTED_S = 0.05
"""Pause between two looks at what is contested: each costs what all of it costs, and a merge changes it in steps."""

Contested = Mapping[tuple[int, int], list[str]]
"""What this session holds and others hold as well: (type, id) and the others' Zenoh ids."""


class Presence:
    """The `directory` of one session, kept up to date.

    ``on_changes`` hears who came and left, several at a time where they came together (a merge of two sites brings
    hundreds); ``on_contested`` all that others claim of what is ours, whenever there may be news of that.
    """

    def __init__(
        self, mesh: Mesh, on_changes: Callable[[list[Change]], None], on_contested: Callable[[Contested], None]
    ) -> None:
        self.directory = Directory(mine=mesh.zid)
        self._mesh = mesh
        self._gathered = GatheredTokens(mesh.declare_token)
        self._on_changes = on_changes
        self._on_contested = on_contested
        self._changes: list[Change] = []
        self._change = asyncio.Event()
        self._was_contested = False
        self._looking: asyncio.TimerHandle | None = None
        self._news: deque[tuple[str, bool]] = deque()
        self._handling: asyncio.Handle | None = None
        self._left_out = 0
        self._anew = Anew(mesh, [PRESENCE.every()], self._again)
        self._sweep = Deadline(self._let_go)
        self._watching: Subscription | None = None
        self._unseen: set[str] = set()
        self._confirming: asyncio.Task[None] | None = None

    async def start(self) -> None:
        """Follow from now on; whoever is online is known when this returns.

        It asks before it watches: while a watcher's first news are on their way, an answer may leave some out (seen
        with Zenoh 1.10.2 in every second attempt).
        """
        self._mesh.on_link(self._link)
        self._unseen = set(await self._mesh.tokens(PRESENCE.every()))
        self._watching = self._mesh.watch_tokens(PRESENCE.every(), self._watched)
        for key in self._unseen:
            self._token(key, True)
        self._tell()
        self._confirming = asyncio.get_running_loop().create_task(self._confirm())

    async def _confirm(self) -> None:
        """Let go of who left between the answer and the watcher's beginning. It asks twice: under load an answer can
        be empty."""
        await asyncio.sleep(CONFIRM_S)
        for _ in range(2):
            if self._unseen:
                self._unseen.difference_update(await self._mesh.tokens(PRESENCE.every()))
        for key in self._unseen:
            self._token(key, False)
        self._unseen.clear()
        self._tell()

    def _watched(self, key: str, alive: bool) -> None:
        """A token came or ended. Those that come together are handled in pieces, between which others have their turn:
        one session can have thousands."""
        if not alive:
            self._anew.ended(key)
        self._news.append((key, alive))
        if self._handling is None:
            self._handling = asyncio.get_running_loop().call_soon(self._handle)

    def _handle(self) -> None:
        self._handling = None
        for _ in range(min(len(self._news), AT_ONCE)):
            key, alive = self._news.popleft()
            self._unseen.discard(key)
            self._changes += self.directory.token(key, alive, time.monotonic())
        if self._news:
            self._handling = asyncio.get_running_loop().call_soon(self._handle)
        self._tell()

    def _again(self, keys: Sequence[str]) -> None:
        """Tokens that may have been left out. Those of who is known are old news, maybe of an earlier group."""
        for key in keys:
            if not self.directory.knows(key):
                self._token(key, True)
        self._tell()

    def close(self) -> None:
        """Follow no more."""
        self._gathered.close()
        if self._watching is not None:
            self._watching.close()
        for handle in (self._handling, self._looking, self._confirming):
            if handle is not None:
                handle.cancel()
        self._sweep.cancel()
        self._anew.close()

    def declare(
        self, agent_type: int, agent_id: int, group: int, epoch: int = 0, *, asleep: int = 0, gather: bool = False
    ) -> Token:
        """Be online under this id, until the token is closed. Subscribe the inbox before: who is seen is sent to.

        ``epoch`` is another one than that of who had the id in this session before, ``asleep`` for each time that its
        connection has ended. ``gather``: when it is its turn among many that come within moments, or with
        `declare_now`.
        """
        key = AgentInfo(agent_type, agent_id, group, self._mesh.zid, epoch, asleep).presence
        return self._gathered.declare(key) if gather else self._mesh.declare_token(key)

    def declare_now(self, token: Token) -> None:
        """Let the agent with this token be online before its turn."""
        self._gathered.declare_now(token)

    def unseen(self, token: Token) -> AgentInfo | None:
        """The agent with this token, while it is not online yet since it is not its turn."""
        key = self._gathered.waiting(token)
        return None if key is None else AgentInfo.parse(key)

    def elsewhere(self, agent_type: int) -> list[AgentInfo]:
        """The online agents of a type whose token is not only ours."""
        return [agent for agent in self.directory.of_type(agent_type) if agent.zid != self._mesh.zid]

    def contested(self) -> Contested:
        """All that others claim now of what is ours."""
        return self.directory.contested(self._mesh.zid)

    async def change(self) -> None:
        """Wait until somebody comes or leaves."""
        self._change.clear()
        await self._change.wait()

    def _token(self, key: str, alive: bool) -> None:
        self._changes += self.directory.token(key, alive, time.monotonic())

    def _link(self, up: bool) -> None:
        self.directory.link(up, time.monotonic())
        self._schedule_sweep()

    def _tell(self) -> None:
        room = self.directory.room
        if more := room.left_out - self._left_out:
            self._left_out = room.left_out
            text = (
                "more than %d agents of one session, %d sessions of one agent or %d claims in all: some do not count"
            )
            most = Directory.PER_SESSION, Directory.PER_AGENT, Directory.IN_ALL
            self._mesh.drops.once("too_many_claims", text, *most, about="presence", count=more)
        if room.is_made():
            self._anew.ask()
        changes, self._changes = self._changes, []
        if changes:
            self._change.set()
            self._on_changes(changes)
        if self._looking is None and (self.directory.is_contested or self._was_contested):
            self._looking = asyncio.get_running_loop().call_later(CONTESTED_S, self._look)
        self._schedule_sweep()

    def _look(self) -> None:
        self._looking = None
        contested = self.contested()
        self._was_contested = bool(contested)
        self._on_contested(contested)

    def _schedule_sweep(self) -> None:
        self._sweep.set(self.directory.next_deadline())

    def _let_go(self) -> None:
        self._changes += self.directory.tick(time.monotonic())
        self._tell()
