"""What keys say, as types."""

from __future__ import annotations

import typing

import pytest

from macs_zenoh.protocol.keyexpr import KEYS

NUMBERS = {"type", "from_type", "id", "from_id", "group", "block", "from_block"}


@pytest.mark.parametrize("space_name", KEYS)
def test_what_a_key_says_has_the_fields_of_its_template(space_name: str) -> None:
    """Each key space has a type of its own for its fields: these, in this order, numbers where they are numbers."""
    space = KEYS[space_name]
    assert space.read._fields == space.fields
    kinds = typing.get_type_hints(space.read)
    assert kinds == {name: int if name in NUMBERS else str for name in space.fields}
