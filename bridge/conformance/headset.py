"""A headset under test: the kit is its router, and judges what it says and what it outlives.

Whether a headset still handles messages is asked with the one that every headset answers at any time: a later
AgentConfigurer. So each thing that it should outlive is followed by one.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterable
from contextlib import AsyncExitStack
from typing import TYPE_CHECKING, Protocol

from macs_zenoh.errors import MacsError, MissingExtra
from macs_zenoh.timeouts import within

from . import vectors
from .checks import Level, Verdict, Verdicts
from .client_frames import ClientFrames, Kind, Node, Said
from .headset_checks import CHECKS as CHECKS
from .headset_checks import IGNORED, WELCOMES
from .headset_sessions import AGAIN_S, Sessions, registered
from .router import Client, Router, cdr_for
from .vectors import Value

if TYPE_CHECKING:
    from .websocket import WebSockets

START_S = 30.0
MOST_S = 55.0
"""Checks that would come later are skipped: so many fail then that the first of them tell enough."""
_SETTLE_S = 0.7
_SETTLED_S = 3.0
_BEAT_S = 7.5
_LOOKS = 3
_LARGE_BYTES = 1 << 20


class Gone(MacsError):
    """The headset has no connection any more and makes none."""


class Program(Protocol):
    """The headset's program, where the kit runs it."""

    async def start(self, port: int) -> None:
        """Start it, again if it has ended."""

    async def stop(self) -> bool:
        """Stop it by SIGTERM; whether it took that and ended by itself."""


