"""Whether running routers hold everybody to a plan: tried, with each node's own certificate.

For each pair of nodes one tries everything: to send by id, by group, to all, on a stream and by name; to call, to
answer, to see and to be seen; in its own name, and in that of each other node. Two sessions for each node, one that
says and one that listens, so each attempt has a known answer from the plan: who must get it, and nobody else.

Zenoh says nothing when it refuses. So nothing waits for a time: every session first listens, then everything is said
at once, and then a message that each node may send to itself follows the others through the same queues. When it is
there, what has not come was refused.

Of a mesh that is in use, this is seen: everybody who listens gets a few `PROBE` payloads, which are not passed on;
robots log one message type that nobody has registered. Calls of verbs that robots have go to the robot where it is
online; elsewhere the check's sessions stand in for it, and answer nobody but the check. Presence tokens have a last
chunk that no program reads.
"""

from __future__ import annotations

import asyncio
import datetime as dt
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import AsyncExitStack
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import NamedTuple

from bridge.security import access, certificates
from bridge.security.expected import Expected, agent_of, inbox_of, presence_of, sender_of
from bridge.security.files import client_overrides
from bridge.security.plan import Client, Gateway, Operator, Plan, Robot
from macs_zenoh.config import MeshSettings, changed
from macs_zenoh.errors import ConfigError, Refused, Unreachable
from macs_zenoh.mesh import Mesh, Sample, Subscription
from macs_zenoh.protocol import endpoints, keyexpr
from macs_zenoh.protocol.keyexpr import (
    BROADCAST,
    CALL,
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
from macs_zenoh.protocol.wire import PROBE

MARK = "macs_check"
"""A topic, a verb and a message type of the check's own."""
UNREAD = "%6Dacs_check"
"""The same as programs do not write it, so that no program takes the key for one of its own."""

BARRIER_S = 5.0
"""How long what everybody may send to itself may take."""
ANSWER_S = 2.0
"""How long a question may stay without an answer that is permitted."""
AT_ONCE = 200
RETRY_S = 0.1

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Result:
    """One attempt and what became of it."""

    router: str
    what: str
    permitted: bool
    """What the plan says."""
    seen: bool
    """What happened."""
    key: str = ""

    @property
    def as_planned(self) -> bool:
        return self.permitted == self.seen

    def as_dict(self) -> dict[str, object]:
        """For programs."""
        return {**asdict(self), "as_planned": self.as_planned}


@dataclass
class Attempt:
    """Something said, and by whom it is heard: as the plan has it, and as it was."""

    what: str
    key: str
    target: str | None
    """For whom it is, where that is one; else everybody is asked about."""
    hearers: dict[str, bool]
    heard: set[str] = field(default_factory=set)

    def results(self, router: str) -> Iterator[Result]:
        for name, permitted in self.hearers.items():
            if name == self.target or (self.target is None):
                yield Result(router, f"{self.what}, heard by {name}", permitted, name in self.heard, self.key)
        others = sorted(name for name in self.heard - {self.target} if not self.hearers.get(name, True))
        if self.target is not None:
            who = f" ({', '.join(others)})" if others else ""
            yield Result(router, f"{self.what}, heard by somebody else{who}", False, bool(others), self.key)


class Question(NamedTuple):
    """Something asked. ``thief``: who must not be asked, however many others answer; None: nobody in particular."""

    asker: str
    what: str
    key: str
    permitted: bool
    thief: str | None = None


async def check(
    plan: Plan,
    directory: Path,
    routers: Sequence[str] | None = None,
    *,
    timeout_s: float = 5.0,
    progress: Progress = lambda done, of: None,
) -> list[Result]:
    """Try everything on each router, and across each link between two.

    Args:
        directory: what `generate` wrote, with everybody's key.
        routers: endpoints to try, one by one; None: those of the plan, and their links.

    Raises Unreachable: a router does not answer. ConfigError: a certificate is not there.
    """
    for client in plan.clients:
        for name in (certificates.CERTIFICATE, certificates.KEY, certificates.AUTHORITY):
            if not (directory / client.name / name).exists():
                raise ConfigError(str(directory / client.name / name), "is not there; run `macs security generate`")
    ways = [(endpoint, endpoint, endpoint) for endpoint in routers or ()]
    if not routers:
        ways = [(router.name, router.dialled[0], router.dialled[0]) for router in plan.routers]
        ways += [
            (f"{one.name} to {other.name}", one.dialled[0], other.dialled[0])
            for one in plan.routers
            for other in access.linked(plan, one)
        ]
    results: list[Result] = []
    for number, (label, near, far) in enumerate(ways):
        one_way = _Way(plan, directory, label, near, far, timeout_s)

        def part(done: int, of: int, number: int = number) -> None:
            progress(number * of + done, len(ways) * of)

        await asyncio.gather(*(_reach(label, endpoint, timeout_s) for endpoint in {near, far}))
        let_in = _refusals(plan, directory, label, near, timeout_s) if near == far else _nothing()
        trying = [asyncio.create_task(one_way.run(part)), asyncio.create_task(let_in)]
        try:
            for found in await asyncio.gather(*trying):
                results += found
        finally:
            for task in trying:
                task.cancel()
            await asyncio.gather(*trying, return_exceptions=True)
    return results


async def _reach(label: str, endpoint: str, timeout_s: float) -> None:
    """Wait until somebody listens there: where nobody does, so many sessions take several times their time to fail.

    Raises Unreachable.
    """
    place = endpoints.address_of(endpoint)
    if place is None or endpoints.protocol_of(endpoint) not in ("tcp", "tls"):
        return

    async def connect() -> None:
        while True:
            try:
                _, writer = await asyncio.open_connection(*place)
            except OSError:
                await asyncio.sleep(RETRY_S)
            else:
                writer.close()
                return

    try:
        await asyncio.wait_for(connect(), timeout_s)
    except asyncio.TimeoutError:
        where = label if label == endpoint else f"{label} at {endpoint}"
        raise Unreachable(where, f"nobody listens there, tried for {timeout_s:g} s") from None


# -- one router, or the way from one to another ------------------------------------------------------------------


class _Way:
    """Everybody's two sessions: one at the near router that says, one at the far one that listens."""

    def __init__(self, plan: Plan, directory: Path, label: str, near: str, far: str, timeout_s: float) -> None:
        self._plan = plan
        self._directory = directory
        self._label = label
        self._near, self._far = near, far
        self._timeout_s = timeout_s
        self._expected = Expected(plan)
        self._verbs = self._expected.limited_verbs()
        self._clients = {client.name: client for client in plan.clients}
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
            settings = settings_of(self._plan, self._directory / name, endpoint)
            sessions[name] = await stack.enter_async_context(await Mesh.open_once(settings, timeout_s=self._timeout_s))

        opening = [one(name, self._near, self._saying) for name in self._clients]
        opening += [one(name, self._far, self._listening) for name in self._clients]
        failed = [error for error in await asyncio.gather(*opening, return_exceptions=True) if error is not None]
        for error in failed:
            if not isinstance(error, Unreachable):
                raise error
        if len(failed) == len(opening):
            raise Unreachable(self._label, "no certificate of the plan is let in, or no router is there")
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
            token = _token(PRESENCE.every(**presence_of(self._clients[name])), f"ready-{name}")
            ready[name] = asyncio.Event()
            self._kept.append(
                self._saying[name].watch_tokens(token, lambda key, alive, name=name: ready[name].set())  # type: ignore[misc]
            )
            self._kept.append(mesh.declare_token(token))
        await self._all(ready, "sees itself")

    def _listened(self) -> list[str]:
        """What everybody tries to hear: each inbox, group, stream and name, and everything at once."""
        keys = {BROADCAST.every(), NAMED_ALL.every(), PING.of(zid=MARK), keyexpr.EVERYTHING}
        for client in self._plan.clients:
            keys.add(UNICAST.every(**inbox_of(client)))
            if isinstance(client, Robot):
                keys.add(STREAM.of(type=ROS, id=client.id, node=MARK))
                if client.group:
                    keys.add(GROUP.every(group=client.group, type=ROS))
                if client.called is not None:
                    keys.add(NAMED.every(name=client.called))
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

        for other in self._plan.clients:
            for mark in (MARK, *self._verbs) if other.name == name else (f"{MARK}-{name}",):
                real = mark in self._verbs  # calls of others may come: they are for the robot, if it is there
                if not isinstance(other, Gateway):
                    serve(CALL.every(**agent_of(other), verb=mark), stand_in=real)
                if (called := access.called(other)) is not None and not real:
                    serve(NAMED.every(name=called, message_type=mark))
                    serve(LAST.every(name=called, message_type=mark))
        serve(PING.of(zid=f"{MARK}-{name}"))

    # -- saying --------------------------------------------------------------------------------------------------

    def _say(self) -> None:
        for client in self._here:
            mesh = self._saying[client.name]
            for attempt in self._tokens_of(client):
                self._attempts.append(attempt)
                self._by_token[attempt.key] = attempt
                self._kept.append(mesh.declare_token(attempt.key))
            for attempt in self._puts_of(client):
                payload = PROBE + f" {len(self._attempts)}".encode()
                self._attempts.append(attempt)
                self._by_payload[payload] = attempt
                mesh.put_unasked(attempt.key, payload)

    def _puts_of(self, client: Client) -> Iterator[Attempt]:
        for name in self._here:
            for what, key, target, hearers in self._puts_as(name):
                really = self._expected.speaks_as(client, name)
                heard_by = {other.name: really and other in hearers for other in self._here}
                if target is None:
                    heard_by.pop(name.name)  # it has its own words already
                pretending = "" if name is client else f" as {name.name}"
                yield Attempt(f"{client.name} puts{pretending} {what}", key, target, heard_by)
        at_once = UNICAST.every(type=ROS, **sender_of(client))
        nobody = {other.name: False for other in self._here}
        yield Attempt(f"{client.name} puts to every robot at once", at_once, None, nobody)

    def _puts_as(self, name: Client) -> Iterator[tuple[str, str, str | None, list[Client]]]:
        """What somebody may put, or who pretends to be him: in words, the key, for whom, and who may hear it."""
        expected, sender, here = self._expected, sender_of(name), self._here
        reached = [other for other in here if expected.reaches(name, other)]
        for receiver in here:
            key = UNICAST.of(**inbox_of(receiver), **sender)
            hearers = [other for other in here if receiver in reached and expected.has_inbox(other, receiver)]
            yield f"to {receiver.name} by id", key, receiver.name, hearers
        for group in sorted({robot.group for robot in self._plan.robots if robot.group}):
            key = GROUP.of(group=group, type=ROS, **sender)
            hearers = [other for other in reached if isinstance(other, Robot) and other.group == group]
            yield f"to robots of group {group}", key, None, hearers
        if self._plan.gateways:
            key = GROUP.every(type=UNITY, **sender).replace("*", MARK)
            yield "to a group of headsets", key, None, [other for other in reached if isinstance(other, Gateway)]
        yield "to all", BROADCAST.of(**sender), None, reached
        if isinstance(name, Robot):
            key = STREAM.of(type=ROS, id=name.id, node=MARK)
            yield "on a stream", key, None, [other for other in here if self._plan.may(other, "see", name)]
        if (by := access.called(name)) is None:
            return
        friends = [other for other in here if expected.writes_to(name, other)]
        for receiver in here:
            if (called := access.called(receiver)) is not None and receiver is not name:
                key = NAMED.of(name=called, message_type=MARK, from_name=by)
                yield f"to {receiver.name} by name", key, receiver.name, [receiver] if receiver in friends else []
        yield "by name to all", NAMED_ALL.of(message_type=MARK, from_name=by), None, friends

    def _tokens_of(self, client: Client) -> Iterator[Attempt]:
        expected = self._expected
        for name in self._here:
            really = expected.speaks_as(client, name)
            mark = f"{name.name}-by-{client.name}"
            pretending = "" if name is client else f" as {name.name}"
            sees = {other.name: really and expected.sees(other, name) for other in self._here}
            knows = {other.name: really and expected.knows_name(other, name) for other in self._here}
            leases = {other.name: really and not isinstance(other, Robot) for other in self._here}
            yield Attempt(
                f"{client.name} is online{pretending}",
                _token(PRESENCE.every(**presence_of(name)), mark),
                None,
                sees,
            )
            if isinstance(name, Gateway):
                block = name.blocks[-1] if name.blocks else 255
                yield Attempt(
                    f"{client.name} leases block {block}{pretending}",
                    _token(LEASE.every(block=block), mark),
                    None,
                    leases,
                )
            if isinstance(name, Robot) and name.called is not None:
                yield Attempt(
                    f"{client.name} is called {name.called}{pretending}",
                    _token(NAME.every(name=name.called, type=ROS, id=name.id), mark),
                    None,
                    knows,
                )
                yield Attempt(
                    f"{client.name} takes messages{pretending}",
                    _token(WANTED.every(name=name.called, message_type=MARK), mark),
                    None,
                    knows,
                )

    async def _echo(self, number: int) -> None:
        """Send to oneself what comes behind everything said so far, and wait for it."""
        events = {}
        for client in self._here:
            if isinstance(client, Operator):
                key = PING.of(zid=f"{MARK}-{client.name}")
            else:
                key = UNICAST.of(**inbox_of(client), **sender_of(client))
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
        questions = list(self._questions())
        done = 0
        limit = asyncio.Semaphore(AT_ONCE)

        async def ask(number: int, question: Question) -> None:
            nonlocal done
            payload = PROBE + f" {number}".encode()
            async with limit:
                answered = await _answered(self._saying[question.asker], question.key, payload)
            asked = self._asked.get(payload, set())
            if question.thief is not None:
                seen = question.thief in asked
            else:
                seen = answered or (bool(asked) and not question.permitted)
            self._results.append(Result(self._label, question.what, question.permitted, seen, question.key))
            done += 1
            progress(len(self._attempts) + done, len(self._attempts) + len(questions))

        await asyncio.gather(*(ask(number, question) for number, question in enumerate(questions)))

    def _questions(self) -> Iterator[Question]:
        for client in self._here:
            for name in self._here:
                yield from self._calls(client, name)
                yield from self._named_questions(client, name)
            for other in self._here:
                key = PING.of(zid=f"{MARK}-{other.name}")
                yield Question(client.name, f"{client.name} pings {other.name}", key, isinstance(client, Operator))
            # the admin space is outside every namespace, and so out of reach of who is inside one
            admitted = isinstance(client, Operator) and self._plan.namespace is None
            yield Question(client.name, f"{client.name} asks who the routers are", keyexpr.ROUTERS, admitted)

    def _calls(self, client: Client, name: Client) -> Iterator[Question]:
        really = self._expected.speaks_as(client, name)
        pretending = "" if name is client else f" as {name.name}"
        for callee in self._here:
            if isinstance(callee, Gateway) or callee is name:
                continue
            verbs = self._plan.verbs(name, callee)
            if name is not client and verbs == []:
                continue  # what its owner may not do shows nothing about who pretends to be it
            for verb in (MARK, *self._verbs):
                key = CALL.of(**agent_of(callee), verb=verb, **sender_of(name))
                what = f"{client.name} calls {verb} of {callee.name}{pretending}"
                yield Question(client.name, what, key, really and (verbs is None or verb in verbs))
            if name is client and verbs is None:
                for thief in self._here:
                    if thief is not callee:
                        key = CALL.of(**agent_of(callee), verb=f"{MARK}-{thief.name}", **sender_of(client))
                        what = f"{thief.name} answers {client.name} as {callee.name}"
                        permitted = self._expected.speaks_as(thief, callee)
                        yield Question(client.name, what, key, permitted, thief.name)

    def _named_questions(self, client: Client, name: Client) -> Iterator[Question]:
        by = access.called(name)
        pretending = "" if name is client else f" as {name.name}"
        for receiver in self._here:
            called = access.called(receiver)
            if by is None or called is None or receiver is name:
                continue
            permitted = name is client and self._expected.writes_to(name, receiver)
            for space, what in ((NAMED, "delivers to"), (LAST, "asks for the last value of")):
                key = space.of(name=called, message_type=MARK, from_name=by)
                yield Question(client.name, f"{client.name} {what} {receiver.name}{pretending}", key, permitted)
            if permitted:
                for thief in self._here:
                    if thief is not receiver:
                        key = NAMED.of(name=called, message_type=f"{MARK}-{thief.name}", from_name=by)
                        what = f"{thief.name} takes a message for {receiver.name}"
                        yield Question(client.name, what, key, False, thief.name)


async def _answered(mesh: Mesh, key: str, payload: bytes) -> bool:
    """Whether anybody answers, be it with a refusal: our programs refuse what has no frame, and do nothing."""
    if key.startswith("@"):
        return bool(await mesh.ask_all(key, timeout_s=ANSWER_S))
    try:
        await mesh.query(key, payload, timeout_s=ANSWER_S)
    except Refused:
        return True
    except Unreachable:
        return False
    return True


def _token(expression: str, mark: str) -> str:
    """A key of an expression that ends in ``**``, which no program takes for a token of its own."""
    return expression.removesuffix("**") + f"{UNREAD}-{mark}"


def settings_of(plan: Plan, directory: Path, endpoint: str) -> MeshSettings:
    """A node's session for the check: its certificate, and what the plan says of every link."""
    return changed(
        plan.mesh,
        connect=[endpoint],
        namespace=plan.namespace,
        overrides=client_overrides(str(directory.resolve())),
    )


# -- who must not be let in at all -------------------------------------------------------------------------------


async def _refusals(plan: Plan, directory: Path, label: str, endpoint: str, timeout_s: float) -> list[Result]:
    """Sessions without a certificate, with one of another authority, and without TLS."""
    name = plan.clients[0].name if plan.clients else plan.routers[0].name
    ours = directory / name
    with tempfile.TemporaryDirectory() as elsewhere:
        foreign = Path(elsewhere) / name
        authority, _ = certificates.authority(Path(elsewhere), plan, dt.datetime.now(dt.timezone.utc))
        authority.issue(foreign, None, plan, dt.datetime.now(dt.timezone.utc), renew=False)
        certificates.write(
            foreign / certificates.AUTHORITY, (ours / certificates.AUTHORITY).read_bytes(), certificates.PUBLIC_FILE
        )
        root = f"transport/link/tls/root_ca_certificate:'{(ours / certificates.AUTHORITY).resolve()}'"
        attempts = {
            f"{name} with a certificate of another authority is let in": settings_of(plan, foreign, endpoint),
            "somebody without a certificate is let in": changed(plan.mesh, connect=[endpoint], overrides=[root]),
            "somebody without TLS is let in": changed(plan.mesh, connect=[endpoints.by_protocol("tcp", endpoint)]),
        }
        seen = await asyncio.gather(*(_let_in(settings, timeout_s) for settings in attempts.values()))
    return [Result(label, what, False, inside) for what, inside in zip(attempts, seen, strict=True)]


async def _nothing() -> list[Result]:
    return []


async def _let_in(settings: MeshSettings, timeout_s: float) -> bool:
    try:
        async with await Mesh.open_once(settings, timeout_s=timeout_s):
            return True
    except Unreachable:
        return False
