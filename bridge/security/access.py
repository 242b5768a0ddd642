"""What each node of a policy may put, declare, ask and answer: the rules of a router's access control. Pure.

Zenoh allows a message when its key is included in the key expression of a rule, for each session that it passes:
``ingress`` on its way into the router, ``egress`` on its way out. So each node gets

* what it may say, and as whom: the source is the end of each key, and only its own is allowed. That is decided where
  the message enters the mesh;
* what it may hear: its own inbox, group, streams, calls. For what goes to several (groups, everybody) the senders are
  listed, so that a message reaches only those of the receivers that its sender may reach;
* whom it may see: the presence of those with whom it has to do.

Every key is made by `macs_zenoh.protocol.keyexpr`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple

from bridge.security.policy import LOOK_VERBS, Client, Gateway, Operator, Policy, Robot, Router, kind_of
from macs_zenoh.protocol.key_expressions import distinct
from macs_zenoh.protocol.keyexpr import (
    ADMIN,
    BLOCK_SIZE,
    BROADCAST,
    CALL,
    CALLS,
    EVERYTHING,
    GROUP,
    LAST,
    LEASE,
    NAME,
    NAMED,
    NAMED_ALL,
    PING,
    PRESENCE,
    SLOW,
    STREAM,
    UNICAST,
    WANTED,
    FieldValue,
    Key,
    inside,
    is_recovery,
    with_recovery,
)
from macs_zenoh.protocol.messages import NOBODY, OPERATOR, ROS, UNITY
from macs_zenoh.protocol.rmw_zenoh.keyexpr import session_keys
from macs_zenoh.protocol.together import VERBS

TYPES = {"robots": ROS, "gateways": UNITY, "operators": OPERATOR}

VISITOR: dict[str, FieldValue] = {"from_type": UNITY, "from_id": 0}
"""As whom a gateway asks for its page: a headset that has not joined, which has no id of any block."""

ANY = ""
"""A callee whose every verb may be called."""

INGRESS, EGRESS = "ingress", "egress"

MESSAGES = (
    "put",
    "delete",
    "declare_subscriber",
    "query",
    "declare_queryable",
    "reply",
    "liveliness_token",
    "declare_liveliness_subscriber",
    "liveliness_query",
)
"""All that Zenoh's access control knows."""

Fields = dict[str, FieldValue]


class Rule(NamedTuple):
    """One rule for one node."""

    what: str
    """For people: ``robot-7 speaks``."""
    messages: tuple[str, ...]
    flows: tuple[str, ...]
    keys: tuple[str, ...]


def rules(policy: Policy, client: Client) -> list[Rule]:
    """Everything that a client may."""
    outbound = _Outbound(policy, client)
    inbound = _Inbound(policy, client)
    seen = list(_tokens_seen(policy, client))
    found = [
        Rule("is present", ("liveliness_token",), (INGRESS,), distinct(_own_tokens(policy, client))),
        Rule("speaks", ("put",), (INGRESS,), distinct(outbound.puts())),
        Rule("asks", ("query",), (INGRESS,), distinct([*outbound.queries(), *inbound.recoveries_asked()])),
        Rule("learns who listens to it", ("declare_subscriber",), (EGRESS,), distinct(outbound.listeners())),
        Rule(
            "learns who answers it",
            ("declare_queryable",),
            (EGRESS,),
            distinct([*outbound.answerers(), *inbound.recovered()]),
        ),
        Rule("is answered", ("reply",), (EGRESS,), distinct([*outbound.replies(), *inbound.recovered()])),
        Rule("subscribes", ("declare_subscriber",), (INGRESS,), distinct(inbound.subscriptions())),
        Rule("hears", ("put",), (EGRESS,), distinct(inbound.puts())),
        Rule(
            "answers", ("declare_queryable", "reply"), (INGRESS,), distinct([*inbound.queryables(), *outbound.kept()])
        ),
        Rule("is asked", ("query",), (EGRESS,), distinct([*inbound.queryables(), *outbound.kept_asked()])),
        Rule(
            "watches presence",
            ("declare_liveliness_subscriber", "liveliness_query"),
            (INGRESS,),
            distinct(_watched(client)),
        ),
        Rule("sees who is there", ("liveliness_token",), (EGRESS,), distinct(seen)),
    ]
    own = [_in(policy.namespace, rule) for rule in found if rule.keys]
    if isinstance(client, Robot) and client.ros_namespace:
        keys = distinct(session_keys(client.ros_namespace))  # in no other namespace
        own.append(Rule("has ROS nodes", MESSAGES, (INGRESS, EGRESS), keys))
    return own


