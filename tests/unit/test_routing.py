"""One copy for each agent that a header names, whoever it is behind, and none for anybody else."""

from __future__ import annotations

from collections import Counter
from typing import NamedTuple

import zenoh
from hypothesis import example, given
from hypothesis import strategies as st

from macs_zenoh.protocol.keyexpr import BROADCAST, GROUP, KEYS, UNICAST, block_of, parse
from macs_zenoh.protocol.routing import inbox, keys_of, takes_group_copy
from macs_zenoh.protocol.wire import Header

AgentKey = tuple[int, int]


class Site(NamedTuple):
    """A mesh: every agent's group (0: none), and which agents share a gateway; the others are on their own."""

    groups: dict[AgentKey, int]
    behind_gateway: frozenset[AgentKey]


TYPES = st.integers(1, 3)
IDS = st.sampled_from([1, 2, 3, 255, 256, 300])
GROUPS = st.integers(1, 3)

headers = st.builds(
    lambda kind, ids, groups: Header(kind, tuple(ids), tuple(groups), 0, 8),
    st.integers(0, 3),
    st.lists(IDS, max_size=10),
    st.lists(GROUPS, max_size=10),
)


@st.composite
def sites(draw: st.DrawFn) -> Site:
    """Some agents of some types, some of them behind a gateway."""
    groups = draw(st.dictionaries(st.tuples(TYPES, IDS), st.just(0) | GROUPS, min_size=1, max_size=12))
    return Site(groups, frozenset(draw(st.sets(st.sampled_from(sorted(groups))))))


def subscriptions(site: Site) -> list[tuple[frozenset[AgentKey], str]]:
    """What everybody subscribes to: the agents behind each subscription and its key expression. One gateway
    subscribes once per block and group, however many of its agents are there."""
    found: dict[tuple[bool | AgentKey, str], set[AgentKey]] = {}
    for agent, group in site.groups.items():
        gateway = agent in site.behind_gateway
        session = gateway or agent
        own = UNICAST.every(type=agent[0], block=block_of(agent[1])) if gateway and agent[0] == 2 else inbox(*agent)
        expressions = [own, BROADCAST.every()]
        if group:
            expressions.append(GROUP.every(group=group, type=agent[0]))
        for expression in expressions:
            found.setdefault((session, expression), set()).add(agent)
    return [(frozenset(agents), expression) for (_, expression), agents in found.items()]


def takes(agent: AgentKey, key: str, header: Header, sender: AgentKey) -> bool:
    """Whether an agent keeps a copy that came to its session on a key."""
    plane, fields = parse(key) or ("", None)
    assert fields.sender == sender
    if plane == "unicast":
        return (fields.type, fields.id) == agent
    if plane == "group":
        return takes_group_copy(header, agent[1], sender, agent[0])
    return plane == "broadcast" and agent != sender


def addressed(site: Site, header: Header, sender: AgentKey) -> set[AgentKey]:
    """Whom a header names, as the protocol page says it."""
    if header.agent_type == 0:
        return set(site.groups) - {sender}
    by_id = {agent for agent in site.groups if agent[0] == header.agent_type and agent[1] in header.ids}
    by_group = {
        agent
        for agent, group in site.groups.items()
        if agent[0] == header.agent_type and group in header.groups and agent != sender
    }
    return by_id | by_group


@given(sites(), headers, st.data())
@example(Site({(2, 1): 1, (2, 2): 1}, frozenset([(2, 1), (2, 2)])), Header(2, (1, 2), (1,), 0, 8), None)
@example(Site({(2, 1): 1, (2, 2): 1}, frozenset()), Header(2, (1, 1, 2), (1, 1), 0, 8), None)
def test_everybody_addressed_gets_one_copy(site: Site, header: Header, data: st.DataObject | None) -> None:
    """Each agent that the header names gets exactly one copy, behind a gateway or not; nobody else gets any; the
    sender gets one only when its own id is named."""
    sender = data.draw(st.sampled_from(sorted(site.groups))) if data else (2, 1)
    copies: Counter[AgentKey] = Counter()
    for key in keys_of(header, *sender):
        for agents, expression in subscriptions(site):
            if zenoh.KeyExpr(expression).intersects(zenoh.KeyExpr(key)):
                copies.update(agent for agent in agents if takes(agent, key, header, sender))
    assert copies == Counter(addressed(site, header, sender))


@given(headers, TYPES, IDS)
def test_no_key_is_used_twice(header: Header, from_type: int, from_id: int) -> None:
    """A frame goes to each key once, however often the header repeats an id or a group; each key names the sender."""
    keys = keys_of(header, from_type, from_id)
    assert len(keys) == len(set(keys))
    for key in keys:
        plane, fields = parse(key) or ("", None)
        assert plane in KEYS
        assert fields.sender == (from_type, from_id)


@given(st.lists(IDS, max_size=10), st.lists(GROUPS, max_size=10))
def test_a_broadcast_ignores_ids_and_groups(ids: list[int], groups: list[int]) -> None:
    """Type 0 goes to everybody on one key, whatever else the header says."""
    assert keys_of(Header(0, tuple(ids), tuple(groups), 0, 8), 2, 7) == ["macs/all/unity/7"]


def test_a_header_that_names_nobody_goes_nowhere() -> None:
    """No ids and no groups give no keys."""
    assert keys_of(Header(2, (), (), 0, 8), 1, 7) == []


def test_the_keys_of_a_header() -> None:
    """Ids come first, in the order of the header, each with its block; then groups."""
    assert keys_of(Header(2, (300, 5, 300), (4, 2), 0, 8), 1, 7) == [
        "macs/to/unity/1/300/ros/7",
        "macs/to/unity/0/5/ros/7",
        "macs/group/4/unity/ros/7",
        "macs/group/2/unity/ros/7",
    ]
    assert inbox(2, 300) == "macs/to/unity/1/300/**"
