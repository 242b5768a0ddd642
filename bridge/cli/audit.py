"""Verify the record that gateways and robots keep with audit_file: who did what.

Each line carries a hash over the one before, so a line that was changed, removed or moved is found. Older files of the
same record, beside FILE, are verified with it. Two things the files alone cannot show: that lines were cut off at the
end, and that the whole record was written anew. For these, keep what `macs audit head` prints now and then in another
place, and compare the record with it: --seen.

Exit code 0: nothing is wrong; 1: something is, or a file cannot be read; 2: wrong usage.

examples:
  macs audit verify /var/log/macs/audit.jsonl
  macs audit head /var/log/macs/audit.jsonl
  macs audit verify <(ssh robot cat /var/log/macs/audit.jsonl)
  macs audit verify /var/log/macs/audit.jsonl --seen 1234:9f86d081884c7d65…

what it prints:
  audit.jsonl, line 18: removed: line 17 should be before this one, which is number 18
  52 lines, the last is number 52"""

from __future__ import annotations

import argparse
from pathlib import Path

from bridge.audit.writer import older_files
from bridge.cli import output
from macs_zenoh.errors import ConfigError, UsageError
from macs_zenoh.plain import plain
from macs_zenoh.protocol.audit_chain import Seen, Verifier

SUMMARY = "verify the record of who did what"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    kinds = parser.add_subparsers(dest="audit_verb", metavar="VERB", required=True, title="verbs")
    for name, about in (
        ("verify", "find what was changed or is missing"),
        ("head", "the number and hash of the last line"),
    ):
        verb = kinds.add_parser(name, help=about, description=about)
        verb.add_argument(
            "files", nargs="+", type=Path, metavar="FILE", help="the record; older files are found beside it"
        )
        if name == "verify":
            verb.add_argument("--seen", action="append", default=[], type=_seen, metavar="N:HASH", help="from `head`")
            verb.add_argument("--json", action="store_true", help="for programs: one object")


def _seen(text: str) -> Seen:
    number, _, hashed = text.partition(":")
    if not number.isdecimal() or len(hashed) != 64:
        raise argparse.ArgumentTypeError(f"{text} is not N:HASH as `macs audit head` prints it")
    return Seen(int(number), hashed)


def run(args: argparse.Namespace) -> int:
    verifier = Verifier(args.seen if args.audit_verb == "verify" else ())
    for path in _all(args.files):
        try:
            if not path.is_file() and path.exists() and not _is_given(path):  # a FIFO: one would wait
                raise ConfigError(str(path), "is no file")
            with path.open("rb") as file:
                verifier.read(str(path), file)
        except OSError as error:
            raise ConfigError(str(path), error.strerror or str(error)) from error
    if args.audit_verb == "head":
        if not verifier.lines:
            raise UsageError("there is no line")
        output.say(str(verifier.link))
        return 0
    findings = verifier.finish()
    wrong = any(finding.is_fault for finding in findings)
    if args.json:
        told = [
            {"kind": each.kind.value, "fault": each.is_fault, "file": each.file, "line": each.line, "text": each.text}
            for each in findings
        ]
        output.say(
            output.as_json({"lines": verifier.lines, "head": str(verifier.link), "wrong": wrong, "findings": told})
        )
        return int(wrong)
    for each in findings:
        output.say(plain(f"{each.file}, line {each.line}: {each.kind.value}: {each.text}"))
    output.say(f"{verifier.lines} lines, the last is number {verifier.link.number}")
    return int(wrong)


def _is_given(path: Path) -> bool:
    """Whether it is open already, as a shell gives it: ``/dev/stdin``, or ``<(ssh host cat audit.jsonl)``."""
    return path == Path("/dev/stdin") or path.parent in (Path("/dev/fd"), Path("/proc/self/fd"))


def _all(named: list[Path]) -> list[Path]:
    """The files in their order, each once, with those that a record was in before."""
    found: dict[Path, None] = {}
    for path in named:
        for each in (*older_files(path), path):
            found.setdefault(each)
    return list(found)
