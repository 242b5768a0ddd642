"""Make a mesh secure from a policy, and prove that it is.

`generate` reads a policy (YAML: who exists, who may command, see, call or message whom) and writes a directory for
each node: its certificate and key, a router's whole configuration, a client's settings. Run again, it keeps what is
good, renews certificates with less than a third of their life left, and names what is no longer in the policy.

`check` proves by trying, against running routers, that each may do what the policy says and nothing else.
docs/security.md has the policy's fields and what to do when something is stolen.

`headset` prints how a headset's browser reaches the page /xr so that it gives it WebXR: addresses, a certificate for
the web port, and what to do on the headset (docs/webxr.md).

examples:
  macs security generate site.yaml --into pki
  macs security generate site.yaml --into pki --at /etc/macs       where the files will be on their machines
  macs security generate site.yaml --into pki --renew robot-7
  macs security check site.yaml --dir pki
  macs security check site.yaml --dir pki -e tls/10.0.0.5:7447 --json
  macs security headset --into page-pki

what it prints:
  robot-7: certificate made, new, until 2027-02-26                                   of generate
  ../pki: 5 certificates made, 0 kept, 18 files written; the first certificate ends on 2027-02-26
  WRONG tls/10.0.0.5:7447: robot-9 commands robot-7: forbidden, permitted seen       of check
  212 attempts, 211 as expected, 1 not"""

from __future__ import annotations

import argparse
import json
import logging
from pathlib import Path
from typing import TYPE_CHECKING

from bridge.cli import headset_ways, output, running, terminal
from bridge.cli.terminal import BAD, Block

if TYPE_CHECKING:
    from bridge.security.attempts import Result
    from bridge.security.generate import Report

SUMMARY = "certificates and access rules from a policy"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    verbs = parser.add_subparsers(dest="what", metavar="VERB", required=True, title="verbs")
    generate = verbs.add_parser(
        "generate", help="write certificates, rules and settings", description=_generate.__doc__
    )
    generate.add_argument("policy", metavar="POLICY", help="the policy (YAML), as config/security/site.yaml")
    generate.add_argument("--into", required=True, metavar="DIR", help="directory for everything, with the authority")
    generate.add_argument(
        "--at", metavar="PATH", help="where nodes' directories will be on their machines, as /etc/macs"
    )
    generate.add_argument(
        "--renew", metavar="NAME", action="append", default=[], help="make this certificate anew; `all`; repeat"
    )
    generate.add_argument("--new-ca", action="store_true", help="a new authority: all certificates so far end")
    generate.add_argument("--json", action="store_true", help="for programs")
    headset = verbs.add_parser(
        "headset", help="how a headset's browser reaches /xr", description=headset_ways.run.__doc__
    )
    headset_ways.add_arguments(headset)
    check = verbs.add_parser("check", help="try everything on running routers", description=_check.__doc__)
    check.add_argument("policy", metavar="POLICY", help="the policy (YAML)")
    check.add_argument("--dir", required=True, metavar="DIR", help="what `generate` wrote")
    check.add_argument(
        "-e", "--connect", metavar="ENDPOINT", action="append", help="routers to try; default: those of the policy"
    )
    check.add_argument("--json", action="store_true", help="for programs: every attempt, expected and seen")
    check.add_argument("--all", action="store_true", help="show what is as expected as well")
    check.add_argument(
        "--timeout", type=float, default=5.0, metavar="S", help="how long to wait for a router (default: 5)"
    )


def run(args: argparse.Namespace) -> int:
    if args.what == "headset":
        return headset_ways.run(args)
    return _generate(args) if args.what == "generate" else _check(args)


def _generate(args: argparse.Namespace) -> int:
    """Write what follows from a policy. Exit code 2: the policy or the directory cannot be used."""
    import datetime as dt

    from bridge.security import policy
    from bridge.security.generate import generate

    report = generate(
        policy.load(args.policy),
        Path(args.into),
        dt.datetime.now(dt.timezone.utc),
        at=args.at,
        renew=args.renew,
        new_authority=args.new_ca,
    )
    output.say(_as_json(report) if args.json else _as_text(report))
    return 0


def _as_text(report: Report) -> str:
    made = [one for one in report.issued if one.why]
    kept = len(report.issued) - len(made)
    first = min(one.until for one in report.issued)
    lines = []
    if report.authority.why:
        lines.append(f"authority: {report.authority.why}, until {report.authority.until:%Y-%m-%d}")
    lines += [f"{one.name}: certificate made, {one.why}, until {one.until:%Y-%m-%d}" for one in made]
    for name, until in report.orphaned:
        lines.append(
            f"{name}: not in the policy any more. Its certificate lasts until {until:%Y-%m-%d} and is good for nothing"
            " as soon as the routers run with these files"
        )
    if report.routers_changed:
        lines.append(f"start again: {', '.join(report.routers_changed)}")
    lines.append(
        f"{report.into}: {len(made)} certificates made, {kept} kept, {len(report.written)} files written;"
        f" the first certificate ends on {first:%Y-%m-%d}"
    )
    return "\n".join(lines)


def _as_json(report: Report) -> str:
    return json.dumps(
        {
            "into": str(report.into),
            "authority": {"made": report.authority.why, "until": report.authority.until.isoformat()},
            "certificates": [
                {"name": one.name, "made": one.why, "until": one.until.isoformat()} for one in report.issued
            ],
            "written": [str(path) for path in report.written],
            "restart": report.routers_changed,
            "orphaned": [{"name": name, "until": until.isoformat()} for name, until in report.orphaned],
        }
    )


def _check(args: argparse.Namespace) -> int:
    """Try what each node may and may not, with its own certificate, on routers that run.

    Exit code 0: everything is as expected; 1: something is not, or a router does not answer; 2: the policy or the
    directory cannot be used; 130 after Ctrl-C.
    """
    from bridge.security import policy
    from bridge.security.check import check

    read = policy.load(args.policy)
    if not args.verbose:
        logging.getLogger("macs.mesh").setLevel(logging.WARNING)  # of each of many sessions

    async def work() -> int:
        with terminal.progress() as tell:
            results = await check(
                read,
                Path(args.dir),
                args.connect,
                timeout_s=args.timeout,
                progress=lambda done, of: tell("attempts", done, of),
            )
        wrong = [result for result in results if not result.as_expected]
        if args.json:
            output.say(json.dumps([result.as_dict() for result in results]))
        else:
            terminal.show(*(_line(result) for result in (results if args.all else wrong)))
            output.say(f"{len(results)} attempts, {len(results) - len(wrong)} as expected, {len(wrong)} not")
        return 1 if wrong or not results else 0

    return running.until_stopped(work, interrupted=running.INTERRUPTED)


def _line(result: Result) -> Block:
    verdict = "ok   " if result.as_expected else "WRONG"
    expected = "permitted" if result.permitted else "forbidden"
    seen = "permitted" if result.seen else "forbidden"
    key = f" ({result.key})" if result.key else ""
    line = f"{verdict} {result.router}: {result.what}: {expected}, {seen} seen{key}"
    return line if result.as_expected else (line, BAD)
