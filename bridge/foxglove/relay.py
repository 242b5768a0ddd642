"""The door of a Foxglove server: whose page asks, by which token, and what that permits. Asyncio.

The SDK's server looks at no origin and knows no tokens. So it listens on a port of this machine alone, by TLS with a
certificate made for this once, which no browser takes; and what clients say there counts only after a secret. Here
every client is judged before it is let through, and each thing that it publishes or calls.
"""

from __future__ import annotations

import asyncio
import datetime as dt
import ipaddress
import json
import logging
import ssl
import time
from collections.abc import Collection, Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import aiohttp
from aiohttp import WSCloseCode, WSMsgType, web

from bridge.recording.streams import split_topic
from bridge.tokens.watch import Watch
from macs_zenoh.errors import BadJson, Unreachable, WireError
from macs_zenoh.losses import Losses
from macs_zenoh.protocol.addresses import of_peer
from macs_zenoh.protocol.credit import Credit
from macs_zenoh.protocol.json_fields import json_object, judged
from macs_zenoh.protocol.messages import UNITY, AddNode, NodeType, node_name
from macs_zenoh.protocol.origins import host_problem, origin_problem
from macs_zenoh.protocol.rights import ANY, EVERY_NAME, OPEN, Grant
from macs_zenoh.protocol.websocket import TOKEN_SUBPROTOCOL

log = logging.getLogger("macs.foxglove")

SUBPROTOCOLS = ("foxglove.sdk.v1",)
CLIENTS, CLIENTS_PER_ADDRESS = 32, 24
MESSAGE_BYTES = 16 << 20
"""Of a client."""
TEXT_BYTES = 256 << 10
"""Of what a client says besides the data of topics and calls."""
TEXT_PARTS = 24 << 10
"""Keys in it: all that so much text has that subscribes to channels, of which a site has thousands."""
MESSAGES_PER_S = 1000.0
"""Of a client. Who sends more is closed: what would wait here is commands that have become old."""
TOLD_BYTES = 256 << 20
"""Of the SDK: pictures and clouds."""
CHANNELS = 256
"""Of one client, that it publishes to."""
AT_ONCE = 1024
"""Channels that one message may advertise: what is refused is said of each."""
PASSED = frozenset({"subscribe", "unsubscribe", "subscribeConnectionGraph", "unsubscribeConnectionGraph"})
"""What a client may say whatever its rights are; the rest is judged or dropped."""
PUBLISHED, CALLED = 1, 2
"""First byte of a client's binary messages."""


@dataclass(eq=False)
class _Client:
    """One that was let in."""

    grant: Grant
    shown: str | None
    host: str
    here: web.WebSocketResponse
    channels: dict[int, str] = field(default_factory=dict)
    services: dict[int, str] = field(default_factory=dict)


