"""Whether running routers hold everybody to a policy: tried, with each node's own certificate.

For each pair of nodes one tries everything: to send by id, by group, to all, on a stream and by name; to call, to
answer, to see and to be seen; in its own name, and in that of each other node. Two sessions for each node, one that
says and one that listens, so each attempt has a known answer from the policy: who must get it, and nobody else.

Of a mesh that is in use, this is seen: everybody who listens gets a few `PROBE` payloads, which are not passed on;
robots log one message type that nobody has registered. Calls of verbs that robots have go to the robot where it is
online; elsewhere the check's sessions stand in for it, and answer nobody but the check. Presence tokens have a last
chunk that no program reads.
"""

from __future__ import annotations

import asyncio
import datetime as dt
import tempfile
from collections.abc import Sequence
from pathlib import Path

from bridge.security import access, certificates
from bridge.security.attempts import Result
from bridge.security.headsets import try_headsets
from bridge.security.policy import Policy
from bridge.security.router_path import Progress, RouterPath, settings_of
from macs_zenoh.config import MeshSettings
from macs_zenoh.errors import ConfigError, Unreachable
from macs_zenoh.mesh import Mesh
from macs_zenoh.protocol import endpoints
from macs_zenoh.sections import changed
from macs_zenoh.timeouts import within

RETRY_S = 0.1


async def check(
    policy: Policy,
    directory: Path,
    routers: Sequence[str] | None = None,
    *,
    timeout_s: float = 5.0,
    progress: Progress = lambda done, of: None,
) -> list[Result]:
    """Try everything on each router, and across each link between two.

    Args:
        directory: what `generate` wrote, with everybody's key.
        routers: endpoints to try, one by one; None: those of the policy, and their links.

    Raises Unreachable: a router does not answer. ConfigError: a certificate is not there.
    """
    for client in policy.clients:
        for name in (certificates.CERTIFICATE, certificates.KEY, certificates.AUTHORITY):
            if not (directory / client.name / name).exists():
                raise ConfigError(str(directory / client.name / name), "is not there; run `macs security generate`")
    paths = [(endpoint, endpoint, endpoint) for endpoint in routers or ()]
    if not routers:
        paths = [(router.name, router.dialled[0], router.dialled[0]) for router in policy.routers]
        paths += [
            (f"{one.name} to {other.name}", one.dialled[0], other.dialled[0])
            for one in policy.routers
            for other in access.linked(policy, one)
        ]
    results: list[Result] = await try_headsets(policy, directory, timeout_s)
    for number, (label, near, far) in enumerate(paths):
        path = RouterPath(policy, directory, label, near, far, timeout_s)

        def part(done: int, of: int, number: int = number) -> None:
            progress(number * of + done, len(paths) * of)

        await asyncio.gather(*(_reach(label, endpoint, timeout_s) for endpoint in {near, far}))
        let_in = _refusals(policy, directory, label, near, timeout_s) if near == far else _nothing()
        trying = [asyncio.create_task(path.run(part)), asyncio.create_task(let_in)]
        try:
            for found in await asyncio.gather(*trying):
                results += found
        finally:
            for task in trying:
                task.cancel()
            await asyncio.gather(*trying, return_exceptions=True)
    return results


async def _reach(label: str, endpoint: str, timeout_s: float) -> None:
    """Wait until somebody listens there: where nobody does, so many sessions take several times their time to fail.

    Raises Unreachable.
    """
    place = endpoints.address_of(endpoint)
    if place is None or endpoints.protocol_of(endpoint) not in ("tcp", "tls"):
        return

    async def connect() -> None:
        while True:
            try:
                _, writer = await asyncio.open_connection(*place)
            except OSError:
                await asyncio.sleep(RETRY_S)
            else:
                writer.close()
                return

    try:
        await within(connect(), timeout_s)
    except asyncio.TimeoutError:
        where = label if label == endpoint else f"{label} at {endpoint}"
        raise Unreachable(where, f"nobody listens there, tried for {timeout_s:g} s") from None


# -- who must not be let in at all -------------------------------------------------------------------------------


async def _refusals(policy: Policy, directory: Path, label: str, endpoint: str, timeout_s: float) -> list[Result]:
    """Sessions without a certificate, with one of another authority, and without TLS."""
    name = policy.clients[0].name if policy.clients else policy.routers[0].name
    ours = directory / name
    with tempfile.TemporaryDirectory() as elsewhere:
        foreign = Path(elsewhere) / name
        authority, _ = certificates.authority(Path(elsewhere), policy, dt.datetime.now(dt.timezone.utc))
        authority.issue(foreign, None, policy, dt.datetime.now(dt.timezone.utc), renew=False)
        certificates.write(
            foreign / certificates.AUTHORITY, (ours / certificates.AUTHORITY).read_bytes(), certificates.PUBLIC_FILE
        )
        root = f"transport/link/tls/root_ca_certificate:'{(ours / certificates.AUTHORITY).resolve()}'"
        attempts = {
            f"{name} with a certificate of another authority is let in": settings_of(policy, foreign, endpoint),
            "somebody without a certificate is let in": changed(policy.mesh, connect=[endpoint], overrides=[root]),
            "somebody without TLS is let in": changed(policy.mesh, connect=[endpoints.by_protocol("tcp", endpoint)]),
        }
        seen = await asyncio.gather(*(_let_in(settings, timeout_s) for settings in attempts.values()))
    return [Result(label, what, False, inside) for what, inside in zip(attempts, seen, strict=True)]


async def _nothing() -> list[Result]:
    return []


async def _let_in(settings: MeshSettings, timeout_s: float) -> bool:
    try:
        async with await Mesh.open_once(settings, timeout_s=timeout_s):
            return True
    except Unreachable:
        return False
