"""Tokens: what is kept of them, and which are found."""

from __future__ import annotations

import os

import pytest

from macs_zenoh.errors import ConfigError, UsageError
from macs_zenoh.protocol.rights import Rights
from macs_zenoh.protocol.tokens import (
    PAIRING_S,
    PAIRING_TRIES,
    SECRETS_EACH,
    SHOWN_CHARACTERS,
    Token,
    Tokens,
    changed,
    code_of,
    encode,
    hash_of,
    new_pairing,
    new_secret,
    parse,
)


def made(name: str, secret: str, expires_at: float | None = None) -> Token:
    """A token of this secret."""
    return Token(name=name, hashes=[hash_of(secret)], rights=Rights(may=["see"], robots=[1]), expires_at=expires_at)


SECRETS = [new_secret(bytes([number]) * 32) for number in range(3)]


def test_a_token_is_found_by_its_secret_alone() -> None:
    """Found is what was made; not what is wrong, cut off, longer, empty, of another file, or a hash of it."""
    tokens = Tokens().with_token(made("anna", SECRETS[0])).with_token(made("bert", SECRETS[1]))
    assert [found.name for secret in SECRETS[:2] if (found := tokens.find(secret, 0.0))] == ["anna", "bert"]
    secret = SECRETS[0]
    wrong = ["", secret[:-1], secret + "x", secret.upper(), SECRETS[2], hash_of(secret), "anna", "\ud800", "é" * 300]
    assert [tokens.find(each, 0.0) for each in [None, *wrong]] == [None] * (len(wrong) + 1)
    assert Tokens().find(secret, 0.0) is None


def test_a_token_ends_in_its_time() -> None:
    """It holds until its end and no longer."""
    tokens = Tokens().with_token(made("anna", SECRETS[0], expires_at=10.0))
    assert tokens.find(SECRETS[0], 9.9) is not None
    assert tokens.find(SECRETS[0], 10.0) is None


def test_a_secret_is_long_random_and_told_by_its_beginning() -> None:
    """Programs that look for secrets in texts know it, and what is kept of it does not have it."""
    secret = new_secret(os.urandom(32))
    assert secret.startswith("macs_")
    assert len(secret) == 48
    assert len(secret) < SHOWN_CHARACTERS
    assert secret[5:] not in encode(Tokens().with_token(made("anna", secret))).decode()


def test_what_is_written_is_read() -> None:
    """The file gives the same tokens back; anything else in its place is an error with its name."""
    tokens = Tokens().with_token(made("anna", SECRETS[0], 5.0)).with_pairing(new_pairing("anna", "1", b"x" * 32, 0), 0)
    assert parse(encode(tokens), "f") == tokens
    for content in (
        b"",
        b"[]",
        b"{",
        b'{"format":2}',
        b'{"tokens":[{"name":"a b"}]}',
        b'{"tokens":[{"name":"a","hashes":["x"]}]}',
        b'{"tokens":[{"name":"a"},{"name":"a"}]}',
        b'{"tokens":[{"name":"a","rights":{"may":["broadcast"]}}]}',
        b"\xff",
        b"[" * 5000,
    ):
        with pytest.raises(ConfigError, match=r"tokens\.json"):
            parse(content, "tokens.json")


def test_secrets_of_one_token_are_bounded_and_rotate() -> None:
    """Each secret is the token; of many the oldest gives way; after a rotation only the new one is."""
    tokens = Tokens().with_token(made("anna", SECRETS[0]))
    more = [new_secret(bytes([100 + number]) * 32) for number in range(SECRETS_EACH)]
    for secret in more:
        tokens = tokens.with_secret("anna", secret)
    assert len(tokens.named("anna").hashes) == SECRETS_EACH
    assert tokens.find(SECRETS[0], 0.0) is None
    assert all(tokens.find(secret, 0.0) for secret in more)
    rotated = tokens.with_secret("anna", SECRETS[1], only=True)
    assert [bool(rotated.find(secret, 0.0)) for secret in (SECRETS[1], more[-1])] == [True, False]
    assert list(changed(tokens, rotated)) == ["anna"]
    assert list(changed(tokens, tokens)) == []
    for wrong in (tokens.without, lambda name: tokens.with_secret(name, "x"), tokens.named):
        with pytest.raises(UsageError, match="no token called"):
            wrong("bert")
    assert tokens.without("anna").tokens == []


def test_a_pairing_is_good_once_and_for_its_time() -> None:
    """The right code gives a secret, once; not after two minutes."""
    tokens = Tokens().with_token(made("anna", SECRETS[0]))
    tokens = tokens.with_pairing(new_pairing("anna", "123456", b"s" * 32, 0.0), 0.0)
    after, name = tokens.exchange("123456", SECRETS[1], 1.0)
    assert name == "anna"
    assert after.find(SECRETS[1], 1.0) is not None
    assert after.find(SECRETS[0], 1.0) is not None
    assert after.exchange("123456", SECRETS[2], 1.0)[1] is None
    assert tokens.exchange("123456", SECRETS[1], PAIRING_S)[1] is None
    assert tokens.without("anna").pairings == []


def test_a_code_cannot_be_guessed() -> None:
    """Five wrong codes are the end of it, whichever pairing was meant."""
    tokens = Tokens().with_token(made("anna", SECRETS[0])).with_token(made("bert", SECRETS[1]))
    for name, code in (("anna", "123456"), ("bert", "654321")):
        tokens = tokens.with_pairing(new_pairing(name, code, name.encode() * 8, 0.0), 0.0)
    for number in range(PAIRING_TRIES):
        assert tokens.exchange("123456", SECRETS[2], 1.0)[1] == "anna"
        tokens, name = tokens.exchange(code_of(number), SECRETS[2], 1.0)
        assert name is None
    assert tokens.pairings == []
    assert tokens.exchange("123456", SECRETS[2], 1.0)[1] is None
