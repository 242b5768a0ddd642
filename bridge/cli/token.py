"""Make and revoke tokens: a headset shows one to be let in, and the token says what it may do.

A token is printed once, when it is made. The file keeps its hash, name, rights and end. Gateways
follow the file without a restart: a token that is revoked ends within a second. Copy the file to
other gateways, or keep it where all of them read it.

Rights: see, command, call, serve, act, stop, ask, send, broadcast, record, robot (docs/security.md).
What is not named is not permitted.

examples:
  macs token create anna --robots 1,2 --groups 3 --may see,command,stop --expires 30d
  macs token create wall --robots any --may see --topics '/camera/**'
  macs token create desk --robots any --may see,record
  macs token list
  macs token show anna --qr --url http://192.168.1.10:7080      pair a headset without a keyboard
  macs token rotate anna                                        a new secret; the old one ends
  macs token revoke anna

what it prints:
  macs_Zm9v...                                of create and rotate: the token, this once
  anna  see,command,stop  robots 1,2  ...     of list"""

from __future__ import annotations

import argparse
import re
import secrets
import sys
import time
from pathlib import Path
from typing import Any, get_args

import msgspec

from bridge.cli import output
from bridge.tokens import store
from macs_zenoh.errors import MissingExtra, UsageError
from macs_zenoh.protocol.rights import ANY, RIGHTS, Right, Rights
from macs_zenoh.protocol.tokens import (
    CODE_DIGITS,
    PAIRING_S,
    SECRET_BYTES,
    Token,
    Tokens,
    code_of,
    hash_of,
    new_pairing,
    new_secret,
)

SUMMARY = "who may come to a gateway, and do what"

USUAL = "see,command,call,serve,act,stop"
SECONDS = {"s": 1, "m": 60, "h": 3600, "d": 86400, "w": 7 * 86400}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    verbs = parser.add_subparsers(dest="token_verb", metavar="VERB", required=True, title="verbs")
    create = _verb(verbs, "create", "make a token and print it, once")
    create.add_argument("name", metavar="NAME", help="what it is called: letters, digits, . _ -")
    _add_rights(create)
    create.add_argument("--expires", type=_duration, metavar="TIME", help="as 30d, 12h, 45m (default: never)")
    change = _verb(verbs, "change", "give a token other rights; who is connected has them within a second")
    change.add_argument("name", metavar="NAME")
    _add_rights(change)
    listed = _verb(verbs, "list", "all tokens, and what they permit")
    listed.add_argument("--json", action="store_true", help="for programs")
    show = _verb(verbs, "show", "what a token permits; with --qr a code to pair a headset with")
    show.add_argument("name", metavar="NAME")
    show.add_argument("--qr", action="store_true", help=f"a code of {CODE_DIGITS} digits, good for two minutes, once")
    show.add_argument("--url", metavar="URL", help="with --qr: the gateway's web port, as headsets reach it")
    show.add_argument("--json", action="store_true", help="for programs")
    rotate = _verb(verbs, "rotate", "a new secret for a token; all old ones end at once")
    rotate.add_argument("name", metavar="NAME")
    revoke = _verb(verbs, "revoke", "end a token, and the connections of who came in by it")
    revoke.add_argument("name", metavar="NAME")


def _verb(verbs: Any, name: str, summary: str) -> argparse.ArgumentParser:
    parser: argparse.ArgumentParser = verbs.add_parser(
        name, help=summary, description=f"{summary[0].upper()}{summary[1:]}."
    )
    parser.add_argument(
        "--file", metavar="FILE", help="where tokens are kept (default: $MACS_TOKENS, or ~/.config/macs/tokens.json)"
    )
    return parser


