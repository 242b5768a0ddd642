"""Tokens of a policy's headsets: what is made, and what stays when it is made again."""

from __future__ import annotations

import datetime as dt
import stat
from pathlib import Path

import pytest

from bridge.security import policy
from bridge.security.generate import generate
from bridge.tokens import store
from macs_zenoh.errors import ConfigError

NOW = dt.datetime(2026, 3, 1, tzinfo=dt.timezone.utc)

TEXT = """
routers: [{name: site, addresses: [site.example.org]}]
robots: [{name: robot-7, id: 7, group: 3}, {name: robot-8, id: 8}]
gateways: [{name: hall-1}, {name: hall-2}]
headsets:
  - {name: anna, gateways: [hall-1], may: [see, stop], robots: [robot-7], groups: [3], topics: [/camera/**], days: 30}
  - {name: bert, may: [see], robots: any}
permissions: [{who: all, may: all, whom: all}]
"""


def made(into: Path, text: str = TEXT, now: dt.datetime = NOW, **options: object) -> set[str]:
    """Which files were written."""
    report = generate(policy.parse(text), into, now, **options)  # type: ignore[arg-type]
    return {str(path.relative_to(into)) for path in report.written}


def test_each_gateway_has_the_tokens_of_its_headsets(tmp_path: Path) -> None:
    """With their rights, by robots' names; the secret is in the headset's own directory and nowhere else."""
    made(tmp_path, at="/etc/macs")
    hall_1, hall_2 = (store.read(tmp_path / name / "tokens.json") for name in ("hall-1", "hall-2"))
    assert [token.name for token in hall_1.tokens] == ["anna", "bert"]
    assert [token.name for token in hall_2.tokens] == ["bert"]
    anna = hall_1.named("anna")
    assert (anna.rights.may, anna.rights.robots, anna.rights.groups) == (["see", "stop"], [7], [3])
    assert anna.rights.topics == ["/camera/**"]
    assert anna.expires_at == NOW.timestamp() + 30 * 86_400
    secret = (tmp_path / "anna" / "token").read_text().strip()
    assert hall_1.find(secret, NOW.timestamp()) == anna
    assert hall_2.find(secret, NOW.timestamp()) is None
    assert stat.S_IMODE((tmp_path / "anna" / "token").stat().st_mode) == 0o600
    assert not any(secret in path.read_text() for path in tmp_path.glob("hall-*/*"))
    assert 'tokens_file = "/etc/macs/hall-1/tokens.json"' in (tmp_path / "hall-1" / "macs.toml").read_text()


def test_made_again_nothing_changes_that_need_not(tmp_path: Path) -> None:
    """Secrets stay, and so does the end of a token until less than a third is left; one that is renewed has another
    secret, one that is taken out is in no file."""
    made(tmp_path)
    secret = (tmp_path / "anna" / "token").read_text()
    assert made(tmp_path, now=NOW + dt.timedelta(days=15)) == set()
    assert "hall-1/tokens.json" in made(tmp_path, now=NOW + dt.timedelta(days=25))
    assert store.read(tmp_path / "hall-1" / "tokens.json").named("anna").expires_at == NOW.timestamp() + 55 * 86_400
    assert (tmp_path / "anna" / "token").read_text() == secret
    made(tmp_path, renew=["anna"])
    assert (tmp_path / "anna" / "token").read_text() != secret
    made(tmp_path, "\n".join(line for line in TEXT.splitlines() if "name: anna" not in line))
    assert [token.name for token in store.read(tmp_path / "hall-1" / "tokens.json").tokens] == ["bert"]


@pytest.mark.parametrize(
    ("of_anna", "problem"),
    [
        ("robots: [robot-9]", "did you mean"),
        ("gateways: [hall-3]", "did you mean"),
        ("may: [fly]", "fly"),
        ("may: [broadcast]", "robots any"),
        ("topics: [a//b]", "topics"),
    ],
)
def test_a_headset_that_cannot_be_is_refused(tmp_path: Path, of_anna: str, problem: str) -> None:
    """Before anything is written."""
    anna = next(line for line in TEXT.splitlines() if "name: anna" in line)
    with pytest.raises(ConfigError, match=problem):
        made(tmp_path / "pki", TEXT.replace(anna, f"  - {{name: anna, {of_anna}}}"))
    assert not (tmp_path / "pki").exists()
