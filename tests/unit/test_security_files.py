"""What follows from a policy: rules, routers' configurations, settings, certificates."""

from __future__ import annotations

import datetime as dt
import json
import os
import stat
from functools import lru_cache
from pathlib import Path
from typing import Any

import pytest
import zenoh
from cryptography import x509
from cryptography.x509.oid import ExtendedKeyUsageOID

from bridge.security import access, files, policy
from bridge.security.generate import generate
from bridge.security.policy import Policy
from bridge.security.router_path import settings_of
from bridge.settings import parse
from macs_zenoh.config import MeshSettings
from macs_zenoh.errors import ConfigError, UsageError

ROOT = Path(__file__).parents[2]
NOW = dt.datetime(2026, 11, 22, tzinfo=dt.timezone.utc)
DAY = dt.timedelta(days=1)

TEXT = """
routers:
  - {name: site, addresses: [site.example.org, 10.0.0.5]}
  - {name: cloud, addresses: [cloud.example.org], links: [site]}
robots:
  - {name: robot-7, id: 7, group: 3, awareness_name: "drone 7"}
  - {name: robot-8, id: 300, group: 3, awareness_name: drone8}
gateways:
  - {name: hall-1, blocks: [1]}
  - {name: hall-2, blocks: [2]}
operators:
  - {name: anna}
permissions:
  - {who: hall-1, may: [command, see, call], whom: robots}
  - {who: hall-2, may: see, whom: robot-7}
  - {who: operators, may: call, verbs: [status], whom: robots}
  - {who: robot-7, may: message, whom: robot-8}
"""


SITE = policy.parse(TEXT)


@pytest.fixture
def site() -> Policy:
    return SITE


@lru_cache
def allowed(name: str, message: str, flow: str) -> list[zenoh.KeyExpr]:
    """The keys that some rule of a client allows to a kind of message in one direction."""
    client = next(client for client in SITE.clients if client.name == name)
    rules = [rule for rule in access.rules(SITE, client) if message in rule.messages and flow in rule.flows]
    return [zenoh.KeyExpr(key) for rule in rules for key in rule.keys]


def may(name: str, message: str, flow: str, key: str) -> bool:
    return any(rule.includes(zenoh.KeyExpr(key)) for rule in allowed(name, message, flow))


# -- rules ---------------------------------------------------------------------------------------------------------


def test_every_key_of_every_rule_is_one_for_zenoh(site: Policy) -> None:
    """Rules have canonical key expressions, each once."""
    for client in site.clients:
        for rule in access.rules(site, client):
            assert [str(zenoh.KeyExpr(key)) for key in rule.keys] == list(dict.fromkeys(rule.keys))


SENDS = [
    ("hall-1", "macs/to/ros/0/7/unity/256", True),
    ("hall-1", "macs/to/ros/1/300/unity/511", True),
    ("hall-1", "macs/to/ros/0/7/unity/512", False),
    ("hall-1", "macs/to/ros/0/7/ros/8", False),
    ("hall-1", "macs/group/3/ros/unity/300", True),
    ("hall-1", "macs/from/ros/7/nd__x", False),
    ("hall-1", "macs/to/unity/2/512/unity/256", False),
    ("hall-2", "macs/to/ros/0/7/unity/512", False),
    ("hall-2", "macs/group/3/ros/unity/512", False),
    ("robot-7", "macs/to/unity/2/512/ros/7", True),
    ("robot-8", "macs/to/unity/2/512/ros/300", False),
    ("robot-8", "macs/to/unity/1/256/ros/300", True),
    ("robot-7", "macs/to/ros/1/300/ros/7", False),
    ("robot-7", "macs/from/ros/7/nd__x", True),
    ("robot-7", "macs/from/ros/300/nd__x", False),
    ("robot-7", "macs/ca/to/drone8/t/by/drone 7", True),
    ("robot-8", "macs/ca/to/drone 7/t/by/drone8", False),
    ("anna", "macs/to/ros/0/7/operator/0", False),
]


