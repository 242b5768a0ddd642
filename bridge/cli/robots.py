"""Robots as an operator sees them: who is online, and what each one answers to a call.

The session joins nothing: its calls come from ``operator/0``, who has no presence and no inbox. The settings
(``[operator]``) or ``--as`` name somebody else, where robots or a router's access rules want to know who it is.
"""

from __future__ import annotations

import argparse
import asyncio
import time
from collections import Counter
from collections.abc import AsyncIterator, Collection, Mapping
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any, TypeVar

import msgspec

from bridge.principal import Principal
from bridge.settings import OperatorSettings
from macs_zenoh.config import MeshSettings
from macs_zenoh.errors import MacsError, Refused, Unreachable, WireError
from macs_zenoh.protocol import keyexpr, ping
from macs_zenoh.protocol.agent_id import AgentId
from macs_zenoh.protocol.directory import AgentInfo, Directory
from macs_zenoh.protocol.json_fields import answered
from macs_zenoh.protocol.keyexpr import LEASE, NAME, PING, PRESENCE
from macs_zenoh.protocol.messages import OPERATOR, ROS, Metadata
from macs_zenoh.protocol.named import Named, Names
from macs_zenoh.protocol.ping import Pong
from macs_zenoh.protocol.routers import Router, router_of
from macs_zenoh.protocol.routing import call
from macs_zenoh.protocol.wire import Layout

if TYPE_CHECKING:
    from macs_zenoh.mesh import Mesh

_T = TypeVar("_T")

USUALLY_S = 0.4
"""Within so long a router has let us in, if one does."""

CLOCK_PINGS = 5
"""Of so many comparisons of two clocks the closest one counts."""

WITHOUT_A_ROUTER = "(start one with `macs router`, or name it with -e; `macs doctor` looks closer)"


def chosen_caller(args: argparse.Namespace, settings: OperatorSettings) -> AgentId:
    """Who ``--as`` names, else who the settings are for; whom nobody named asks as ``operator/0``."""
    principal: Principal = args.principal or Principal("operator", settings.id or 0)
    return AgentId(*principal.agent) if principal.kind else AgentId(OPERATOR, 0)


def here(elsewhere: Mapping[str, int]) -> str:
    """What follows "nobody is online", where others are in other namespaces."""
    others = ", ".join(f"{count} in {name!r} (--namespace {name})" for name, count in sorted(elsewhere.items()))
    return f" here; {others}" if others else ""


class Operator:
    """Looks at the mesh and calls robots. Made by `operator`."""

    def __init__(self, mesh: Mesh, caller: AgentId, timeout_s: float) -> None:
        self._mesh = mesh
        self._caller = caller
        self._timeout_s = timeout_s
        self._layout = Layout(mesh.settings.id_slots, mesh.settings.group_slots)

    @property
    def not_answered(self) -> str:
        """Why a robot that is online may not answer a call."""
        return f"it does not answer {self._caller}; access rules may not allow it (--as, docs/security.md)"

    async def online(self) -> list[AgentInfo]:
        """Everybody on the mesh, by type and id; who has an id that another session has as well is listed, too."""
        directory = Directory()
        for key in await self._mesh.tokens(PRESENCE.every(), timeout_s=self._timeout_s):
            directory.token(key, True, 0.0)
        return directory.claims()

    async def names(self) -> list[Named]:
        """The names by which some are reached, also those that two have."""
        names = Names()
        for key in await self._mesh.tokens(NAME.every(), timeout_s=self._timeout_s):
            names.token(key, True)
        return names.claims()

    async def gateways(self) -> set[str]:
        """The sessions of gateways: who is behind one answers no calls."""
        leases = [LEASE.parse(key) for key in await self._mesh.tokens(LEASE.every(), timeout_s=self._timeout_s)]
        return {lease.zid for lease in leases if lease is not None}

    async def pongs(self, gateways: Collection[str], *, timeout_s: float) -> dict[str, Pong | None]:
        """What each of these gateways says of itself, None for one that does not answer."""
        said = await asyncio.gather(*(self._pong(zid, timeout_s) for zid in gateways))
        return dict(zip(gateways, said, strict=True))

    async def _pong(self, zid: str, timeout_s: float) -> Pong | None:
        try:
            return ping.decode(await self._mesh.query(PING.of(zid=zid), b"", timeout_s=timeout_s))[0]
        except MacsError:
            return None

    async def clock(self, zid: str) -> tuple[float, float] | None:
        """How far the clock of a program is ahead of ours in seconds, and within what that is known; None: it does not
        answer."""
        best: tuple[float, float] | None = None
        for _ in range(CLOCK_PINGS):
            sent_s = time.time()
            said = await self._pong(zid, self._timeout_s)
            heard_s = time.time()
            if said is None:
                return best
            clock = (said.time_s - (sent_s + heard_s) / 2, (heard_s - sent_s) / 2)
            best = clock if best is None or clock[1] < best[1] else best
        return best

    async def routers(self, *, timeout_s: float) -> list[Router]:
        """The routers that let themselves be seen, or at least those that we are linked with."""
        linked = [Router(zid) for zid in self._mesh.routers]
        if self._mesh.settings.namespace:  # what they tell is in none
            return linked
        found = {router.zid: router for router in linked}
        for _, answer in await self._mesh.ask_all(keyexpr.ROUTERS, timeout_s=timeout_s):
            if (router := router_of(answer)) is not None:
                found[router.zid] = router
        return sorted(found.values(), key=lambda router: router.zid)

    async def elsewhere(self) -> Counter[str]:
        """How many agents there are in other namespaces."""
        return await elsewhere(self._mesh, timeout_s=self._timeout_s)

    async def why_silent(self, robot: AgentInfo, gateways: Collection[str], *, timeout_s: float) -> str:
        """Why a robot that is online does not serve a verb; empty when it need not: it is behind a gateway, or it
        answers what every program with a session of its own answers."""
        if robot.zid in gateways:
            return ""
        try:
            await self.ask(robot.id, "ping", timeout_s=timeout_s)
        except Refused:
            return ""
        except MacsError:
            return f"it does not answer {self._caller}; access rules may not allow it (--as operator/N)"
        return ""

    async def why_not_allowed(self, robot: int, verb: str, *, timeout_s: float) -> str:
        """Whether what a robot agent always serves does not get through to it; empty when it is no such agent."""
        try:
            await self.ask(robot, "status", timeout_s=timeout_s)
        except MacsError:
            return ""
        right = f"a policy gives it by `may: call` with `verbs: [{verb}]`, or `may: command`"
        return f"access rules do not let {self._caller} call its verb {verb}; {right} (docs/security.md)"

    async def ask(self, robot: int, verb: str, data: bytes = b"", *, timeout_s: float, urgent: bool = False) -> bytes:
        """What a robot answers. ``urgent``: at the priority of commands.

        Raises Refused with its reason, Unreachable when nobody there serves the verb, CallTimeout.
        """
        from macs_zenoh.mesh import Traffic

        key, frame = call((ROS, robot), verb, self._caller, data, Metadata(*self._caller), self._layout)
        traffic = Traffic.COMMAND if urgent else Traffic.CALL
        return await self._mesh.query(key, frame, timeout_s=timeout_s, traffic=traffic)