def link_rules(policy: Policy) -> list[Rule]:
    """Everything that one router may send another: what is forbidden to a client is stopped at the client's router."""
    keys = distinct([*with_recovery([EVERYTHING]), *ADMIN])
    carried = [_in(policy.namespace, Rule("carries everything", MESSAGES, (INGRESS, EGRESS), keys))]
    if ros := [key for robot in policy.robots if robot.ros_namespace for key in session_keys(robot.ros_namespace)]:
        carried.append(Rule("carries what ROS nodes say", MESSAGES, (INGRESS, EGRESS), distinct(ros)))
    return carried


def linked(policy: Policy, router: Router) -> list[Router]:
    """The routers that this one has a link with, whoever dials."""
    return [
        other
        for other in policy.routers
        if other is not router and (other.name in router.links or router.name in other.links)
    ]


# -- who is who in keys ------------------------------------------------------------------------------------------


def headset_ids(gateway: Gateway) -> list[int]:
    """The ids that a gateway with blocks may give out."""
    return [i for block in gateway.blocks for i in range(max(1, block * BLOCK_SIZE), (block + 1) * BLOCK_SIZE)]


def agents(client: Client) -> list[Fields]:
    """Whom a client speaks for, as fields of `CALL`; without an id: every agent of the type."""
    if isinstance(client, Robot):
        return [{"type": ROS, "id": client.id}]
    if isinstance(client, Operator):
        return [{"type": OPERATOR, "id": client.id or 0}]
    return [{"type": UNITY, "id": number} for number in headset_ids(client)] or [{"type": UNITY}]


def senders(client: Client) -> list[Fields]:
    """The same as the end of a key."""
    return [{f"from_{name}": value for name, value in agent.items()} for agent in agents(client)]


def present(client: Client) -> list[Fields]:
    """The same as fields of `PRESENCE`: a block instead of all its ids."""
    if isinstance(client, Gateway):
        return [{"type": UNITY, "block": block} for block in client.blocks] or [{"type": UNITY}]
    return agents(client)


def inboxes(client: Client) -> list[Fields]:
    """The same as fields of `UNICAST`. Nobody can write to an operator without id."""
    return [] if isinstance(client, Operator) and client.id is None else present(client)


# -- who may what ------------------------------------------------------------------------------------------------


def reaches(policy: Policy, sender: Client, receiver: Client) -> bool:
    """Whether one may send to the other by id, by group and with everybody.

    To a robot that is commanding it. Others also hear those whom they may command, see or call, since these answer.
    """
    if not inboxes(receiver):
        return False
    if policy.may(sender, "command", receiver) or isinstance(receiver, Robot):
        return policy.may(sender, "command", receiver)
    return policy.may(sender, "message", receiver) or any(
        policy.may(receiver, right, sender) for right in ("command", "see", "call")
    )


def converse(policy: Policy, one: Client, other: Client) -> bool:
    """Whether one of two named robots may send to the other by name, so that both need to know of each other."""
    return policy.may(one, "message", other) or policy.may(other, "message", one)


def awareness_name(client: Client) -> str | None:
    """A client's name in collective awareness."""
    return client.awareness_name if isinstance(client, Robot) else None


def _names(policy: Policy, client: Client, holds: Callable[[Client, Client], bool]) -> list[str]:
    """The names of the named robots for which something holds with a named client; none for one without a name."""
    others = [robot for robot in policy.robots if robot is not client and awareness_name(client) is not None]
    return [robot.awareness_name for robot in others if robot.awareness_name is not None and holds(client, robot)]


