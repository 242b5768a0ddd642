"""The command ``macs``: one module per verb, each with ``SUMMARY``, ``add_arguments(parser)`` and ``run(args)``.

Data goes to stdout, logs to stderr. Exit code 0: done; 1: not found, unreachable, unhealthy; 2: wrong usage or
configuration; 130: stopped before it was done. A verb imports what is heavy (zenoh, rclpy,
rosbags) inside ``run``, so that help is instant.
"""

from __future__ import annotations

import argparse
import difflib
import importlib
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from types import ModuleType
from typing import Any

from bridge import logs
from bridge.cli import completion, options, output, running
from macs_zenoh.errors import ConfigError, MacsError, UsageError
from macs_zenoh.plain import plain
from macs_zenoh.versions import installed

NAMES = (
    "up",
    "router",
    "gateway",
    "agent",
    "rmw-zenoh",
    "headset",
    "awareness",
    "ls",
    "topic",
    "service",
    "action",
    "top",
    "watch",
    "trace",
    "ping",
    "bench",
    "stop",
    "doctor",
    "security",
    "conformance",
    "record",
    "bag",
    "replay",
    "foxglove",
    "audit",
    "token",
    "init",
    "keys",
    "interfaces",
    "completion",
)


class Verbs(Mapping[str, ModuleType]):
    """The modules of all verbs by name, in the order of the help; each is loaded when it is asked for."""

    def __getitem__(self, name: str) -> ModuleType:
        if name not in NAMES:
            raise KeyError(name)
        return importlib.import_module(f"{__name__}.{name.replace('-', '_')}")

    def __iter__(self) -> Iterator[str]:
        return iter(NAMES)

    def __len__(self) -> int:
        return len(NAMES)


VERBS = Verbs()

DESCRIPTION = """\
ROS 2 robots and XR headsets on one Zenoh mesh, reached by id, by group or all at once.

A robot joins with `macs agent` beside its ROS 2 graph. A headset opens a TCP connection
to a `macs gateway`. Both find each other through a `macs router` (or any Zenoh router).
`macs up` starts all three on this machine."""

EXAMPLES = """\
examples:
  macs up --demo                                     everything on this machine, with a demo robot
  macs agent --id 7 -e tcp/192.168.1.10:7447         this machine's ROS 2 graph is robot 7
  macs ls -e tcp/192.168.1.10:7447                   who is online there

`macs VERB --help` explains one verb, and shows what it prints.
MACS_CONNECT names the router for verbs that were told of none with -e or in settings.
Exit codes: 0 done; 1 not found, unreachable, unhealthy, not done; 2 wrong usage or
configuration; 130 stopped before it was done."""


NEVER_MEANT = frozenset({"stop"})
"""Verbs that are not offered for a misspelled one: who types what was offered without thinking stops every robot."""


class Parser(argparse.ArgumentParser):
    """Wrong words are told by the parser of the verb that they were said to, with what may have been meant. Options
    are never guessed from their first letters: ``--worker`` is not ``--workers``."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **{"allow_abbrev": False, **kwargs})

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> tuple[Any, list[str]]:
        """As argparse's, but whatever is left over is an error here and not in the parser above."""
        found, unknown = super().parse_known_args(args, namespace)
        if unknown:
            option = unknown[0].partition("=")[0]
            shown = (action for action in self._actions if action.help != argparse.SUPPRESS)
            known = [name for action in shown for name in action.option_strings] if option.startswith("-") else []
            self.error(f"unrecognized arguments: {' '.join(unknown)}{_meant(option, known)}")
        return found, unknown

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        if action.choices is not None and value not in action.choices:
            meant = _meant(value, [choice for choice in action.choices if choice not in NEVER_MEANT])
            if meant:
                raise argparse.ArgumentError(action, f"invalid choice: {value!r}{meant}")
        super()._check_value(action, value)


def _meant(word: Any, known: Iterable[Any]) -> str:
    names = {str(name).lstrip("-"): name for name in known}  # what all options begin with makes none likelier
    near = difflib.get_close_matches(str(word).lstrip("-"), names, n=1, cutoff=0.7)
    return f", did you mean {names[near[0]]}?" if near else ""


class _Version(argparse.Action):
    """argparse's own wants to know the version before anybody asks for it."""

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        parser._print_message(f"macs-zenoh {installed('macs-zenoh') or '(not installed)'}\n", sys.stdout)
        parser.exit()


class _VerbsInOneColumn(argparse.RawDescriptionHelpFormatter):
    """argparse forgets that verbs are indented, and breaks the line after each of the longest."""

    def __init__(self, prog: str) -> None:
        super().__init__(prog)
        self._action_max_length = max(map(len, NAMES)) + 4


def build_parser(verb: str = "") -> Parser:
    """The command line: of one verb, whose module alone is loaded, or of all where it is none of them."""
    parser = Parser(prog="macs", description=DESCRIPTION, epilog=EXAMPLES, formatter_class=_VerbsInOneColumn)
    parser.add_argument("--version", action=_Version, nargs=0, help="show program's version number and exit")
    verbs = parser.add_subparsers(dest="verb", metavar="VERB", required=True, title="verbs")
    for name in [verb] if verb in NAMES else NAMES:
        module = VERBS[name]
        added = verbs.add_parser(
            name,
            help=module.SUMMARY,
            description=module.__doc__,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        options.add_log_options(added, getattr(module, "VERBOSE", "log more"))
        module.add_arguments(added)
        added.set_defaults(run=module.run)
    return parser


def program() -> int:
    """The process ``macs``: `main`, with streams that can be used whatever they are."""
    completion.answer_shell(build_parser)
    output.prepare()
    return main()


def main(argv: Sequence[str] | None = None) -> int:
    """Run one verb; what a user can cause ends in one line on stderr, never in a traceback."""
    words = sys.argv[1:] if argv is None else argv
    try:
        return _run(words)
    except output.OutputLost as lost:
        output.give_up()
        return 1 if lost.reader_left else _fail(words[0] if words else "", lost, 1)


def _run(words: Sequence[str]) -> int:
    parser = build_parser(words[0] if words else "")
    if not words:
        parser.print_help(sys.stderr)
        parser.exit(2, "\nmacs: no verb was given\n")
    try:
        args = parser.parse_args(words)
    except SystemExit:
        output.finish()  # it may have printed help
        raise
    args.words = list(words)
    options.start_logging(args)
    try:
        code: int = args.run(args)
        output.finish()
    except (ConfigError, UsageError) as error:
        return _fail(args.verb, error, 2)
    except MacsError as error:
        return _fail(args.verb, error, 1)
    except KeyboardInterrupt:
        return running.INTERRUPTED
    return code


def _fail(verb: str, error: Exception, code: int) -> int:
    logs.catch_up()  # the last line says why
    text = str(error)
    output.note(plain(text if text.startswith(f"macs {verb}: ") else f"macs {verb}: {text}"))
    return code
