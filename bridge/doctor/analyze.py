"""What the facts mean. Pure."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from typing import Any

from bridge.principal import Principal
from macs_zenoh.protocol.directory import AgentInfo, published
from macs_zenoh.protocol.keyexpr import LEASE, NAME, PRESENCE, UNICAST, block_of, namespace_of, type_name
from macs_zenoh.protocol.messages import UNITY

from .checks import ERROR, GROUPS, NOTE, WARNING
from .facts import Certificate, Clock, Endpoint, Facts, NetworkPath, Program, RouterInfo
from .findings import Finding, found
from .words import (
    bit_rate,
    byte_size,
    bytes_per_s,
    counted,
    median_ms,
    name_of,
    round_trip,
    seconds,
    sessions,
    short_problem,
    short_version,
    some,
    tallied,
    throughput,
)

CLOCK_S = 0.1
"""A clock that is further off makes sensor times and latencies misleading."""
CERTIFICATE_S = 14 * 86_400.0
LEASE_MS = (1_000, 10_000)
"""Below, a busy Wi-Fi looks like a lost host; above, a lost host is online for longer than an operator waits."""
QUEUE_BATCHES = 16
"""With more, Zenoh panics at the first link (1.10)."""
BATCH_BYTES = 65_535
CLOSE_US = 5_000_000
"""Zenoh's own, which slow links need."""
SLOW_MS = 150.0
DEFAULT_PORT = 7447
"""Of routers."""


def analyze(facts: Facts) -> list[Finding]:
    """Everything that the facts show, worst first within each group."""
    everything = [
        *_routers(facts),
        *_linked(facts),
        *_versions(facts),
        *_sessions(facts),
        *_tls(facts),
        *_access(facts),
        *_mesh(facts),
        *_programs(facts),
        *_settings(facts),
    ]
    unique = list(dict.fromkeys(everything))
    return sorted(unique, key=lambda finding: (GROUPS.index(finding.group), -finding.severity))


def of_endpoints(facts: Facts) -> list[Finding]:
    """What is wrong with endpoints that let nobody in, where only the way to them was looked at."""
    return [finding for finding in [*_routers(facts), *_tls(facts)] if finding.where and finding.severity > NOTE]


# -- routers -----------------------------------------------------------------------------------------------------


def _routers(facts: Facts) -> Iterator[Finding]:
    if not facts.endpoints:
        yield found("no_endpoint")
    some_answer = any(endpoint.router for endpoint in facts.endpoints)
    for endpoint in facts.endpoints:
        where = endpoint.endpoint
        if endpoint.router:
            yield found(
                "router_ok",
                where,
                version=_version_of(endpoint),
                round_trip=round_trip(endpoint.path),
                throughput=throughput(endpoint.path, crossings=4),
            )
            if not endpoint.routers:
                yield found("admin_hidden", where)
            if endpoint.drops_commands is False:
                yield found("commands_wait", where)
            if median_ms(endpoint.path) > SLOW_MS:
                yield found("slow", where, round_trip=round_trip(endpoint.path))
            yield from _way(endpoint.path, where)
        elif endpoint.reach not in ("ok", "untried"):
            # programs use the others meanwhile
            severity = WARNING if some_answer else ERROR
            yield found(endpoint.reach, where, severity=severity, detail=endpoint.reach_detail)
        elif endpoint.speaks_tls:
            yield found("speaks_tls", where)
        elif endpoint.speaker == "gateway":
            yield found("is_gateway", where, router=_router_beside(endpoint))
        elif endpoint.tls is None or not endpoint.tls.problem:
            yield found("session_refused", where, detail=short_problem(endpoint.problem))


def _router_beside(endpoint: Endpoint) -> str:
    beside = endpoint.router_beside
    return f"it is at {beside}" if beside else f"by default it is at port {DEFAULT_PORT}, a gateway at 7000"


def _version_of(endpoint: Endpoint) -> str:
    versions = [short_version(info.version) for info in endpoint.routers if info.zid == endpoint.router]
    return f"Zenoh {versions[0]}" if versions else "a Zenoh router"


