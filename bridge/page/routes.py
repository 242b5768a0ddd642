"""Where a gateway's page is, and what its browsers are told over HTTP: files, the mesh, each robot, types."""

from __future__ import annotations

import time
from collections.abc import Mapping
from functools import partial
from typing import Any

import msgspec
from aiohttp import web

from bridge.gateway.site import Site
from macs_zenoh.errors import MacsError
from macs_zenoh.protocol.credit import Credit
from macs_zenoh.protocol.limits import NAME_BYTES
from macs_zenoh.protocol.messages import ROS
from macs_zenoh.protocol.rights import RIGHTS, Grant
from macs_zenoh.versions import installed

from . import files
from .definitions import Definitions
from .files import File
from .mesh import Picture
from .recordings import may_record
from .robots import Robots, may_see, problem_of
from .traces import Traces

POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; "
    "connect-src 'self'; worker-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
"""Nothing of the page is from elsewhere, and no other page shows it."""

BYTES_PER_S = 32e6
"""Of files, to all together: they cost others nothing that could be noticed."""

DRAWN_S = 0.5
DRAWN = 64
"""So many tokens have a picture that is kept."""


class Page:
    """The page of one gateway."""

    def __init__(self, site: Site) -> None:
        gateway = site.gateway
        self._site = site
        self._robots = Robots(gateway.mesh)
        self._picture = Picture(gateway.mesh, gateway.directory, self._robots)
        self._definitions = Definitions(self._robots)
        self._traces = Traces(gateway.mesh, gateway.directory, self._robots.ask)
        self._drawn: dict[str, tuple[float, bytes]] = {}
        """By token, when the picture of the mesh was made, and what it was: of a large mesh it takes milliseconds."""
        self._credit = Credit(BYTES_PER_S, time.monotonic())

    def close(self) -> None:
        """Ask nobody any more."""
        self._picture.close()
        self._robots.close()
        self._traces.close()

    def add_to(self, site: Site) -> None:
        """Say what is where."""
        found = files.read_all()
        if files.missing(found):
            site.get_for_all("/", partial(self._file, files.without_libraries()))
        else:
            site.get_for_all("/", partial(self._file, found["index.html"]))
        scene = files.without_libraries() if files.missing(found, files.XR_LIBRARIES) else found["xr/index.html"]
        site.get_for_all("/xr", partial(self._file, scene))
        for name, file in found.items():
            site.get_for_all(f"/{name}", partial(self._file, file))
        site.get_for_all("/view/me", self._me)
        site.get("/view/mesh", self._mesh)
        site.get(r"/view/robots/{robot:\d{1,5}}/{what:status|offers}", self._robot)
        site.get(r"/view/trace/{robot:\d{1,5}}", self._trace)
        site.get(r"/types/{robot:\d{1,5}}/{package}/{kind:msg|srv|action}/{name}", self._type)

    async def _file(self, file: File, request: web.Request) -> web.StreamResponse:
        headers = {"Cache-Control": "no-cache", "ETag": file.tag, "Content-Security-Policy": POLICY}
        headers["Referrer-Policy"] = "no-referrer"
        if request.headers.get("If-None-Match") == file.tag:
            return web.Response(status=304, headers=headers)
        body = file.body
        if file.compressed and "gzip" in request.headers.get("Accept-Encoding", ""):
            body, headers["Content-Encoding"] = file.compressed, "gzip"
        if not self._credit.take(len(body), time.monotonic()):
            return web.json_response({"error": "too much is asked for"}, status=503, headers={"Retry-After": "1"})
        return web.Response(
            body=body, headers={**headers, "Content-Type": file.content_type, "Vary": "Accept-Encoding"}
        )

    async def _me(self, request: web.Request) -> web.StreamResponse:
        """Who asks, and what he may do: no error where a token is wanted, which browsers would log as one."""
        visitor = self._site.visitor(request)
        if visitor is None:
            self._site.refuse(request)
            return _json({"wanted": True})
        rights = visitor.rights
        return _json(
            {
                "wanted": False,
                "name": visitor.name,
                "may": sorted(RIGHTS) if rights is None else rights.may,
                "robots": "any" if rights is None else rights.robots,
                "groups": "any" if rights is None else rights.groups,
                "topics": ["/**"] if rights is None else rights.topics,
                "version": installed("macs-zenoh"),
                "recordings": self._site.gateway.settings.recordings is not None and may_record(visitor),
            }
        )

    async def _mesh(self, _: web.Request, visitor: Grant) -> web.StreamResponse:
        now = time.monotonic()
        at, body = self._drawn.get(visitor.name, (0.0, b""))
        if now - at > DRAWN_S:
            if len(self._drawn) >= DRAWN:
                self._drawn.clear()
            gateway = self._site.gateway
            body = msgspec.json.encode(self._picture.now(visitor, gateway.address, gateway.drops))
            self._drawn[visitor.name] = now, body
        return web.Response(body=body, content_type="application/json")

    async def _robot(self, request: web.Request, visitor: Grant) -> web.StreamResponse:
        robot = int(request.match_info["robot"])
        problem = self._problem(robot, visitor)
        if problem is not None:
            return _json({"error": problem})
        asking = self._robots.status if request.match_info["what"] == "status" else self._robots.offers
        try:
            return _json(await asking(robot))
        except MacsError as error:
            return _json({"error": problem_of(error)})  # the question was right: it is the robot that does not answer

    async def _trace(self, request: web.Request, visitor: Grant) -> web.StreamResponse:
        """Of a topic, or of commands: those are ``?commands=``."""
        robot, topic = int(request.match_info["robot"]), request.query.get("topic", "")[:NAME_BYTES]
        commands = "commands" in request.query
        problem = self._problem(robot, visitor)
        if problem is None and visitor.rights is not None and not commands:
            problem = visitor.rights.of_topic(topic)
        if problem is None and not topic and not commands:
            problem = "say which topic"
        if problem is not None:
            return _json({"error": problem})
        try:
            return _json({"ways": await self._traces.of(robot, "" if commands else topic)})
        except MacsError as error:
            return _json({"error": problem_of(error)})

    async def _type(self, request: web.Request, visitor: Grant) -> web.StreamResponse:
        said = request.match_info
        robot, name = int(said["robot"]), f"{said['package']}/{said['kind']}/{said['name']}"
        text = None
        if self._may_see(robot, visitor):
            text = await self._definitions.text(robot if self._is_online(robot) else None, name)
        if text is None:
            return _json({"error": f"nobody here knows the type {name}"})
        return _json({"text": text})

    def _is_online(self, robot: int) -> bool:
        return (ROS, robot) in self._site.gateway.directory

    def _may_see(self, robot: int, visitor: Grant) -> bool:
        agent = self._site.gateway.directory.get(ROS, robot)
        return may_see(visitor, robot, agent.group if agent is not None else 0)

    def _problem(self, robot: int, visitor: Grant) -> str | None:
        """Why a robot is not even asked: nothing is remembered of robots that are not there."""
        if not self._may_see(robot, visitor):
            return "this token does not give the right to see this robot"
        if not self._site.gateway.mesh.linked:
            return "this gateway has lost its router"
        return None if self._is_online(robot) else f"robot {robot} is not online"


def _json(document: Mapping[str, Any]) -> web.Response:
    return web.Response(body=msgspec.json.encode(document), content_type="application/json")


def add_page(site: Site) -> None:
    """Add the page to a gateway's web port."""
    page = Page(site)
    page.add_to(site)
    site.on_close(page.close)
