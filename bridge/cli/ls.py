"""List the agents that are online, robots and headsets, whichever gateway they are behind; then gateways and routers.

SESSION is the Zenoh session: headsets that have the same one are behind the same gateway. STATE is what a robot
answers when it is asked: whether it is stopped, and who has control of which topic. A ? means that it should
answer but does not: it hangs, or access rules do not let you ask it ([operator] in the settings, or --as, say who
you are). A headset is away when its gateway has heard nothing of it for 10 s: it was taken off, or is out of
reach. If it stays away, the gateway closes its connection later (idle_timeout_s). The address of a gateway is
where headsets connect.
-v adds, for each robot: the emergency stop, who has registered what, control and dead-man of each topic, what was
lost, and what it offers. Exit code 1 when no router answers, 130 after Ctrl-C.

examples:
  macs ls
  macs ls -v -e tcp/192.168.1.10:7447
  macs ls --json | jq '.[] | select(.type == "ros").id'
  macs ls --json | jq '.[] | select(.status.stopped) | {id, by: .status.stop.by}'
  macs ls -v --json | jq '.[] | select(.type == "ros") | {id, topics: .offers.publishers}'
  macs ls -v --json | jq '.[] | select(.type == "gateway").address'

what it prints:
  TYPE    ID  GROUP  SESSION   NAME    STATE
  ros      7      3  3c41ba1c  drone0  stopped by operator/5, /cmd_vel: unity/256
  unity  256      -  9f2d07e1  -       -

  gateway  9f2d07e1  10.0.0.5:7000      1 agents  macs 0.1.0, Zenoh 1.10.2
  router   d8c1f2aa  tcp/10.0.0.1:7447            Zenoh 1.10.2"""

from __future__ import annotations

import argparse
import asyncio
import json
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from msgspec import UNSET

from bridge.cli import options, output, robots, running, terminal
from bridge.cli.robots import Operator
from bridge.cli.terminal import BAD, HEADING, ODD, Block, Cell, Columns
from macs_zenoh.errors import MacsError, NotServed, Refused, Unreachable
from macs_zenoh.protocol.directory import AgentInfo
from macs_zenoh.protocol.messages import ROS
from macs_zenoh.protocol.named import Named
from macs_zenoh.protocol.ping import Pong
from macs_zenoh.protocol.robot_state import NodeStatus, Offered, RobotStatus, TopicQos
from macs_zenoh.protocol.routers import Router

SUMMARY = "who is online, and what robots are doing"
VERBOSE = "all about each robot"

SHORT = 8
"""Of a session's id so much tells it from others; --json has all of it."""

FACT_WIDTH = len("emergency stop")
ANSWER_S = 1.0
"""How long robots may take to tell their state; without -v nobody wants to wait for one that is stuck."""


@dataclass(frozen=True)
class RobotReport:
    """What a robot said of itself: as it was, for programs, and as it is read here.

    ``problem`` is why it said nothing, empty for one that has nothing to say, as robots behind a gateway.
    """

    problem: str = ""
    status: RobotStatus | None = None
    offers: Offered | None = None
    raw_status: dict[str, Any] | None = None
    raw_offers: dict[str, Any] | None = None


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--json",
        action="store_true",
        help="for programs: a list of {type, id, group, zid, name}, away ones also {away}; robots {status, problem}, "
        "with -v {offers}",
    )
    parser.add_argument(
        "--timeout",
        type=float,
        default=3.0,
        metavar="S",
        help="how long to wait for a router, the last of several (default: 3)",
    )
    options.add_as_option(parser)
    options.add_mesh_options(parser)


def run(args: argparse.Namespace) -> int:
    settings = options.settings(args)
    caller = robots.chosen_caller(args, settings.operator)
    answer_s = args.timeout if args.verbose else min(ANSWER_S, args.timeout)

    async def show() -> int:
        async with robots.operator(settings.mesh, caller, timeout_s=args.timeout) as operator:
            agents, names = await operator.online(), await operator.names()
            gateways = await operator.gateways()
            looking = asyncio.gather(
                operator.pongs(gateways, timeout_s=answer_s), operator.routers(timeout_s=answer_s)
            )
            online = [agent for agent in agents if agent.type == ROS]
            asked = (_ask(operator, robot, gateways, answer_s, offers=args.verbose) for robot in online)
            told = dict(zip((robot.id for robot in online), await asyncio.gather(*asked), strict=True))
            pongs, routers = await looking
            elsewhere = Counter() if agents or names or args.json else await operator.elsewhere()
        away = {agent for pong in pongs.values() if pong is not None for agent in pong.away}
        if args.json:
            output.say(_json(agents, names, told, away, _infrastructure(agents, pongs, routers), args.verbose))
        else:
            blocks = _text(agents, names, told, away, args.verbose) or [_nobody(elsewhere)]
            terminal.show(*blocks, *_shown_infrastructure(_infrastructure(agents, pongs, routers)))
        return 0

    return running.until_stopped(show, interrupted=running.INTERRUPTED)


