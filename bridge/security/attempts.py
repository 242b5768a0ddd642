"""What the check tries: all that a node may say, in its own name and in others', and what must come of it. Pure."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field
from typing import NamedTuple

from bridge.security import access
from bridge.security.expected import Expected, agent_of, presence_of, sender_of
from bridge.security.policy import LOOK_VERBS, Client, Gateway, Operator, Policy, Robot
from macs_zenoh.protocol import keyexpr, together
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

MARK = "macs_check"
"""A topic, a verb and a message type of the check's own."""
UNREAD = "%6Dacs_check"
"""The same as programs do not write it, so that no program takes the key for one of its own."""


@dataclass(frozen=True)
class Result:
    """One attempt and what became of it."""

    router: str
    what: str
    permitted: bool
    """What the policy says."""
    seen: bool
    """What happened."""
    key: str = ""

    @property
    def as_expected(self) -> bool:
        return self.permitted == self.seen

    def as_dict(self) -> dict[str, object]:
        """For programs."""
        return {**asdict(self), "as_expected": self.as_expected}


@dataclass
class Attempt:
    """Something said, and by whom it is heard: as the policy has it, and as it was."""

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
    """Something asked. ``impostor``: who must not be asked, however many others answer; None: nobody in particular."""

    asker: str
    what: str
    key: str
    permitted: bool
    impostor: str | None = None


