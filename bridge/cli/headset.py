"""Act as a headset, without the hardware: what a Unity headset does over TCP, from the command line.

Results are JSON lines on stdout, logs go to stderr. Exit code 0: done (also when Ctrl-C ends a verb that has no
end of its own); 1: unreachable, timed out or fewer messages than asked for; 2: wrong usage; 130: Ctrl-C before
the end.

examples:
  macs headset 127.0.0.1:7000 online
  macs headset 127.0.0.1:7000 sub /chatter std_msgs/String
  macs headset 127.0.0.1:7000 pub /cmd_vel geometry_msgs/Twist '{"linear": {"x": 0.5}}' --rate 10
  macs headset 127.0.0.1:7000 call /set std_srvs/SetBool '{"data": true}' --agent 1
  macs headset 127.0.0.1:7000 --group 3 listen
  macs headset 127.0.0.1:7000 run script.txt

`macs headset HOST:PORT VERB --help` explains one verb.

what it prints:
  {"id": 2, "ros": [1], "unity": [2]}                                     of online
  {"topic": "/chatter", "from": 1, "message": {"data": "hello"}}          of sub; each verb's help has its own"""

from __future__ import annotations

import argparse
import os
from typing import Any

from bridge.cli import output

SUMMARY = "a scriptable headset over TCP, in place of the hardware"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    from bridge.headset import verbs  # light: no asyncio, no rosbags

    parser.add_argument(
        "target",
        metavar="HOST[:PORT]",
        type=verbs.parse_target,
        help="a gateway (default port: 7000), or ws://HOST:PORT",
    )
    parser.add_argument(
        "--token",
        metavar="TOKEN",
        default=os.environ.get("MACS_TOKEN") or None,
        help="what the gateway wants to see (macs token); better in $MACS_TOKEN, since others see a command line",
    )
    parser.add_argument("--tls", action="store_true", help="over TLS, to the gateway's TLS port")
    parser.add_argument("--ca", metavar="FILE", help="over TLS, and trust the certificates of this authority (PEM)")
    parser.add_argument("--group", type=verbs.group_id, default=0, metavar="G", help="be in this group, 1..255")
    parser.add_argument("--reconnect", action="store_true", help="when the connection ends make a new one")
    parser.add_argument(
        "--types",
        action="append",
        default=[],
        metavar="DIR",
        help="find .msg, .srv and .action files here too (a package's folder or a workspace); may be repeated",
    )
    subparsers = parser.add_subparsers(dest="headset_verb", metavar="VERB", required=True, title="verbs")
    verbs.add_verbs(subparsers)
    verbs.add_run(subparsers)


def run(args: argparse.Namespace) -> int:
    from bridge.cli.running import until_stopped
    from bridge.headset.script import perform

    return until_stopped(lambda: perform(args, _print))


def _print(line: dict[str, Any]) -> None:
    output.say(output.as_json(line))