class Judge:
    """One run of a headset, which the kit can start again where it has its ``program``."""

    def __init__(
        self, router: Router, frames: ClientFrames, verdicts: Verdicts, patience_s: float, program: Program | None
    ) -> None:
        self._router = router
        self._frames = frames
        self._verdicts = verdicts
        self._patience_s = patience_s
        self._again_s = max(AGAIN_S, patience_s)
        self._request = 1000
        self._client: Client
        self._program = program
        self._sessions = Sessions(router, frames, verdicts, patience_s)

    async def run(self, start_s: float) -> None:
        """All of it. Raises Gone when the headset is."""
        client = await self._router.next(start_s)
        if not self._verdicts.hold("handshake.connects", client is not None, f"nobody came within {start_s:g} s"):
            raise Gone("nobody came")
        assert client is not None
        self._client = client
        await self._handshake()
        await self._settle()
        await self._later_welcomes()
        if not self._verdicts.failed("renumber.answers"):
            await self._fragments()
            await self._messages()
            await self._services()
            await self._pace()
        await self._heartbeats()
        if self._verdicts.asked("reconnect.after_end"):
            await self._reconnects()
            self._client = await self._sessions.run(self._client)
        if not self._verdicts.failed("renumber.answers"):
            await self._bad_messages()
        if self._verdicts.asked("offline.says") and self._program is not None:
            await self._leaves(self._program)

    # -- the handshake -----------------------------------------------------------------------------------------------

    async def _handshake(self) -> None:
        hold = self._verdicts.hold
        early = await self._client.until(self._configured_since(0, None), 0.3)
        hold("handshake.waits", not early, "its configuration came first")
        answer = await self._greeted(7)
        if not hold("handshake.answers", answer is not None, self._silence()) or answer is None:
            raise Gone("it never answered its router's first message")
        says = answer.management
        hold("handshake.agent_type", says.get("agent_type") == 2, f"it is {says.get('agent_type')!r}")
        hold("handshake.agent_id", says.get("agent_id") == 7, f"it is {says.get('agent_id')!r}, given was 7")
        group = says.get("group_id", 0)
        hold("handshake.group", type(group) is int and 0 <= group <= 255, f"it is {group!r}")
        request = says.get("request_id")
        hold("handshake.request_id", request == self._request, f"it is {request!r}, asked was {self._request}")
        hold("handshake.message", answer.whole.endswith(bytes(8)) and not answer.metadata, f"it is {answer.whole!r}")

    async def _greeted(self, agent_id: int, *, bytewise: bool = False) -> Said | None:
        """Give it its id on this connection; its answer. A program may look who is there first, and connect again."""
        for _ in range(_LOOKS):
            welcome = self._welcome(agent_id)
            pieces = range(1, len(welcome)) if bytewise else ()
            answer = await self._asked(welcome, None, max(5.0, self._patience_s), pieces)
            if answer is not None and answer.management.get("session"):  # it waits for what became of that
                await self._client.send(vectors.fill("router_messages", "session_opened"))
            if answer is not None or not self._client.ended:
                return answer
            other = await self._router.next(_SETTLE_S)
            if other is None:
                return None
            self._client = other
        return None

    async def _settle(self) -> None:
        """Let it register what it wants to."""
        loop = asyncio.get_running_loop()
        until = loop.time() + _SETTLED_S
        while loop.time() < until:
            seen = self._registrations()
            if not await self._client.until(lambda seen=seen: self._registrations() > seen, _SETTLE_S):  # type: ignore[misc]
                break
        answers = [said for said in self._client.said if said.kind is Kind.CONFIGURATION]
        self._verdicts.hold("handshake.once", len(answers) == 1, f"it answered {len(answers)} times")

    def _registrations(self) -> int:
        return sum(said.kind is Kind.REGISTRATION for said in self._client.said)

    def _welcome(self, agent_id: int, vector: str = "welcome") -> bytes:
        self._request = 0 if vector == "welcome_request_zero" else max(self._request, 1000) + 1
        self._frames.given.add(agent_id)
        return vectors.fill("router_messages", vector, id=agent_id, request=self._request)

    def _configured_since(self, start: int, request: int | None) -> Callable[[], bool]:
        def configured() -> bool:
            since = self._client.said[start:]
            return any(_answers(said, request) for said in since)

        return configured

    async def _asked(
        self, data: bytes, request: int | None, seconds: float, pieces: Iterable[int] = ()
    ) -> Said | None:
        """Its configuration with this number (any, for None) after these bytes, which end with an AgentConfigurer."""
        start = len(self._client.said)
        if self._verdicts.failed("handshake.request_id"):
            request = None  # that is known, and not what is asked here
        await self._client.send(data, pieces)
        if not await self._client.until(self._configured_since(start, request), seconds):
            return None
        return next(said for said in self._client.said[start:] if _answers(said, request))

    def _silence(self) -> str:
        if self._client.ended:
            return "it gave its connection up"
        return "it handled nothing after it, while its connection went on"

    # -- later ones --------------------------------------------------------------------------------------------------

    async def _later_welcomes(self) -> None:
        hold = self._verdicts.hold
        answer = await self._asked(self._welcome(7), None, self._patience_s)
        if not hold("renumber.answers", answer is not None, self._silence()):
            self._skip_rest("it does not answer a later AgentConfigurer, so nobody can tell whether it goes on")
            return
        for name, agent_id in (("new_id", 8), ("two_bytes", 300), ("largest_id", 0xFFFF)):
            answer = await self._asked(self._welcome(agent_id), None, self._patience_s)
            said = answer.management.get("agent_id") if answer else None
            hold(f"renumber.{name}", said == agent_id, f"it says {said}, given was {agent_id}")
        if self._verdicts.asked("renumber.largest_number"):
            self._frames.given.add(7)
            welcome = vectors.fill("router_messages", "welcome", id=7, request=0xFFFFFFFF)
            await self._outlives("renumber.largest_number", welcome, 0xFFFFFFFF)
        for name, vector in WELCOMES.items():
            await self._outlives(f"renumber.{name}", self._welcome(7, vector), self._request)

    async def _outlives(self, name: str, data: bytes, request: int, pieces: Iterable[int] = ()) -> bool:
        """Whether it answers the AgentConfigurer that these bytes end with; else it gets a new connection."""
        answer = await self._asked(data, request, self._patience_s, pieces)
        if self._verdicts.hold(name, answer is not None, self._silence()):
            return True
        await self._anew(name)
        return False

    async def _survives(self, name: str, data: bytes) -> bool:
        """The same for bytes that it should outlive."""
        return await self._outlives(name, data + self._welcome(7), self._request)

    async def _anew(self, why: str) -> None:
        """Make it connect again, after a check that cost its connection. Raises Gone."""
        self._client.abort()
        client = await self._router.next(self._again_s)
        if client is None:
            client = await self._started_again(f"it made no new connection after {why}")
        self._client = client
        if await self._greeted(7) is None:
            raise Gone(f"after {why} it answers nobody any more")
        await self._client.until(lambda: self._registrations() >= len(self._frames.nodes), _SETTLE_S)

    async def _fragments(self) -> None:
        welcome = self._welcome(7)
        metadata_end = 4 + int.from_bytes(welcome[:4], "little")
        await self._outlives("fragments.bytewise", welcome, self._request, range(1, len(welcome)))
        cuts = {"in_size": 2, "behind_size": 4, "in_metadata": 20, "in_data_size": metadata_end + 2, "in_data": -3}
        for name, place in cuts.items():
            welcome = self._welcome(7)
            await self._outlives(f"fragments.{name}", welcome, self._request, [place % len(welcome)])
        first = self._welcome(9)
        await self._outlives("fragments.two_at_once", first + self._welcome(7), self._request)
        metadata = vectors.named("bad_messages", "unknown_node").example
        end = 4 + int.from_bytes(metadata[:4], "little")
        large = metadata[:end] + _LARGE_BYTES.to_bytes(4, "little") + bytes(_LARGE_BYTES)
        await self._survives("fragments.large", large)

    # -- messages ----------------------------------------------------------------------------------------------------

    def _node(self, kind: int) -> Node | None:
        """A node that it has registered, of a type that the kit knows if there is one."""
        nodes = [node for node in self._frames.nodes.values() if node.node_type == kind]
        return next((node for node in nodes if cdr_for(node)), nodes[0] if nodes else None)

    def _of(self, node: Node) -> dict[str, Value]:
        cdr = cdr_for(node) or "0001000000"
        other = 3 if node.node_type == 1 else 1
        return {
            "node": node.name,
            "topic": node.topic,
            "type": node.data_type,
            "robot": node.robot,
            "node_type": node.node_type,
            "other_node_type": other,
            "cdr": cdr,
            "number": 1,
        }

    async def _messages(self) -> None:
        for name in IGNORED:
            await self._survives(f"messages.{name}", vectors.fill("router_messages", name, number=4_000_000))
        for name, kind in (("topic", 1), ("answer", 3)):
            node = self._node(kind)
            if node is None or not cdr_for(node):
                self._verdicts.skip(
                    f"messages.{name}", f"it registered no node of type {kind} whose type the kit knows"
                )
                continue
            message = vectors.fill("router_messages", name, **{**self._of(node), "number": 4_000_000})
            await self._survives(f"messages.{name}", message)

    async def _bad_messages(self) -> None:
        for vector in vectors.read("bad_messages"):
            name = f"bad.{vector.name}"
            if not self._verdicts.asked(name):
                continue
            values: dict[str, Value] = {"request": 77}
            if needs := vector.marks.get("needs"):
                kinds = (1, 2, 3, 4) if needs == "any" else (int(needs),)
                node = next((found for kind in kinds if (found := self._node(kind))), None)
                if node is None:
                    self._verdicts.skip(name, f"it registered no node of type {needs}")
                    continue
                values |= self._of(node)
            if vector.marks.get("costs") == "connection":
                await self._gives_up(name, vector.fill(values))
            else:
                await self._survives(name, vector.fill(values))

    async def _gives_up(self, name: str, data: bytes) -> None:
        """After bytes behind which no message can be found it has to begin a new connection."""
        await self._client.send(data + bytes(64))
        ended = await self._client.until(lambda: self._client.ended, self._patience_s)
        self._verdicts.hold(name, ended, "it waits for bytes that will not come")
        await self._anew(name)

    # -- services, pace, heartbeats ----------------------------------------------------------------------------------

    async def _services(self) -> None:
        names = ("services.answers", "services.number", "services.to_asker", "services.all")
        node = self._node(4)
        if node is None or not cdr_for(node):
            for name in names:
                self._verdicts.skip(name, "it serves nothing whose type the kit knows")
            return
        hold = self._verdicts.hold
        first = await self._requests(node, [77])
        if not hold("services.answers", first, f"no answer came within {self._patience_s:g} s"):
            return
        numbers = {said.metadata.get("requestId") for said in [*first, *await self._requests(node, [0])]}
        hold("services.number", {0, 77} <= numbers, f"answers had {sorted(map(str, numbers))}, asked were 0 and 77")
        robots = int.from_bytes(first[0].whole[1:3], "little")
        hold("services.to_asker", robots == node.robot, f"it goes to {robots}, {node.robot} asked")
        if self._verdicts.asked("services.all"):
            wanted = list(range(100, 130))
            found = {said.metadata.get("requestId") for said in await self._requests(node, wanted)}
            missing = sorted(set(wanted) - found)
            hold("services.all", not missing, f"{len(missing)} were not answered: {missing}")

    async def _requests(self, node: Node, numbers: list[int]) -> list[Said]:
        """Ask it, all at once; its answers."""
        start = len(self._client.said)
        values = self._of(node)
        asked = [vectors.fill("router_messages", "request", **{**values, "number": number}) for number in numbers]
        await self._client.send(b"".join(asked))
        await self._client.until(
            lambda: len(_answered(self._client.said[start:], node)) >= len(numbers), self._patience_s
        )
        return _answered(self._client.said[start:], node)

    async def _pace(self) -> None:
        unknown = vectors.fill("bad_messages", "unknown_manager")
        await self._survives("pace.burst", unknown * 500)
        self._client.pause()
        await asyncio.sleep(2.0)
        self._client.resume()
        await self._survives("pace.stalled_router", b"")

    async def _heartbeats(self) -> None:
        """Say nothing that it answers, and see when it says something by itself."""
        loop = asyncio.get_running_loop()
        hold, client, start = self._verdicts.hold, self._client, len(self._client.said)
        unknown = vectors.fill("bad_messages", "unknown_manager")
        began = quiet_since = loop.time()
        beats: list[float] = []
        while len(beats) < 2 and loop.time() - quiet_since < _BEAT_S and loop.time() - began < 2.5 * _BEAT_S:
            seen = len(client.said)
            await client.until(lambda seen=seen: len(client.said) > seen, 1.0)  # type: ignore[misc]
            if len(client.said) > seen:
                quiet_since = client.said[-1].at
            beats = [said.at for said in client.said[start:] if said.kind is Kind.HEARTBEAT]
            await client.send(unknown)
            if client.ended:
                raise Gone("it ended its connection while nothing was asked of it")
        silent_s = loop.time() - quiet_since
        if not beats and silent_s < _BEAT_S:
            self._verdicts.skip("heartbeat.comes", "it always had something else to say")
            self._verdicts.skip("heartbeat.goes_on", "it always had something else to say")
            return
        hold("heartbeat.comes", beats, f"it said nothing for {silent_s:.1f} s")
        if beats:
            goes_on = len(beats) > 1 or silent_s < _BEAT_S
            hold("heartbeat.goes_on", goes_on, f"after the first one it said nothing for {silent_s:.1f} s")
        if len(beats) > 1:
            hold("heartbeat.not_too_often", beats[1] - beats[0] >= 1.0, f"two came within {beats[1] - beats[0]:.2f} s")

    # -- connections -------------------------------------------------------------------------------------------------

    async def _reconnects(self) -> None:
        had = set(self._frames.nodes)
        self._client.finish()
        await self._joins_again("reconnect.after_end", 21)
        came = await self._client.until(lambda: registered(self._client) >= had, max(3.0, self._patience_s))
        if had:
            missing = sorted(name for _, name in had - registered(self._client))
            self._verdicts.hold("reconnect.registers", came, f"it did not register {', '.join(missing)}")
        else:
            self._verdicts.skip("reconnect.registers", "it had registered nothing")
        self._client.abort()
        await self._joins_again("reconnect.after_reset", 22)
        await self._closed_at_once()

    async def _joins_again(self, name: str, agent_id: int) -> None:
        client = await self._router.next(self._again_s)
        if not self._verdicts.hold(name, client is not None, f"it did not within {self._again_s:g} s"):
            client = await self._started_again(f"it made no new connection ({name})")
        assert client is not None
        self._client, self._frames.id = client, 0
        early = await client.until(self._configured_since(0, None), 0.3)
        self._verdicts.hold("reconnect.waits", not early, "its configuration came first")
        answer = await self._greeted(agent_id, bytewise=True)
        if not self._verdicts.hold("handshake.bytewise", answer is not None, self._silence()) or answer is None:
            raise Gone("it does not answer its router's first message")
        own = answer.management.get("agent_id")
        self._verdicts.hold("reconnect.new_id", own == agent_id, f"it says {own}, given was {agent_id}")

    async def _closed_at_once(self) -> None:
        """Close each connection as it comes, for a second."""
        loop = asyncio.get_running_loop()
        self._client.abort()
        before, until = self._router.arrivals, loop.time() + 1.0
        while (left := until - loop.time()) > 0:
            client = await self._router.next(left)
            if client is not None:
                client.abort()
        tries = self._router.arrivals - before
        self._verdicts.hold("reconnect.pauses", tries <= 50, f"it tried {tries} times in a second")
        await self._anew("that its router closed at once")

    async def _started_again(self, why: str) -> Client:
        """Its connection after it was started again. Raises Gone."""
        if self._program is None:
            raise Gone(why)
        await self._program.start(self._router.entrance)
        client = await self._router.next(START_S)
        if client is None:
            raise Gone(f"{why}, nor after it was started again")
        return client

    async def _leaves(self, program: Program) -> None:
        start = len(self._client.said)
        took_it = await program.stop()
        await self._client.until(lambda: self._client.ended, self._patience_s)
        left = any(said.kind is Kind.OFFLINE for said in self._client.said[start:])
        if left or took_it:
            self._verdicts.hold("offline.says", left, "its connection ended without it")
        else:
            self._verdicts.skip("offline.says", "it does not take SIGTERM")

    def _skip_rest(self, why: str) -> None:
        for check in CHECKS:
            if check.name.startswith(("renumber.", "fragments.", "messages.", "bad.", "pace.", "services.")):
                self._verdicts.skip(check.name, why)


