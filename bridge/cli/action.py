"""Actions of robots from the command line, over the mesh and without a gateway: as `ros2 action`.

The type is what the robot offers, the goal is written as YAML or JSON. A goal may move a robot: one has to be named
where several are online. Ctrl-C cancels it. --as says who you are, where a robot's settings or access rules want to
know.

Exit code 0: the goal succeeded; 1: it did not, or was refused, not found, unreachable; 2: wrong usage; 130: Ctrl-C.

examples:
  macs action list -t
  macs action send /turn demo_msgs/action/Turn 'angle: 90' --robot 7 --feedback

what it prints:
  Goal accepted with ID: 0b9e...
  Result:
      angle: 90.0
  Goal finished with status: SUCCEEDED"""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from bridge.cli import named, output
from bridge.cli.topic import EVERY_ROBOT, ONE_ROBOT, _is_type

if TYPE_CHECKING:
    from bridge.graph.site import Site

SUMMARY = "actions of robots: list, send"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    verbs = parser.add_subparsers(dest="action_verb", metavar="VERB", required=True, title="verbs")
    listing = named.add_verb(
        verbs,
        "list",
        "every action that robots have",
        "example:\n  macs action list -t --robot 7\n\nwhat it prints:\n  /turn [demo_msgs/action/Turn]   with -t",
        _list,
    )
    listing.add_argument("-t", "--show-types", action="store_true", help="with their types")
    named.add_site_options(listing, robots_are=EVERY_ROBOT)
    send = named.add_verb(
        verbs,
        "send",
        "give a goal to an action and wait for its result: it may move a robot",
        "Fields that are left out get their defaults.\n\n"
        "example:\n  macs action send /turn demo_msgs/action/Turn 'angle: 90' --robot 7 --feedback\n\n"
        "what it prints:\n  Goal accepted with ID: 0b9e...\n  Result:\n      angle: 90.0\n"
        "  Goal finished with status: SUCCEEDED\n"
        'with --json:\n  {"action": "/turn", "robot": 7, "status": "succeeded", "result": {...}}',
        _send,
    )
    send.add_argument("action", metavar="ACTION", help="its name, as /turn")
    send.add_argument("type", metavar="TYPE", nargs="?", help="as pkg/action/Name (default: as robots offer it)")
    send.add_argument("values", metavar="VALUES", nargs="?", help="the goal (default: an empty one)")
    send.add_argument("-f", "--feedback", action="store_true", help="show what it tells meanwhile")
    send.add_argument("--timeout", type=named.positive, metavar="S", help="cancel it after S seconds")
    named.add_site_options(send, robots_are=ONE_ROBOT)


def run(args: argparse.Namespace) -> int:
    code: int = args.run_below(args)
    return code


def _list(args: argparse.Namespace) -> int:
    from bridge.graph import lists

    return named.list_found(args, "action", lists.actions)


def _send(args: argparse.Namespace) -> int:
    from bridge.graph import acts, words

    of_type, text = args.type, args.values or ""
    if args.values is None and of_type is not None and not _is_type(of_type):
        of_type, text = None, of_type
    wish = acts.GoalWish(words.value_of(text), args.feedback, args.timeout)

    async def work(site: Site) -> int:
        return await acts.send_goal(site, args.action, of_type, wish, output.say, named.emit, as_json=args.json)

    return named.on_site(args, work)