class Relay:
    """The port that clients come to. ``inside`` is the port of the SDK's server, ``secret`` the name of a channel by
    which it knows who comes through here; None where clients may publish nothing."""

    def __init__(
        self,
        inside: int,
        context: ssl.SSLContext,
        secret: str | None,
        *,
        tokens: Watch | None,
        origins: Collection[str],
        names: Collection[str],
        robots: Iterable[int],
    ) -> None:
        self.drops = Losses(log)
        self._inside = inside
        self._context = context
        self._secret = secret
        self._tokens = tokens
        self._origins = origins
        self._names = names
        self._robots = frozenset(robots)
        self._clients: set[_Client] = set()
        self._runner: web.AppRunner | None = None
        self._session: aiohttp.ClientSession | None = None

    async def open(self, host: str, port: int, outside: ssl.SSLContext | None) -> int:
        """Listen; the port. Raises OSError."""
        self._session = aiohttp.ClientSession()
        app = web.Application()
        app.router.add_get("/", self._came)
        self._runner = web.AppRunner(app, handle_signals=False, access_log=None, shutdown_timeout=0.2)
        await self._runner.setup()
        site = web.TCPSite(self._runner, host, port, ssl_context=outside)
        await site.start()
        number: int = self._runner.addresses[0][1]
        return number

    async def close(self) -> None:
        """End, with all clients."""
        if self._runner is not None:
            await self._runner.cleanup()
        if self._session is not None:
            await self._session.close()

    def look(self) -> None:
        """Tokens may have changed: whose token has ended, or has other rights, is ended."""
        for client in list(self._clients):
            if client.shown is not None and self._find(client.shown) != client.grant:
                asyncio.ensure_future(client.here.close(code=4001, message=b"the token has ended or changed"))  # noqa: RUF006

    # -- the door ------------------------------------------------------------------------------------------------

    async def _came(self, request: web.Request) -> web.StreamResponse:
        host, origin = request.headers.get("Host", ""), request.headers.get("Origin")
        problem = host_problem(host, self._names) or origin_problem(origin, host, self._origins)
        if problem is not None:
            self.drops.once("other_page", "a page of %s is refused: %s; --origin lets it", origin, problem)
            return web.json_response({"error": problem}, status=403)
        shown = _token(request)
        grant = OPEN if self._tokens is None else self._find(shown)
        if grant is None:
            self.drops.once("wrong_token", "%s is refused: a valid token is wanted", request.remote)
            return web.json_response({"error": "a valid token is wanted here: ws://…/?token=macs_…"}, status=401)
        problem = self._why_not_see(grant)
        if problem is not None:
            self.drops.once("client_not_allowed", "%s is refused: %s", request.remote, problem)
            return web.json_response({"error": problem}, status=403)
        host = of_peer(request.remote or "?")
        from_there = sum(client.host == host for client in self._clients)
        if len(self._clients) >= CLIENTS or from_there >= CLIENTS_PER_ADDRESS:
            name = "too_many_connections" if len(self._clients) >= CLIENTS else "too_many_from_address"
            problem = f"{len(self._clients)} look already, {from_there} from there"
            self.drops.once(name, "%s is refused: %s", host, problem)
            return web.json_response({"error": problem}, status=503)
        here = web.WebSocketResponse(
            protocols=SUBPROTOCOLS, heartbeat=20.0, compress=False, max_msg_size=MESSAGE_BYTES
        )
        if not here.can_prepare(request):
            return web.json_response({"error": "a WebSocket is wanted here"}, status=426)
        await here.prepare(request)
        client = _Client(grant, shown if self._tokens is not None else None, host, here)
        self._clients.add(client)
        try:
            await self._both_ways(client)
        finally:
            self._clients.discard(client)
        return here

    def _find(self, shown: str | None) -> Grant | None:
        assert self._tokens is not None
        token = self._tokens.tokens.find(shown, time.time())
        return None if token is None else Grant(token.name, token.rights)

    def _why_not_see(self, grant: Grant) -> str | None:
        """Everything is shown to each client, so a token has to be for all of it."""
        rights = grant.rights
        if rights is None:
            return None
        if not rights.has("see") or EVERY_NAME not in rights.topics:
            return "this token does not give the right to see all topics"
        if rights.robots != ANY and not (self._robots and self._robots <= set(rights.robots)):
            return "this token is not for all robots that are shown; macs foxglove --robot shows fewer"
        return None

    # -- through it ----------------------------------------------------------------------------------------------

    async def _both_ways(self, client: _Client) -> None:
        assert self._session is not None
        url = f"wss://127.0.0.1:{self._inside}/"
        try:
            async with self._session.ws_connect(
                url, protocols=SUBPROTOCOLS, ssl=self._context, max_msg_size=TOLD_BYTES, compress=0
            ) as there:
                if self._secret is not None:
                    channel = {"id": 0xFFFFFFFF, "topic": self._secret, "encoding": "json", "schemaName": ""}
                    await there.send_str(json.dumps({"op": "advertise", "channels": [channel]}))
                down = asyncio.ensure_future(self._down(client, there))
                try:
                    await self._up(client, there)
                finally:
                    down.cancel()
                    with suppress(asyncio.CancelledError, ConnectionError):
                        await down
        except (aiohttp.ClientError, ConnectionError) as error:
            log.debug("a client has gone: %r", error)

    async def _down(self, client: _Client, there: Any) -> None:
        async for message in there:
            if message.type == WSMsgType.BINARY:
                await client.here.send_bytes(message.data)
            elif message.type == WSMsgType.TEXT:
                if '"advertiseServices"' in message.data:
                    self._learn(client, message.data)
                await client.here.send_str(message.data)
        await client.here.close()

    @staticmethod
    def _learn(client: _Client, text: str) -> None:
        for service in json.loads(text).get("services", []):
            client.services[service["id"]] = service["name"]

    async def _up(self, client: _Client, there: Any) -> None:
        credit = Credit(MESSAGES_PER_S, time.monotonic())
        async for message in client.here:
            if not credit.take(1, time.monotonic()):
                problem = f"more than {MESSAGES_PER_S:g} messages a second"
                self.drops.once("flooded", "%s is closed: it sends %s", client.host, problem)
                await client.here.close(code=WSCloseCode.POLICY_VIOLATION, message=problem.encode())
            elif message.type == WSMsgType.BINARY and message.data:
                await self._binary(client, there, message.data)
            elif message.type == WSMsgType.TEXT:
                try:
                    said = json_object("a message", judged("a message", message.data.encode(), TEXT_BYTES, TEXT_PARTS))
                    op = said["op"]
                    if not isinstance(op, str):
                        raise BadJson("a message", "its op is no text")
                except (WireError, KeyError) as error:
                    self.drops.once("bad_json", "a client says what is no message of Foxglove's: %s", error)
                    await self._tell(client, f"this is dropped: {error}")
                    continue
                if op == "advertise":
                    said["channels"] = await self._advertised(client, said)
                    if said["channels"]:
                        await there.send_str(json.dumps(said))
                elif op == "unadvertise":
                    numbers = [
                        number
                        for number in _list(said, "channelIds")
                        if isinstance(number, int) and client.channels.pop(number, "")
                    ]
                    if numbers:
                        await there.send_str(json.dumps({"op": op, "channelIds": numbers}))
                elif op in PASSED:
                    await there.send_str(message.data)
                else:
                    self.drops.once("unknown_op", "a client says %r, which nobody here does", op[:80])
                    await self._tell(client, f"nobody here does {op[:80]}")

    async def _advertised(self, client: _Client, said: dict[str, Any]) -> list[Any]:
        """Of the channels that a client will publish to, those that it may."""
        passed, named = [], _list(said, "channels")
        for channel in named[:AT_ONCE]:
            number, topic = (channel.get("id"), channel.get("topic")) if isinstance(channel, dict) else (None, None)
            topic = topic if isinstance(topic, str) else ""
            why = self._why_not(client.grant, NodeType.PUBLISHER, topic)
            if type(number) is not int or not 0 <= number < 0xFFFFFFFF:
                why = "it has no number"
            elif why is None and len(client.channels) >= CHANNELS:
                why = f"a client publishes to {CHANNELS} topics and no more"
            elif why is None:
                client.channels[number] = topic
                passed.append(channel)
                continue
            await self._refuse(client, topic, why or "")
        if (more := len(named) - AT_ONCE) > 0:
            await self._refuse(client, f"{more} channels more", f"one message names at most {AT_ONCE}", more)
        return passed

    async def _binary(self, client: _Client, there: Any, data: bytes) -> None:
        kind, number = data[0], int.from_bytes(data[1:5], "little")
        if kind == PUBLISHED and number in client.channels:
            await there.send_bytes(data)
        elif kind == CALLED and len(data) >= 9:
            service = client.services.get(number, "")
            why = self._why_not(client.grant, NodeType.CLIENT, service)
            if why is None:
                await there.send_bytes(data)
                return
            self.drops.once("client_not_allowed", "a call of %s is refused: %s", service, why)
            call = int.from_bytes(data[5:9], "little")
            failure = {"op": "serviceCallFailure", "serviceId": number, "callId": call, "message": why}
            await client.here.send_str(json.dumps(failure))
        else:
            self.drops.once("not_advertised", "%s publishes to what it has not advertised, or may not", client.host)

    def _why_not(self, grant: Grant, kind: NodeType, name: str) -> str | None:
        """Why a client may not publish to a topic or call a service of the mesh, as ``/7/cmd_vel``; None: it may."""
        if self._secret is None:
            return "this server only shows: see its --publish"
        named = split_topic(name)
        if named is None:
            return f"{name[:80]} names no robot; /7/cmd_vel is robot 7's"
        if grant.rights is None:
            return None
        robot, topic = named
        node = AddNode(UNITY, 0, int(kind), node_name(topic), topic, "")
        return grant.rights.of_registration(node, [robot], [])

    async def _refuse(self, client: _Client, topic: str, why: str, count: int = 1) -> None:
        self.drops.once("client_not_allowed", "%s is not published to: %s", topic[:200], why, count=count)
        await self._tell(client, f"{topic[:200]}: {why}", id=topic[:200])

    async def _tell(self, client: _Client, problem: str, **about: str) -> None:
        """In Foxglove's own list of problems."""
        status = {"op": "status", "level": 1, "message": problem, **about}
        await client.here.send_str(json.dumps(status))