@pytest.mark.parametrize(("name", "key", "permitted"), SENDS, ids=[f"{name} {key}" for name, key, _ in SENDS])
def test_who_may_put(name: str, key: str, permitted: bool) -> None:
    """Each sends in its own name to those whom it may command, or who may see or call it."""
    assert may(name, "put", "ingress", key) == permitted


def test_a_call_is_bound_to_its_verb() -> None:
    """Who may see a robot may register there; who may call one verb may call no other."""
    assert may("hall-2", "query", "ingress", "macs/call/ros/7/add_node/unity/512")
    assert not may("hall-2", "query", "ingress", "macs/call/ros/7/stop/unity/512")
    assert not may("hall-2", "query", "ingress", "macs/call/ros/300/add_node/unity/512")
    assert may("anna", "query", "ingress", "macs/call/ros/300/status/operator/0")
    assert not may("anna", "query", "ingress", "macs/call/ros/300/stop/operator/0")
    assert not may("hall-1", "query", "ingress", "@/abc/router")
    assert may("anna", "query", "ingress", "@/*/router")


def test_what_goes_to_several_reaches_whom_its_sender_may_reach() -> None:
    """A robot hears group messages and broadcasts of gateways that may command it, and of no other."""
    for key in ("macs/group/3/ros/unity/{}", "macs/all/unity/{}"):
        assert may("robot-7", "put", "egress", key.format(256))
        assert not may("robot-7", "put", "egress", key.format(512))
    assert may("hall-2", "put", "egress", "macs/all/ros/7")
    assert not may("hall-2", "put", "egress", "macs/all/ros/300")


def test_presence_is_seen_by_who_has_to_do_with_it() -> None:
    """Robots that have nothing to do with each other, or with a gateway, do not see it; operators see all."""
    assert may("hall-2", "liveliness_token", "egress", "macs/live/ros/0/7/3/a1")
    assert not may("hall-2", "liveliness_token", "egress", "macs/live/ros/1/300/3/a1")
    assert not may("robot-8", "liveliness_token", "egress", "macs/live/unity/2/512/0/a1")
    assert not may("robot-7", "liveliness_token", "ingress", "macs/live/ros/0/7/4/a1")
    assert may("anna", "liveliness_token", "egress", "macs/live/ros/1/300/3/a1")


def test_only_what_a_node_may_hear_is_in_its_rules(site: Policy) -> None:
    """Nobody may subscribe to what belongs to others, nor to everything."""
    for client in site.clients:
        for key in ("macs/**", "**", "macs/to/**", "macs/from/**", "macs/ca/to/**", "macs/call/**"):
            assert not may(client.name, "declare_subscriber", "ingress", key), (client.name, key)
            assert not may(client.name, "put", "egress", key), (client.name, key)


def test_a_namespace_is_before_every_key_but_the_routers_own() -> None:
    """Rules are for keys as the router sees them."""
    inside = policy.parse(TEXT + "namespace: site1/hall\n")
    keys = [key for client in inside.clients for rule in access.rules(inside, client) for key in rule.keys]
    keys += [key for rule in access.link_rules(inside) for key in rule.keys]
    assert {key.partition("/macs/")[0] for key in keys if not key.startswith("@")} == {"site1/hall"}
    assert set(access.ADMIN) <= set(keys)


# -- a router's file -------------------------------------------------------------------------------------------------


def loaded(found: Policy, name: str, tmp_path: Path) -> Any:
    path = tmp_path / "router.json5"
    router = next(router for router in found.routers if router.name == name)
    path.write_text(files.router_json5(found, router, "/etc/macs/" + name))
    return zenoh.Config.from_file(str(path))


