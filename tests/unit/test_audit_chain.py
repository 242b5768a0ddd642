"""The record's chain: what was changed, removed, put elsewhere or cut off is found, as far as it can be."""

from __future__ import annotations

import pytest

from macs_zenoh.protocol.audit_chain import FAULTS, Kind, Link, Seen, Verifier, last_link, torn_bytes


def record(count: int) -> list[bytes]:
    """Lines as a program writes them."""
    link, lines = Link(), []
    for number in range(count):
        event = "started" if not number else "stopped" if number == count - 1 else "joined"
        line, link = link.line({"program": "gateway", "event": event, "by": {"agent": f"unity/{number}"}})
        lines.append(line)
    return lines


def found(lines: list[bytes], *seen: Seen) -> list[tuple[Kind, int]]:
    verifier = Verifier(seen)
    verifier.read("a", lines)
    return [(finding.kind, finding.line) for finding in verifier.finish()]


def test_what_was_written_is_in_order() -> None:
    """A whole record has no finding, in one file or in several."""
    lines = record(9)
    assert found(lines) == []
    verifier = Verifier()
    for start in (0, 3, 6):
        verifier.read(str(start), lines[start : start + 3])
    assert verifier.finish() == []
    assert verifier.lines == 9


@pytest.mark.parametrize("at", range(8))
def test_a_changed_line_is_found(at: int) -> None:
    """Whatever of a line is changed, the next one does not fit; but for the last line of all."""
    lines = record(9)
    lines[at] = lines[at].replace(b"gateway", b"gatewax")
    assert (Kind.CHANGED, at + 2) in found(lines)
    lines[at] = lines[at].replace(b"}\n", b" }\n")
    assert (Kind.CHANGED, at + 2) in found(lines)


@pytest.mark.parametrize("at", range(1, 8))
def test_a_removed_line_is_found(at: int) -> None:
    """At its place, one or several."""
    lines = record(9)
    assert (Kind.REMOVED, at + 1) in found(lines[:at] + lines[at + 1 :])
    assert (Kind.REMOVED, 2) in found(lines[:1] + lines[at + 1 :])


@pytest.mark.parametrize("at", range(7))
def test_reordered_and_repeated_lines_are_found(at: int) -> None:
    """Two that changed places, and one that is there twice."""
    lines = record(9)
    swapped = [*lines[:at], lines[at + 1], lines[at], *lines[at + 2 :]]
    assert Kind.OUT_OF_ORDER in {kind for kind, _ in found(swapped)}
    assert (Kind.OUT_OF_ORDER, at + 2) in found([*lines[: at + 1], lines[at], *lines[at + 1 :]])


def test_an_invented_line_is_found() -> None:
    """It may have the right number, and the right hash over the line before: the line behind it does not fit."""
    lines = record(5)
    made, _ = last_link(b"".join(lines[:2])).line({"program": "gateway", "event": "joined", "by": {}})  # type: ignore[union-attr]
    assert (Kind.CHANGED, 4) in found([*lines[:2], made, *lines[3:]])
    assert Kind.OUT_OF_ORDER in {kind for kind, _ in found([*lines[:2], made, *lines[2:]])}


def test_foreign_bytes_are_found() -> None:
    """What is no line is told, wherever it is."""
    lines = record(4)
    for junk in (b"hello\n", b"{}\n", b"\n", b"\xff\xfe\n", b"[" * 100_000 + b"\n"):
        assert (Kind.UNREADABLE, 3) in found([*lines[:2], junk, *lines[2:]])


def test_a_cut_end_is_found_by_what_was_seen() -> None:
    """Without that it is only an open end, as of a program that runs; a record made anew is found by it as well."""
    lines = record(9)
    link = last_link(b"".join(lines))
    assert link is not None
    seen = Seen(link.number, link.hash)
    assert found(lines, seen) == []
    assert found(lines[:6]) == [(Kind.OPEN_END, 6)]
    assert (Kind.CUT_OFF, 6) in found(lines[:6], seen)
    assert Kind.CHANGED in {kind for kind, _ in found(record(10)[:9], seen)}


def test_the_traces_of_a_kill_are_no_fault() -> None:
    """Half a line that the next start has told of, and a start without a stop before."""
    lines = record(4)[:3]
    link = last_link(b"".join(lines))
    assert link is not None
    half = lines[1][:20]
    line, link = link.line({"program": "gateway", "event": "started", "torn": len(half)})
    last, _ = link.line({"program": "gateway", "event": "stopped", "lost": 7})
    kinds = found([*lines, half + b"\n", line, last])
    assert kinds == [(Kind.TORN, 4), (Kind.KILLED, 5), (Kind.LOST, 6)]
    assert not {kind for kind, _ in kinds} & FAULTS
    assert torn_bytes(b"".join(lines) + half) == 20
    assert found([*lines, half])[0] == (Kind.TORN, 4)
    assert (Kind.UNREADABLE, 4) in found([*lines, half + b"!\n", line, last])


def test_a_chain_that_begins_late_is_told() -> None:
    """Older files are removed by the settings: that is no fault."""
    assert found(record(9)[4:]) == [(Kind.BEGINS_LATE, 1)]


@pytest.mark.parametrize("number", ["9" * 4299, "-1", "1e3", "true", str(1 << 53)])
def test_numbers_that_no_chain_comes_to_are_no_line(number: str) -> None:
    """Whoever writes one into the file neither ends who verifies, nor who goes on writing behind it."""
    line = b'{"n":%s,"previous":""}\n' % number.encode()
    assert last_link(line) is None
    assert (Kind.UNREADABLE, 2) in found([record(2)[0], line, record(2)[1]])
