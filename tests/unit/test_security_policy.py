"""A security policy: what it may say, and what is refused with which words."""

from __future__ import annotations

import re
from pathlib import Path

import msgspec
import pytest

from bridge.security import policy
from bridge.security.policy import COMMAND_VERBS, SEE_VERBS, Policy
from macs_zenoh.errors import ConfigError

EXAMPLES = sorted((Path(__file__).parents[2] / "config" / "security").glob("*.yaml"))

BASE = """
routers:
  - {name: site, addresses: [site.example.org, 10.0.0.5]}
robots:
  - {name: robot-7, id: 7, group: 3, awareness_name: drone7}
  - {name: robot-8, id: 8}
gateways:
  - {name: hall-1, blocks: [1]}
  - {name: hall-2, blocks: [2, 3]}
operators:
  - {name: anna}
"""


def made(permissions: str = "", base: str = BASE) -> Policy:
    return policy.parse(base + (f"permissions:\n{permissions}" if permissions else ""))


def may(found: Policy, who: str, right: str, whom: str) -> bool:
    nodes = {client.name: client for client in found.clients}
    return found.may(nodes[who], right, nodes[whom])  # type: ignore[arg-type]


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.name)
def test_the_shipped_plans_can_be_read(path: Path) -> None:
    """Each policy in config/security is one."""
    assert policy.load(path).clients


def test_a_plan_can_be_short() -> None:
    """A router, a robot, a gateway and an operator who may do everything are less than 15 lines."""
    text = (Path(__file__).parents[2] / "config" / "security" / "small.yaml").read_text()
    assert len(text.splitlines()) <= 15
    small = policy.parse(text)
    assert all(
        small.may(one, right, other)
        for one in small.clients
        for other in small.clients
        if one is not other
        for right in policy.RIGHTS
    )


def test_what_is_not_permitted_is_denied() -> None:
    """Without permissions nobody may do anything."""
    found = made()
    assert not any(found.related(one, other) for one in found.clients for other in found.clients)


def test_a_permission_names_nodes_or_kinds() -> None:
    """Who and whom are one or several nodes, a kind, or all; a node needs no right over itself and gets none."""
    found = made(
        "  - {who: hall-1, may: [command, see], whom: robots}\n  - {who: [robots, hall-2], may: message, whom: all}\n"
    )
    assert may(found, "hall-1", "command", "robot-7")
    assert may(found, "hall-1", "see", "robot-8")
    assert not may(found, "hall-1", "call", "robot-8")
    assert not may(found, "hall-2", "command", "robot-7")
    assert may(found, "robot-7", "message", "robot-8")
    assert may(found, "hall-2", "message", "anna")
    assert not may(found, "robot-7", "message", "robot-7")


def test_verbs_of_a_call() -> None:
    """Seeing and commanding bring their verbs along; `call` gives those listed, or every one."""
    found = made(
        "  - {who: hall-1, may: command, whom: robots}\n"
        "  - {who: hall-2, may: see, whom: robots}\n"
        "  - {who: anna, may: call, verbs: [status], whom: robots}\n"
        "  - {who: robot-8, may: call, whom: robot-7}\n"
    )
    nodes = {client.name: client for client in found.clients}
    robot = nodes["robot-7"]
    assert found.verbs(nodes["hall-1"], robot) == list(COMMAND_VERBS)
    assert found.verbs(nodes["hall-2"], robot) == list(SEE_VERBS)
    assert found.verbs(nodes["anna"], robot) == ["status"]
    assert found.verbs(nodes["robot-8"], robot) is None
    assert found.verbs(robot, nodes["robot-8"]) == []


def test_clients_dial_the_routers_in_the_order_of_the_plan_or_in_their_own() -> None:
    """Endpoints are a router's first address at its port, unless it has others; a client may prefer a router."""
    found = policy.parse(
        "routers:\n"
        "  - {name: site, addresses: [site.example.org, 10.0.0.5], listen: ['tls/[::]:7000']}\n"
        "  - {name: v6, addresses: ['fd00::1']}\n"
        "  - {name: cloud, addresses: [cloud], endpoints: ['tls/cloud:443', 'quic/cloud:443']}\n"
        "robots:\n"
        "  - {name: a, id: 1}\n"
        "  - {name: b, id: 2, routers: [cloud, site]}\n"
    )
    first, second = found.robots
    assert found.endpoints(first) == [
        "tls/site.example.org:7000",
        "tls/[fd00::1]:7447",
        "tls/cloud:443",
        "quic/cloud:443",
    ]
    assert found.endpoints(second) == ["tls/cloud:443", "quic/cloud:443", "tls/site.example.org:7000"]


