"""The events of a record that docs/audit.md lists."""

from __future__ import annotations

import re

from tests.support.processes import ROOT


def events_of(*writers: str) -> set[str]:
    """Those that these write, as the page says."""
    text = (ROOT / "docs" / "audit.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (`[a-z_`, ]+`) \| (gateway|robot|both) \|", text, re.MULTILINE)
    assert len(rows) > 8
    return {event for names, writer in rows if writer in writers for event in re.findall(r"`(\w+)`", names)}