def _linked(facts: Facts) -> Iterator[Finding]:
    """Routers that do not see each other: by their own account, or because tokens do not pass."""
    there = [endpoint for endpoint in facts.endpoints if endpoint.router]
    for number, one in enumerate(there):
        for other in there[number + 1 :]:
            if one.router != other.router and _apart(one, other):
                yield found("split", one.endpoint, other=other.endpoint)
    for endpoint in there:
        if endpoint.misses:
            count, others = len(endpoint.misses), " and ".join(endpoint.meets)
            yield found("link_stale", endpoint.endpoint, others=others, count=count, one=endpoint.misses[0])
        for info in endpoint.routers:
            if info.zid == endpoint.router and info.routers:
                dead = {session.zid for session in info.sessions if session.whatami == "router"} - set(info.routers)
                yield from (found("link_dead", endpoint.endpoint, other=zid[:8]) for zid in sorted(dead))


def _apart(one: Endpoint, other: Endpoint) -> bool:
    linked = next((info.routers for info in one.routers if info.zid == one.router), [])
    if linked:
        return other.router not in linked
    if one.rights.seen and other.rights.seen:
        return other.endpoint not in one.meets and one.endpoint not in other.meets
    return False


def _versions(facts: Facts) -> Iterator[Finding]:
    versions: dict[str, list[str]] = defaultdict(list)
    for info in _all_routers(facts):
        versions[short_version(info.version)].append(f"router {info.zid[:8]}")
    for program in facts.programs:
        if program.pong is not None and program.pong.zenoh:
            versions[program.pong.zenoh].append(name_of(program))
    if facts.own.zenoh:
        versions[facts.own.zenoh].append("here")
    if len(versions) > 1:
        minors = {version.rpartition(".")[0] for version in versions}
        severity = WARNING if len(minors) > 1 else NOTE
        yield found("versions_differ", severity=severity, versions=_listed_versions(versions))


def _listed_versions(versions: dict[str, list[str]]) -> str:
    return "; ".join(f"{version} ({some(who)})" for version, who in sorted(versions.items()))


def _sessions(facts: Facts) -> Iterator[Finding]:
    names = {program.zid: name_of(program) for program in facts.programs}
    for info in _all_routers(facts):
        where = f"router {info.zid[:8]}"
        peers = [_session_name(s.zid, s.address, names) for s in info.sessions if s.whatami == "peer"]
        if len(peers) > 1:
            yield found("peers", where, count=len(peers), who=some(peers))
        elif peers:
            yield found("peer", where, who=peers[0])
        if shared := [_session_name(s.zid, s.address, names) for s in info.sessions if s.shared_memory]:
            yield found("session_shared_memory", where, who=some(shared))


def _session_name(zid: str, address: str, names: dict[str, str]) -> str:
    name = names.get(zid) or names.get(published(zid)) or published(zid)[:8]
    return f"{name} at {address.partition('/')[2] or '?'}"


def _all_routers(facts: Facts) -> list[RouterInfo]:
    return list({info.zid: info for endpoint in facts.endpoints for info in endpoint.routers}.values())


# -- TLS ---------------------------------------------------------------------------------------------------------


def _tls(facts: Facts) -> Iterator[Finding]:
    shown = _setting(facts, "transport/link/tls/enable_mtls") is True
    has_certificate = bool(_setting(facts, "transport/link/tls/connect_certificate"))
    for endpoint in facts.endpoints:
        if endpoint.tls is None:
            continue
        if endpoint.tls.problem and not endpoint.router:
            hint = ": enable_mtls is not set" if has_certificate and not shown else ""
            detail = endpoint.tls.detail or "no reason given"
            yield found(f"tls_{endpoint.tls.problem}", endpoint.endpoint, detail=detail, hint=hint)
        if endpoint.tls.certificate is not None:
            yield from _ends(endpoint.tls.certificate, endpoint.endpoint, "the router's certificate", facts.at_s)
    if has_certificate and not shown:
        yield found("mtls_off")
    for certificate in facts.own.certificates:
        yield from _ends(certificate, "", certificate.subject, facts.at_s)


