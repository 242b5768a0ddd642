"""The files of a policy's nodes: a router's configuration (JSON5) and a client's settings (TOML). Pure."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import msgspec

from bridge.security import access
from bridge.security.access import Rule
from bridge.security.policy import Client, Gateway, Operator, Policy, Robot, Router
from macs_zenoh.config import MeshSettings, TrafficRule
from macs_zenoh.protocol import keyexpr
from macs_zenoh.protocol.endpoints import protocol_of
from macs_zenoh.protocol.key_expressions import begins
from macs_zenoh.protocol.keyexpr import STREAM, type_name
from macs_zenoh.protocol.messages import ROS, UNITY
from macs_zenoh.sections import changed

WIDTH = 119

WHY = {
    "mode": "a router: gateways, robots and operators are its clients",
    "listen/endpoints": "TLS only",
    "connect/endpoints": "routers that this one dials",
    "connect/timeout_ms": "go on trying as long as it takes",
    "connect/exit_on_failure": "a router whose neighbour is away still serves its own side",
    "connect/retry": "soon (Zenoh: 1 s to 4 s), but not at once: a link that is back within 0.1 s may stay dead",
    "scouting/multicast/enabled": "a mesh is what its endpoints say",
    "scouting/delay": "nothing to wait for without scouting",
    "transport/unicast/open_timeout": "ms until the next attempt, where a host does not even refuse (Zenoh: 10 s)",
    "transport/shared_memory/enabled": "implicit shared memory bypasses limits and can drop silently",
    "transport/link/tx/lease": "a host that stops has left after so many ms (Zenoh: 10 s)",
    "transport/link/tx/queue/congestion_control/drop/wait_before_drop": (
        "µs that stream data waits for room (Zenoh: 1 ms)"
    ),
    "transport/link/tx/queue/congestion_control/drop/max_wait_before_drop_fragments": (
        "the same for the fragments of a big message: without it they vanish"
    ),
    "transport/link/tx/queue/congestion_control/block/wait_before_close": (
        "µs until a link that takes nothing is closed, so that it does not hold up the others (Zenoh: 5 s)"
    ),
    "transport/link/tx/queue/size": "batches of 64 KiB per priority and link (Zenoh: 2; above 16 it panics)",
    "transport/link/protocols": "nothing that is not encrypted",
    "transport/link/tls/root_ca_certificate": "who signs the certificates of this mesh, and no other",
    "transport/link/tls/enable_mtls": "who dials shows a certificate as well",
    "transport/link/tls/verify_name_on_connect": "a router must be who it was dialled as",
    "transport/link/tls/close_link_on_expiration": "an expired certificate ends the link, not only the next one",
    "adminspace": "`macs doctor` reads versions and links there; who may is below",
    "metadata": "this router's name, for the doctor",
}
"""Why a value is what it is, by its path in Zenoh's configuration."""


def certificate_paths(directory: str) -> dict[str, str]:
    """Where Zenoh finds a node's certificate, by Zenoh's path: for dialling and, in a router, for listening."""
    return {
        "root_ca_certificate": f"{directory}/ca.pem",
        "connect_private_key": f"{directory}/key.pem",
        "connect_certificate": f"{directory}/cert.pem",
    }


def client_overrides(directory: str) -> list[str]:
    """TLS of who dials, as `MeshSettings.overrides`."""
    tls: dict[str, str | bool] = {
        **certificate_paths(directory),
        "enable_mtls": True,
        "verify_name_on_connect": True,
        "close_link_on_expiration": True,
    }
    return [f"transport/link/tls/{name}:{json.dumps(value)}" for name, value in tls.items()]


# -- a router ----------------------------------------------------------------------------------------------------


def router_json5(policy: Policy, router: Router, directory: str) -> str:
    """The whole configuration of a router, for ``zenohd -c`` and ``macs router -c``.

    ``directory`` is where its certificate will be on its machine.
    """
    others = {other.name: other for other in policy.routers}
    mesh = changed(
        policy.mesh,
        mode="router",
        listen=router.listen,
        connect=[endpoint for name in router.links for endpoint in others[name].dialled],
    )
    tree: dict[str, Any] = {}
    for path, json5, _ in mesh.zenoh():
        _put(tree, path, json.loads(json5))
    tls: dict[str, str | bool] = {
        **certificate_paths(directory),
        "listen_private_key": f"{directory}/key.pem",
        "listen_certificate": f"{directory}/cert.pem",
        "enable_mtls": True,
        "verify_name_on_connect": True,
        "close_link_on_expiration": True,
    }
    for name, value in tls.items():
        _put(tree, f"transport/link/tls/{name}", value)
    protocols = sorted({protocol_of(endpoint) for one in policy.routers for endpoint in (*one.listen, *one.dialled)})
    _put(tree, "transport/link/protocols", protocols)
    tree["adminspace"] = {"enabled": True, "permissions": {"read": True, "write": False}}
    tree["metadata"] = {"name": router.name}
    own_rules = tree.pop("qos")["network"]
    body = [*_members(tree, "", 1), "", *_access(policy, router), *_traffic(policy, own_rules)]
    return "\n".join(
        [
            f"// Router {router.name}, made by `macs security generate` from a policy: change that, not this.",
            f"//   zenohd -c router.json5   or   macs router -c router.json5; its certificate is in {directory}",
            "{",
            *body,
            "}",
            "",
        ]
    )


