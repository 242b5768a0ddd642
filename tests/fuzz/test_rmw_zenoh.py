"""What others put on a robot's router, changed at random: the fuzz target runs, finds what is planted, and on a real
router each of a thousand is counted."""

from __future__ import annotations

import asyncio
import random

import pytest
import zenoh

from macs_zenoh import ros
from macs_zenoh.protocol.rmw_zenoh.attachment import encode_attachment, parse_attachment
from macs_zenoh.protocol.rmw_zenoh.keyexpr import BadToken, parse_token
from tests.fuzz import rmw_zenoh
from tests.support.waiting import PATIENCE_S, until

DOMAIN = 50
TEXT = b"\0\1\0\0\3\0\0\0hi\0"


@pytest.mark.parametrize("seed", range(4))
def test_a_short_run_finds_nothing(seed: int) -> None:
    """A thousand inputs of each run are read, or refused by name."""
    assert rmw_zenoh.run(seed, rounds=1000) == 1000


def test_a_planted_bug_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """An exception that nobody expects ends the run with the input that caused it."""

    def fail(text: str) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr(rmw_zenoh, "parse_token", fail)
    found = rmw_zenoh.run(0, rounds=100)
    assert isinstance(found, rmw_zenoh.Found)
    assert isinstance(found.problem, ZeroDivisionError)


async def test_each_of_a_thousand_is_counted(router: str) -> None:
    """Tokens and attachments that are none, beside a node of ours: it counts each, and still hears what is right."""
    pytest.importorskip("xxhash", reason="being a ROS node needs xxhash: pip install 'macs-zenoh[rmw-zenoh]'")
    chance = random.Random(20)
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", f'["{router}"]')
    session = await asyncio.to_thread(zenoh.open, config)
    try:
        async with ros.node("listener", domain=DOMAIN, connect=[router]) as node:
            heard = node.subscribe("/orders", "std_msgs/String")
            key = heard._made.endpoint.key
            right = encode_attachment(1, 1, bytes(16))

            def comes() -> bool:
                session.put(key, TEXT, attachment=right)
                return bool(heard._waiting)

            await until(comes, PATIENCE_S, every_s=0.05)
            bad_tokens = set()
            while len(bad_tokens) < 500:
                text = rmw_zenoh.mutated(chance, chance.choice(rmw_zenoh.TOKENS))
                if text.startswith(f"@ros2_lv/{DOMAIN}/") and is_key(text) and is_bad(text):
                    bad_tokens.add(text)
            declared = [session.liveliness().declare_token(text) for text in bad_tokens]
            bad = 0
            while bad < 500:
                attached = rmw_zenoh.changed(chance, chance.choice(rmw_zenoh.ATTACHMENTS))
                if parse_attachment(attached) is None:
                    bad += 1
                    session.put(key, TEXT, attachment=attached, congestion_control=zenoh.CongestionControl.BLOCK)
            await until(lambda: node.drops["bad_attachment"] >= bad, PATIENCE_S)
            await until(lambda: node.drops["bad_token"] >= len(bad_tokens), PATIENCE_S)
            assert (node.drops["bad_attachment"], node.drops["bad_token"]) == (bad, len(bad_tokens))
            heard._waiting.clear()
            await until(comes, PATIENCE_S, every_s=0.05)
            for token in declared:
                token.undeclare()
    finally:
        await asyncio.to_thread(session.close)


def is_key(text: str) -> bool:
    """Whether Zenoh has such a key."""
    try:
        zenoh.KeyExpr(text)
    except zenoh.ZError:
        return False
    return "*" not in text


def is_bad(text: str) -> bool:
    """Whether it is no token."""
    try:
        parse_token(text)
    except BadToken:
        return True
    return False
