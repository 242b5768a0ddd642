"""Topics of robots from the command line, over the mesh and without a gateway: as `ros2 topic`, for robots that are
anywhere on it.

Types are what the robots offer, messages are written as YAML or JSON. Without --robot or --group all robots that are
online are listened to; to publish, one has to be named where there are several. A robot lets you receive and publish
what it lets a headset; --as says who you are, where its settings or access rules want to know.

Exit code 0: done, also when Ctrl-C ends what has no end; 1: not found, unreachable, refused, or fewer messages than
asked for; 2: wrong usage; 130: Ctrl-C before the end.

examples:
  macs topic list -t
  macs topic echo /pose --robot 7 --field pose.position
  macs topic hz /imu --robot 7
  macs topic pub /cmd_vel geometry_msgs/msg/Twist 'linear: {x: 0.2}' --robot 7 --rate 10 --count 20

`macs topic VERB --help` explains one verb.

what it prints:
  what `ros2 topic` prints; with --json a line for each topic, message or measurement"""

from __future__ import annotations

import argparse
import json
from typing import TYPE_CHECKING, Any

from bridge.cli import named, output
from macs_zenoh.errors import Unreachable
from macs_zenoh.plain import plain

if TYPE_CHECKING:
    from bridge.graph.echo import End
    from bridge.graph.site import Looking, Site

SUMMARY = "topics of robots: list, info, echo, hz, bw, delay, pub"

SETTLE_S = 0.5
EVERY_ROBOT = "all that are online"
ONE_ROBOT = "the only one that is online"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    verbs = parser.add_subparsers(dest="topic_verb", metavar="VERB", required=True, title="verbs")
    _add_list(verbs)
    _add_info(verbs)
    _add_echo(verbs)
    _add_measure(
        verbs,
        "hz",
        "how often messages come, here, over the mesh",
        "average rate: 20.001\n          min: 0.049s max: 0.051s std dev: 0.00031s window: 42",
        '{"topic": "/pose", "robot": 7, "rate_hz": 20.001, "min_s": 0.049, ..., "window": 42}',
    )
    _add_measure(
        verbs,
        "bw",
        "how much comes in a second",
        "1.02 MB/s from 100 messages\n          Message size mean: 10.21 KB min: 10.20 KB max: 10.22 KB",
        '{"topic": "/camera", "robot": 7, "bytes_per_s": 1020000.0, "mean_bytes": ..., "window": 100}',
    )
    _add_measure(
        verbs,
        "delay",
        "how old messages are when they come, by the time in their header",
        "average delay: 0.004\n          min: 0.003s max: 0.009s std dev: 0.00081s window: 42",
        '{"topic": "/pose", "robot": 7, "delay_s": 0.004, "min_s": 0.003, ...}\n'
        "The robot's clock is compared with ours, and the difference allowed for; the log says how well it is known.",
    )
    _add_pub(verbs)


def run(args: argparse.Namespace) -> int:
    code: int = args.run_below(args)
    return code


def _add_list(verbs: Any) -> None:
    parser = named.add_verb(
        verbs,
        "list",
        "every topic that robots have",
        "examples:\n  macs topic list -t\n  macs topic list --robot 7 --json\n\n"
        "what it prints:\n  /pose [geometry_msgs/msg/PoseStamped]                       with -t\n"
        '  {"topic": "/pose", "type": "...", "publishers": [7], "subscribers": []}   with --json',
        _list,
    )
    parser.add_argument("-t", "--show-types", action="store_true", help="with their types")
    parser.add_argument("-v", "--verbose", dest="details", action="store_true", help="by who has them, with robots")
    parser.add_argument("--count-topics", action="store_true", help="only how many there are")
    named.add_site_options(parser, robots_are=EVERY_ROBOT)


def _add_info(verbs: Any) -> None:
    parser = named.add_verb(
        verbs,
        "info",
        "type of a topic and which robots have it; -v: QoS, who is registered, who has control, the type's definition",
        "example:\n  macs topic info /cmd_vel -v\n\n"
        "what it prints:\n  Type: geometry_msgs/msg/Twist\n  Publisher count: 0\n  Subscription count: 1 (robot 7)",
        _info,
    )
    parser.add_argument("topic", metavar="TOPIC", help="its name, as /pose")
    parser.add_argument("-v", "--verbose", dest="details", action="store_true", help="all that robots tell of it")
    named.add_site_options(parser, robots_are=EVERY_ROBOT)


