"""What the verbs for topics, services and actions share: which robots are meant, who asks, and being on the mesh."""

from __future__ import annotations

import argparse
import json
from collections.abc import Awaitable, Callable
from typing import TYPE_CHECKING, Any

from bridge.cli import options, output, robots, running
from bridge.principal import Principal
from bridge.settings import Settings
from macs_zenoh.errors import UsageError
from macs_zenoh.plain import plain
from macs_zenoh.protocol.messages import ROS, UNITY

if TYPE_CHECKING:
    from bridge.graph.lists import Named
    from bridge.graph.site import Looking, Site

ANSWER_S = 5.0
"""How long a router, and then a robot, may take to answer."""


def add_verb(verbs: Any, name: str, summary: str, text: str, run: Callable[..., int]) -> argparse.ArgumentParser:
    """A verb below one of `macs`, with examples."""
    parser = options.add_verb(verbs, name, summary, text)
    parser.set_defaults(run_below=run)
    return parser


def add_site_options(parser: argparse.ArgumentParser, *, robots_are: str) -> None:
    """Which robots, who asks, where the router is, how long to wait. ``robots_are``: those that are meant unless one
    is named."""
    parser.add_argument(
        "--robot", type=robot_ids, action="extend", default=[], metavar="1,2", help=f"these (default: {robots_are})"
    )
    parser.add_argument("--group", type=_group, action="append", default=[], metavar="G", help="robots of this group")
    parser.add_argument("--json", action="store_true", help="for programs: JSON, a line for each")
    parser.add_argument(
        "--wait", type=positive, default=ANSWER_S, metavar="S", help="for a router, then for a robot (default: 5)"
    )
    options.add_as_option(parser)
    options.add_mesh_options(parser)


def add_end_options(parser: argparse.ArgumentParser) -> None:
    """When it has been enough."""
    end = parser.add_mutually_exclusive_group()
    end.add_argument("--once", "-1", dest="count", action="store_const", const=1, help="stop after one message")
    end.add_argument("--count", type=number, metavar="N", help="stop after N messages")
    parser.add_argument("--timeout", type=positive, metavar="S", help="stop after S seconds")


def on_site(args: argparse.Namespace, work: Callable[[Site], Awaitable[int]], *, endless: bool = False) -> int:
    """Join the mesh, do ``work`` with the robots that are meant, leave. ``endless``: to be stopped is its good end."""
    settings = options.settings(args)
    joining = who_joins(args, settings)

    async def run() -> int:
        from bridge.graph.site import Chosen, Site
        from macs_zenoh.joining import joined

        chosen = Chosen(tuple(dict.fromkeys(args.robot)), tuple(dict.fromkeys(args.group)))
        async with (
            robots.session(settings.mesh, timeout_s=args.wait) as mesh,
            joined(mesh, joining[0], id=joining[1]) as agent,
        ):
            nobody = not agent.directory.of_type(ROS)
            elsewhere = robots.here(await robots.elsewhere(mesh, timeout_s=args.wait)) if nobody else ""
            return await work(Site(agent, chosen, args.wait, elsewhere))

    return running.until_stopped(run, interrupted=0 if endless else running.INTERRUPTED)


def looking(args: argparse.Namespace, work: Callable[[Looking], Awaitable[int]]) -> int:
    """Look at the robots that are meant from a session that joins nothing, as `macs ls` does."""
    settings = options.settings(args)
    caller = robots.chosen_caller(args, settings.operator)

    async def run() -> int:
        from bridge.graph.site import Chosen, Looking

        chosen = Chosen(tuple(dict.fromkeys(args.robot)), tuple(dict.fromkeys(args.group)))
        async with robots.operator(settings.mesh, caller, timeout_s=args.wait) as operator:
            online = [agent for agent in await operator.online() if agent.type == ROS]

            def ask(robot: int, verb: str, data: bytes) -> Awaitable[bytes]:
                return operator.ask(robot, verb, data, timeout_s=args.wait)

            elsewhere = "" if online else robots.here(await operator.elsewhere())
            return await work(Looking(lambda: online, ask, chosen, args.wait, elsewhere))

    return running.until_stopped(run, interrupted=running.INTERRUPTED)


def list_found(args: argparse.Namespace, kind: str, find: Callable[[Any], list[Named]]) -> int:
    """List what robots have of a kind, as ``--json`` and ``--show-types`` say."""

    async def work(site: Looking) -> int:
        found = find(await site.must_offer(site.must_be_online()))
        if args.json:
            output.say(json.dumps([each.facts(kind) for each in found]))
        for each in () if args.json else found:
            output.say(plain(f"{each.name} [{each.type}]" if args.show_types else each.name))
        return 0

    return looking(args, work)


def who_joins(args: argparse.Namespace, settings: Settings) -> tuple[int, int | None]:
    """(type, id) under which a verb is online, as ``--as`` says: as a headset with a free id unless told otherwise.

    Raises UsageError for an observer, to whom no robot sends anything.
    """
    principal: Principal | None = args.principal
    if principal is None and settings.operator.id is not None:
        principal = Principal("operator", settings.operator.id)
    if principal is None:
        return UNITY, None
    if not principal.kind:
        raise UsageError("an observer is nobody: name somebody who may be registered, as --as unity/5")
    kind, number = principal.agent
    return kind, number or None


def emit(line: Any) -> None:
    """One object as a line of JSON."""
    output.say(output.as_json(line))


def number(text: str) -> int:
    """A number of messages."""
    if text.isascii() and text.isdigit() and 1 <= int(text) < 1 << 31:
        return int(text)
    raise argparse.ArgumentTypeError(f"{text!r} is no number of at least 1")


def positive(text: str) -> float:
    """A number above 0."""
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text!r} is no number above 0")
    return value


def robot_ids(text: str) -> list[int]:
    """Ids of robots, with commas between them."""
    return [_bounded(part, 0xFFFF) for part in text.split(",") if part]


def _group(text: str) -> int:
    return _bounded(text, 0xFF)


def _bounded(text: str, high: int) -> int:
    value = int(text) if text.isascii() and text.isdigit() else 0
    if not 1 <= value <= high:
        raise argparse.ArgumentTypeError(f"{text!r} is no number from 1 to {high}")
    return value
