"""One router, or the path from one to another: everybody's sessions there, what they say, and what is heard.

Zenoh says nothing when it refuses. So nothing waits for a time: every session first listens, then everything is said
at once, and then a message that each node may send to itself follows the others through the same queues. When it is
there, what has not come was refused.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator
from contextlib import AsyncExitStack
from pathlib import Path

from bridge.security import access
from bridge.security.attempts import MARK, Attempt, Attempts, Question, Result, token
from bridge.security.expected import Expected, agent_of, presence_of, sender_of
from bridge.security.files import client_overrides
from bridge.security.policy import Client, Gateway, Operator, Policy, Robot
from macs_zenoh.config import MeshSettings
from macs_zenoh.errors import Refused, Unreachable
from macs_zenoh.mesh import Mesh, Sample, Subscription
from macs_zenoh.protocol import keyexpr
from macs_zenoh.protocol.keyexpr import (
    BROADCAST,
    CALL,
    CALLS,
    GROUP,
    LAST,
    LEASE,
    NAME,
    NAMED,
    NAMED_ALL,
    PING,
    PRESENCE,
    STREAM,
    UNICAST,
    WANTED,
)
from macs_zenoh.protocol.messages import ROS, UNITY
from macs_zenoh.protocol.rmw_zenoh.keyexpr import probe_key
from macs_zenoh.protocol.wire import PROBE
from macs_zenoh.sections import changed

BARRIER_S = 5.0
"""How long what everybody may send to itself may take."""
ANSWER_S = 2.0
"""How long a question may stay without an answer that is permitted."""
AT_ONCE = 200

Progress = Callable[[int, int], None]


class RouterPath:
    """Everybody's two sessions: one at the near router that says, one at the far one that listens."""

    def __init__(self, policy: Policy, directory: Path, label: str, near: str, far: str, timeout_s: float) -> None:
        self._policy = policy
        self._directory = directory
        self._label = label
        self._near, self._far = near, far
        self._timeout_s = timeout_s
        self._expected = Expected(policy)
        self._verbs = self._expected.limited_verbs()
        self._tried = Attempts(policy, self._expected, [])
        self._clients = {client.name: client for client in policy.clients}
        self._saying: dict[str, Mesh] = {}
        self._listening: dict[str, Mesh] = {}
        self._attempts: list[Attempt] = []
        self._by_payload: dict[bytes, Attempt] = {}
        self._by_token: dict[str, Attempt] = {}
        self._echoes: dict[bytes, asyncio.Event] = {}
        self._asked: dict[bytes, set[str]] = {}
        self._kept: list[Subscription] = []
        self._results: list[Result] = []

    async def run(self, progress: Progress) -> list[Result]:
        """Try everything."""
        async with AsyncExitStack() as stack:
            await self._open(stack)
            self._tried = Attempts(self._policy, self._expected, self._here)
            await self._listen()
            self._say()
            for number in (1, 2):  # through the senders' queues; then through the receivers', which come behind them
                await self._echo(number)
            for attempt in self._attempts:
                self._results += attempt.results(self._label)
            await self._ask(progress)
        return self._results

    async def _open(self, stack: AsyncExitStack) -> None:
        async def one(name: str, endpoint: str, sessions: dict[str, Mesh]) -> None:
            settings = settings_of(self._policy, self._directory / name, endpoint)
            sessions[name] = await stack.enter_async_context(await Mesh.open_once(settings, timeout_s=self._timeout_s))

        opening = [one(name, self._near, self._saying) for name in self._clients]
        opening += [one(name, self._far, self._listening) for name in self._clients]
        failed = [error for error in await asyncio.gather(*opening, return_exceptions=True) if error is not None]
        for error in failed:
            if not isinstance(error, Unreachable):
                raise error
        if len(failed) == len(opening):
            raise Unreachable(self._label, "no certificate of the policy is let in, or no router is there")
        for name in self._clients:
            inside = name in self._saying and name in self._listening
            self._results.append(Result(self._label, f"{name} is let in", True, inside))
            if not inside:
                self._saying.pop(name, None)
                self._listening.pop(name, None)

    @property
    def _here(self) -> list[Client]:
        return [client for name, client in self._clients.items() if name in self._saying]

    # -- listening -----------------------------------------------------------------------------------------------

    async def _listen(self) -> None:
        keys = self._listened()
        ready = {}
        for name, mesh in self._listening.items():
            for key in keys:
                self._kept.append(mesh.subscribe(key, lambda batch, name=name: self._hear(name, batch)))  # type: ignore[misc]
            for space in (PRESENCE, LEASE, NAME, WANTED):
                self._kept.append(
                    mesh.watch_tokens(space.every(), lambda key, alive, name=name: self._see(name, key))  # type: ignore[misc]
                )
            self._serve(name, mesh)
            # a token that is declared after all that, and seen by the same node elsewhere, has overtaken nothing
            ready_token = token(PRESENCE.every(**presence_of(self._clients[name])), f"ready-{name}")
            ready[name] = asyncio.Event()
            self._kept.append(
                self._saying[name].watch_tokens(ready_token, lambda key, alive, name=name: ready[name].set())  # type: ignore[misc]
            )
            self._kept.append(mesh.declare_token(ready_token))
        await self._all(ready, "sees itself")

    def _listened(self) -> list[str]:
        """What everybody tries to hear: each inbox, group, stream and name, and everything at once."""
        keys = {BROADCAST.every(), NAMED_ALL.every(), PING.of(zid=MARK), keyexpr.EVERYTHING}
        for client in self._policy.clients:
            keys.add(UNICAST.every(**agent_of(client)))
            if isinstance(client, Robot):
                keys.add(STREAM.of(type=ROS, id=client.id, node=MARK))
                if client.ros_namespace:
                    keys.add(probe_key(client.ros_namespace, MARK))
                if client.group:
                    keys.add(GROUP.every(group=client.group, type=ROS))
                if client.awareness_name is not None:
                    keys.add(NAMED.every(name=client.awareness_name))
            else:
                keys.add(GROUP.every(type=UNITY))
            keys.add(PING.of(zid=f"{MARK}-{client.name}"))
        return sorted(keys)

    def _hear(self, name: str, batch: Iterator[Sample]) -> None:
        for _, payload in batch:
            if (attempt := self._by_payload.get(bytes(payload))) is not None:
                attempt.heard.add(name)
            elif (echo := self._echoes.get(bytes(payload))) is not None and payload.endswith(f" {name}".encode()):
                echo.set()

    def _see(self, name: str, key: str) -> None:
        if (attempt := self._by_token.get(key)) is not None:
            attempt.heard.add(name)

    def _serve(self, name: str, mesh: Mesh) -> None:
        async def answer(key: str, payload: bytes) -> bytes | None:
            if not payload.startswith(PROBE):
                return None  # somebody else's call of a robot that is not there
            self._asked.setdefault(payload, set()).add(name)
            return b""

        def serve(key: str, *, stand_in: bool = False) -> None:
            self._kept.append(mesh.serve(key, answer, stand_in=stand_in))

        for other in self._policy.clients:
            for mark in (MARK, *self._verbs) if other.name == name else (f"{MARK}-{name}",):
                real = mark in self._verbs  # calls of others may come: they are for the robot, if it is there
                if not isinstance(other, Gateway):
                    serve(CALL.every(**agent_of(other), verb=mark), stand_in=real)
                if isinstance(other, Robot):
                    serve(CALLS.every(**agent_of(other), verb=mark), stand_in=real)
                if (called := access.awareness_name(other)) is not None and not real:
                    serve(NAMED.every(name=called, message_type=mark))
                    serve(LAST.every(name=called, message_type=mark))
        serve(PING.of(zid=f"{MARK}-{name}"))

    # -- saying --------------------------------------------------------------------------------------------------

    def _say(self) -> None:
        for client in self._here:
            mesh = self._saying[client.name]
            for attempt in self._tried.tokens_of(client):
                self._attempts.append(attempt)
                self._by_token[attempt.key] = attempt
                self._kept.append(mesh.declare_token(attempt.key))
            for attempt in self._tried.puts_of(client):
                payload = PROBE + f" {len(self._attempts)}".encode()
                self._attempts.append(attempt)
                self._by_payload[payload] = attempt
                mesh.put_unasked(attempt.key, payload)

    async def _echo(self, number: int) -> None:
        """Send to oneself what comes behind everything said so far, and wait for it."""
        events = {}
        for client in self._here:
            if isinstance(client, Operator):
                key = PING.of(zid=f"{MARK}-{client.name}")
            else:
                key = UNICAST.of(**agent_of(client), **sender_of(client))
            payload = PROBE + f" echo {number} {client.name}".encode()
            events[client.name] = self._echoes[payload] = asyncio.Event()
            self._saying[client.name].put_unasked(key, payload)
        await self._all(events, "hears itself")

    async def _all(self, events: dict[str, asyncio.Event], what: str) -> None:
        """Wait for everybody's event. Who may do so little is cut off, and that is a result."""
        waiting = {name: asyncio.ensure_future(event.wait()) for name, event in events.items()}
        if waiting:
            await asyncio.wait(waiting.values(), timeout=BARRIER_S)
        for name, task in waiting.items():
            task.cancel()
            if not events[name].is_set():
                self._results.append(Result(self._label, f"{name} {what}", True, False))

    # -- asking --------------------------------------------------------------------------------------------------

    async def _ask(self, progress: Progress) -> None:
        questions = [(PROBE + f" {number}".encode(), each) for number, each in enumerate(self._tried.questions())]
        answered: set[bytes] = set()
        limit = asyncio.Semaphore(AT_ONCE)
        done = len(self._attempts)
        total = done + len(questions)

        async def ask(payload: bytes, question: Question) -> None:
            nonlocal done
            async with limit:
                if await self._answered(question, payload):
                    answered.add(payload)
            done += 1
            progress(done, total)

        await asyncio.gather(*(ask(payload, question) for payload, question in questions))
        for number in (3, 4):  # behind the questions: who hears one late, on a busy machine, has heard it
            await self._echo(number)
        for payload, question in questions:
            asked = self._asked.get(payload, set())
            if question.impostor is not None:
                seen = question.impostor in asked
            else:
                seen = payload in answered or (bool(asked) and not question.permitted)
            self._results.append(Result(self._label, question.what, question.permitted, seen, question.key))

    async def _answered(self, question: Question, payload: bytes) -> bool:
        """Ask it: once more, with as much time as a session has to come in, where an answer is permitted and does not
        come. A machine or a link may be busy; that something is refused is said of a site only when it is."""
        asker = self._saying[question.asker]
        if await _answered(asker, question.key, payload, ANSWER_S):
            return True
        return question.permitted and await _answered(asker, question.key, payload, self._timeout_s)


async def _answered(mesh: Mesh, key: str, payload: bytes, timeout_s: float) -> bool:
    """Whether anybody answers, be it with a refusal: our programs refuse what has no frame, and do nothing."""
    if key.startswith("@"):
        return bool(await mesh.ask_all(key, timeout_s=timeout_s))
    try:
        await mesh.query(key, payload, timeout_s=timeout_s)
    except Refused:
        return True
    except Unreachable:
        return False
    return True


def settings_of(policy: Policy, directory: Path, endpoint: str) -> MeshSettings:
    """A node's session for the check: its certificate, and what the policy says of every link."""
    return changed(
        policy.mesh,
        connect=[endpoint],
        namespace=policy.namespace,
        overrides=client_overrides(str(directory.resolve())),
    )