def _put(tree: dict[str, Any], path: str, value: object) -> None:
    *parents, last = path.split("/")
    for parent in parents:
        tree = tree.setdefault(parent, {})
    tree[last] = value


def _members(tree: dict[str, Any], path: str, depth: int) -> Iterator[str]:
    """The members of an object, one line each, with a comment where there is a reason to give."""
    indent = "  " * depth
    for name, value in tree.items():
        here = f"{path}/{name}" if path else name
        if here in WHY:
            yield f"{indent}// {WHY[here]}"
        if isinstance(value, dict) and any(
            isinstance(each, dict) or f"{here}/{k}" in WHY for k, each in value.items()
        ):
            yield f"{indent}{name}: {{"
            yield from _members(value, here, depth + 1)
            yield f"{indent}}},"
        else:
            yield f"{indent}{name}: {_inline(value)},"


def _inline(value: Any) -> str:
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{name}: {_inline(each)}" for name, each in value.items()) + " }"
    if isinstance(value, list):
        return "[" + ", ".join(map(_inline, value)) + "]"
    return json.dumps(value)


# -- access control ----------------------------------------------------------------------------------------------


def _access(policy: Policy, router: Router) -> Iterator[str]:
    by_node = [(client.name, access.rules(policy, client)) for client in policy.clients]
    by_node += [(other.name, access.link_rules(policy)) for other in access.linked(policy, router)]
    yield "  // Who may what. A certificate's common name says who somebody is; what no rule allows is dropped."
    yield "  // `ingress` is on the way into this router, `egress` on the way out of it."
    yield "  access_control: {"
    yield "    enabled: true,"
    yield '    default_permission: "deny",'
    yield "    rules: ["
    for name, rules in by_node:
        yield f"      // {_summary(policy, name)}"
        for rule in rules:
            yield from _rule(name, rule)
    yield "    ],"
    yield "    subjects: ["
    yield from (f"      {{ id: {json.dumps(name)}, cert_common_names: [{json.dumps(name)}] }}," for name, _ in by_node)
    yield "    ],"
    yield "    policies: ["
    for name, rules in by_node:
        yield "      {"
        yield f"        subjects: [{json.dumps(name)}],"
        yield from _listed("rules", [json.dumps(_id(name, rule)) for rule in rules], 8)
        yield "      },"
    yield "    ],"
    yield "  },"


def _id(name: str, rule: Rule) -> str:
    return f"{name} {rule.what}"


def _rule(name: str, rule: Rule) -> Iterator[str]:
    yield "      {"
    yield f"        id: {json.dumps(_id(name, rule))},"
    yield '        permission: "allow",'
    yield from _listed("messages", [json.dumps(message) for message in rule.messages], 8)
    yield f"        flows: {json.dumps(rule.flows)},"
    yield from _listed("key_exprs", [json.dumps(key) for key in rule.keys], 8)
    yield "      },"


def _summary(policy: Policy, name: str) -> str:
    node = policy.node(name)
    if isinstance(node, Router):
        return f"{name}: a router, which has held its own clients to these rules"
    if isinstance(node, Robot):
        group = f", group {node.group}" if node.group else ""
        return f"{name}: robot {node.id}{group}" + (
            f", called {node.awareness_name}" if node.awareness_name is not None else ""
        )
    if isinstance(node, Gateway):
        of = f"block {', '.join(map(str, node.blocks))}" if node.blocks else "any block"
        return f"{name}: a gateway, which speaks for the headsets of {of}"
    return f"{name}: an operator, operator/{node.id or 0}"


def _listed(name: str, words: Sequence[str], indent: int, end: str = ",") -> Iterator[str]:
    """``name: ["as", "many", "on", "a", "line", "as", "fit"],``"""
    spaces = " " * indent
    line = f"{spaces}{name}: [{', '.join(words)}]{end}"
    if len(line) <= WIDTH:
        yield line
        return
    yield f"{spaces}{name}: ["
    line = f"{spaces}  "
    for word in words:
        if len(line) + len(word) + 1 > WIDTH:
            yield line.rstrip()
            line = f"{spaces}  "
        line += f"{word}, "
    yield line.rstrip()
    yield f"{spaces}]{end}"


