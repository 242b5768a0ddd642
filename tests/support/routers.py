"""Zenoh routers as processes: zenohd where it is installed, otherwise the same router out of the Python wheel."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from pathlib import Path

from macs_zenoh.config import MeshSettings
from macs_zenoh.sections import changed
from tests.support.processes import Process
from tests.support.programs import READY, free_port
from tests.support.tools import zenohd


def as_macs_router(settings: MeshSettings) -> list[str]:
    """What `macs router` with these settings does with links and messages, as ``overrides``."""
    table = changed(settings, mode="router").zenoh()
    return [f"{path}:{json5}" for path, json5, _ in table if path.startswith(("transport/", "qos/"))]


class Router(Process):
    """A router."""

    def __init__(
        self,
        config: Path | None = None,
        *,
        listen: Sequence[str] = (),
        connect: Sequence[str] = (),
        overrides: Sequence[str] = (),
        within: Sequence[str] = (),
        host: str = "127.0.0.1",
    ) -> None:
        """``overrides`` are ``path:JSON5``; ``within`` comes before the command, as ``ip netns exec site``.

        Without ``listen`` and ``config`` it listens on a free port of ``host``.
        """
        if not listen and config is None:
            listen = [f"tcp/{host}:{free_port()}"]
        self.endpoint = listen[0] if listen else ""
        binary = zenohd()
        command = [binary, "--no-multicast-scouting"] if binary else [sys.executable, "-m", "bridge", "router"]
        if config is not None:
            command += ["-c", str(config)]
        for flag, values in (("-l", listen), ("-e", connect), ("--cfg", overrides)):
            command += [word for value in values for word in (flag, value)]
        super().__init__(*command, env={"RUST_LOG": os.environ.get("RUST_LOG", "info")}, within=within)

    def _heard(self, line: str, *, is_log: bool) -> bool:
        if not is_log:
            self.log.append(line)  # zenohd logs to standard output
        return line.startswith(READY) or "Zenoh can be reached at" in line
