"""The verbs of ``macs headset`` as argparse sees them: the same for the command line and for a script's lines."""

from __future__ import annotations

import argparse
import json
import math
from typing import Any, NamedTuple, NoReturn

from bridge.cli.options import add_verb
from macs_zenoh.errors import UsageError
from macs_zenoh.protocol import addresses
from macs_zenoh.protocol.websocket import WEBSOCKET_PATH

SETTLE_S = 0.5
"""How long `pub` waits between registering and its first message, unless told otherwise."""
MAX_BYTES = 256
"""Byte arrays above this are shown as their size, unless ``--full``."""

_AGENT_TYPES = {"all": 0, "ros": 1, "unity": 2}


class ScriptParser(argparse.ArgumentParser):
    """A parser for one line of a script: a wrong line is a UsageError, not the end of the process."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **{"allow_abbrev": False, **kwargs})

    def error(self, message: str) -> NoReturn:
        raise UsageError(f"{self.prog}: {message}")

    def print_help(self, file: Any = None) -> None:
        """Say nothing: `exit` tells it, and stdout is for results."""

    def exit(self, status: int = 0, message: str | None = None) -> NoReturn:
        raise UsageError(message or self.format_help())


def script_parser() -> ScriptParser:
    """A parser for the lines of a script."""
    parser = ScriptParser(prog="", add_help=False)
    verbs = parser.add_subparsers(dest="headset_verb", metavar="VERB", required=True)
    add_verbs(verbs)
    _add_script_verbs(verbs)
    return parser


def add_verbs(verbs: Any) -> None:
    """Add the verbs that the command line and a script share to an argparse subparsers object."""
    _add_online(verbs)
    _add_sub(verbs)
    _add_pub(verbs)
    _add_call(verbs)
    _add_serve(verbs)
    _add_goal(verbs)
    _add_ask(verbs)
    _add_send(verbs)
    _add_listen(verbs)


def add_run(verbs: Any) -> None:
    """Add ``run``, which only the command line has."""
    run = add_verb(verbs, "run", "several verbs on one connection, from a file or from stdin", RUN_HELP)
    run.add_argument("file", metavar="FILE", help="a line per command; - reads stdin, line by line as it comes")
    run.add_argument("--keep-going", action="store_true", help="go on after a line that failed")


class WebTarget(NamedTuple):
    """A gateway's web port."""

    host: str
    port: int
    tls: bool


WEB_PORT = 7080


def parse_target(text: str) -> tuple[str, int] | WebTarget:
    """``HOST:PORT``, ``[IPV6]:PORT`` or ``HOST`` (then port 7000); or ``ws://…``, ``wss://…`` (port 7080).
    Raises argparse.ArgumentTypeError."""
    try:
        scheme, web, rest = text.partition("://")
        if not web:
            return addresses.parse(text, 7000)
        if scheme not in ("ws", "wss", "http", "https"):
            raise ValueError(f"{scheme}:// is no way to a gateway; say ws:// or wss://")
        host, path, after = rest.partition("/")
        if path and "/" + after not in ("/", WEBSOCKET_PATH):
            raise ValueError(f"a gateway's WebSocket is at {WEBSOCKET_PATH}")
        return WebTarget(*addresses.parse(host, WEB_PORT), scheme in ("wss", "https"))
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


RUN_HELP = """\
Each line is a verb with its arguments, quoted as in a shell; # begins a comment. All lines use one connection.
`sub`, `serve` and `listen` go on in the background; `&` at the end of a line puts any other verb there too.
At the end of the script, verbs with an end of their own (--count, --timeout) are waited for, then the headset
goes offline. Besides the verbs of the command line there are:

  wait [WHAT] [--count N]   until WHAT (a topic, a service, or `listen`) has had N messages in all;
       [--timeout S]        without WHAT: until every background verb that has an end has ended
  unsub TOPIC               deregister a topic or a service everywhere
  group G                   move to another group
  sleep S                   do nothing for S seconds
  pause / resume            stop and start reading, as a headset that renders no frames
  drop                      cut the connection without a word; with --reconnect a new one is made

examples:
  printf '%s\\n' 'sub /chatter std_msgs/String --agents 1' \\
                'pub /chatter std_msgs/String "{\\"data\\": \\"hi\\"}" --agents 1' \\
                'wait /chatter --count 1 --timeout 5' | macs headset 127.0.0.1:7000 run -"""