# -- traffic -----------------------------------------------------------------------------------------------------


GUARD = 2.0
"""A router lets so many times a rule's rate pass: what the rule says is done where messages enter the mesh, and a
message that was a little late there must not be lost here."""


def _traffic(policy: Policy, own_rules: list[dict[str, Any]]) -> Iterator[str]:
    """The policy's traffic rules as Zenoh has them, against programs that do not keep them."""
    yield ""
    if policy.traffic:
        yield "  // Traffic rules of the policy. Programs apply them where messages enter the mesh; the router stops"
        yield "  // what comes from a program that does not."
    yield from _downsampling(policy)
    yield from _low_pass(policy)
    yield from _priorities(policy, own_rules)


def _downsampling(policy: Policy) -> Iterator[str]:
    rates: dict[str, float] = {}
    for rule in policy.traffic:
        if rule.max_hz is None:
            continue
        keys = [] if rule.cache is not None else _exact(policy, rule)
        if not keys:
            yield f"  // max_hz of {rule.match} is left to the programs: Zenoh counts all keys of a rule as one"
        for key in keys:
            rates.setdefault(key, rule.max_hz)
    if rates:
        yield f"  // {GUARD:g} times max_hz: what was a little late at its source is not lost here"
        yield '  downsampling: [{ id: "max_hz", messages: ["put"], flows: ["ingress"], rules: ['
        for key, rate in rates.items():
            yield f"    {{ key_expr: {json.dumps(_inside(policy, key))}, freq: {GUARD * rate:g} }},"
        yield "  ] }],"


def _exact(policy: Policy, rule: TrafficRule) -> list[str]:
    """The keys of a rule, where they are those of one topic: of one robot, or of each of the policy's."""
    return keyexpr.of_each(rule.match, ROS, [robot.id for robot in policy.robots])


def _low_pass(policy: Policy) -> Iterator[str]:
    largest = 0
    entries = []
    for number, rule in enumerate(policy.traffic):
        if rule.max_bytes is not None:
            # of several rules that fit, Zenoh takes the smallest limit and programs the first: so none is smaller
            largest = max(largest, rule.max_bytes)
            keys = json.dumps([_inside(policy, rule.match)])
            entries.append(
                f'    {{ id: "max_bytes {number}", messages: ["put", "query"], flows: ["ingress"], key_exprs: {keys},'
                f" size_limit: {largest} }},"
            )
    if entries:
        yield "  low_pass_filter: ["
        yield from entries
        yield "  ],"


STREAMS = begins(STREAM.template)
"""How the keys of robots' topics begin, and no others."""


def _priorities(policy: Policy, own_rules: list[dict[str, Any]]) -> Iterator[str]:
    """Not of robots' topics: a robot's own rule for a topic wins over one for its key; a router would undo that."""
    entries: list[str] = []
    given = [(number, rule) for number, rule in enumerate(policy.traffic) if rule.priority is not None]
    for number, rule in given:
        begin = begins(rule.match)
        if begin == STREAMS:
            yield f"  // priority of {rule.match} is left to the programs: a robot may have another for the topic"
        elif begin is not None:
            entries.append(
                f'    {{ id: "priority {number}", messages: ["put", "query"], flows: ["ingress"],'
                f" key_exprs: {json.dumps([_inside(policy, rule.match)])},"
                f" overwrite: {{ priority: {json.dumps(rule.priority)} }} }},"
            )
        else:
            yield f"  // priorities from {rule.match} on are left to the programs: robots' topics are among its keys"
            break
    yield "  qos: { network: ["
    if entries:
        yield "    // the last one that fits wins here, the first one in the policy"
    yield from reversed(entries)
    yield "    // What has the priority of commands now is dropped where a link is full: who waits holds up everybody."
    for own in own_rules:
        *_, (last, overwrite) = own.items()
        yield f"    {_inline({name: value for name, value in own.items() if name != last})[:-2]},"
        yield f"      {last}: {_inline(overwrite)} }},"
    yield "  ] },"


def _inside(policy: Policy, key: str) -> str:
    return keyexpr.inside(policy.namespace, key)


# -- a client ----------------------------------------------------------------------------------------------------