async def elsewhere(mesh: Mesh, *, timeout_s: float) -> Counter[str]:
    """How many agents a session sees in other namespaces."""
    found: Counter[str] = Counter()
    for key in set(await mesh.tokens(keyexpr.everywhere(PRESENCE), timeout_s=timeout_s)):
        if namespace := keyexpr.namespace_of(PRESENCE, key):
            found[namespace] += 1
    return found


@asynccontextmanager
async def operator(settings: MeshSettings, caller: AgentId, *, timeout_s: float) -> AsyncIterator[Operator]:
    """An operator's session until the end of the block. Raises Unreachable when no router answers in time."""
    async with session(settings, timeout_s=timeout_s) as mesh:
        yield Operator(mesh, caller, timeout_s)


@asynccontextmanager
async def session(settings: MeshSettings, *, timeout_s: float) -> AsyncIterator[Mesh]:
    """A session until the end of the block. Of several routers each but the last one may take its time
    (``open_limit_ms``) beside ``timeout_s``, as when its host is off.

    Raises Unreachable when no router answers in time.
    """
    from macs_zenoh.mesh import Mesh

    patience_s = timeout_s + max(0, len(settings.routers) - 1) * settings.open_limit_ms / 1000
    opening = asyncio.create_task(Mesh.open(settings, on_waiting=lambda target: None, quiet=True))
    try:
        mesh = await _opened(opening, settings, patience_s)
    finally:
        opening.cancel()
    async with mesh:
        yield mesh


async def _opened(opening: asyncio.Task[Mesh], settings: MeshSettings, patience_s: float) -> Mesh:
    """The session, when a router lets us in; meanwhile it is found out why none does. Raises Unreachable."""
    from bridge.doctor import first

    loop = asyncio.get_running_loop()
    deadline = loop.time() + patience_s
    target = ", ".join(settings.routers) or "a router"
    await asyncio.wait([opening], timeout=min(USUALLY_S, patience_s))
    if opening.done():
        return opening.result()
    looking = loop.create_task(first.why(settings, timeout_s=min(first.STEP_S, patience_s)))
    await asyncio.wait([opening, looking], timeout=deadline - loop.time(), return_when=asyncio.FIRST_COMPLETED)
    if looking.done() and first.certain(looking.result(), len(settings.routers)):
        opening.cancel()
        raise Unreachable(target, first.sentence(looking.result()))
    await asyncio.wait([opening], timeout=max(0.0, deadline - loop.time()))
    if opening.done():
        looking.cancel()
        return opening.result()
    await asyncio.wait([looking], timeout=first.STEP_S)
    findings = looking.result() if looking.done() else []
    looking.cancel()
    if reasons := first.sentence(findings):
        raise Unreachable(target, f"no Zenoh router answered within {patience_s:g} s: {reasons} {WITHOUT_A_ROUTER}")
    raise Unreachable(target, f"no Zenoh router answered within {patience_s:g} s {WITHOUT_A_ROUTER}")


def read(answer: bytes, kind: type[_T]) -> tuple[dict[str, Any], _T]:
    """A robot's answer as it is, and as far as it is known here. Raises Unreachable: it makes no sense."""
    try:
        document = answered("an answer", answer)
        return document, msgspec.convert(document, kind)
    except (WireError, msgspec.ValidationError) as error:
        raise Unreachable("the robot", f"its answer makes no sense: {error}") from error