def _add_online(verbs: Any) -> None:
    add_verb(
        verbs,
        "online",
        "who is online, and which id this headset got",
        'Prints {"id": 2, "ros": [1], "unity": [2]}.\n\nexample:\n  macs headset 127.0.0.1:7000 online',
    )


def _add_sub(verbs: Any) -> None:
    sub = add_verb(
        verbs,
        "sub",
        "print a robot's topic, a line per message",
        'Prints {"topic": "/chatter", "from": 1, "message": {"data": "hello"}} for each message.\n\n'
        "examples:\n"
        "  macs headset 127.0.0.1:7000 sub /chatter\n"
        "  macs headset 127.0.0.1:7000 sub /camera sensor_msgs/CompressedImage --agents 1,2 --raw --count 10",
    )
    _add_topic(sub, "TOPIC", "topic", type_is_optional=True)
    _add_robots(sub)
    _add_end(sub)
    sub.add_argument("--raw", action="store_true", help="sizes only; needs no definition of the type")
    sub.add_argument("--full", action="store_true", help=f"arrays whole, also above {MAX_BYTES} bytes")
    sub.add_argument(
        "--buffer", type=_positive, default=10, metavar="N", help="messages kept for a slow taker (default: 10)"
    )
    sub.add_argument("--drop-new", action="store_true", help="when full, drop the newest instead of the oldest")


def _add_pub(verbs: Any) -> None:
    pub = add_verb(
        verbs,
        "pub",
        "publish to a robot's topic",
        "Fields that are left out get their defaults; $i in JSON becomes the number of the message, from 0.\n"
        "Without --count: one message, or with --rate until stopped.\n"
        'Prints {"topic": "/talk", "published": 3}. When a robot does not take it, or has no such topic but one\n'
        "that is spelled alike, exit code 1 and\n"
        '{"topic": "/talk", "sent": 3, "refused": [{"robot": 1, "reason": "the emergency stop holds"}]}.\n\n'
        "examples:\n"
        '  macs headset 127.0.0.1:7000 pub /cmd_vel geometry_msgs/Twist \'{"linear": {"x": 0.5}}\' --rate 10\n'
        '  macs headset 127.0.0.1:7000 pub /talk std_msgs/String \'{"data": "$i"}\' --agents 1 --count 3\n'
        '  macs headset 127.0.0.1:7000 pub /cmd_vel geometry_msgs/Twist \'{"linear": {"x": 0.5}}\' --rate 10 --timed',
    )
    pub.add_argument("topic", metavar="TOPIC", help="name of the topic, as /topic")
    # one that may be left out before one that may not is taken for left out when an option comes first
    message = "the type as pkg/Name (default: as robots offer it), and the message"
    pub.add_argument("type", metavar="[TYPE] JSON", help=message)
    pub.add_argument("json", nargs="?", help=argparse.SUPPRESS)
    _add_robots(pub)
    pub.add_argument("--rate", type=_positive_number, metavar="HZ", help="messages per second")
    pub.add_argument("--count", type=_positive, metavar="N", help="stop after N messages")
    pub.add_argument(
        "--timed",
        action="store_true",
        help="tell when each message was made: robots that know this refuse what comes late, again or out of order",
    )
    pub.add_argument("--latched", action="store_true", help="the robot keeps the last message for late subscribers")
    pub.add_argument(
        "--settle",
        type=_number,
        default=SETTLE_S,
        metavar="S",
        help="wait between registering and the first message, until ROS nodes have found"
        f" the new publisher (default: {SETTLE_S})",
    )


def _add_call(verbs: Any) -> None:
    call = add_verb(
        verbs,
        "call",
        "call a service that runs on a robot",
        'Prints {"service": "/set", "from": 1, "response": {"success": true, "message": ""}, "ms": 3.1}.\n\n'
        "example:\n"
        "  macs headset 127.0.0.1:7000 call /set std_srvs/SetBool '{\"data\": true}' --agent 1",
    )
    _add_topic(call, "SERVICE", "service", type_is_optional=True)
    call.add_argument("json", metavar="JSON", nargs="?", default="{}", help="the request (default: {})")
    call.add_argument("--agent", type=_agent_id, metavar="ID", help="which robot (default: the only one online)")
    call.add_argument(
        "--timeout", type=_positive_number, default=5.0, metavar="S", help="wait for the answer (default: 5)"
    )


