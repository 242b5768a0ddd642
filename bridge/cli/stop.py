"""Stop robots: every one that is online, or those named. --release lets them go on.

The emergency stop holds until it is released: a robot refuses commands and goals, and publishes the stop messages
in its settings (docs/robot.md). This command repeats its call until the robot says that it is stopped; a moment
later it asks once more whether that still holds. Robots and routers may allow it only to some: the settings
([operator]) or --as say who you are.

Exit code 0 when every robot has confirmed; 1 when one has not, or none is online; 130 after Ctrl-C. This does not
replace the button on the robot: a program has to start first, and there is a network in between.

examples:
  macs stop                                       every robot that is online
  macs stop 7 8 -e tcp/192.168.1.10:7447          these two, whether they can be seen or not
  macs stop --group 3 --as operator/5             every robot of group 3
  macs stop 7 --release
  macs stop --all --release

what it prints:
  robot 7 is stopped, by operator/0
  robot 8 is NOT stopped: no answer within 5 s"""

from __future__ import annotations

import argparse
import asyncio
import json
from contextlib import suppress
from dataclasses import asdict, dataclass, replace

from bridge.cli import options, output, robots, running
from bridge.cli.robots import Operator
from bridge.settings import Settings
from macs_zenoh.errors import CallTimeout, MacsError, NotServed, Refused, Unreachable, UsageError
from macs_zenoh.plain import plain
from macs_zenoh.protocol.messages import ROS
from macs_zenoh.protocol.robot_state import RobotStatus, release

SUMMARY = "stop robots, and release them"

FIRST_S = 0.5
"""How long the first attempt waits for its answer; each further one waits twice as long."""
RETRY_S = 0.05
LOOK_AGAIN_S = 0.3
"""After so long a stop is looked at once more: somebody may have released it."""


@dataclass(frozen=True)
class Outcome:
    """What became of it on one robot. ``stopped``: what the robot says, None when it has said nothing."""

    id: int
    done: bool
    stopped: bool | None = None
    by: str = ""
    problem: str = ""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("robots", nargs="*", type=_robot, metavar="ROBOT", help="id of a robot (default: all)")
    parser.add_argument("--group", action="append", type=_group, default=[], metavar="G", help="robots of this group")
    parser.add_argument("--all", action="store_true", help="every robot that is online; --release wants it said")
    parser.add_argument("--release", action="store_true", help="end the stop")
    parser.add_argument("--json", action="store_true", help="for programs: a list of {id, done, stopped, by, problem}")
    parser.add_argument(
        "--timeout",
        type=float,
        default=5.0,
        metavar="S",
        help="for a router, more with several; then for the robots (default: 5)",
    )
    options.add_as_option(parser)
    options.add_mesh_options(parser)


def run(args: argparse.Namespace) -> int:
    settings = options.settings(args)
    named = bool(args.robots or args.group)
    if named and args.all:
        raise UsageError("robots and groups, or --all, not both")
    if args.release and not named and not args.all:
        raise UsageError("say which robots shall go on, or --all")

    return running.until_stopped(lambda: _stop(settings, args), interrupted=running.INTERRUPTED)


async def _stop(settings: Settings, args: argparse.Namespace) -> int:
    outcomes, elsewhere = [], ""
    caller = robots.chosen_caller(args, settings.operator)
    async with robots.operator(settings.mesh, caller, timeout_s=args.timeout) as operator:
        ids = await _chosen(operator, args)
        asked = [asyncio.create_task(_settle(operator, robot, args)) for robot in sorted(ids)]
        try:
            for coming in asyncio.as_completed(asked):
                outcome = await coming
                outcomes.append(outcome)
                if not args.json:
                    output.say_if_possible(_line(outcome, release=args.release))
        finally:
            for task in asked:
                task.cancel()
            await asyncio.gather(*asked, return_exceptions=True)
        if not ids:
            elsewhere = robots.here(await operator.elsewhere())
    if args.json:
        ordered = sorted(outcomes, key=lambda outcome: outcome.id)
        output.say_if_possible(json.dumps([asdict(outcome) for outcome in ordered]))
    elif not outcomes:
        output.say_if_possible(f"no such robot is online{elsewhere}")
    return 0 if outcomes and all(outcome.done for outcome in outcomes) else 1