def test_a_router_has_our_values(site: Policy, tmp_path: Path) -> None:
    """Everything that `macs router` would set is in the file, with the same values."""
    conf = loaded(site, "cloud", tmp_path)
    ours = MeshSettings(mode="router", listen=["tls/[::]:7447"], connect=["tls/site.example.org:7447"])
    for path, value, _ in ours.zenoh():
        expected = zenoh.Config()
        expected.insert_json5(path, value)
        assert conf.get_json(path) == expected.get_json(path), path
    tls = json.loads(conf.get_json("transport/link/tls"))
    assert tls["enable_mtls"] is True
    assert tls["listen_private_key"] == "/etc/macs/cloud/key.pem"
    assert json.loads(conf.get_json("transport/link/protocols")) == ["tls"]
    access_control = json.loads(conf.get_json("access_control"))
    assert access_control["enabled"] is True
    assert access_control["default_permission"] == "deny"
    assert {subject["id"] for subject in access_control["subjects"]} == {
        "robot-7",
        "robot-8",
        "hall-1",
        "hall-2",
        "anna",
        "site",
    }


@pytest.mark.parametrize("path", sorted((ROOT / "config" / "security").glob("*.yaml")), ids=lambda path: path.name)
def test_the_shipped_plans_make_files_that_load(path: Path, tmp_path: Path) -> None:
    """Zenoh takes the routers' files of each shipped policy, and our programs take the settings."""
    shipped = policy.load(path)
    for router in shipped.routers:
        assert json.loads(loaded(shipped, router.name, tmp_path).get_json("access_control/enabled")) is True
    for client in shipped.clients:
        assert parse(files.settings_toml(shipped, client, "/etc/macs")).mesh.connect


def test_the_rules_in_the_file_are_the_rules(site: Policy, tmp_path: Path) -> None:
    """Each client's rules are in the file whole, and in its policy, and in nobody else's."""
    control = json.loads(loaded(site, "site", tmp_path).get_json("access_control"))
    rules = {rule["id"]: rule for rule in control["rules"]}
    for client in site.clients:
        (policy,) = [policy for policy in control["policies"] if policy["subjects"] == [client.name]]
        written = [rules.pop(name) for name in policy["rules"]]
        assert [(tuple(r["messages"]), tuple(r["flows"]), tuple(r["key_exprs"])) for r in written] == [
            (rule.messages, rule.flows, rule.keys) for rule in access.rules(site, client)
        ]
        assert {rule["permission"] for rule in written} == {"allow"}
    assert list(rules) == ["cloud carries everything"]


def test_no_line_is_long(site: Policy) -> None:
    """The file can be read: keys are wrapped, and each node has a line that says who it is."""
    text = files.router_json5(site, site.routers[0], "/etc/macs/site")
    assert max(map(len, text.splitlines())) <= 140
    assert "// robot-7: robot 7, group 3, called drone 7" in text


TRAFFIC = """
traffic:
  - {match: "macs/from/ros/*/nd__camera$*", max_hz: 15, priority: data_low}
  - {match: "macs/from/ros/*/nd__pose", max_hz: 50}
  - {match: "macs/from/ros/7/nd__log", max_hz: 5, cache: 100}
  - {match: "macs/from/ros/7/**", max_bytes: 5000000, priority: data_high}
  - {match: "macs/to/ros/**", priority: interactive_high}
  - {match: "macs/to/**", priority: data}
  - {match: "macs/**", max_bytes: 100000, max_bytes_per_s: 1000000}
"""


def test_traffic_rules_are_a_guard_in_the_router(tmp_path: Path) -> None:
    """What Zenoh can say of the traffic rules is in the file, never stricter than where messages enter the mesh."""
    conf = loaded(policy.parse(TEXT + TRAFFIC), "site", tmp_path)
    (rates,) = json.loads(conf.get_json("downsampling"))
    assert rates["flows"] == ["ingress"]
    assert {rule["key_expr"]: rule["freq"] for rule in rates["rules"]} == {
        "macs/from/ros/7/nd__pose": 100.0,
        "macs/from/ros/300/nd__pose": 100.0,
    }
    sizes = json.loads(conf.get_json("low_pass_filter"))
    assert [(size["key_exprs"], size["size_limit"]) for size in sizes] == [
        (["macs/from/ros/7/**"], 5000000),
        (["macs/**"], 5000000),
    ]
    *priorities, own = json.loads(conf.get_json("qos/network"))
    assert own["overwrite"]["congestion_control"] == "drop", "also of what the rules before give that priority"
    assert [(one["key_exprs"], one["overwrite"]["priority"]) for one in priorities] == [
        (["macs/to/ros/**"], "interactive_high"),
        (["macs/to/**"], "data"),
    ][::-1]


