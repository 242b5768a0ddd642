"""What a check of a router is tried with: agents of one check, closed behind it, and what arrives at each."""

from __future__ import annotations

import itertools
import secrets
from collections.abc import Awaitable, Callable
from types import TracebackType
from typing import Any, NamedTuple

from .. import vectors
from ..agents import Agent, Received
from ..checks import Check, Level, NotHeld, NotTried
from ..vectors import Value

_numbers = itertools.count(1)


class Scene:
    """The agents of one check at the router under test."""

    def __init__(self, host: str, port: int, patience_s: float, group: int) -> None:
        self.patience_s = patience_s
        self.group = group
        self._place = (host, port)
        self._agents: list[Agent] = []
        self._run = secrets.token_hex(4)

    async def __aenter__(self) -> Scene:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for agent in self._agents:
            await agent.close()

    def word(self) -> str:
        """A text that nobody else says: others may use the router as well."""
        return f"{self._run}-{next(_numbers)}"

    async def connect(self, *, greeted: bool = True) -> Agent:
        """A connection that has its id, and has not said who it is."""
        agent = await Agent.open(*self._place, self.patience_s)
        self._agents.append(agent)
        if greeted:
            await agent.first()
        return agent

    async def headset(self, group: int = 0, configuration: str = "configuration") -> Agent:
        """A headset that is online."""
        agent = await self.connect()
        agent.group = group
        await agent.say(configuration)
        await self.settled(agent)
        return agent

    async def settled(self, agent: Agent) -> None:
        """Wait until others can reach it. Raises NotHeld."""
        for _ in range(50):
            if agent.id in (await self.online(agent))["unityAgentIds"]:
                return
        raise NotHeld(f"headset {agent.id} is not among those who are online, after its configuration")

    async def robot(self, group: int = 0, configuration: str = "configuration") -> Agent:
        """A robot that is online. Raises NotTried where none is let in."""
        agent = await self.connect()
        agent.kind, agent.group = 1, group
        others = set((await self.online(await self.headset()))["rosAgentIds"])
        await agent.say(configuration)
        asker = await self.headset()
        for _ in range(50):
            if agent.ended:
                break
            online = set((await self.online(asker))["rosAgentIds"])
            if agent.id in online:
                return agent
            if len(online - others) == 1:  # a router may give robots ids that it keeps for them
                agent.id = (online - others).pop()
                return agent
        raise NotTried("it lets no robot in (macs gateway --robots any)")

    async def online(self, agent: Agent, request: str = "online_request", number: int = 5) -> dict[str, Any]:
        """What the router answers to who asks who is online. Raises NotHeld."""
        await agent.say(request, number=number)
        answer = await agent.wait(lambda message: "unityAgentIds" in message.json(), "who is online")
        found = answer.json()
        if not all(isinstance(found.get(key), list) for key in ("rosAgentIds", "unityAgentIds")):
            raise NotHeld(f"who is online was answered with {answer.data[:200]!r}")
        return found

    async def sends(self, sender: Agent, receiver: Agent, name: str, **values: Value) -> list[Received]:
        """What arrives of a vector: the receiver's messages with its text, before another message to it by id."""
        word = self.word()
        frame = sender.frame(
            name, **{"peer": receiver.id, "group": receiver.group or self.group, "text": word, **values}
        )
        return await self.puts(sender, receiver, frame, word)

    async def puts(self, sender: Agent, receiver: Agent, frame: bytes, word: str = "") -> list[Received]:
        """The same for bytes; with no ``word`` everything that comes but news of who has left."""
        await sender.send(frame)
        return await self.fence(sender, receiver, word)

    async def fence(self, sender: Agent, receiver: Agent, word: str = "") -> list[Received]:
        """What has come to a headset before a message that is sent to it now. Raises NotHeld without that."""
        last = self.word()
        await sender.send(_plain(sender, receiver, last))
        before: list[Received] = []

        def is_last(message: Received) -> bool:
            if last.encode() in message.data:
                return True
            before.append(message)
            return False

        await receiver.wait(is_last, "a message to a headset by its id")
        marked = [message for message in before if word.encode() in message.data]
        return [message for message in marked if message.manager != GONE]


GONE = "PrunedUnityAgentsInterfaceNodesCleaner"


def _plain(sender: Agent, receiver: Agent, text: str) -> bytes:
    return vectors.fill("headset_frames", "unicast", id=sender.id, agent_type=sender.kind, peer=receiver.id, text=text)


Run = Callable[[Scene], Awaitable[None]]


class Trial(NamedTuple):
    """A check and how it is tried."""

    check: Check
    run: Run


class Trials(list[Trial]):
    """The checks of one module, in their order."""

    def add(self, name: str, about: str, level: Level = Level.COMPATIBLE) -> Callable[[Run], Run]:
        """Decorates the coroutine that tries it: it raises NotHeld or NotTried, or it holds."""

        def keep(run: Run) -> Run:
            self.append(Trial(Check(name, about, level), run))
            return run

        return keep


def expect(held: object, seen: str) -> None:
    """Raises NotHeld with what was seen unless it holds."""
    if not held:
        raise NotHeld(seen)


def expect_copies(arrived: list[Received], copies: int) -> None:
    """Raises NotHeld unless so many messages have come."""
    if len(arrived) != copies:
        what = f", the first {arrived[0].raw[:200]!r}" if arrived else ""
        raise NotHeld(f"{len(arrived)} came, {copies} should have{what}")
