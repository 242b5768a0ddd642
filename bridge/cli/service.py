"""Services of robots from the command line, over the mesh and without a gateway: as `ros2 service`.

The type is what the robot offers, the request is written as YAML or JSON. A service may move a robot: one has to be
named where several are online. --as says who you are, where a robot's settings or access rules want to know.

Exit code 0: done; 1: not found, unreachable, refused, or not answered in time; 2: wrong usage; 130: Ctrl-C.

examples:
  macs service list -t
  macs service call /set_lights std_srvs/srv/SetBool 'data: true' --robot 7
  macs service call /reset --group 3 --json

what it prints:
  response:
  success: true
  message: lights on

  {"service": "/set_lights", "robot": 7, "response": {...}, "ms": 3.1}     with --json"""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from bridge.cli import named, output
from bridge.cli.topic import EVERY_ROBOT, ONE_ROBOT, _is_type

if TYPE_CHECKING:
    from bridge.graph.site import Site

SUMMARY = "services of robots: list, call"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    verbs = parser.add_subparsers(dest="service_verb", metavar="VERB", required=True, title="verbs")
    listing = named.add_verb(
        verbs,
        "list",
        "every service that robots have",
        "example:\n  macs service list -t --robot 7\n\nwhat it prints:\n"
        "  /set_lights [std_srvs/srv/SetBool]   with -t",
        _list,
    )
    listing.add_argument("-t", "--show-types", action="store_true", help="with their types")
    named.add_site_options(listing, robots_are=EVERY_ROBOT)
    call = named.add_verb(
        verbs,
        "call",
        "call a service: it may move a robot",
        "Fields that are left out get their defaults.\n\n"
        "example:\n  macs service call /set_lights std_srvs/srv/SetBool 'data: true' --robot 7\n\n"
        "what it prints:\n  response:\n  success: true\n  message: lights on",
        _call,
    )
    call.add_argument("service", metavar="SERVICE", help="its name, as /set_lights")
    call.add_argument("type", metavar="TYPE", nargs="?", help="as pkg/srv/Name (default: as robots offer it)")
    call.add_argument("values", metavar="VALUES", nargs="?", help="the request (default: an empty one)")
    named.add_site_options(call, robots_are=ONE_ROBOT)


def run(args: argparse.Namespace) -> int:
    code: int = args.run_below(args)
    return code


def _list(args: argparse.Namespace) -> int:
    from bridge.graph import lists

    return named.list_found(args, "service", lists.services)


def _call(args: argparse.Namespace) -> int:
    from bridge.graph import acts, words

    of_type, text = args.type, args.values or ""
    if args.values is None and of_type is not None and not _is_type(of_type):
        of_type, text = None, of_type
    value = words.value_of(text)

    async def work(site: Site) -> int:
        return await acts.call_service(site, args.service, of_type, value, output.say, named.emit, as_json=args.json)

    return named.on_site(args, work)