def _add_echo(verbs: Any) -> None:
    parser = named.add_verb(
        verbs,
        "echo",
        "show the messages of a topic",
        "examples:\n  macs topic echo /pose --robot 7 --once\n"
        "  macs topic echo /odom --field pose.pose.position --csv > way.csv\n\n"
        "what it prints:\n  data: hello\n  ---\n"
        '  {"topic": "/chatter", "robot": 7, "message": {"data": "hello"}}   with --json',
        _echo,
    )
    _add_topic(parser)
    parser.add_argument(
        "--csv", action="store_true", help="values with commas between them; of several robots, the id first"
    )
    parser.add_argument("--field", metavar="FIELD", help="only this part, as pose.position.x or transforms[0].header")
    parser.add_argument("-f", "--full-length", action="store_true", help="arrays whole, also above 256 bytes")
    parser.add_argument("--flow-style", action="store_true", help="YAML in one line")
    named.add_end_options(parser)
    named.add_site_options(parser, robots_are=EVERY_ROBOT)


def _add_measure(verbs: Any, name: str, summary: str, prints: str, as_json: str) -> None:
    parser = named.add_verb(
        verbs,
        name,
        summary,
        f"example:\n  macs topic {name} /pose --robot 7\n\nwhat it prints, every second:\n  {prints}\n"
        f"with --json:\n  {as_json}",
        _measure,
    )
    _add_topic(parser)
    parser.add_argument("--window", type=named.number, metavar="N", help="of the last N (default: 10000, bw: 100)")
    parser.add_argument("--csv", action="store_true", help="values with commas: robot, then as in JSON")
    named.add_end_options(parser)
    named.add_site_options(parser, robots_are=EVERY_ROBOT)


def _add_pub(verbs: Any) -> None:
    parser = named.add_verb(
        verbs,
        "pub",
        "publish to a topic, once a second unless told otherwise: it may move a robot",
        "Fields that are left out get their defaults. A robot that does not take it says why: exit code 1.\n\n"
        "examples:\n  macs topic pub /chatter std_msgs/msg/String 'data: hello' --robot 7 --once\n"
        '  macs topic pub /cmd_vel \'{"linear": {"x": 0.2}}\' --robot 7 --rate 10 --count 20\n\n'
        'what it prints:\n  publishing #1: {"data": "hello"}\n'
        '  {"topic": "/chatter", "sent": 1, "refused": [{"robot": 7, "reason": "..."}]}   in the end, with --json',
        _pub,
    )
    parser.add_argument("topic", metavar="TOPIC", help="its name, as /chatter")
    # one that may be left out before one that may not is taken for left out when an option comes first
    parser.add_argument("type", metavar="[TYPE] VALUES", help="the type (default: as robots have it), and the message")
    parser.add_argument("values", nargs="?", help=argparse.SUPPRESS)
    parser.add_argument("-r", "--rate", type=named.positive, default=1.0, metavar="HZ", help="so often (default: 1)")
    count = parser.add_mutually_exclusive_group()
    count.add_argument("--once", "-1", dest="count", action="store_const", const=1, help="one message")
    count.add_argument("-t", "--times", "--count", dest="count", type=named.number, metavar="N", help="N messages")
    parser.add_argument(
        "--settle",
        type=_not_negative,
        default=SETTLE_S,
        metavar="S",
        help=f"wait before the first, until ROS nodes have found the new publisher (default: {SETTLE_S})",
    )
    named.add_site_options(parser, robots_are=ONE_ROBOT)