def _by_kind(
    policy: Policy, client: Client, holds: Callable[[Client], bool]
) -> Iterator[tuple[str, list[Client], bool]]:
    """The others for whom something holds, by kind, with whether they are all of that kind."""
    lists: dict[str, Sequence[Client]] = {
        "robots": policy.robots,
        "gateways": policy.gateways,
        "operators": policy.operators,
    }
    for kind, everyone in lists.items():
        others = [other for other in everyone if other is not client]
        chosen = [other for other in others if holds(other)]
        if chosen:
            yield kind, chosen, len(chosen) == len(others)


def _collapsed(
    policy: Policy, client: Client, holds: Callable[[Client], bool], fields: Callable[[Client], list[Fields]]
) -> list[Fields]:
    """Fields for the others for whom something holds: only the type where it holds for all of a kind."""
    found: list[Fields] = []
    for kind, chosen, complete in _by_kind(policy, client, holds):
        each = [fields_of_one for other in chosen for fields_of_one in fields(other)]
        if each and complete:
            each = [{"from_type" if fields is senders else "type": TYPES[kind]}]
        found += each
    return found


# -- saying ------------------------------------------------------------------------------------------------------


class _Outbound:
    """What a client may say, and what it must know to say it: a publisher here is quiet until it knows who listens."""

    def __init__(self, policy: Policy, client: Client) -> None:
        self._policy = policy
        self._client = client
        self._as = senders(client)
        self._name = awareness_name(client)
        reached = _collapsed(policy, client, lambda other: reaches(policy, client, other), inboxes)
        self._inboxes = [*([] if {"type": TYPES[kind_of(client)]} in reached else inboxes(client)), *reached]
        self._groups = list(self._group_targets())
        self._broadcasts = bool(reached) or isinstance(client, Gateway)
        self._friends = _names(policy, client, lambda me, robot: policy.may(me, "message", robot))

    def _group_targets(self) -> Iterator[Fields]:
        policy, client = self._policy, self._client
        for kind, chosen, complete in _by_kind(policy, client, lambda other: reaches(policy, client, other)):
            if kind == "gateways":
                yield {"type": UNITY}  # headsets choose their groups themselves
            elif kind == "robots" and complete:
                yield {"type": ROS}
            elif kind == "robots":
                for group in sorted({robot.group for robot in chosen if isinstance(robot, Robot) and robot.group}):
                    yield {"type": ROS, "group": group}
        if isinstance(client, Gateway):
            yield {"type": UNITY}

    def puts(self) -> Iterator[str]:
        for sender in self._as:
            yield from _every(UNICAST, self._inboxes, sender)
            yield from _every(GROUP, self._groups, sender)
            if self._broadcasts:
                yield BROADCAST.every(**sender)
            if isinstance(self._client, Gateway):
                yield SLOW.every(**sender)
        if isinstance(self._client, Operator):
            yield PING.every()
        if self._name is not None:
            yield from (NAMED.every(name=name, from_name=self._name) for name in self._friends)
        yield from self.kept()

    def queries(self) -> Iterator[str]:
        for sender in self._as:
            yield from _every(CALL, self._callees(), sender)
        yield from self._together()
        if isinstance(self._client, Gateway) and self._client.blocks:
            yield from _every(CALL, self._looked_at(), VISITOR)
        if self._name is not None:
            for name in self._friends:
                yield NAMED.every(name=name, from_name=self._name)
                yield LAST.every(name=name, from_name=self._name)
        if isinstance(self._client, Operator):
            yield PING.every()
            yield from ADMIN

    def _together(self) -> Iterator[str]:
        """Calls for several of its headsets at once: one of whom somebody speaks for is not enough."""
        if isinstance(self._client, Gateway):
            for callee in self._called_together():
                for block in self._client.blocks:
                    yield CALLS.every(**callee, from_type=UNITY, from_block=block)
                if not self._client.blocks:
                    yield CALLS.every(**callee, from_type=UNITY)

    def _called_together(self) -> Iterator[Fields]:
        return (each for each in self._callees() if each["type"] == ROS and each.get("verb", ANY) in (ANY, *VERBS))

    def _looked_at(self) -> Iterator[Fields]:
        """What its page asks of robots, whoever looks at it."""
        for callee in self._callees():
            if callee["type"] == ROS:
                verbs = [verb for verb in LOOK_VERBS if callee.get("verb", verb) == verb]
                yield from ({**callee, "verb": verb} for verb in verbs)

    def _callees(self) -> list[Fields]:
        policy, client = self._policy, self._client
        by_verbs: dict[tuple[str, ...] | None, list[Client]] = {}
        others: list[Client] = [*policy.robots, *policy.operators]
        for other in others:
            verbs = policy.verbs(client, other)
            if other is not client and verbs != []:
                by_verbs.setdefault(tuple(verbs) if verbs is not None else None, []).append(other)
        found: list[Fields] = []
        for some, chosen in by_verbs.items():
            callees = _collapsed(policy, client, chosen.__contains__, agents)
            found += [{**callee, "verb": verb} for callee in callees for verb in some] if some else callees
        return found

    def listeners(self) -> Iterator[str]:
        """Keys of the subscriptions of those to whom it may send, as wide as these may declare them."""
        yield from _every(UNICAST, self._inboxes)
        yield from _every(GROUP, self._groups)
        if self._broadcasts:
            yield BROADCAST.every()
        if isinstance(self._client, Gateway):
            yield SLOW.every()
        if isinstance(self._client, Operator):
            yield PING.every()
        yield from (NAMED.every(name=name) for name in self._friends)
        yield from self._kept(by=None)

    def kept(self) -> Iterator[str]:
        """What it sends to all who want it, and may keep for those that missed some of it."""
        return self._kept(by=self._name)

    def kept_asked(self) -> Iterator[str]:
        """Keys of questions for what was missed: who missed it asks everybody who sends such messages."""
        return (key for key in self._kept(by=None) if is_recovery(key))

    def _kept(self, by: str | None) -> Iterator[str]:
        if isinstance(self._client, Robot):
            yield from with_recovery([STREAM.every(type=ROS, id=self._client.id)])
        if self._friends:
            yield from with_recovery([NAMED_ALL.every(from_name=by) if by is not None else NAMED_ALL.every()])

    def answerers(self) -> Iterator[str]:
        yield from _every(CALL, self._callees())
        if isinstance(self._client, Gateway):
            yield from _every(CALLS, self._called_together())
        for name in self._friends:
            yield NAMED.every(name=name)
            yield LAST.every(name=name)
        if isinstance(self._client, Operator):
            yield PING.every()

    def replies(self) -> Iterator[str]:
        """Answers go to who asked, and to nobody else, so the type of the asking agent is enough."""
        if self._callees():
            yield CALL.every(from_type=self._as[0]["from_type"])
        if isinstance(self._client, Gateway) and any(self._called_together()):
            yield CALLS.every(from_type=UNITY)
        if self._name is not None and self._friends:
            yield NAMED.every(from_name=self._name)
            yield LAST.every(from_name=self._name)
        if isinstance(self._client, Operator):
            yield PING.every()
            yield from ADMIN