def test_a_router_leaves_the_priorities_of_topics_to_robots(tmp_path: Path) -> None:
    """A robot's own rule for a topic wins over a traffic rule for its key, so no router may change it again; behind a
    rule that holds for topics and others alike nothing is exported, because there the last one would win."""
    text = TEXT + TRAFFIC.replace("macs/to/ros/**", "macs/**")
    conf = loaded(policy.parse(text), "site", tmp_path)
    assert not [rule for rule in json.loads(conf.get_json("qos/network")) if rule["overwrite"]["priority"]]
    written = (tmp_path / "router.json5").read_text()
    assert "priority of macs/from/ros/7/** is left to the programs" in written
    assert "priorities from macs/** on are left to the programs" in written


# -- a client's file -------------------------------------------------------------------------------------------------


def test_settings_say_who_somebody_is() -> None:
    """A client's settings have routers in order, its certificate, and what it is on the mesh."""
    found = policy.parse(TEXT + TRAFFIC + "namespace: site1\n")
    made = {client.name: parse(files.settings_toml(found, client, "/etc/macs")) for client in found.clients}
    robot = made["robot-7"]
    assert robot.mesh.connect == ["tls/site.example.org:7447", "tls/cloud.example.org:7447"]
    assert 'transport/link/tls/connect_private_key:"/etc/macs/key.pem"' in robot.mesh.overrides
    assert "transport/link/tls/enable_mtls:true" in robot.mesh.overrides
    assert robot.mesh.namespace == "site1"
    assert (robot.robot.id, robot.robot.group) == (7, 3)
    assert robot.robot.register_allow == ["block/1"]  # hall-2 may see it, and no more
    assert (robot.awareness.name, robot.awareness.id, robot.awareness.beside) == ("drone 7", 7, True)
    assert made["hall-2"].gateway.blocks == [2]
    assert robot.traffic == found.traffic
    assert made["anna"].operator.id is None
    numbered = policy.parse((TEXT + TRAFFIC).replace("{name: anna}", "{name: anna, id: 5}"))
    anna = next(client for client in numbered.clients if client.name == "anna")
    assert parse(files.settings_toml(numbered, anna, "/etc/macs")).operator.id == 5


def test_groups_are_believed_of_those_who_are_answered_for() -> None:
    """Where a gateway says from where a group may be chosen, robots that have to do with it believe its headsets;
    robots are in the group that their certificate is for."""
    text = TEXT.replace("blocks: [1]", "blocks: [1], groups: {'9': [10.0.3.0/24]}")
    found = policy.parse(text)
    made = {client.name: parse(files.settings_toml(found, client, "/x")) for client in found.clients}
    assert made["hall-1"].gateway.groups == {"9": ["10.0.3.0/24"]}
    assert made["hall-2"].gateway.groups == {}
    assert made["robot-7"].robot.groups["9"] == ["block/1"]
    with pytest.raises(ConfigError, match=r"gateways: hall-1\.groups\.9.*is not a network"):
        policy.parse(text.replace("10.0.3.0/24", "somewhere"))


def test_a_robot_knows_who_may_command_it() -> None:
    """What somebody registers for is in a payload, where no router sees it, so the robot's settings say who may."""
    text = TEXT.replace("{name: anna}", "{name: anna, id: 5}\n  - {name: berta}").replace(", blocks: [1]", "")
    text = text.replace(", blocks: [2]", "").partition("permissions:")[0]
    found = policy.parse(text + "permissions: [{who: [gateways, robot-8, operators], may: command, whom: robot-7}]")
    first, second = (parse(files.settings_toml(found, robot, "/x")).robot for robot in found.robots)
    assert sorted(first.register_allow) == ["operator/0", "operator/5", "ros/300", "unity"]
    assert second.register_allow == []


