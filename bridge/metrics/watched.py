"""What is asked of a program that is watched, and what its place on the mesh says of itself."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, Any

from macs_zenoh.losses import Losses
from macs_zenoh.protocol.keyexpr import type_name
from macs_zenoh.versions import installed

from .families import Family, Histogram, build, by_type, drops, gauge
from .hops import HopTimes

if TYPE_CHECKING:
    from macs_zenoh.mesh import Mesh
    from macs_zenoh.protocol.directory import Directory

log = logging.getLogger("macs.metrics")

Figures = Callable[[], Iterable[Family]]
Problems = Callable[[], list[str]]
Facts = Callable[[], Mapping[str, Any]]


class Watched:
    """A program as who watches it sees it. ``name`` is its verb; what it is asked is answered at once, on its loop."""

    def __init__(
        self,
        name: str,
        mesh: Callable[[], Mesh | None],
        *,
        figures: Figures = tuple,
        lost: Callable[[], Mapping[str, Mapping[str, int]]] = dict,
        problems: Problems = list,
        facts: Facts = dict,
        directory: Callable[[], Directory | None] = lambda: None,
    ) -> None:
        """``lost`` counts what was lost, by where and name, besides what the session lost. ``problems`` say why it is
        not ready, ``facts`` what else it tells of itself."""
        self.name = name
        self._mesh = mesh
        self._figures = figures
        self._lost = lost
        self._problems = problems
        self._facts = facts
        self._directory = directory
        self._hops = HopTimes()
        self.at_port = Losses(log)
        """Connections of who watches that were closed."""
        self._began_s = time.monotonic()
        self._versions = {"macs": installed("macs-zenoh"), "zenoh": installed("eclipse-zenoh")}

    def figures(self) -> list[Family]:
        """All figures, bounded."""
        mesh, directory = self._mesh(), self._directory()
        families = [
            build(self.name, self._versions),
            gauge("macs_ready", "whether the program does its work now").add(not self.problems()),
            drops(self._all_lost()),
        ]
        if mesh is not None:
            families += [
                gauge("macs_linked", "whether a router is connected").add(mesh.linked),
                gauge("macs_routers", "routers that are connected").add(len(mesh.routers)),
                gauge("macs_backlog_bytes", "bytes that wait to be sent over the mesh").add(mesh.backlog_bytes),
                gauge("macs_waiting_samples", "samples of the mesh that wait for the loop").add(mesh.waiting_samples),
            ]
        if directory is not None:
            families.append(
                by_type("macs_agents", "agents online on the mesh", (type_name(agent.type) for agent in directory))
            )
        return [family.bounded() for family in (*families, *self._figures())]

    def histograms(self) -> list[Histogram]:
        """How long hops took of what was traced, since somebody first asked."""
        mesh = self._mesh()
        if mesh is not None:
            mesh.tracing.on_report = self._hops.take
        return [self._hops.histogram()]

    def problems(self) -> list[str]:
        """Why it is not ready, in words; empty when it is."""
        mesh = self._mesh()
        if mesh is None:
            return ["it is not on the mesh yet"]
        return ([] if mesh.linked else ["no router is connected"]) + list(self._problems())

    def diagnostics(self) -> dict[str, Any]:
        """All that it tells of itself, for a person or a program that looks for a fault."""
        mesh, problems = self._mesh(), self.problems()
        said: dict[str, Any] = {
            "program": self.name,
            "versions": self._versions,
            "ready": not problems,
            "problems": problems,
            "up_s": round(time.monotonic() - self._began_s, 1),
            "lost": {where: dict(sorted(names.items())) for where, names in self._all_lost().items() if names},
        }
        if mesh is not None:
            said["session"] = mesh.zid
            said["routers"] = mesh.routers
            said["mode"] = mesh.settings.mode
            said["now"] = mesh.tells()
        return {**said, **self._facts()}

    def _all_lost(self) -> dict[str, Mapping[str, int]]:
        mesh = self._mesh()
        session = {"session": dict(mesh.drops)} if mesh is not None else {}
        return {**session, **self._lost(), **({"metrics": dict(self.at_port)} if self.at_port else {})}