WRONG = [
    ("robots: [{name: a, id: 1}]", "routers"),
    ("routers: [{name: s, addresses: [x]}]\nrobots: [{name: a, id: 0}]", "robots[0].id"),
    ("routers: [{name: s, addresses: []}]", "addresses"),
    ("routers: [{name: s, addresses: [x], adresses: [y]}]", "did you mean `addresses`"),
    ("routes: []", "did you mean `routers`"),
    ("[1, 2]", "a policy has routers"),
    ("routers: [", "line 1: not YAML"),
    ("routers: [{name: s, addresses: [x]}]\nrouters: []", "line 2: not YAML: 'routers' twice"),
    ("? [a, b]\n: 1", "line 1: not YAML: a list as a name"),
    ("routers: [{? {a: 1} : 2}]", "line 1: not YAML: a list as a name"),
    ("a: " + "[" * 20_000 + "]" * 20_000, "nests too deep"),
    ("a: " + "{a: " * 5000 + "1" + "}" * 5000, "nests too deep"),
    ("a: 2020-99-99", "not YAML"),
    ("2020-99-99: 1", "not YAML"),
    (BASE + "  - {name: robot-7}", "name robot-7 is robot-7's already"),
    (BASE + "  - {name: Robot-7}", "name robot-7 is robot-7's already"),
    (BASE + "  - {name: all}", "is a word of the policy"),
    (BASE + "  - {name: ca}", "is a word of the policy"),
    (BASE + "  - {name: ../x}", "operators[1].name"),
    (BASE.replace("id: 8", "id: 7"), "robots: robot-8: id 7 is robot-7's already"),
    (BASE.replace("id: 8", "id: 8, awareness_name: drone7"), "awareness_name drone7 is robot-7's already"),
    (BASE.replace("[2, 3]", "[2, 1]"), "gateways: hall-2: block 1 is hall-1's already"),
    (BASE.replace("[2, 3]", "[2, 256]"), "gateways[1].blocks[1]"),
    (BASE.replace("id: 8", "id: 8, routers: [sit]"), "there is no 'sit' here, did you mean 'site'?"),
    (BASE.replace("10.0.0.5]", "10.0.0.5], links: [site]"), "there is no 'site' here"),
    (BASE.replace("10.0.0.5]", "10.0.0.5], listen: ['tcp/[::]:7447']"), "is no TLS endpoint"),
    (BASE.replace("10.0.0.5]", "'tls/10.0.0.5']"), "is no host name or IP address"),
    (BASE + "permissions: [{who: robts, may: see, whom: all}]", "did you mean 'robots'?"),
    (BASE + "permissions: [{who: robots, may: sea, whom: all}]", "permissions[0].may"),
    (BASE + "permissions: [{who: robots, may: [], whom: all}]", "gives no right"),
    (BASE + "permissions: [{who: [], may: see, whom: all}]", "names nobody"),
    (BASE + "permissions: [{who: site, may: see, whom: all}]", "there is no 'site' here"),
    (BASE + "permissions: [{who: anna, may: see, verbs: [status], whom: all}]", "belong to `call`"),
    (BASE + "traffic: [{match: 'a//b', max_hz: 1}]", "is not a key expression"),
    (BASE + "traffic: [{match: 'a', max_hx: 1}]", "did you mean `max_hz`?"),
    (BASE + "namespace: a/*", "is not a plain key"),
    (BASE + "certificates: {days: 0}", "certificates.days"),
    (BASE + "certificates: {days: 90, ca_days: 60}", "certificates.ca_days: below days, 90"),
]


@pytest.mark.parametrize(
    ("text", "words"), WRONG, ids=[f"{words} {number}" for number, (_, words) in enumerate(WRONG)]
)
def test_a_wrong_plan_is_refused(text: str, words: str) -> None:
    """What cannot be is refused with where it is and what would be right."""
    with pytest.raises(ConfigError, match=r"^site\.yaml") as refused:
        policy.parse(text, "site.yaml")
    assert words in str(refused.value)


def test_gateways_with_different_permissions_need_blocks() -> None:
    """Headsets are told apart by their block, so gateways without one may only have the same permissions."""
    crowd = BASE.replace(", blocks: [1]", "")
    made("  - {who: gateways, may: all, whom: all}\n  - {who: all, may: all, whom: gateways}\n", crowd)
    for permission in (
        "  - {who: hall-1, may: see, whom: robots}\n",
        "  - {who: robot-7, may: message, whom: hall-2}\n",
        "  - {who: hall-1, may: message, whom: hall-2}\n",
        "  - {who: hall-1, may: call, verbs: [x], whom: robots}\n",
    ):
        with pytest.raises(ConfigError, match=r"hall-1\.blocks"):
            made(permission, crowd)
        made(permission)


def test_a_plan_that_is_not_there(tmp_path: Path) -> None:
    """A missing file and one that is no text are told apart from a wrong policy."""
    with pytest.raises(ConfigError, match="No such file"):
        policy.load(tmp_path / "x.yaml")
    (tmp_path / "x.yaml").write_bytes(b"\xff\xfe")
    with pytest.raises(ConfigError, match="not UTF-8"):
        policy.load(tmp_path / "x.yaml")


def test_the_page_has_every_field() -> None:
    """docs/security.md explains each field of each entry of a policy."""
    page = (Path(__file__).parents[2] / "docs" / "security.md").read_text(encoding="utf-8")
    rows = [line.split("|") for line in page.splitlines() if line.startswith("| `")]
    explained = {(name, row[2].strip(" `")) for row in rows for name in re.findall(r"`(\w+)`", row[1])}
    words = {word for name, of in explained for word in (name, *re.findall(r"\w+", of))}
    assert {field.name for field in msgspec.structs.fields(Policy)} <= words
    for kind in (policy.Router, policy.Robot, policy.Gateway, policy.Operator, policy.Permission, policy.Certificates):
        where = kind.__name__.lower() + ("" if kind is policy.Certificates else "s")
        for field in msgspec.structs.fields(kind):
            of = {of for name, of in explained if name == field.name}
            assert any(where in each or each == "all" for each in of), (kind.__name__, field.name)