def test_names_with_quotes_and_spaces_survive() -> None:
    """Whatever a robot is called and wherever its files are, its settings say so."""
    found = policy.parse(TEXT.replace('"drone 7"', """'d"r\\o''né 7'"""))
    made = parse(files.settings_toml(found, found.robots[0], "/etc/it's macs/ß"))
    assert made.awareness.name == "d\"r\\o'né 7"
    assert made.mesh.overrides[0] == 'transport/link/tls/root_ca_certificate:"/etc/it\'s macs/\\u00df/ca.pem"'


def test_the_check_has_the_links_of_the_plan(tmp_path: Path) -> None:
    """Sessions of the check wait as long as everybody's on this mesh, so that a slow link is not cut and misread."""
    slow = policy.parse(TEXT + "namespace: site1\nmesh: {lease_ms: 10000, block_limit_ms: 5000}\n")
    made = settings_of(slow, tmp_path, "tls/cloud.example.org:7447")
    assert (made.lease_ms, made.block_limit_ms, made.namespace) == (10000, 5000, "site1")
    assert made.connect == ["tls/cloud.example.org:7447"]
    assert made.overrides


# -- certificates ----------------------------------------------------------------------------------------------------


def certificate(directory: Path) -> x509.Certificate:
    return x509.load_pem_x509_certificate((directory / "cert.pem").read_bytes())


def test_a_certificate_says_who_and_for_what(site: Policy, tmp_path: Path) -> None:
    """The common name is the node's; only routers may be servers, under their addresses."""
    generate(site, tmp_path, NOW)
    for node in site.nodes:
        made = certificate(tmp_path / node.name)
        assert [name.value for name in made.subject] == [node.name]
        usages = list(made.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value)
        assert (ExtendedKeyUsageOID.SERVER_AUTH in usages) == (node in site.routers)
        assert made.not_valid_after_utc == NOW + 90 * DAY
        made.verify_directly_issued_by(x509.load_pem_x509_certificate((tmp_path / node.name / "ca.pem").read_bytes()))
    names = certificate(tmp_path / "site").extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    assert [str(name.value) for name in names] == ["site.example.org", "10.0.0.5"]


def test_keys_are_for_their_owner_only(site: Policy, tmp_path: Path) -> None:
    """Whatever the umask: directories 0700; keys, routers' files and settings 0600."""
    before = os.umask(0)
    try:
        generate(site, tmp_path / "pki", NOW)
    finally:
        os.umask(before)
    for path in (tmp_path / "pki", *(tmp_path / "pki").rglob("*")):
        mode = stat.S_IMODE(path.stat().st_mode)
        if path.is_dir():
            assert mode == 0o700, path
        else:
            assert mode == (0o644 if path.name in ("cert.pem", "ca.pem") else 0o600), path


def test_a_directory_that_is_there_stays_as_it_is(site: Policy, tmp_path: Path) -> None:
    """Only what is made is closed to others, not the directory that somebody had already."""
    tmp_path.chmod(0o755)
    generate(site, tmp_path, NOW)
    assert stat.S_IMODE(tmp_path.stat().st_mode) == 0o755
    assert stat.S_IMODE((tmp_path / "ca").stat().st_mode) == 0o700


def contents(directory: Path) -> dict[str, bytes]:
    return {str(path.relative_to(directory)): path.read_bytes() for path in directory.rglob("*") if path.is_file()}


def test_a_second_run_changes_nothing(site: Policy, tmp_path: Path) -> None:
    """While certificates are good and the policy is the same, every file stays as it is."""
    generate(site, tmp_path, NOW)
    before = contents(tmp_path)
    report = generate(site, tmp_path, NOW + 59 * DAY)
    assert contents(tmp_path) == before
    assert not [one for one in report.issued if one.why]
    assert not report.written
    assert not report.routers_changed