def _token(request: web.Request) -> str | None:
    """Shown as programs do, or as Foxglove can: in the address, which we write to no log."""
    scheme, _, token = request.headers.get("Authorization", "").partition(" ")
    if scheme.lower() == "bearer":
        return token.strip()
    offered = [each.strip() for each in request.headers.get("Sec-WebSocket-Protocol", "").split(",")]
    shown = next((each[len(TOKEN_SUBPROTOCOL) :] for each in offered if each.startswith(TOKEN_SUBPROTOCOL)), None)
    return shown if shown is not None else request.query.get("token")


def _list(said: dict[str, Any], name: str) -> list[Any]:
    found = said.get(name)
    return found if isinstance(found, list) else []


def own_certificate() -> tuple[bytes, bytes, ssl.SSLContext]:
    """A certificate and its key for this once, and a context that takes this one and no other. Raises Unreachable."""
    try:
        from cryptography import x509
        from cryptography.hazmat.primitives import hashes, serialization
        from cryptography.hazmat.primitives.asymmetric import ec
        from cryptography.x509.oid import NameOID
    except ImportError as error:
        raise Unreachable(
            "the Foxglove server", "cryptography is missing: pip install 'macs-zenoh[foxglove]'"
        ) from error
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "macs foxglove, inside")])
    now, life = dt.datetime.now(dt.timezone.utc), dt.timedelta(days=3650)
    here = x509.SubjectAlternativeName([x509.IPAddress(ipaddress.ip_address("127.0.0.1"))])
    certificate = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - dt.timedelta(days=1))
        .not_valid_after(now + life)
        .add_extension(here, critical=False)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .sign(key, hashes.SHA256())
    )
    pem = certificate.public_bytes(serialization.Encoding.PEM)
    private = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    context = ssl.create_default_context(cadata=pem.decode())
    return pem, private, context
