"""Print what a shell has to read so that Tab completes verbs, options, robots' ids and topics.

Robots and topics are looked up on the mesh for at most a second, at the router that -e, the settings or
MACS_CONNECT name. When none answers, there are no suggestions and no error.

examples:
  eval "$(macs completion bash)"                       in ~/.bashrc
  eval "$(macs completion zsh)"                        in ~/.zshrc, after compinit
  macs completion fish > ~/.config/fish/completions/macs.fish

what it prints:
  a function of that shell, and the line that binds it to `macs`"""

from __future__ import annotations

import argparse
import asyncio
import logging
import os
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Any

from bridge.cli import options, output
from macs_zenoh.protocol.agent_id import AgentId
from macs_zenoh.protocol.messages import OPERATOR, ROS

SUMMARY = "complete words with Tab in bash, zsh or fish"

WITHIN_S = 1.0
"""Who presses Tab waits no longer."""

ASKED_BY_SHELL = "_ARGCOMPLETE"
"""What a shell sets that wants to know what may come next."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("shell", metavar="SHELL", choices=("bash", "zsh", "fish"), help="bash, zsh or fish")


def run(args: argparse.Namespace) -> int:
    from argcomplete.shell_integration import shellcode

    output.say(shellcode(["macs"], shell=args.shell, use_defaults=False).rstrip())
    return 0


# -- what may come next ----------------------------------------------------------------------------------------------


def answer_shell(build_parser: Callable[[], argparse.ArgumentParser]) -> None:
    """Where a shell asks what may come next, tell it and end the process; else do nothing."""
    if ASKED_BY_SHELL not in os.environ:
        return
    import argcomplete
    from argcomplete.completers import SuppressCompleter

    logging.disable()
    parser = build_parser()
    _tell_what_completes(parser)
    argcomplete.autocomplete(parser, always_complete_options=False, default_completer=SuppressCompleter())


def _tell_what_completes(parser: argparse.ArgumentParser) -> None:
    """Give each argument its completer, by what stands for it in the usage."""
    from argcomplete.completers import DirectoriesCompleter, FilesCompleter

    completers = {
        **dict.fromkeys(("FILE", "PATH", "POLICY"), FilesCompleter()),
        "DIR": DirectoriesCompleter(),
        **dict.fromkeys(("ROBOT", "ID"), _robots),
        "1,2": _robots_in_list,
        "TOPIC": _topics,
        "SERVICE": _names_of("services"),
        "ACTION": _names_of("actions"),
    }
    for below in _parsers(parser):
        for action in below._actions:
            completer = completers.get(str(action.metavar))
            if completer is not None:
                action.completer = completer  # type: ignore[attr-defined]  # where argcomplete looks


def _parsers(parser: argparse.ArgumentParser) -> Iterator[argparse.ArgumentParser]:
    yield parser
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for below in action.choices.values():
                yield from _parsers(below)


def _robots(parsed_args: argparse.Namespace, **_: Any) -> list[str]:
    return [str(robot) for robot in asked(parsed_args)]


def _robots_in_list(prefix: str, parsed_args: argparse.Namespace, **_: Any) -> list[str]:
    before, comma, _last = prefix.rpartition(",")
    return [f"{before}{comma}{robot}" for robot in asked(parsed_args) if str(robot) not in before.split(",")]


def _topics(parsed_args: argparse.Namespace, **_: Any) -> list[str]:
    """What a robot publishes for who subscribes, what it takes for who publishes."""
    publishes = "pub" in (getattr(parsed_args, "headset_verb", ""), getattr(parsed_args, "topic_verb", ""))
    return _offered(parsed_args, "subscribers" if publishes else "publishers")


def _names_of(what: str) -> Callable[..., list[str]]:
    return lambda parsed_args, **_: _offered(parsed_args, what)


def _offered(args: argparse.Namespace, what: str) -> list[str]:
    return sorted({name for offers in asked(args, offers=True).values() for name in getattr(offers, what)})


def asked(args: argparse.Namespace, *, offers: bool = False) -> dict[int, Any]:
    """Ids of the robots that are online, with what they offer if that is wanted; what is known within `WITHIN_S`."""
    found: dict[int, Any] = {}
    asking = threading.Thread(target=_ask, args=(args, offers, found), daemon=True)
    asking.start()
    asking.join(WITHIN_S)
    return dict(found)


def _ask(args: argparse.Namespace, offers: bool, found: dict[int, Any]) -> None:
    with suppress(Exception):  # whatever is wrong, who presses Tab did not ask for it
        asyncio.run(_collect(args, offers, found))


async def _collect(args: argparse.Namespace, offers: bool, found: dict[int, Any]) -> None:
    from bridge.cli import robots
    from macs_zenoh.protocol.robot_state import Offered

    settings = options.settings(args) if hasattr(args, "connect") else options.defaults()
    caller = AgentId(OPERATOR, settings.operator.id or 0)
    async with robots.operator(settings.mesh, caller, timeout_s=WITHIN_S) as operator:
        ids = [agent.id for agent in await operator.online() if agent.type == ROS]

        async def tell(robot: int) -> None:
            with suppress(Exception):
                answer = await operator.ask(robot, "offers", timeout_s=WITHIN_S)
                found[robot] = robots.read(answer, Offered)[1]

        if offers:
            await asyncio.gather(*map(tell, ids))
        else:
            found.update(dict.fromkeys(ids))