def test_what_is_about_to_end_is_renewed(site: Policy, tmp_path: Path) -> None:
    """With less than a third of its life left, or when it is asked for, a certificate and its key are made anew."""
    generate(site, tmp_path, NOW)
    before = contents(tmp_path)
    report = generate(site, tmp_path, NOW + 10 * DAY, renew=["robot-7"])
    assert [(one.name, one.why) for one in report.issued if one.why] == [("robot-7", "asked")]
    after = contents(tmp_path)
    changed = {name for name in after if after[name] != before[name]}
    assert changed == {"robot-7/cert.pem", "robot-7/key.pem"}

    report = generate(site, tmp_path, NOW + 62 * DAY)
    assert [one.name for one in report.issued if not one.why] == ["robot-7"]
    assert report.routers_changed == ["cloud", "site"]
    assert contents(tmp_path)["ca/ca.pem"] == before["ca/ca.pem"]
    assert certificate(tmp_path / "hall-1").not_valid_after_utc == NOW + 152 * DAY


def test_what_does_not_fit_is_renewed(site: Policy, tmp_path: Path) -> None:
    """A router with other addresses, a lost key and a broken certificate are made anew; nothing else."""
    generate(site, tmp_path, NOW)
    (tmp_path / "robot-7" / "key.pem").write_bytes((tmp_path / "robot-8" / "key.pem").read_bytes())
    (tmp_path / "hall-1" / "key.pem").unlink()
    (tmp_path / "hall-2" / "cert.pem").write_text("broken")
    moved = policy.parse(TEXT.replace("10.0.0.5", "10.0.0.6"))
    report = generate(moved, tmp_path, NOW + DAY)
    assert {one.name: one.why for one in report.issued if one.why} == {
        "site": "other addresses",
        "robot-7": "not its key",
        "hall-1": "unreadable",
        "hall-2": "unreadable",
    }


def test_a_directory_under_another_name_gets_a_certificate_of_its_own(site: Policy, tmp_path: Path) -> None:
    """What was moved or copied says who it was, which no rule knows under the new name: it is made anew."""
    generate(site, tmp_path, NOW)
    (tmp_path / "robot-7").rename(tmp_path / "robot-7b")
    report = generate(policy.parse(TEXT.replace("robot-7", "robot-7b")), tmp_path, NOW + DAY)
    assert {one.name: one.why for one in report.issued if one.why} == {"robot-7b": "other name"}
    assert [name.value for name in certificate(tmp_path / "robot-7b").subject] == ["robot-7b"]


def test_a_new_authority_ends_all_certificates(site: Policy, tmp_path: Path) -> None:
    """With a new authority everybody gets a new certificate and trusts the new one only."""
    generate(site, tmp_path, NOW)
    before = contents(tmp_path)
    report = generate(site, tmp_path, NOW + DAY, new_authority=True)
    after = contents(tmp_path)
    assert {one.why for one in report.issued} == {"of another authority"}
    assert all(after[name] != before[name] for name in after if name.endswith(".pem"))
    assert {after[name] for name in after if name.endswith("ca.pem")} == {after["ca/ca.pem"]}


def test_who_left_the_plan_is_named_and_in_no_rule(site: Policy, tmp_path: Path) -> None:
    """A name that is no longer in the policy is reported, its files stay, and routers do not know it any more."""
    generate(site, tmp_path, NOW)
    fewer = policy.parse(
        TEXT.replace("  - {name: robot-8, id: 300, group: 3, awareness_name: drone8}\n", "").replace(
            "  - {who: robot-7, may: message, whom: robot-8}\n", ""
        )
    )
    report = generate(fewer, tmp_path, NOW + DAY)
    assert report.orphaned == [("robot-8", NOW + 90 * DAY)]
    assert report.routers_changed == ["cloud", "site"]
    assert (tmp_path / "robot-8" / "cert.pem").exists()
    assert "robot-8" not in (tmp_path / "site" / "router.json5").read_text()


def test_no_certificate_outlives_its_authority(site: Policy, tmp_path: Path) -> None:
    """An authority that ends sooner than a certificate would says what to do."""
    generate(site, tmp_path, NOW)
    with pytest.raises(ConfigError, match="--new-ca"):
        generate(site, tmp_path, NOW + 3600 * DAY)