def _add_serve(verbs: Any) -> None:
    serve = add_verb(
        verbs,
        "serve",
        "run a service for ROS nodes on a robot",
        'Answers every request the same, and prints {"service": "/ask", "from": 1, "request": {"data": true}}.\n\n'
        "example:\n"
        "  macs headset 127.0.0.1:7000 serve /ask std_srvs/SetBool '{\"success\": true}' --agents 1",
    )
    _add_topic(serve, "SERVICE", "service")
    serve.add_argument("json", metavar="JSON_RESPONSE", nargs="?", default="{}", help="the response (default: {})")
    _add_robots(serve)
    _add_end(serve)


def _add_goal(verbs: Any) -> None:
    goal = add_verb(
        verbs,
        "goal",
        "give a goal to an action that runs on a robot",
        'Prints {"action": "/turn", "from": 1, "feedback": {...}} for each step, and in the end\n'
        '{"action": "/turn", "from": 1, "status": "succeeded", "result": {...}, "ms": 2031.5}; exit code 1 for\n'
        "another status. Ctrl-C cancels the goal. Where ROS is not installed --types names the folder of the type.\n\n"
        "example:\n"
        "  macs headset 127.0.0.1:7000 --types demo_msgs goal /turn demo_msgs/Turn '{\"angle\": 90}' --agent 1",
    )
    _add_topic(goal, "ACTION", "action")
    goal.add_argument("json", metavar="JSON", nargs="?", default="{}", help="the goal (default: {})")
    goal.add_argument("--agent", type=_agent_id, metavar="ID", help="which robot (default: the only one online)")
    goal.add_argument("--timeout", type=_positive_number, metavar="S", help="cancel it after S seconds")


def _add_ask(verbs: Any) -> None:
    ask = add_verb(
        verbs,
        "ask",
        "ask a robot or the gateway something by the name of its manager",
        "Robots answer RobotStatus, RobotControl and FunctionalityGetter (docs/robot.md) and their own managers,\n"
        'a gateway its own (docs/managers.md). Prints {"manager": "RobotStatus", "from": 7, "answer": {...}};\n'
        "exit code 1 when there is no answer, or one that says that it was refused or not done.\n\n"
        "examples:\n"
        "  macs headset 127.0.0.1:7000 ask RobotStatus --agent 7\n"
        '  macs headset 127.0.0.1:7000 ask RobotControl \'{"action": "take", "topic": "/cmd_vel"}\' --agent 7\n'
        "  macs headset 127.0.0.1:7000 ask ClockComparer '{\"sentAtS\": 1760000000.25}'",
    )
    ask.add_argument("manager", metavar="MANAGER", help="as RobotStatus")
    ask.add_argument("json", metavar="JSON", nargs="?", default="{}", help="its data (default: {})")
    ask.add_argument("--agent", type=_agent_id, metavar="ID", help="this robot (default: the gateway)")
    ask.add_argument(
        "--timeout", type=_positive_number, default=5.0, metavar="S", help="wait for the answer (default: 5)"
    )


def _add_send(verbs: Any) -> None:
    send = add_verb(
        verbs,
        "send",
        "send text to agents by id, by group or to all",
        'Prints {"to": "ros", "ids": [1, 2], "groups": [], "bytes": 5}, with "absent" where ids are not online.\n\n'
        "examples:\n"
        "  macs headset 127.0.0.1:7000 send 'look here' --to unity --groups 3\n"
        "  macs headset 127.0.0.1:7000 send hello --to ros --ids 1,2\n"
        "  macs headset 127.0.0.1:7000 send hello --to all",
    )
    send.add_argument("text", metavar="TEXT")
    send.add_argument("--to", choices=sorted(_AGENT_TYPES), default="all", help="agents of this type (default: all)")
    send.add_argument("--ids", type=_id_list, default=[], metavar="1,2", help="at most 10")
    send.add_argument("--groups", type=_group_list, default=[], metavar="3", help="at most 10")
    send.add_argument("--manager", default="", metavar="NAME", help="the receiver's message manager")


