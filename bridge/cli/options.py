"""Options that several verbs share, and how they, a settings file and the environment become settings.

The Zenoh options are spelled as Zenoh's own tools spell them. An option wins over the settings file; a Zenoh
configuration file (``-c``) wins over our defaults, and ``--cfg`` over everything. The environment is asked last:
``ZENOH_CONFIG`` for ``-c``, and ``MACS_CONNECT`` for ``-e`` where nothing else names a router.
"""

from __future__ import annotations

import argparse
import logging
import os
from typing import Any

from bridge.logs import FORMAT, FORMATS, JSON, TEXT, log_to_stderr
from bridge.principal import GRAMMAR, Principal
from bridge.settings import Settings, load
from macs_zenoh.config import MeshSettings
from macs_zenoh.errors import UsageError
from macs_zenoh.protocol import endpoints
from macs_zenoh.sections import changed


def add_log_options(parser: argparse.ArgumentParser, verbose: str = "log more") -> None:
    parser.add_argument("-v", "--verbose", action="store_true", help=verbose)
    parser.add_argument(
        "--log-format",
        choices=(TEXT, JSON),
        help=f"of the log on stderr: for people (with dates where it is no terminal), or JSON; default: ${FORMAT}",
    )


CONNECT = "MACS_CONNECT"
"""Routers, as ``-e`` names them, with commas or spaces between them."""


def add_settings_option(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--settings",
        metavar="FILE",
        action="append",
        help="our settings file (TOML), see config/macs.toml; repeat: a later one wins",
    )


def add_metrics_option(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--metrics",
        metavar="HOST:PORT",
        help="tell who watches: /metrics for Prometheus, /healthz, /readyz, /diagnostics (a port alone: this machine)",
    )


def add_as_option(parser: argparse.ArgumentParser) -> None:
    """Whose rights to use, told the same way to every verb: a `Principal`, None unless told."""
    parser.add_argument(
        "--as",
        dest="principal",
        type=_principal,
        metavar="WHO",
        help=f"whose rights to use: {GRAMMAR} (default: as the settings say)",
    )


def _principal(text: str) -> Principal:
    try:
        return Principal.parse(text)
    except UsageError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def add_verb(verbs: Any, name: str, summary: str, text: str) -> argparse.ArgumentParser:
    """A verb below one of `macs`; what it prints and its examples are behind its options."""
    parser: argparse.ArgumentParser = verbs.add_parser(
        name,
        help=summary,
        description=f"{summary[0].upper()}{summary[1:]}.",
        epilog=text,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    return parser


def add_ros_args(parser: argparse.ArgumentParser) -> None:
    """ROS's own arguments: the last of a line."""
    parser.add_argument(
        "--ros-args", nargs=argparse.REMAINDER, default=[], metavar="...", help="ROS arguments, to the end of the line"
    )


def ros_args(args: argparse.Namespace) -> list[str]:
    """What `add_ros_args` was told, as ROS wants it."""
    return ["--ros-args", *args.ros_args] if args.ros_args else []


def add_mesh_options(
    parser: argparse.ArgumentParser, *, modes: tuple[str, ...] = ("client", "peer"), dials: bool = True
) -> None:
    """``modes``: those that make sense for the verb; none means that its mode is fixed. ``dials``: it needs a router,
    so that the environment may name one."""
    add_settings_option(parser)
    zenoh = parser.add_argument_group("Zenoh options")
    zenoh.add_argument("-c", "--config", metavar="FILE", help="Zenoh configuration (JSON5); default: $ZENOH_CONFIG")
    if modes:
        zenoh.add_argument("-m", "--mode", choices=modes, help="how to join the mesh (default: client)")
    zenoh.add_argument(
        "-e",
        "--connect",
        metavar="ENDPOINT",
        action="append",
        help="router, as tcp/HOST:7447; repeat for fail-over" + (f"; default: ${CONNECT}" if dials else ""),
    )
    parser.set_defaults(dials=dials)
    zenoh.add_argument("-l", "--listen", metavar="ENDPOINT", action="append", help="where to accept Zenoh sessions")
    zenoh.add_argument(
        "--cfg", metavar="PATH:JSON5", action="append", help="set one value, as transport/link/tx/lease:5000"
    )
    zenoh.add_argument("--namespace", metavar="KEY", help="put before every key: several meshes on one router")


def mesh_words(args: argparse.Namespace) -> list[str]:
    """What `add_mesh_options` and `add_as_option` were told, for a program that joins in the same way."""
    words = [word for file in args.settings or () for word in ("--settings", file)]
    for option in ("config", "mode", "connect", "listen", "cfg", "namespace"):
        said = getattr(args, option, None)
        for each in said if isinstance(said, list) else [] if said is None else [said]:
            words += [f"--{option}", each]
    return words + (["--verbose"] if args.verbose else [])


def settings_file(args: argparse.Namespace) -> Settings:
    """What the settings files say, all defaults without one. Raises `ConfigError`."""
    return load(*args.settings or ())


def settings(args: argparse.Namespace) -> Settings:
    """The settings file, changed by the options given. Raises `ConfigError`."""
    base = settings_file(args)
    config_file = args.config or base.mesh.config_file or os.environ.get("ZENOH_CONFIG")
    unnamed = args.dials and not base.mesh.connect and not config_file
    mesh = changed(
        base.mesh,
        mode=getattr(args, "mode", None),
        connect=args.connect or (_routers_of_environment() if unnamed else None),
        listen=args.listen,
        config_file=config_file,
        overrides=[*base.mesh.overrides, *args.cfg] if args.cfg else None,
        namespace=args.namespace,
    )
    return changed(base, mesh=mesh)


def defaults() -> Settings:
    """The settings of who was told nothing."""
    return changed(Settings(), mesh=changed(MeshSettings(), connect=_routers_of_environment()))


def _routers_of_environment() -> list[str] | None:
    routers = os.environ.get(CONNECT, "").replace(",", " ").split()
    for router in routers:
        if problem := endpoints.problem(router):
            raise UsageError(f"{CONNECT}: {router!r} {problem}")
    return routers or None


def start_logging(args: argparse.Namespace) -> None:
    """Log ``macs.*`` to stderr, one short line each; other libraries only from WARNING on."""
    form = getattr(args, "log_format", None)
    if form is None and os.environ.get(FORMAT, TEXT) not in FORMATS:
        raise UsageError(f"{FORMAT} is {os.environ[FORMAT]!r}: say {TEXT} or {JSON}")
    if form is not None:
        os.environ[FORMAT] = form  # for the programs that this one starts
    log_to_stderr(form)
    logging.getLogger("macs").setLevel(logging.DEBUG if args.verbose else logging.INFO)