def _add_rights(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--robots", type=_numbers, default=[], metavar="1,2", help="robots by id; or any")
    parser.add_argument(
        "--groups", type=_numbers, default=[], metavar="3", help="groups that it may name and be in; or any"
    )
    parser.add_argument("--may", type=_rights, default=_rights(USUAL), metavar="WHAT", help=f"(default: {USUAL})")
    parser.add_argument(
        "--topics",
        action="append",
        metavar="PATTERN",
        help="topics, services and actions, as '/camera/**' (default: all); repeat for more",
    )
    parser.add_argument(
        "--stop-topics", action="append", metavar="TOPIC", help="where robots expect a stop (default: /emergency_stop)"
    )
    parser.add_argument("--rate", type=float, default=0.0, metavar="HZ", help="frames per second (default: no limit)")


def _numbers(text: str) -> list[int] | str:
    if text == ANY:
        return text
    try:
        return [int(each) for each in text.split(",") if each]
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is neither any nor a list of numbers, as 1,2") from None


def _rights(text: str) -> list[Right]:
    named = [each.strip() for each in text.split(",") if each.strip()]
    for each in named:
        if each not in get_args(Right):
            raise argparse.ArgumentTypeError(f"{each!r} is no right; there are {', '.join(RIGHTS)}")
    return [right for right in RIGHTS if right in named]


def _duration(text: str) -> float:
    found = re.fullmatch(r"(\d{1,9})([smhdw])", text)
    if not found:
        raise argparse.ArgumentTypeError(f"{text!r} is no time, as 30d, 12h or 45m")
    return float(found[1]) * SECONDS[found[2]]


def run(args: argparse.Namespace) -> int:
    path = store.path_of(args.file)
    verbs = {"create": _create, "change": _change, "list": _list, "show": _show, "rotate": _rotate, "revoke": _revoke}
    return verbs[args.token_verb](args, path)


def _create(args: argparse.Namespace, path: Path) -> int:
    secret, now = _new_secret(), time.time()
    expires_at = None if args.expires is None else now + args.expires
    token = _checked(args.name, _rights_of(args), now, expires_at, secret)

    def edit(tokens: Tokens) -> tuple[Tokens, None]:
        if any(each.name == args.name for each in tokens.tokens):
            raise UsageError(f"there is a token called {args.name} already; `rotate`, `change` or `revoke` it")
        return tokens.with_token(token), None

    store.change(path, edit)
    output.say(secret)
    return 0


def _checked(name: str, rights: Rights, now: float, expires_at: float | None, secret: str) -> Token:
    token = Token(name=name, rights=rights, created_at=now, expires_at=expires_at, hashes=[hash_of(secret)])
    try:
        return msgspec.convert(msgspec.to_builtins(token), Token)
    except msgspec.ValidationError as error:
        raise UsageError(f"no such token can be: {error}") from None


def _rights_of(args: argparse.Namespace) -> Rights:
    said = {"may": args.may, "robots": args.robots, "groups": args.groups, "frames_per_s": args.rate}
    if args.topics:
        said["topics"] = args.topics
    if args.stop_topics:
        said["stop_topics"] = args.stop_topics
    try:
        return msgspec.convert(said, Rights)
    except msgspec.ValidationError as error:
        raise UsageError(f"no such rights can be: {error}") from None


def _change(args: argparse.Namespace, path: Path) -> int:
    rights = _rights_of(args)
    store.change(
        path,
        lambda tokens: (tokens.with_token(msgspec.structs.replace(tokens.named(args.name), rights=rights)), None),
    )
    return 0


def _list(args: argparse.Namespace, path: Path) -> int:
    tokens, now = store.read(path).tokens, time.time()
    if args.json:
        output.say(output.as_json([_shown(token, now) for token in tokens]))
        return 0
    for token in tokens:
        output.say(_line(token, now))
    return 0


def _show(args: argparse.Namespace, path: Path) -> int:
    if args.qr:
        return _pair(args, path)
    token, now = store.read(path).named(args.name), time.time()
    output.say(output.as_json(_shown(token, now)) if args.json else _line(token, now))
    return 0


def _pair(args: argparse.Namespace, path: Path) -> int:
    """A code that a headset exchanges for a secret of its own; as a picture where it can see one."""
    code, now = code_of(secrets.randbelow(10**CODE_DIGITS)), time.time()
    pairing = new_pairing(args.name, code, secrets.token_bytes(32), now)
    store.change(path, lambda tokens: (tokens.with_pairing(pairing, now), None))
    said = {"name": args.name, "code": code, "expires_s": PAIRING_S}
    url = None if args.url is None else f"{args.url.rstrip('/')}/#pair={code}"  # what follows # is sent to nobody
    if args.json:
        output.say(output.as_json({**said, "url": url}))
        return 0
    try:
        import segno
    except ModuleNotFoundError as error:
        raise MissingExtra("a QR code", "segno", "web") from error
    segno.make(url or code, micro=False).terminal(sys.stdout, compact=True)
    output.say(f"code {code}, for two minutes, once; {url or 'POST /pair on the web port takes it'}")
    return 0


def _rotate(args: argparse.Namespace, path: Path) -> int:
    secret = _new_secret()
    store.change(path, lambda tokens: (tokens.with_secret(args.name, secret, only=True), None))
    output.say(secret)
    return 0


def _revoke(args: argparse.Namespace, path: Path) -> int:
    store.change(path, lambda tokens: (tokens.without(args.name), None))
    return 0


def _new_secret() -> str:
    return new_secret(secrets.token_bytes(SECRET_BYTES))


def _shown(token: Token, now: float) -> dict[str, Any]:
    """What is known of a token, without what would help to guess it."""
    return {
        "name": token.name,
        **msgspec.to_builtins(token.rights),
        "secrets": len(token.hashes),
        "created_at": token.created_at,
        "expires_at": token.expires_at,
        "holds": token.holds(now),
    }


def _line(token: Token, now: float) -> str:
    rights = token.rights

    def named(which: list[int] | str) -> str:
        return which if isinstance(which, str) else ",".join(map(str, which)) or "none"

    parts = [
        token.name,
        ",".join(rights.may) or "nothing",
        f"robots {named(rights.robots)}",
        f"groups {named(rights.groups)}",
        f"topics {' '.join(rights.topics)}",
    ]
    if rights.frames_per_s:
        parts.append(f"{rights.frames_per_s:g} frames/s")
    if not token.holds(now):
        parts.append("has ended")
    elif token.expires_at is not None:
        parts.append(f"ends in {_left(token.expires_at - now)}")
    return "  ".join(parts)


def _left(seconds: float) -> str:
    for unit in ("d", "h", "m"):
        if seconds >= SECONDS[unit]:
            return f"{seconds / SECONDS[unit]:.0f}{unit}"
    return f"{seconds:.0f}s"
