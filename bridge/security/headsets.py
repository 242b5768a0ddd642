"""Tokens of a policy's headsets: made with everything else, and tried at gateways that run.

A headset's secret is in the file ``token`` of its directory. Gateways have its hash and rights in ``tokens.json``.
"""

from __future__ import annotations

import contextlib
import datetime as dt
import secrets
from pathlib import Path

from bridge.headset import frames
from bridge.headset.client import Headset as Client
from bridge.headset.frames import NodeSpec
from bridge.headset.stream import Way
from bridge.security import certificates
from bridge.security.attempts import Result
from bridge.security.certificates import PRIVATE_DIRECTORY, PRIVATE_FILE
from bridge.security.policy import Gateway, Headset, Policy
from macs_zenoh.errors import ConfigError, Refused, Unreachable
from macs_zenoh.protocol.addresses import joined
from macs_zenoh.protocol.messages import UNITY, AddNode, NodeRefused, NodeType, RemoveNode
from macs_zenoh.protocol.rights import RIGHTS, Rights
from macs_zenoh.protocol.tokens import SECRET_BYTES, Token, Tokens, encode, hash_of, new_secret, parse

TOKEN_FILE, TOKENS_FILE = "token", "tokens.json"
RENEW_BELOW = 1 / 3
"""A token that ends gets its whole time again when less than this part of it is left."""

NODES = {
    NodeType.SUBSCRIBER: "see",
    NodeType.PUBLISHER: "command",
    NodeType.CLIENT: "call",
    NodeType.SERVICE: "serve",
    NodeType.ACTION: "act",
}


def rights_of(policy: Policy, headset: Headset) -> Rights:
    """What a headset's token permits. Raises ConfigError."""
    ids = {robot.name: robot.id for robot in policy.robots}
    robots = headset.robots if isinstance(headset.robots, str) else sorted(ids[name] for name in headset.robots)
    more = {"topics": headset.topics} if headset.topics else {}
    try:
        return Rights(
            may=headset.may,
            robots=robots,
            groups=headset.groups,
            frames_per_s=headset.frames_per_s,
            **more,
        )
    except ValueError as error:
        raise ConfigError(f"headsets: {headset.name}", str(error)) from None


def gateways_of(policy: Policy, headset: Headset) -> list[Gateway]:
    """Where it may come."""
    return [each for each in policy.gateways if not headset.gateways or each.name in headset.gateways]


def secret_of(directory: Path, *, renew: bool) -> str:
    """A headset's secret, kept in its directory, or made. Raises ConfigError, UsageError."""
    path = directory / TOKEN_FILE
    directory.mkdir(mode=PRIVATE_DIRECTORY, exist_ok=True)
    certificates.check_own(directory, path)
    if not renew:
        with contextlib.suppress(FileNotFoundError):
            return path.read_text().strip()
    secret = new_secret(secrets.token_bytes(SECRET_BYTES))
    certificates.write(path, f"{secret}\n".encode(), PRIVATE_FILE)
    return secret


def tokens_of(policy: Policy, gateway: Gateway, into: Path, now: dt.datetime, *, known: dict[str, str]) -> bytes:
    """What a gateway's file of tokens has; ``known`` are the secrets by headset. Pairings and secrets that were added
    to the file there stay."""
    path = into / gateway.name / TOKENS_FILE
    before = Tokens()
    with contextlib.suppress(FileNotFoundError):
        before = parse(path.read_bytes(), str(path))
    had = {token.name: token for token in before.tokens}
    kept = []
    for headset in policy.headsets:
        if gateway in gateways_of(policy, headset):
            kept.append(_token(headset, rights_of(policy, headset), known[headset.name], had.get(headset.name), now))
    names = {token.name for token in kept}
    pairings = [each for each in before.pairings if each.name in names and each.holds(now.timestamp())]
    return encode(Tokens(tokens=sorted(kept, key=lambda token: token.name), pairings=pairings))


def _token(headset: Headset, rights: Rights, secret: str, before: Token | None, now: dt.datetime) -> Token:
    digest, at = hash_of(secret), now.timestamp()
    same = before is not None and digest in before.hashes
    life = headset.days * 86_400.0 if headset.days is not None else None
    expires_at = before.expires_at if same and before is not None else None
    if life is None:
        expires_at = None
    elif expires_at is None or expires_at - at < life * RENEW_BELOW or expires_at - at > life:
        expires_at = at + life
    return Token(
        name=headset.name,
        hashes=before.hashes if same and before is not None else [digest],
        rights=rights,
        created_at=before.created_at if same and before is not None else at,
        expires_at=expires_at,
    )


