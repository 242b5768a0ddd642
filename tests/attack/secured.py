"""The policy of a site on which somebody attacks with a certificate, and what each certificate permits, as keys.

On such a site the router lets nobody in without one. The people are those of every site; beside them there is one more
of each kind that a policy makes, and it attacks.
"""

from __future__ import annotations

import datetime as dt
import itertools
from collections.abc import Iterator
from pathlib import Path

import zenoh

from bridge import settings
from bridge.security import access, policy
from bridge.security.access import INGRESS, Fields
from bridge.security.generate import generate
from bridge.security.policy import Client, Policy
from macs_zenoh.config import MeshSettings
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
    Key,
    block_of,
    router,
)
from macs_zenoh.protocol.messages import OPERATOR, ROS, UNITY
from tests.support.programs import free_port

ROBOT, GATEWAY, OPERATED = "robot-1", "hall-1", "anna"
"""The well-behaved: a robot, a gateway, and an operator who may stop the robot."""

INSIDERS = {
    "gateway": "hall-2",
    "watching_gateway": "window",
    "robot": "robot-2",
    "operator": "ben",
    "observer": "eve",
}
"""Who attacks, by what its certificate is for: commanding robots, seeing them only, being one, asking them how they
are, and seeing who is there."""

POLICY = """
routers:
  - {name: site, addresses: [127.0.0.1], listen: ['%s']}
robots:
  - {name: robot-1, id: 1, group: 3, awareness_name: drone1}
  - {name: robot-2, id: 2, group: 3, awareness_name: drone2}
gateways:
  - {name: hall-1, blocks: [1]}
  - {name: hall-2, blocks: [2]}
  - {name: window, blocks: [3]}
operators:
  - {name: anna, id: 7}
  - {name: ben, id: 8}
  - {name: eve}
permissions:
  - {who: [hall-1, hall-2], may: [command, see, call], whom: robots}
  - {who: window, may: see, whom: robots}
  - {who: gateways, may: message, whom: gateways}
  - {who: robots, may: message, whom: robots}
  - {who: anna, may: call, whom: robots}
  - {who: ben, may: call, whom: robots, verbs: [status, offers, control, ping]}
"""

EACH = 4
"""Of the ids that a gateway's certificate may speak for, so many."""
MOST = 200
"""Keys of one kind that are used at most."""


def made(directory: Path) -> str:
    """Make certificates, the router's rules and everybody's settings; where the router will listen."""
    endpoint = f"tls/127.0.0.1:{free_port()}"
    text = POLICY % endpoint
    directory.mkdir(mode=0o700)
    generate(policy.parse(text), directory, dt.datetime.now(dt.timezone.utc))
    (directory / "policy.yaml").write_text(text)
    return endpoint


def mesh_of(directory: Path, name: str) -> MeshSettings:
    """How somebody's programs reach the mesh."""
    return settings.load(directory / name / "macs.toml").mesh


class Rights:
    """What the rules of a router let one certificate do, as concrete keys."""

    def __init__(self, directory: Path, name: str) -> None:
        self.policy: Policy = policy.load(directory / "policy.yaml")
        node = self.policy.node(name)
        assert isinstance(node, Client)
        self.client: Client = node

    def expressions(self, message: str) -> list[str]:
        """The key expressions of a kind of message (`access.MESSAGES`) that it may send into the router."""
        rules = [rule for rule in access.rules(self.policy, self.client) if message in rule.messages]
        return [key for rule in rules if INGRESS in rule.flows for key in rule.keys]

    def keys(self, message: str) -> list[str]:
        """Keys that fit these, of every space of the mesh, with ids that exist and that do not."""
        allowed = [zenoh.KeyExpr(each) for each in self.expressions(message)]
        found = dict.fromkeys(
            key for key in self._candidates() if any(each.includes(zenoh.KeyExpr(key)) for each in allowed)
        )
        return list(itertools.islice(found, MOST))

    def _candidates(self) -> Iterator[str]:
        me = access.senders(self.client)[:EACH]
        agents: list[Fields] = [
            *({"type": ROS, "id": each} for each in (1, 2, 9)),
            *({"type": UNITY, "id": each} for each in (256, 257, 512, 513, 768, 900)),
            *({"type": OPERATOR, "id": each} for each in (0, 7, 8)),
        ]
        own = access.agents(self.client)[:EACH]
        names = ("drone1", "drone2")
        groups = [{"type": kind, "group": group} for kind in (ROS, UNITY) for group in (3, 5)]
        verbs = [{"verb": verb} for verb in ("status", "offers", "control", "add_node", "remove_node", "stop", "none")]
        zid = {"zid": "a" * 32}
        yield from _each(UNICAST, [{**agent, "block": block_of(int(agent["id"]))} for agent in agents], me)
        yield from _each(GROUP, groups, me)
        yield from _each(BROADCAST, me)
        yield from _each(CALL, agents, verbs, me)
        yield from _each(CALLS, agents, verbs, [{"from_type": UNITY, "from_block": block} for block in range(4)])
        yield from _each(PRESENCE, own, [{"group": 0}, {"group": 3}], [zid])
        yield from _each(LEASE, [{"block": block} for block in range(5)], [zid])
        yield from (PING.of(**zid), f"{router('a' * 32)}/linkstate/routers")
        for name, other in itertools.product(names, names):
            about = {"message_type": "Hello", "from_name": other}
            yield from (NAMED.of(name=name, **about), LAST.of(name=name, **about))
            yield WANTED.of(name=name, message_type="Hello", **zid)
            yield NAME.of(name=name, type=ROS, id=names.index(other) + 1, **zid)
        kept = [STREAM.of(type=ROS, id=each, node=node) for each in (1, 2) for node in ("nd__x", "nd__emergency_stop")]
        for key in (*kept, *(NAMED_ALL.of(message_type="Hello", from_name=name) for name in names)):
            yield from (key, f"{key}/@adv/pub/{zid['zid']}/1/_")


def _each(key: Key, *fields: list[Fields]) -> Iterator[str]:
    for combined in itertools.product(*fields):
        yield key.of(**{name: value for each in combined for name, value in each.items()})
