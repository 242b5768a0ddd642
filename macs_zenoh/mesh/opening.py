"""How a session of Zenoh's is opened: a client waits for its first router, and nothing of it stays open by mistake."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor

import msgspec
import zenoh

from macs_zenoh.config import MeshSettings
from macs_zenoh.errors import ConfigError, Unreachable

from .threads import shared_threads
from .zenoh_config import check_files, first_line, zenoh_config

log = logging.getLogger("macs.mesh")

LOGGED = "error,zenoh_transport::unicast::establishment=off"
"""What Zenoh logs by itself. Not each attempt to open a session that fails: who waits says so, and why."""


async def open_session(
    settings: MeshSettings, *, on_waiting: Callable[[str], None] | None = None, quiet: bool = False
) -> zenoh.Session:
    """A session of Zenoh's by these settings. See `Mesh.open`."""
    zenoh.init_log_from_env_or("off" if quiet else LOGGED)  # RUST_LOG, as with Zenoh's own tools
    config = zenoh_config(settings)
    check_files(config)  # once: a file that is being replaced ends nobody who waits
    waiting = False
    while True:
        try:
            return await open_now(config)
        except zenoh.ZError as error:
            problem = first_line(error)
            if settings.mode != "client":
                raise Unreachable(", ".join(settings.listen) or "the mesh", problem) from error
            if not problem.startswith("Unable to connect"):
                raise ConfigError("zenoh configuration", problem) from error
            if not waiting:
                waiting = True
                (on_waiting or _log_waiting)(", ".join(settings.routers) or "a router")
            await asyncio.sleep(settings.retry_max_ms / 1000)
            config = zenoh_config(settings)


async def open_now(config: zenoh.Config) -> zenoh.Session:
    """Open a session in a thread. When the caller is cancelled, a session that comes late is closed there: the event
    loop may have ended by then, and a process that exits with an open session hangs.

    Raises zenoh.ZError.
    """
    thread = ThreadPoolExecutor(1, "macs-open")
    opened = thread.submit(_open_now, config)
    thread.shutdown(wait=False)
    try:
        return await asyncio.wrap_future(opened)
    except asyncio.CancelledError:
        opened.add_done_callback(_close_late)
        raise


def _open_now(config: zenoh.Config) -> zenoh.Session:
    with shared_threads(msgspec.json.decode(config.get_json("mode"), type=str)):
        return zenoh.open(config)


def _close_late(opened: Future[zenoh.Session]) -> None:
    if not opened.cancelled() and opened.exception() is None:
        opened.result().close()  # type: ignore[no-untyped-call]


def _log_waiting(target: str) -> None:
    log.warning("no router at %s yet; waiting for it", target)