# -- hearing -----------------------------------------------------------------------------------------------------


class _Inbound:
    """What a client may hear, and what it declares for it."""

    def __init__(self, policy: Policy, client: Client) -> None:
        self._policy = policy
        self._client = client
        self._name = awareness_name(client)
        self._senders = _collapsed(policy, client, lambda other: reaches(policy, other, client), senders)
        self._streams = _collapsed(
            policy, client, lambda other: isinstance(other, Robot) and policy.may(client, "see", other), agents
        )
        self._group: Fields | None = None
        if isinstance(client, Robot):
            self._group = {"group": client.group, "type": ROS} if client.group else None
        elif isinstance(client, Gateway):
            self._group = {"type": UNITY}
        self._friends = _names(policy, client, lambda me, robot: policy.may(robot, "message", me))

    def subscriptions(self) -> Iterator[str]:
        yield from _every(UNICAST, inboxes(self._client))
        if self._group is not None:
            yield GROUP.every(**self._group)
        yield BROADCAST.every()  # what agents subscribe to; of what goes there, they get what is allowed below
        yield from with_recovery(_every(STREAM, self._streams))
        if isinstance(self._client, Gateway):
            yield SLOW.every()
        if isinstance(self._client, Operator):
            yield PING.every()
        if self._name is not None:
            yield NAMED.every(name=self._name)
            yield from with_recovery([NAMED_ALL.every()])

    def puts(self) -> Iterator[str]:
        yield from _every(UNICAST, inboxes(self._client))
        for sender in self._senders:
            if self._group is not None:
                yield GROUP.every(**self._group, **sender)
            yield BROADCAST.every(**sender)
        if isinstance(self._client, Gateway):  # headsets behind another worker of this gateway
            for sender in senders(self._client):
                yield GROUP.every(type=UNITY, **sender)
                yield BROADCAST.every(**sender)
            yield SLOW.every()
        if isinstance(self._client, Operator):
            yield PING.every()
        if self._name is not None:
            yield NAMED.every(name=self._name)
        yield from self.recovered()

    def recovered(self) -> Iterator[str]:
        """What it hears and, where the source keeps it, may ask for again."""
        yield from with_recovery(_every(STREAM, self._streams))
        yield from with_recovery(NAMED_ALL.every(from_name=name) for name in self._friends)

    def recoveries_asked(self) -> Iterator[str]:
        """Keys of its questions for what it missed."""
        found = [*_every(STREAM, self._streams), *([NAMED_ALL.every()] if self._friends else [])]
        return (key for key in with_recovery(found) if is_recovery(key))

    def queryables(self) -> Iterator[str]:
        if not isinstance(self._client, Gateway):
            yield from _every(CALL, agents(self._client))
        if isinstance(self._client, Robot):
            yield CALLS.every(type=ROS, id=self._client.id)
        if self._name is not None:
            yield NAMED.every(name=self._name)
            yield LAST.every(name=self._name)
        yield PING.every()


