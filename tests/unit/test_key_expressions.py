"""Key expressions that people write, judged without Zenoh as Zenoh judges them."""

from __future__ import annotations

import pytest
import zenoh
from hypothesis import given, settings
from hypothesis import strategies as st

from macs_zenoh.protocol import key_expressions
from macs_zenoh.protocol.key_expressions import expression_problem, fits
from tests.support.thorough import examples

expressions = st.text("ab@*$/?#", max_size=9) | st.lists(
    st.sampled_from(["*", "**", "a", "b", "ab", "@a", "a$*", "$*b", "a$*b", "$*", "@$*", "@a$*"]),
    min_size=1,
    max_size=5,
).map("/".join)
"""What may be a key expression or not, wildcards and all."""

keys = st.lists(st.sampled_from(["a", "b", "ab", "aab", "@a", "@ab", "@"]), min_size=1, max_size=5).map("/".join)


@settings(max_examples=examples(500), deadline=None)
@given(text=expressions)
def test_what_zenoh_takes_for_an_expression_is_known_without_it(text: str) -> None:
    """Whatever is not a key expression in canonical form to Zenoh is refused with a reason, and nothing else is."""
    try:
        zenoh.KeyExpr(text)
    except zenoh.ZError:
        assert expression_problem(text)
    else:
        assert expression_problem(text) is None


@settings(max_examples=examples(1000), deadline=None)
@given(text=expressions.filter(lambda text: expression_problem(text) is None), key=keys)
def test_a_key_fits_an_expression_as_zenoh_says(text: str, key: str) -> None:
    """A key is among those of an expression exactly if it is to Zenoh, with all its wildcards and verbatim chunks."""
    among = zenoh.KeyExpr(text).intersects(zenoh.KeyExpr(key))
    assert fits(text, key) == among == zenoh.KeyExpr(text).includes(zenoh.KeyExpr(key))


def test_many_wildcards_cost_little() -> None:
    """Judging a long key by an expression of many wildcards ends: it tries no combinations."""
    assert not fits("/".join(["**", "a"] * 30), "/".join(["a"] * 300 + ["b"]))


def test_expressions_that_another_one_covers_are_left_out() -> None:
    """Each once, in their order; what is verbatim is covered by no wildcard."""
    keys = ["macs/all/**", "macs/all/ros/7", "macs/all/**", "macs/all/@adv/**", "macs/group/3/ros"]
    assert key_expressions.distinct(keys) == ("macs/all/**", "macs/all/@adv/**", "macs/group/3/ros")


@pytest.mark.parametrize(
    ("expression", "begins"),
    [("macs/from/ros/*/n", "macs/from"), ("macs/**", None), ("macs", None), ("macs/f$*/x", None)],
)
def test_how_an_expression_begins(expression: str, begins: str | None) -> None:
    """Two chunks, where they have no wildcards."""
    assert key_expressions.begins(expression) == begins