def _answers(said: Said, request: int | None) -> bool:
    is_answer = said.kind is Kind.CONFIGURATION
    return is_answer and (request is None or said.management.get("request_id") == request)


def _answered(said: list[Said], node: Node) -> list[Said]:
    return [
        each
        for each in said
        if each.kind is Kind.MESSAGE
        and each.metadata.get("nodeType") == 4
        and each.metadata.get("nodeName") == node.name
    ]


async def judge(
    host: str,
    port: int,
    *,
    level: Level = Level.STRICT,
    patience_s: float = 3.0,
    start_s: float = START_S,
    most_s: float = MOST_S,
    on_listening: Callable[[int], object] = lambda port: None,
    program: Program | None = None,
    web: bool = False,
) -> list[Verdict]:
    """Be the router of a headset, and hold it to every check of a level.

    ``on_listening`` is told the port when the headset may come; ``program`` is started then, and after a check that
    ended it. With ``web`` it comes by WebSocket. Raises Unreachable when the port cannot be had, MissingExtra.
    """
    verdicts = Verdicts(CHECKS, level)
    frames = ClientFrames(verdicts)
    async with AsyncExitStack() as stack:
        router = await stack.enter_async_context(Router(frames, host, 0 if web else port))
        if web:
            router.entrance = (await stack.enter_async_context(_web_sockets(host, port, router.port))).port
        on_listening(router.entrance)
        if program is not None:
            await program.start(router.entrance)
        try:
            await within(Judge(router, frames, verdicts, patience_s, program).run(start_s), start_s + most_s)
        except (Gone, asyncio.TimeoutError) as why:
            for check in CHECKS:
                verdicts.skip(
                    check.name, str(why) or f"no time was left of {most_s:g} s, for so much was waited in vain"
                )
    return verdicts.all()


def _web_sockets(host: str, port: int, to_port: int) -> WebSockets:
    try:
        from .websocket import WebSockets
    except ModuleNotFoundError as error:
        raise MissingExtra("a WebSocket", "aiohttp", "web") from error
    return WebSockets(host, port, to_port)