# -- tried -----------------------------------------------------------------------------------------------------------


def way_of(port: str, authority: Path) -> tuple[str, int, Way]:
    """How a gateway's port is reached that a policy names: ``tcp/``, ``tls/``, ``ws/`` or ``wss/`` and its place."""
    protocol, _, place = port.partition("/")
    host, _, number = place.rpartition(":")
    trusted = str(authority) if protocol in ("tls", "wss") else None
    return host.strip("[]"), int(number), Way(protocol in ("ws", "wss"), protocol in ("tls", "wss"), trusted)


async def try_headsets(policy: Policy, directory: Path, timeout_s: float) -> list[Result]:
    """At each port of a gateway that the policy names: each headset with its token, and with none that holds.

    What is tried disturbs nobody: registrations that name no robot, and ends of some that there are not.
    """
    results: list[Result] = []
    for gateway in policy.gateways:
        authority = directory / gateway.name / certificates.AUTHORITY
        for port in gateway.ports:
            host, number, way = way_of(port, authority)
            label = f"{gateway.name} at {port}"
            for headset in policy.headsets:
                secret = secret_of(directory / headset.name, renew=False)
                may_come = gateway in gateways_of(policy, headset)
                results += await _let_in(label, f"{headset.name} with a token cut off", secret[:-1], host, number, way)
                client, why = await _come(host, number, way, secret, timeout_s)
                results.append(Result(label, f"{headset.name} is let in", may_come, client is not None, why))
                if client is not None:
                    async with client:
                        results += await _rights(label, policy, headset, client)
    return results


async def _let_in(label: str, what: str, secret: str, host: str, port: int, way: Way) -> list[Result]:
    client, why = await _come(host, port, way, secret, 5.0)
    if client is not None:
        await client.close()
    return [Result(label, f"{what} is let in", False, client is not None, why)]


async def _come(host: str, port: int, way: Way, secret: str, timeout_s: float) -> tuple[Client | None, str]:
    """Raises Unreachable: nobody is there."""
    try:
        connecting = Client.connect(host, port, token=secret, way=way, handshake_timeout_s=timeout_s)
        return await connecting, ""
    except Refused as refused:
        return None, refused.reason
    except Unreachable as error:
        raise Unreachable(joined(host, port), error.why) from error


async def _rights(label: str, policy: Policy, headset: Headset, client: Client) -> list[Result]:
    rights = rights_of(policy, headset)
    results = []
    topic = next((each.replace("**", "x").replace("*", "x") for each in rights.topics), "/x")
    for kind, right in NODES.items():
        spec = NodeSpec(kind, topic, "std_msgs/String")
        seen = await _passes(client, frames.registration(client.id, spec, [], []), spec)
        permitted = rights.of_registration(_asked(spec), [], []) is None
        what = f"{headset.name} registers to {RIGHTS[right].partition(',')[0]}"  # type: ignore[index]
        results.append(Result(label, what, permitted, seen, topic))
    spec = NodeSpec(NodeType.SUBSCRIBER, "/macs_check", "std_msgs/String")
    for robot in policy.robots:
        seen = await _passes(client, frames.deregistration(client.id, spec, [robot.id], []), spec)
        permitted = rights.of_registration(_asked(spec, remove=True), [robot.id], []) is None
        results.append(Result(label, f"{headset.name} names {robot.name}", permitted, seen))
    for group in sorted({robot.group for robot in policy.robots if robot.group} | {255}):
        seen = await _passes(client, frames.deregistration(client.id, spec, [], [group]), spec)
        permitted = rights.of_registration(_asked(spec, remove=True), [], [group]) is None
        results.append(Result(label, f"{headset.name} names group {group}", permitted, seen))
    return results


def _asked(spec: NodeSpec, *, remove: bool = False) -> AddNode | RemoveNode:
    if remove:
        return RemoveNode(UNITY, 0, spec.kind, spec.name)
    return AddNode(UNITY, 0, spec.kind, spec.name, spec.tos_name, spec.data_type)


async def _passes(client: Client, frame: bytes, spec: NodeSpec) -> bool:
    """Whether no refusal comes before the answer to what is asked behind it."""
    await client.send_frame(frame)
    await client.online()
    refused = False
    while client.waiting:
        message = await client.receive(1.0)
        refused = refused or message.metadata.message_manager == NodeRefused.manager
    return not refused