async def _chosen(operator: Operator, args: argparse.Namespace) -> set[int]:
    """Robots named by id are asked in any case: they may be there although nobody can see them."""
    if args.robots and not args.group:
        return set(args.robots)
    groups = set(args.group)
    online = [agent for agent in await operator.online() if agent.type == ROS]
    return {*args.robots, *(agent.id for agent in online if not groups or agent.group in groups)}


async def _settle(operator: Operator, robot: int, args: argparse.Namespace) -> Outcome:
    """Ask one robot until it says that it is as it was told to be."""
    loop = asyncio.get_running_loop()
    deadline = loop.time() + args.timeout
    wanted, patience_s, outcome, unserved = not args.release, FIRST_S, Outcome(robot, False), False
    said = b"true" if wanted else b""
    while (left_s := deadline - loop.time()) > 0:
        verb = "stop" if said else "status"
        try:
            answer = await operator.ask(robot, verb, said, timeout_s=min(patience_s, left_s), urgent=True)
            _, status = robots.read(answer, RobotStatus)
            if verb == "status":  # a release is for what was seen when it was asked for, however often it is said
                said = release(status.stop.presses)
                continue
        except Refused as refusal:
            return Outcome(robot, False, problem=refusal.reason)
        except CallTimeout:
            if not unserved and outcome.stopped is None:  # the last attempt may be cut short
                outcome = Outcome(robot, False, problem=f"no answer within {args.timeout:g} s")
            patience_s *= 2
            continue
        except Unreachable as error:
            unserved = isinstance(error, NotServed)
            outcome = Outcome(robot, False, problem=error.why)
        else:
            if status.stopped is wanted:
                outcome = Outcome(robot, True, status.stopped, status.stop.by)
                return await _look_again(operator, outcome, status.stop.times, args.timeout) if wanted else outcome
            unserved = False
            outcome = Outcome(robot, False, status.stopped, status.stop.by, "it has not done what it was told")
        await asyncio.sleep(RETRY_S)
    return replace(outcome, problem=await _why_unserved(operator, robot) or outcome.problem) if unserved else outcome


async def _look_again(operator: Operator, stopped: Outcome, times: int, timeout_s: float) -> Outcome:
    """Whether a stop that was confirmed still holds a moment later, and has held all the time."""
    await asyncio.sleep(LOOK_AGAIN_S)
    try:
        answer = await operator.ask(stopped.id, "status", timeout_s=timeout_s, urgent=True)
        _, status = robots.read(answer, RobotStatus)
    except MacsError as error:
        return replace(stopped, done=False, problem=f"it stopped, and does not say whether it still does: {error}")
    if not status.stopped:
        return replace(stopped, done=False, stopped=False, problem=f"it stopped, and {status.stop.by} released it")
    if status.stop.times != times:
        return replace(stopped, done=False, problem="it stopped, somebody released it, and it was stopped again")
    return stopped


async def _why_unserved(operator: Operator, robot: int) -> str:
    """More about a robot that nobody answers for; empty for one that is not online."""
    with suppress(MacsError):
        for agent in await operator.online():
            if agent.key == (ROS, robot):
                gateways = await operator.gateways()
                why = ""
                if agent.zid not in gateways:
                    why = await operator.why_not_allowed(robot, "stop", timeout_s=FIRST_S)
                why = why or await operator.why_silent(agent, gateways, timeout_s=FIRST_S)
                return why or "it is online, and has no emergency stop"
    return ""


def _line(outcome: Outcome, *, release: bool) -> str:
    what = "released" if release else "stopped"
    if not outcome.done:
        return plain(f"robot {outcome.id} is NOT {what}: {outcome.problem}")
    return plain(f"robot {outcome.id} is {what}" + ("" if release else f", by {outcome.by}"))


def _robot(text: str) -> int:
    return _bounded(text, 0xFFFF)


def _group(text: str) -> int:
    return _bounded(text, 0xFF)


def _bounded(text: str, high: int) -> int:
    number = int(text) if text.isascii() and text.isdigit() else 0
    if not 1 <= number <= high:
        raise argparse.ArgumentTypeError(f"{text!r} is no number from 1 to {high}")
    return number