def _add_topic(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("topic", metavar="TOPIC", help="its name, as /pose")
    parser.add_argument("type", metavar="TYPE", nargs="?", help="as pkg/msg/Name (default: as robots offer it)")


def _not_negative(text: str) -> float:
    return 0.0 if text == "0" else named.positive(text)


# -- what they do ----------------------------------------------------------------------------------------------------


def _list(args: argparse.Namespace) -> int:
    from bridge.graph import lists
    from bridge.graph.site import named as named_robots

    async def work(site: Looking) -> int:
        topics = lists.topics(await site.must_offer(site.must_be_online()))
        if args.json:
            output.say(json.dumps([topic.facts() for topic in topics]))
        elif args.count_topics:
            output.say(str(len(topics)))
        elif args.details:
            for heading, end in (("Published", "publishers"), ("Subscribed", "subscribers")):
                output.say(f"{heading} topics:")
                for topic in topics:
                    if robots := getattr(topic, end):
                        output.say(plain(f" * {topic.name} [{topic.type}] {named_robots(robots)}"))
                output.say("")
        else:
            for topic in topics:
                output.say(plain(f"{topic.name} [{topic.type}]" if args.show_types else topic.name))
        return 0

    return named.looking(args, work)


def _info(args: argparse.Namespace) -> int:
    from bridge.graph import lists
    from macs_zenoh.protocol.offers import absolute, closest

    async def work(site: Looking) -> int:
        robots = site.must_be_online()
        offers, name = await site.must_offer(robots), absolute(args.topic)
        about = lists.about_topic(name, offers, await site.states(robots) if args.details or args.json else {})
        if not about["robots"]:
            near = closest(name, [topic.name for topic in lists.topics(offers)])
            raise Unreachable(f"topic {name}", f"no robot has it{f'; did you mean {near}?' if near else ''}")
        told = await site.definitions(lists.types_at(name, offers)) if args.details else {}
        if args.json:
            named.emit({**about, "definitions": lists.definitions(told)} if args.details else about)
        else:
            shown = lists.shown_topic(about, verbose=args.details) + lists.shown_definitions(told)
            output.say("\n".join(map(plain, shown)))
        return 0

    return named.looking(args, work)


def _end(args: argparse.Namespace) -> End:
    from bridge.graph.echo import End

    return End(args.count, args.timeout)


def _echo(args: argparse.Namespace) -> int:
    from bridge.graph import echo, words

    form = "json" if args.json else "csv" if args.csv else "flow" if args.flow_style else "yaml"
    field = words.field_path(args.field) if args.field else ()
    shown = echo.Shown(form, field, args.full_length)

    async def work(site: Site) -> int:
        return await echo.echo(site, args.topic, args.type, shown, _end(args), output.say, named.emit)

    return named.on_site(args, work, endless=not (args.count or args.timeout))


def _measure(args: argparse.Namespace) -> int:
    from bridge.graph import echo, rates

    verb = args.topic_verb
    form = "json" if args.json else "csv" if args.csv else "text"
    window = args.window or (rates.SIZE_WINDOW if verb == "bw" else rates.RATE_WINDOW)
    make: Any = {"hz": rates.Arrivals, "bw": rates.Sizes, "delay": rates.Ages}[verb]

    async def work(site: Site) -> int:
        take_in: Any = {"hz": echo.measure_rate, "bw": echo.measure_size}.get(verb)
        if verb == "delay":
            ahead = await echo.compared_clocks(site, site.must_be_online())
            take_in = echo.Delay(ahead, offset_s=echo.offset_of_clocks())
        measured = echo.Measured(verb, lambda: make(window))
        return await echo.watch(
            site, args.topic, args.type, measured, take_in, _end(args), output.say, named.emit, form=form
        )

    return named.on_site(args, work, endless=not (args.count or args.timeout))


def _pub(args: argparse.Namespace) -> int:
    from bridge.graph import acts, words

    of_type, text = (args.type, args.values) if args.values is not None else (None, args.type)
    if args.values is None and _is_type(args.type):
        of_type, text = args.type, ""
    value = words.value_of(text)
    pace = acts.Pace(args.rate, args.count, args.settle)

    async def work(site: Site) -> int:
        publication = acts.Publication(site, args.topic, of_type, value)
        return await publication.publish(pace, output.say, named.emit, as_json=args.json)

    return named.on_site(args, work, endless=args.count is None)


def _is_type(text: str) -> bool:
    """Whether one word is a type, as ``std_msgs/msg/Empty``, and no message."""
    parts = text.split("/")
    return len(parts) in (2, 3) and all(part.replace("_", "").isalnum() for part in parts)