def test_an_authority_without_its_key_is_not_replaced_silently(site: Policy, tmp_path: Path) -> None:
    """A lost or foreign key of the authority is an error that says what to do."""
    generate(site, tmp_path, NOW)
    key = tmp_path / "ca" / "key.pem"
    key.write_bytes((tmp_path / "site" / "key.pem").read_bytes())
    with pytest.raises(ConfigError, match="--new-ca"):
        generate(site, tmp_path, NOW)
    key.unlink()
    with pytest.raises(ConfigError, match="--new-ca"):
        generate(site, tmp_path, NOW)


def test_only_names_of_the_plan_are_renewed(site: Policy, tmp_path: Path) -> None:
    """A misspelled name to renew is refused before anything is written."""
    with pytest.raises(UsageError, match="robot-9"):
        generate(site, tmp_path / "pki", NOW, renew=["robot-9"])
    assert not (tmp_path / "pki").exists()


def test_files_know_where_they_will_be(site: Policy, tmp_path: Path) -> None:
    """With a place to be, settings and routers' files name it; without, where they are now."""
    generate(site, tmp_path, NOW, at="/etc/macs/")
    assert '"/etc/macs/robot-7/key.pem"' in (tmp_path / "robot-7" / "macs.toml").read_text()
    assert '"/etc/macs/site/key.pem"' in (tmp_path / "site" / "router.json5").read_text()
    generate(site, tmp_path, NOW)
    assert str(tmp_path / "robot-7" / "key.pem") in (tmp_path / "robot-7" / "macs.toml").read_text()


# -- a directory that somebody has prepared --------------------------------------------------------------------------


@pytest.mark.parametrize(
    "planted", ["ca", "ca/key.pem", "ca/ca.pem", "robot-7", "robot-7/key.pem", "robot-7/macs.toml"]
)
def test_nothing_is_written_or_read_through_a_link(site: Policy, tmp_path: Path, planted: str) -> None:
    """Who prepared the directory gets no key of ours, and no authority of his is taken for ours."""
    into, elsewhere = tmp_path / "pki", tmp_path / "elsewhere"
    generate(site, into, NOW)
    moved = into / planted
    moved.rename(elsewhere)
    moved.symlink_to(elsewhere)
    before = sorted(path.stat().st_mtime_ns for path in tmp_path.rglob("*") if path.is_file())
    with pytest.raises(ConfigError, match="is a link"):
        generate(site, into, NOW, renew=["all"])
    assert sorted(path.stat().st_mtime_ns for path in tmp_path.rglob("*") if path.is_file()) == before


def test_a_directory_of_others_is_not_used(site: Policy, tmp_path: Path) -> None:
    """What belongs to somebody else, or can be written by others, is refused with what to do."""
    generate(site, tmp_path / "pki", NOW)
    (tmp_path / "pki" / "ca" / "key.pem").chmod(0o660)
    with pytest.raises(ConfigError, match="can be written by others"):
        generate(site, tmp_path / "pki", NOW)
    (tmp_path / "pki" / "ca" / "key.pem").chmod(0o600)
    generate(site, tmp_path / "pki", NOW)
    if os.geteuid() == 0:
        os.chown(tmp_path / "pki" / "ca" / "ca.pem", 12345, -1)
        with pytest.raises(ConfigError, match="belongs to user 12345"):
            generate(site, tmp_path / "pki", NOW)


def test_a_certificate_that_is_no_authority_signs_nothing(site: Policy, tmp_path: Path) -> None:
    """A node's certificate and key in the authority's place are found out."""
    generate(site, tmp_path, NOW)
    for name, source in (("ca.pem", "cert.pem"), ("key.pem", "key.pem")):
        (tmp_path / "ca" / name).write_bytes((tmp_path / "robot-7" / source).read_bytes())
    with pytest.raises(ConfigError, match="is no authority; use --new-ca"):
        generate(site, tmp_path, NOW)