class Attempts:
    """What those who are let in try."""

    def __init__(self, policy: Policy, expected: Expected, here: Sequence[Client]) -> None:
        self._policy = policy
        self._expected = expected
        self._here = here
        self._verbs = expected.limited_verbs()

    def puts_of(self, client: Client) -> Iterator[Attempt]:
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
            key = UNICAST.of(**agent_of(receiver), **sender)
            hearers = [other for other in here if receiver in reached and expected.has_inbox(other, receiver)]
            yield f"to {receiver.name} by id", key, receiver.name, hearers
        for group in sorted({robot.group for robot in self._policy.robots if robot.group}):
            key = GROUP.of(group=group, type=ROS, **sender)
            hearers = [other for other in reached if isinstance(other, Robot) and other.group == group]
            yield f"to robots of group {group}", key, None, hearers
        if self._policy.gateways:
            key = GROUP.every(type=UNITY, **sender).replace("*", MARK)
            yield "to a group of headsets", key, None, [other for other in reached if isinstance(other, Gateway)]
        yield "to all", BROADCAST.of(**sender), None, reached
        if isinstance(name, Robot):
            key = STREAM.of(type=ROS, id=name.id, node=MARK)
            if name.ros_namespace and not self._policy.namespace:
                yield "to its ROS nodes", probe_key(name.ros_namespace, MARK), None, [name]
            yield "on a stream", key, None, [other for other in here if self._policy.may(other, "see", name)]
        if (by := access.awareness_name(name)) is None:
            return
        friends = [other for other in here if expected.writes_to(name, other)]
        for receiver in here:
            if (called := access.awareness_name(receiver)) is not None and receiver is not name:
                key = NAMED.of(name=called, message_type=MARK, from_name=by)
                yield f"to {receiver.name} by name", key, receiver.name, [receiver] if receiver in friends else []
        yield "by name to all", NAMED_ALL.of(message_type=MARK, from_name=by), None, friends

    def tokens_of(self, client: Client) -> Iterator[Attempt]:
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
                token(PRESENCE.every(**presence_of(name)), mark),
                None,
                sees,
            )
            if isinstance(name, Gateway):
                block = name.blocks[-1] if name.blocks else 255
                yield Attempt(
                    f"{client.name} leases block {block}{pretending}",
                    token(LEASE.every(block=block), mark),
                    None,
                    leases,
                )
            if isinstance(name, Robot) and name.awareness_name is not None:
                yield Attempt(
                    f"{client.name} is called {name.awareness_name}{pretending}",
                    token(NAME.every(name=name.awareness_name, type=ROS, id=name.id), mark),
                    None,
                    knows,
                )
                yield Attempt(
                    f"{client.name} takes messages{pretending}",
                    token(WANTED.every(name=name.awareness_name, message_type=MARK), mark),
                    None,
                    knows,
                )

    def questions(self) -> Iterator[Question]:
        for client in self._here:
            for name in self._here:
                yield from self._calls(client, name)
                yield from self._named_questions(client, name)
            yield from self._looks(client)
            for other in self._here:
                key = PING.of(zid=f"{MARK}-{other.name}")
                yield Question(client.name, f"{client.name} pings {other.name}", key, isinstance(client, Operator))
            # the admin space is outside every namespace, and so out of reach of who is inside one
            admitted = isinstance(client, Operator) and self._policy.namespace is None
            yield Question(client.name, f"{client.name} asks who the routers are", keyexpr.ROUTERS, admitted)

    def _calls(self, client: Client, name: Client) -> Iterator[Question]:
        really = self._expected.speaks_as(client, name)
        pretending = "" if name is client else f" as {name.name}"
        for callee in self._here:
            if isinstance(callee, Gateway) or callee is name:
                continue
            verbs = self._policy.verbs(name, callee)
            if name is not client and verbs == []:
                continue  # what its owner may not do shows nothing about who pretends to be it
            for verb in (MARK, *self._verbs):
                key = CALL.of(**agent_of(callee), verb=verb, **sender_of(name))
                what = f"{client.name} calls {verb} of {callee.name}{pretending}"
                yield Question(client.name, what, key, really and (verbs is None or verb in verbs))
            if isinstance(name, Gateway) and isinstance(callee, Robot):
                yield from self._calls_together(client, name, callee)
            if name is client and verbs is None:
                for impostor in self._here:
                    if impostor is not callee:
                        key = CALL.of(**agent_of(callee), verb=f"{MARK}-{impostor.name}", **sender_of(client))
                        what = f"{impostor.name} answers {client.name} as {callee.name}"
                        permitted = self._expected.speaks_as(impostor, callee)
                        yield Question(client.name, what, key, permitted, impostor.name)

    def _calls_together(self, client: Client, name: Gateway, callee: Robot) -> Iterator[Question]:
        """Calls for all headsets of one of a gateway's blocks."""
        pretending = "" if name is client else f" as {name.name}"
        verbs = self._policy.verbs(name, callee)
        for verb in (MARK, *self._verbs):
            block = keyexpr.block_of(int(agent_of(name)["id"]))
            key = CALLS.of(**agent_of(callee), verb=verb, from_type=UNITY, from_block=block)
            what = f"{client.name} calls {verb} of {callee.name} for many{pretending}"
            may = verbs is None or (verb in verbs and verb in together.VERBS)
            yield Question(client.name, what, key, may and self._expected.speaks_as(client, name))

    def _looks(self, client: Client) -> Iterator[Question]:
        """What gateways ask for their pages, and nobody else may."""
        for callee in self._here:
            if not isinstance(callee, Robot) or callee is client:
                continue
            verbs = self._policy.verbs(client, callee) if isinstance(client, Gateway) else []
            own = isinstance(client, Gateway) and not client.blocks  # it speaks for every headset
            for verb in (MARK, *self._verbs):
                key = CALL.of(**agent_of(callee), verb=verb, **access.VISITOR)
                permitted = (verbs is None or verb in verbs) and (own or verb in LOOK_VERBS)
                yield Question(client.name, f"{client.name} asks {callee.name} {verb} for a page", key, permitted)

    def _named_questions(self, client: Client, name: Client) -> Iterator[Question]:
        by = access.awareness_name(name)
        pretending = "" if name is client else f" as {name.name}"
        for receiver in self._here:
            called = access.awareness_name(receiver)
            if by is None or called is None or receiver is name:
                continue
            permitted = name is client and self._expected.writes_to(name, receiver)
            for space, what in ((NAMED, "delivers to"), (LAST, "asks for the last value of")):
                key = space.of(name=called, message_type=MARK, from_name=by)
                yield Question(client.name, f"{client.name} {what} {receiver.name}{pretending}", key, permitted)
            if permitted:
                for impostor in self._here:
                    if impostor is not receiver:
                        key = NAMED.of(name=called, message_type=f"{MARK}-{impostor.name}", from_name=by)
                        what = f"{impostor.name} takes a message for {receiver.name}"
                        yield Question(client.name, what, key, False, impostor.name)


def token(expression: str, mark: str) -> str:
    """A key of an expression that ends in ``**``, which no program takes for a token of its own."""
    return expression.removesuffix("**") + f"{UNREAD}-{mark}"