# -- presence ----------------------------------------------------------------------------------------------------


def _own_tokens(policy: Policy, client: Client) -> Iterator[str]:
    for agent in present(client):
        yield PRESENCE.every(**agent, **({"group": client.group} if isinstance(client, Robot) else {}))
    if isinstance(client, Operator):
        yield PRESENCE.every(type=NOBODY)
    if isinstance(client, Gateway):
        yield from (LEASE.every(block=block) for block in client.blocks)
        if not client.blocks:
            yield LEASE.every()
    if isinstance(client, Robot) and client.awareness_name is not None:
        yield NAME.every(name=client.awareness_name, type=ROS, id=client.id)
        yield WANTED.every(name=client.awareness_name)


def _watched(client: Client) -> Iterator[str]:
    """What a client's programs watch; of that it sees what `_tokens_seen` says."""
    yield PRESENCE.every()
    if not isinstance(client, Robot):
        yield LEASE.every()
    if isinstance(client, Operator) or awareness_name(client) is not None:
        yield NAME.every()
        yield WANTED.every()


def _tokens_seen(policy: Policy, client: Client) -> Iterator[str]:
    if isinstance(client, Operator):
        yield from (key.every() for key in (PRESENCE, LEASE, NAME, WANTED))
        return
    yield from _every(PRESENCE, present(client))
    yield from _every(PRESENCE, _collapsed(policy, client, lambda other: policy.related(client, other), present))
    if isinstance(client, Gateway):
        yield LEASE.every()
    if (name := awareness_name(client)) is not None:
        for one in [name, *_names(policy, client, lambda me, robot: converse(policy, me, robot))]:
            yield NAME.every(name=one)
            yield WANTED.every(name=one)


# -- keys --------------------------------------------------------------------------------------------------------


def _every(key: Key[Any], targets: Iterable[Fields], sender: Fields | None = None) -> Iterator[str]:
    return (key.every(**target, **(sender or {})) for target in targets)


def _in(namespace: str | None, rule: Rule) -> Rule:
    """A rule as the router sees its keys: the namespace is before each."""
    return rule._replace(keys=tuple(inside(namespace, key) for key in rule.keys))