def settings_toml(policy: Policy, client: Client, directory: str) -> str:
    """The settings of a client's programs. ``directory`` is where its certificate will be on its machine."""
    lines = [
        f"# Settings of {client.name}, made by `macs security generate` from a policy: change that, not this.",
        f"#   {_command(client, directory)}",
        "",
        "[mesh]",
        f"connect = {json.dumps(policy.endpoints(client))}",
        *([f"namespace = {json.dumps(policy.namespace)}"] if policy.namespace is not None else []),
        *_links(policy.mesh),
        "# Who this is: the certificate. Whom it trusts: routers with a certificate of the same authority.",
        "overrides = [",
        *(f"  {_toml(override)}," for override in client_overrides(directory)),
        "]",
    ]
    lines += _sections(policy, client, directory)
    for rule in policy.traffic:
        lines += ["", "[[traffic]]"]
        given = msgspec.structs.asdict(rule)
        lines += [f"{name} = {json.dumps(value)}" for name, value in given.items() if value is not None]
    return "\n".join([*lines, ""])


def _links(mesh: MeshSettings) -> Iterator[str]:
    """What leaves the defaults on every link."""
    for name, default in msgspec.structs.asdict(MeshSettings()).items():
        value = getattr(mesh, name)
        if value != default:
            yield f"{name} = {json.dumps(value)}"


def _command(client: Client, directory: str) -> str:
    verb = "agent" if isinstance(client, Robot) else "gateway" if isinstance(client, Gateway) else "ls"
    return f"macs {verb} --settings {directory}/macs.toml"


def _sections(policy: Policy, client: Client, directory: str) -> list[str]:
    if isinstance(client, Gateway):
        tokens = f"{directory}/tokens.json" if policy.headsets else None
        return _gateway_section(client, tokens)
    if isinstance(client, Operator) and client.id is not None:
        return [
            "",
            "[operator]",
            "# as whom robots are asked; routers let this certificate be nobody else",
            f"id = {client.id}",
        ]
    if not isinstance(client, Robot):
        return []
    lines = ["", "[robot]", f"id = {client.id}", f"group = {client.group}"]
    commanders = [
        pattern for other in policy.clients if policy.may(other, "command", client) for pattern in _who(other)
    ]
    lines += ["# who may command it; who may only see it registers for its topics and for nothing else"]
    lines += [f"register_allow = {json.dumps(list(dict.fromkeys(commanders)))}"]
    lines += _believed(policy, client)
    if client.ros_namespace:
        lines += ["", "# `macs rmw-zenoh`: its nodes' sessions have this namespace, and this certificate"]
        lines += ["[[rmw_zenoh.robots]]", f"id = {client.id}", f"group = {client.group}"]
        lines += [f"session_namespace = {json.dumps(client.ros_namespace)}"]
    if client.awareness_name is not None:
        name = json.dumps(client.awareness_name, ensure_ascii=False)
        lines += ["", "[awareness]", f"name = {name}", f"id = {client.id}", "beside = true"]
    return lines


def _gateway_section(gateway: Gateway, tokens: str | None) -> list[str]:
    lines = []
    if tokens is not None:
        lines += ["# what the policy's headsets may; it is followed while the gateway runs"]
        lines += [f"tokens_file = {json.dumps(tokens)}"]
    if gateway.blocks:
        lines += ["# the certificate is good for these only", f"blocks = {json.dumps(gateway.blocks)}"]
    if gateway.groups:
        lines += ["# robots believe these groups of its headsets", f"groups = {_table(gateway.groups)}"]
    return ["", "[gateway]", *lines] if lines else []


def _believed(policy: Policy, robot: Robot) -> list[str]:
    """Who is in which group, where a robot is told rights of a group: robots by their certificates, headsets as their
    gateways answer for it."""
    groups: dict[str, list[str]] = {}
    for other in policy.robots:
        if other.group and policy.related(robot, other):
            groups.setdefault(str(other.group), []).extend(_who(other))
    for gateway in policy.gateways:
        if policy.related(robot, gateway):
            for group in gateway.groups:
                groups.setdefault(group, []).extend(_who(gateway))
    if not groups:
        return []
    return ["# who is believed to be in a group, where a setting gives rights to one", f"groups = {_table(groups)}"]


def _table(lists: Mapping[str, list[str]]) -> str:
    """An inline table of TOML."""
    return "{ " + ", ".join(f"{name} = {json.dumps(words)}" for name, words in lists.items()) + " }"


def _who(client: Client) -> list[str]:
    """The agents that a client speaks for, as a robot's settings name them."""
    if isinstance(client, Gateway):
        return [f"block/{block}" for block in client.blocks] or [type_name(UNITY)]
    return [f"{type_name(int(agent['type']))}/{agent['id']}" for agent in access.agents(client)]


def _toml(text: str) -> str:
    """A string as TOML writes it, without escapes where that is possible."""
    return f"'{text}'" if "'" not in text and text.isprintable() else json.dumps(text)