async def _ask(
    operator: Operator, robot: AgentInfo, gateways: Collection[str], timeout_s: float, *, offers: bool
) -> RobotReport:
    told = RobotReport()
    try:
        raw, status = robots.read(await operator.ask(robot.id, "status", timeout_s=timeout_s), RobotStatus)
        told = RobotReport(status=status, raw_status=raw)
        if offers:
            raw, offered = robots.read(await operator.ask(robot.id, "offers", timeout_s=timeout_s), Offered)
            told = replace(told, offers=offered, raw_offers=raw)
    except NotServed:
        told = replace(told, problem=await operator.why_silent(robot, gateways, timeout_s=timeout_s))
    except Refused as refusal:  # of an existing program, its gateway refuses
        told = replace(told, problem="" if robot.zid in gateways else refusal.reason)
    except MacsError as error:
        told = replace(told, problem=error.why if isinstance(error, Unreachable) else str(error))
    return told


# -- for programs ----------------------------------------------------------------------------------------------------


Away = Collection[tuple[int, int]]
"""(type, id) of agents behind gateways of which nothing was heard for a while."""


def _rows(agents: list[AgentInfo], names: list[Named], away: Away) -> list[dict[str, Any]]:
    """One row per agent with its name if it has one; a name whose agent is not online has a row of its own."""
    online = {agent.key for agent in agents}
    name_of = {(named.type, named.id): named.name for named in names}
    rows = [
        {"type": a.type_name, "id": a.id, "group": a.group, "zid": a.zid, "name": name_of.get(a.key, "")}
        | ({"away": True} if a.key in away else {})
        for a in agents
    ]
    return rows + [
        {"type": named.type_name, "id": named.id, "group": 0, "zid": named.zid, "name": named.name}
        for named in names
        if (named.type, named.id) not in online
    ]


def _infrastructure(
    agents: list[AgentInfo], pongs: dict[str, Pong | None], routers: list[Router]
) -> list[dict[str, Any]]:
    """A row for each gateway and each router."""
    behind = Counter(agent.zid for agent in agents)
    rows: list[dict[str, Any]] = []
    for zid, pong in sorted(pongs.items()):
        said = {"address": "", "macs": "", "zenoh": ""}
        if pong is not None:
            said = {"address": pong.address, "macs": pong.macs, "zenoh": pong.zenoh}
        rows.append({"type": "gateway", "zid": zid, "agents": behind[zid], **said, "answers": pong is not None})
    for router in routers:
        rows.append({"type": "router", "zid": router.zid, "addresses": router.locators, "zenoh": router.release})
    return rows


def _json(
    agents: list[AgentInfo],
    names: list[Named],
    told: dict[int, RobotReport],
    away: Away,
    infrastructure: list[dict[str, Any]],
    verbose: bool,
) -> str:
    rows = _rows(agents, names, away)
    for row in rows:
        if row["type"] == "ros" and (robot := told.get(row["id"])) is not None:
            row["status"], row["problem"] = robot.raw_status, robot.problem
            if verbose:
                row["offers"] = robot.raw_offers
    return json.dumps(rows + infrastructure if verbose else rows)


# -- for people ------------------------------------------------------------------------------------------------------


def _text(
    agents: list[AgentInfo], names: list[Named], told: dict[int, RobotReport], away: Away, verbose: bool
) -> list[Block]:
    rows = _rows(agents, names, away)
    if not rows:
        return []
    states: list[Cell] = [_state(told.get(row["id"])) if row["type"] == "ros" else "" for row in rows]
    states = [("away", ODD) if row.get("away") else state for row, state in zip(rows, states, strict=True)]
    headings = ["TYPE", "ID", "GROUP", "SESSION", "NAME"]
    lines: list[list[Cell]] = [
        [row["type"], str(row["id"] or "-"), str(row["group"] or "-"), row["zid"][:SHORT], row["name"] or "-"]
        for row in rows
    ]
    if any(states):
        headings.append("STATE")
        lines = [[*line, state or "-"] for line, state in zip(lines, states, strict=True)]
    shown: list[Block] = [Columns(lines, headings=headings, right={1, 2})]
    if verbose:
        for robot, what in told.items():
            shown += ["", (f"robot {robot}", HEADING), *_details(what)]
    return shown


def _nobody(elsewhere: Mapping[str, int]) -> str:
    return f"nobody is online{robots.here(elsewhere)}"


