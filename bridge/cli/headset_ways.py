"""``macs security headset``: what to do so that a headset's browser shows `/xr` in VR."""

from __future__ import annotations

import argparse
import datetime as dt
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from bridge.cli import output
from macs_zenoh.errors import MissingExtra, UsageError

if TYPE_CHECKING:
    from bridge.security.headset_ways import Way

USUAL_DAYS = 365


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--port", type=int, default=7080, metavar="PORT", help="the web port (default: 7080)")
    parser.add_argument(
        "--into", metavar="DIR", help="have a certificate for the web port here, of an authority of its own"
    )
    parser.add_argument(
        "--address",
        action="append",
        default=[],
        metavar="HOST",
        help="an address or name of this machine; repeat (default: those that it has)",
    )
    parser.add_argument(
        "--days",
        type=int,
        default=USUAL_DAYS,
        metavar="N",
        help=f"how long it holds, 1 to 825 (default: {USUAL_DAYS})",
    )
    parser.add_argument("--no-qr", action="store_true", help="without the picture of the address")
    parser.add_argument("--json", action="store_true", help="for programs")


def run(args: argparse.Namespace) -> int:
    """Print how a headset's browser reaches the web port of a gateway here, so that it gives the page WebXR.

    A browser does so only in a secure context: over HTTPS with a certificate that it trusts, or from localhost.
    With --into there is a certificate for all addresses and names of this machine, made anew when these change or less
    than a third of its time is left. Exit code 2: the directory cannot be used.
    """
    from bridge.security.headset_ways import MOST_DAYS, certify, own_addresses, own_names, ways

    if not 1 <= args.days <= MOST_DAYS:
        raise UsageError(f"--days {args.days}: 1 to {MOST_DAYS}")
    if not 1 <= args.port <= 0xFFFF:
        raise UsageError(f"--port {args.port}: 1 to 65535")
    hosts = args.address or [*own_addresses(), *own_names()]
    into = Path(args.into) if args.into else None
    if into is not None:
        why = certify(into, hosts, args.days, dt.datetime.now(dt.timezone.utc))
        if why and not args.json:
            output.say(f"{into / 'page'}: certificate made, {why}, for {', '.join(hosts)}")
    found = ways(hosts, args.port, into / "ca.crt" if into is not None else None)
    gateway = _gateway(args.port, into, args.address)
    if args.json:
        shown = [{"kind": way.kind, "url": way.url, "secure": way.secure, "steps": way.steps} for way in found]
        authority = str(into / "ca.crt") if into is not None else None
        output.say(output.as_json({"gateway": gateway, "authority": authority, "ways": shown}))
        return 0
    output.say(f"the gateway: {gateway}")
    _show(found, qr=not args.no_qr)
    return 0


def _gateway(port: int, into: Path | None, names: list[str]) -> str:
    command = f"macs gateway --web-port {port}"
    if into is None:
        return f"{command} --web-host 127.0.0.1"
    command += f" --host 0.0.0.0 --certificate {into / 'page' / 'cert.pem'} --key {into / 'page' / 'key.pem'}"
    own = [name for name in names if not name.replace(".", "").isdigit() and ":" not in name]
    return command + (f", and in its settings web_names = {own}" if own else "")


def _show(found: list[Way], *, qr: bool) -> None:
    said: set[str] = set()
    for way in found:
        output.say(f"\n{way.kind}: {way.url}" + ("" if way.secure else "   NOT SECURE"))
        for step in way.steps:
            if step not in said:
                output.say(f"  {step}")
        said.update(way.steps)
    best = next((way for way in found if way.kind == "https"), None)
    if qr and best is not None:
        try:
            import segno
        except ModuleNotFoundError as error:
            raise MissingExtra("a QR code", "segno", "web") from error
        output.say("")
        segno.make(best.url, micro=False).terminal(sys.stdout, compact=True)
        output.say(best.url)
    output.say(
        "\na token for it: macs token create NAME --may see,command,stop; macs token show NAME --qr --url ADDRESS"
    )