def _ends(certificate: Certificate, where: str, subject: str, now_s: float) -> Iterator[Finding]:
    left_s = certificate.ends_s - now_s
    if left_s <= 0:
        yield found("certificate_expired", where, subject=subject)
    elif left_s < CERTIFICATE_S:
        yield found("certificate_ends", where, subject=subject, days=int(left_s // 86_400))


# -- access ------------------------------------------------------------------------------------------------------


def _access(facts: Facts) -> Iterator[Finding]:
    who = facts.own.who or "this program"
    for endpoint in facts.endpoints:
        if endpoint.router:
            denied = list(_denied(facts, endpoint, who))
            yield from denied
            tried = _tried(endpoint, any(program.called for program in facts.programs))
            if tried and not any(finding.severity >= WARNING for finding in denied):
                yield found("access_ok", endpoint.endpoint, who=who, tried=tried)


def _denied(facts: Facts, endpoint: Endpoint, who: str) -> Iterator[Finding]:
    rights, where = endpoint.rights, endpoint.endpoint
    principal = Principal.parse(facts.own.who) if facts.own.who else Principal()
    if rights.sees is None and rights.seen is False:
        yield found("presence_unread", where)
    if rights.seen is False and principal.kind not in ("", "operator"):
        yield found("presence_denied", where, who=who, key=_presence(principal))
    if rights.watches is False:
        yield found("presence_unwatched", where)
    if rights.leases is False:
        yield found("lease_denied", where, who=who, key=LEASE.every(block=principal.number))
    if rights.hears is False:
        yield found("inbox_denied", where, who=who, key=_inbox(principal))
    if rights.pings is False:
        yield found("ping_denied", where)
    if endpoint is next(one for one in facts.endpoints if one.router):  # through which calls were made
        for program in facts.programs:
            if program.called is False:
                yield found("call_denied", where, agent=program.agents[0], who=who)


def _presence(principal: Principal) -> str:
    kind, number = principal.agent
    return PRESENCE.every(type=kind) if principal.kind == "gateway" else PRESENCE.every(type=kind, id=number)


def _inbox(principal: Principal) -> str:
    kind, number = principal.agent
    if principal.kind == "gateway":
        return UNICAST.every(type=kind, block=principal.number)
    return UNICAST.every(type=kind, id=number)


def _tried(endpoint: Endpoint, called: bool) -> str:
    rights = endpoint.rights
    words = {
        "be seen": rights.seen,
        "see who is online": rights.sees,
        "be told of changes": rights.watches,
        "lease its block": rights.leases,
        "hear its inbox": rights.hears,
        "call robots": called,
        "ping": rights.pings,
    }
    return ", ".join(word for word, may in words.items() if may)


# -- who is there ------------------------------------------------------------------------------------------------


def _mesh(facts: Facts) -> Iterator[Finding]:
    if not any(endpoint.router for endpoint in facts.endpoints):
        return
    conflicts = [*_blocks_twice(facts), *_ids_twice(facts), *_names_twice(facts), *_ids_and_blocks(facts)]
    yield from conflicts
    count = sum(len(program.agents) for program in facts.programs)
    gateways = sum(1 for program in facts.programs if program.blocks)
    if not count and not gateways:
        yield found("nobody")
    elif not conflicts:
        yield found("mesh_ok", agents=counted(count, "agent"), gateways=counted(gateways, "gateway"))
    yield from _namespaces(facts, bool(count))
    if nodes := _keys(facts, "ros_nodes"):
        yield found("ros_unnamed", count=counted(len(nodes), "ROS node"))


def _blocks_twice(facts: Facts) -> Iterator[Finding]:
    holders: dict[int, set[str]] = defaultdict(set)
    for key in _keys(facts, "leases"):
        if fields := LEASE.parse(key):
            holders[fields.block].add(fields.zid)
    for block, zids in sorted(holders.items()):
        if len(zids) > 1:
            yield found("block_twice", f"block {block}", count=len(zids), who=sessions(zids))


def _ids_twice(facts: Facts) -> Iterator[Finding]:
    holders: dict[str, set[str]] = defaultdict(set)
    for key in _keys(facts, "presence"):
        if claim := AgentInfo.parse(key):
            holders[f"{claim.type_name}/{claim.id}"].add(claim.zid)
    for agent, zids in sorted(holders.items()):
        if len(zids) > 1:
            yield found("id_twice", agent, count=len(zids), who=sessions(zids))


def _names_twice(facts: Facts) -> Iterator[Finding]:
    holders: dict[str, set[str]] = defaultdict(set)
    for key in _keys(facts, "names"):
        if fields := NAME.parse(key):
            holders[fields.name].add(fields.zid)
    for name, zids in sorted(holders.items()):
        if len(zids) > 1:
            yield found("name_twice", name, count=len(zids), who=sessions(zids))


def _ids_and_blocks(facts: Facts) -> Iterator[Finding]:
    """Headsets behind a gateway have its ids, others keep out of leased blocks. Robots choose theirs freely."""
    gateways = {block: program.zid for program in facts.programs for block in program.blocks}
    for program in facts.programs:
        for agent in program.agents:
            kind, _, number = agent.partition("/")
            block = block_of(int(number))
            if kind != type_name(UNITY) or block in program.blocks:
                continue
            if program.blocks:
                blocks = ", ".join(map(str, sorted(program.blocks)))
                yield found("id_outside", agent, blocks=blocks, who=program.zid[:8])
            elif block in gateways:
                yield found("id_in_block", agent, block=block, gateway=gateways[block][:8])


def _namespaces(facts: Facts, somebody: bool) -> Iterator[Finding]:
    counts: dict[str, set[str]] = defaultdict(set)
    for key in _keys(facts, "elsewhere"):
        counts[namespace_of(PRESENCE, key) or ""].add(key)
    for namespace, keys in sorted(counts.items()):
        own = f"“{facts.own.namespace}”" if facts.own.namespace else "none"
        yield found(
            "other_namespace" if somebody else "wrong_namespace",
            count=len(keys),
            namespace=f"“{namespace}”" if namespace else "“” (none)",
            own=own,
        )


def _keys(facts: Facts, field: str) -> list[str]:
    return sorted({key for endpoint in facts.endpoints for key in getattr(endpoint, field)})


# -- programs ----------------------------------------------------------------------------------------------------


def _programs(facts: Facts) -> Iterator[Finding]:
    for endpoint in facts.endpoints:
        if endpoint.path.clock is not None:
            yield from _clock_off(endpoint.path.clock, endpoint.endpoint)
    pingable = any(endpoint.rights.pings for endpoint in facts.endpoints)
    pinged = facts.programs[: len(facts.programs) - facts.unpinged]
    for program in pinged:
        where = name_of(program)
        if program.pong is None:
            if pingable:
                yield found("program_silent", where)
            continue
        yield from _one_program(facts, program, where)
    if facts.unpinged:
        yield found("programs_left_out", count=facts.unpinged)
    macs: dict[str, list[str]] = defaultdict(list)
    for program in pinged:
        if program.pong is not None and program.pong.macs:
            macs[program.pong.macs].append(name_of(program))
    if facts.own.macs:
        macs[facts.own.macs].append("here")
    if len(macs) > 1:
        yield found("macs_versions_differ", versions=_listed_versions(macs))


def _one_program(facts: Facts, program: Program, where: str) -> Iterator[Finding]:
    assert program.pong is not None
    pong, clock = program.pong, program.path.clock
    yield found(
        "program_ok",
        where,
        macs=pong.macs or "(unknown)",
        round_trip=round_trip(program.path),
        throughput=throughput(program.path, crossings=2),
        clock=f"{clock.offset_s * 1000:+.1f} ms (±{clock.within_s * 1000:.1f})" if clock else "unknown",
    )
    if clock is not None:
        yield from _clock_off(clock, where)
    yield from _way(program.path, where)
    ours, theirs = (facts.own.id_slots, facts.own.group_slots), (pong.id_slots, pong.group_slots)
    if any(theirs) and ours != theirs:
        yield found("slots_differ", where, ours="{} and {}".format(*ours), theirs="{} and {}".format(*theirs))
    if pong.shared_memory:
        yield found("program_shared_memory", where)
    if pong.mode != "client":
        yield found("program_peer", where, mode=pong.mode)
    if pong.drops:
        yield found("losses", where, drops=tallied(pong.drops))
    now = dict(pong.now)
    for kind in ("wrong_settings", "no_stop", "shared_graph"):
        if count := now.pop(kind, 0):
            yield found(kind, where, count=count)
    if now:
        yield found("in_trouble", where, now=tallied(now))


def _clock_off(clock: Clock, where: str) -> Iterator[Finding]:
    if abs(clock.offset_s) - clock.within_s > CLOCK_S:
        direction = "ahead of" if clock.offset_s > 0 else "behind"
        yield found("clock_off", where, offset=seconds(abs(clock.offset_s)), direction=direction)


def _way(path: NetworkPath, where: str) -> Iterator[Finding]:
    if path.lost_bytes:
        yield found("large_lost", where, size=byte_size(path.lost_bytes))


# -- our settings ------------------------------------------------------------------------------------------------


def _settings(facts: Facts) -> Iterator[Finding]:
    problems = list(_setting_problems(facts))
    yield from problems
    if not problems:
        yield found(
            "settings_ok",
            macs=facts.own.macs or "(not installed)",
            zenoh=facts.own.zenoh or "(unknown)",
            mode=_setting(facts, "mode") or "client",
            lease=seconds(_number(_setting(facts, "transport/link/tx/lease")) / 1000),
        )
    yield from _dropped(facts)


def _setting_problems(facts: Facts) -> Iterator[Finding]:
    if _setting(facts, "transport/shared_memory/enabled") is not False:
        yield found("own_shared_memory")
    if _setting(facts, "scouting/multicast/enabled") is not False:
        yield found("own_multicast")
    mode = _setting(facts, "mode") or "client"
    if mode != "client":
        yield found("own_mode", mode=mode)
    lease_ms = _number(_setting(facts, "transport/link/tx/lease"))
    if 0 < lease_ms < LEASE_MS[0]:
        yield found("lease_short", lease=seconds(lease_ms / 1000))
    elif lease_ms > LEASE_MS[1]:
        yield found("lease_long", lease=seconds(lease_ms / 1000))
    for name, size in sorted((_setting(facts, "transport/link/tx/queue/size") or {}).items()):
        if _number(size) > QUEUE_BATCHES:
            yield found("queue_long", name=name, size=size)
    wait_us = _number(_congestion(facts, "block", "wait_before_close"))
    if wait_us > max(CLOSE_US, lease_ms * 1000):  # with a longer lease it is for slow links: config/wan/policy.yaml
        yield found("close_long", wait=seconds(wait_us / 1e6))


def _dropped(facts: Facts) -> Iterator[Finding]:
    """How large a stream message may be at the throughput measured: what does not fit into the queue has
    ``max_wait_before_drop_fragments`` to leave it."""
    sizes = _setting(facts, "transport/link/tx/queue/size") or {}
    queue = _number(sizes.get("data")) * BATCH_BYTES
    wait_s = _number(_congestion(facts, "drop", "max_wait_before_drop_fragments")) / 1e6
    for endpoint in facts.endpoints:
        rate = bytes_per_s(endpoint.path, crossings=4)
        if rate and queue and (limit := queue + rate * wait_s) < 5e6:
            yield found("large_dropped", endpoint.endpoint, throughput=bit_rate(rate), size=byte_size(limit))


def _setting(facts: Facts, path: str) -> Any:
    return facts.own.zenoh_settings.get(path)


def _congestion(facts: Facts, kind: str, name: str) -> Any:
    return ((_setting(facts, "transport/link/tx/queue/congestion_control") or {}).get(kind) or {}).get(name)


def _number(value: Any) -> float:
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else 0.0