def _shown_infrastructure(rows: list[dict[str, Any]]) -> list[Block]:
    """Gateways and routers in columns, below the agents."""
    lines: list[list[Cell]] = []
    for row in rows:
        what: Cell = ""
        if row["type"] == "gateway":
            where = row["address"] or "?"
            what = f"{row['agents']} agents" if row["answers"] else (f"{row['agents']} agents, does not answer", ODD)
            version = f"macs {row['macs']}, Zenoh {row['zenoh']}" if row["macs"] else ""
        else:
            where = ", ".join(row["addresses"]) or "?"
            version = f"Zenoh {row['zenoh']}" if row["zenoh"] else ""
        lines.append([row["type"], row["zid"][:SHORT], where, what, version])
    return ["", Columns(lines)] if lines else []


def _state(robot: RobotReport | None) -> Cell:
    """What somebody has to know before commanding it; empty when there is nothing."""
    if robot is None or robot.status is None:
        return ("?", ODD) if robot is not None and robot.problem else ""
    stopped = [f"stopped by {robot.status.stop.by}"] if robot.status.stopped else []
    controls = [(node.name, node.control.holder) for node in robot.status.nodes if node.control is not UNSET]
    state = ", ".join(stopped + [f"{topic}: {holder}" for topic, holder in controls if holder])
    return (state, BAD) if stopped else state


def _details(robot: RobotReport) -> list[Block]:
    status = robot.status
    if status is None:
        silent = "is no `macs agent`: it tells nothing of itself"
        return [f"  tells nothing: {robot.problem}" if robot.problem else f"  {silent}"]
    domain = "?" if status.ros_domain is None else str(status.ros_domain)
    lines: list[Block] = [
        _facts(
            ("ROS node", status.ros_node),
            ("ROS domain", domain),
            ("emergency stop", _stop(status)),
            *([("agent", status.beside)] if isinstance(status.beside, str) else []),
        )
    ]
    # the stop has a node of its own, which concerns people only when somebody has registered it
    nodes = [node for node in status.nodes if node.role != "emergency stop" or node.registrants]
    lines += _block("registered", [(node.role, node.name, node.type, _registrants(node)) for node in nodes])
    lines += _block("safety", [row for node in nodes for row in _safety(node)])
    lines += _block("lost", [(name, str(count)) for name, count in sorted(status.drops.items())])
    if robot.offers is None:
        return [*lines, _facts(("offers", f"? {robot.problem}"))]
    return lines + (_block("offers", list(_offered(robot.offers))) or [_facts(("offers", _nothing(status)))])


def _facts(*facts: tuple[str, str]) -> Columns:
    """What is known of a robot, each under its name, all in one column."""
    return Columns([(f"{name:<{FACT_WIDTH}}", fact) for name, fact in facts], indent=2)


def _nothing(status: RobotStatus) -> str:
    """Why a robot may offer nothing, which most often is a mistake."""
    graph = "its ROS graph" if status.ros_domain is None else f"the ROS graph of domain {status.ros_domain}"
    return f"nothing: {graph} is empty, or hidden by its rules; is that the ROS_DOMAIN_ID of its nodes?"


def _stop(status: RobotStatus) -> str:
    if not any(node.role == "emergency stop" for node in status.nodes):
        return "none"
    before = f", {status.stop.times} in all" if status.stop.times else ""
    if not status.stopped:
        return f"off{before}"
    return f"by {status.stop.by}, {status.stop.seconds:.0f} s ago{before}"


def _registrants(node: NodeStatus) -> str:
    busy = [f"{node.open_calls} open calls"] if node.open_calls else []
    running = sum(not goal.finished for goal in node.goals or ())
    busy += [f"{running} goals running"] if running else []
    return ", ".join([*node.registrants, *busy]) or "-"


def _safety(node: NodeStatus) -> Iterator[tuple[str, ...]]:
    if node.control is not UNSET:
        held = node.control
        free = "free" if held.holder is None else f"for {held.seconds_held:.0f} s, free in {held.seconds_left:.1f} s"
        yield ("control", node.name, held.holder or "-", free)
    if node.deadman is not UNSET:
        guard = node.deadman
        trips = f"trips: {guard.trips}, last: {guard.last}" if guard.trips else "trips: none"
        yield ("dead-man", node.name, guard.commander or "-", trips)


def _offered(offers: Offered) -> Iterator[tuple[str, ...]]:
    for what, named in (("publishes", offers.publishers), ("subscribes", offers.subscribers)):
        for topic, of_type in named.items():
            qos = offers.qos.get(topic, TopicQos())
            policies = ", ".join(filter(None, (qos.reliability, qos.durability)))
            yield (what, topic, of_type, policies.replace("_", " "))
    for what, named in (("service", offers.services), ("action", offers.actions)):
        for name, of_type in named.items():
            yield (what, name, of_type)


def _block(heading: str, rows: Sequence[Sequence[str]]) -> list[Block]:
    """A heading with rows in columns below it; nothing for no rows."""
    return [f"  {heading}", Columns(rows, indent=4)] if rows else []
