"""The doctor's first step, for every program that waits for a router: why none answers, in one line per endpoint.

Zenoh only says that it timed out. This looks below it with the settings' own credentials: name, port, TLS, and who is
there.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable
from typing import Any

from macs_zenoh.config import MeshSettings
from macs_zenoh.errors import MacsError
from macs_zenoh.mesh import configuration
from macs_zenoh.protocol import endpoints

from . import transport
from .analyze import of_endpoints
from .facts import Endpoint, Facts, Own
from .findings import Finding
from .gather import JUDGED

log = logging.getLogger("macs.mesh")

STEP_S = 2.0
CERTAIN = frozenset({"is_gateway", "speaks_tls"})
"""What does not pass by waiting; a name may become known."""


async def why(settings: MeshSettings, *, timeout_s: float = STEP_S) -> list[Finding]:
    """What is wrong with each endpoint that does not let us in, as far as it can be seen from here."""
    try:
        zenoh = configuration(settings)
    except MacsError:
        return []
    tls = endpoints.value_at(zenoh, "transport/link/tls") or {}
    looking = (
        asyncio.to_thread(_look, endpoint, tls, timeout_s) for endpoint in dict.fromkeys(endpoints.configured(zenoh))
    )
    seen = await asyncio.gather(*looking)
    own = Own(zenoh_settings={path: endpoints.value_at(zenoh, path) for path in JUDGED})
    return of_endpoints(Facts(at_s=time.time(), own=own, endpoints=list(seen)))


def _look(endpoint: str, tls: dict[str, Any], timeout_s: float) -> Endpoint:
    """TCP, TLS, and who answers. Blocking."""
    facts, where, protocol = (
        Endpoint(endpoint=endpoint),
        endpoints.address_of(endpoint),
        endpoints.protocol_of(endpoint),
    )
    if where is None or protocol not in ("tcp", "tls"):
        return facts
    facts.reach, facts.reach_detail = transport.reach(*where, timeout_s)
    if facts.reach != "ok":
        return facts
    if protocol == "tls":
        facts.tls = transport.tls(*where, endpoints.tls_settings(endpoint, tls), timeout_s)
    else:
        facts.speaker = transport.answers(*where, timeout_s)
        if facts.speaker == "gateway":
            facts.router_beside = transport.router_beside(where.host, timeout_s)
        facts.speaks_tls = facts.speaker not in ("zenoh", "gateway") and transport.speaks_tls(*where, timeout_s)
    return facts


def sentence(findings: list[Finding]) -> str:
    """All of it in one line."""
    several = len({finding.where for finding in findings}) > 1
    parts = []
    for finding in findings:
        # to start what does not run needs no telling
        what = f"{finding.text} ({finding.remedy})" if finding.remedy and finding.id != "refused" else finding.text
        parts.append(f"{finding.where}: {what}" if several else what)
    return "; ".join(parts)


def certain(findings: list[Finding], endpoints: int) -> bool:
    """Whether waiting helps with none of so many endpoints."""
    hopeless = {finding.where for finding in findings if finding.id in CERTAIN}
    return bool(hopeless) and len(hopeless) >= endpoints


def told_while_waiting(settings: MeshSettings) -> Callable[[str], None]:
    """For who waits for a router as long as it takes: says so, and why none answers as soon as that is known."""
    telling: set[asyncio.Task[None]] = set()

    async def tell() -> None:
        for finding in await why(settings):
            if finding.id != "refused":  # nobody listens there yet: it is what we wait for
                log.warning("%s: %s", finding.where, sentence([finding]))

    def waiting(target: str) -> None:
        log.warning("no router at %s yet; waiting for it", target)
        telling.add(task := asyncio.get_running_loop().create_task(tell()))
        task.add_done_callback(telling.discard)

    return waiting