def _add_listen(verbs: Any) -> None:
    listen = add_verb(
        verbs,
        "listen",
        "print messages that belong to no topic or service",
        'Prints {"from": {"type": "unity", "id": 2}, "manager": "", "bytes": 5, "text": "hello"};\n'
        '"from" is null for the router, "base64" takes the place of "text" for what is no text.\n\n'
        "example:\n  macs headset 127.0.0.1:7000 --group 3 listen --from unity --count 1 --timeout 10",
    )
    _add_end(listen)
    listen.add_argument("--from", dest="sender", choices=("ros", "unity", "router"), help="only from these")
    listen.add_argument("--full", action="store_true", help=f"data whole, also above {MAX_BYTES} bytes")


def _add_script_verbs(verbs: Any) -> None:
    wait = verbs.add_parser("wait", add_help=False)
    wait.add_argument("what", metavar="WHAT", nargs="?")
    wait.add_argument("--count", type=_positive, default=1, metavar="N")
    wait.add_argument("--timeout", type=_positive_number, metavar="S")
    verbs.add_parser("unsub", add_help=False).add_argument("topic", metavar="TOPIC")
    verbs.add_parser("group", add_help=False).add_argument("group", type=group_id, metavar="G")
    verbs.add_parser("sleep", add_help=False).add_argument("seconds", type=_number, metavar="S")
    for name in ("pause", "resume", "drop"):
        verbs.add_parser(name, add_help=False)


TYPE_IS_OPTIONAL = frozenset({"sub", "pub", "call"})
"""Verbs that find the type of a topic or service by themselves, as the robots offer it."""


def _add_topic(parser: argparse.ArgumentParser, metavar: str, what: str, *, type_is_optional: bool = False) -> None:
    parser.add_argument("topic", metavar=metavar, help=f"name of the {what}, as /{what}")
    if type_is_optional:
        parser.add_argument("type", metavar="TYPE", nargs="?", help="as pkg/Name (default: as robots offer it)")
    else:
        parser.add_argument("type", metavar="TYPE", help="as pkg/Name")


def _add_robots(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--agents", type=_id_list, default=[], metavar="1,2", help="robots (default: all that are online now)"
    )
    parser.add_argument("--groups", type=_group_list, default=[], metavar="3", help="robots of these groups")


def _add_end(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--count", type=_positive, metavar="N", help="stop after N messages")
    parser.add_argument("--timeout", type=_positive_number, metavar="S", help="stop after S seconds")


def agent_type(name: str) -> int:
    """The number of ``all``, ``ros`` or ``unity``."""
    return _AGENT_TYPES[name]


def _finite(text: str) -> float:
    number = float(text)
    if not math.isfinite(number):
        raise ValueError(f"{text[:40]} is too large for a number")
    return number


def json_object(text: str) -> dict[str, Any]:
    """A JSON object from the command line. Raises UsageError."""
    try:
        value = json.loads(text, parse_float=_finite)
    except ValueError as error:
        raise UsageError(f"{text!r} is not JSON: {error}") from error
    if not isinstance(value, dict):
        raise UsageError(f"{text!r} is no JSON object")
    return value


def _id_list(text: str) -> list[int]:
    return [_agent_id(part) for part in text.split(",") if part]


def _group_list(text: str) -> list[int]:
    return [_bounded(part, 1, 255) for part in text.split(",") if part]


def _agent_id(text: str) -> int:
    return _bounded(text, 1, 0xFFFF)


def group_id(text: str) -> int:
    return _bounded(text, 0, 255)


def _positive(text: str) -> int:
    return _bounded(text, 1, 1 << 31)


def _bounded(text: str, low: int, high: int) -> int:
    try:
        value = int(text)
    except ValueError:
        value = low - 1
    if not low <= value <= high:
        raise argparse.ArgumentTypeError(f"{text!r} is no number in {low}..{high}")
    return value


def _number(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0 <= value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text!r} is no number of at least 0")
    return value


def _positive_number(text: str) -> float:
    value = _number(text)
    if not value:
        raise argparse.ArgumentTypeError("it must be above 0")
    return value
