"""Keys: what is built is parsed again, means to Zenoh what it means to us, and carries nothing it must not."""

from __future__ import annotations

import itertools
import re

import pytest
import zenoh
from hypothesis import given, settings
from hypothesis import strategies as st

from macs_zenoh.errors import UsageError
from macs_zenoh.protocol import keyexpr
from macs_zenoh.protocol.key_expressions import fits
from macs_zenoh.protocol.key_fields import StreamFields
from macs_zenoh.protocol.keyexpr import (
    CALL,
    GROUP,
    KEYS,
    PRESENCE,
    STREAM,
    UNICAST,
    Key,
    block_of,
    type_name,
    type_number,
)
from macs_zenoh.protocol.limits import KEY_BYTES
from tests.support.thorough import examples

FORBIDDEN = "/*$?#%"
"""Characters that Zenoh gives a meaning to, and the one that escapes them."""

by_space = pytest.mark.parametrize("space_name", KEYS)

texts = st.text(st.characters(exclude_categories=["Cs"]), min_size=1, max_size=12) | st.text(
    FORBIDDEN + "@~. aé\0\n", min_size=1, max_size=6
)
NUMBERS: dict[str, st.SearchStrategy[int | str]] = {
    "type": st.integers(1, 255),
    "from_type": st.integers(1, 255),
    "id": st.integers(1, 0xFFFF),
    "from_id": st.integers(1, 0xFFFF),
    "group": st.integers(0, 255),
    "block": st.integers(0, 255),
    "from_block": st.integers(0, 255),
}
"""Fields that are numbers; all others are text."""


def fields_of(space: Key) -> st.SearchStrategy[dict[str, int | str]]:
    """Any fields of a key space; a block is that of the id."""
    any_fields = st.fixed_dictionaries({name: NUMBERS.get(name, texts) for name in space.fields})
    in_blocks = {"block", "id"} <= set(space.fields)
    return any_fields.map(lambda fields: {**fields, "block": block_of(int(fields["id"]))} if in_blocks else fields)


# -- what Zenoh would not survive ------------------------------------------------------------------------------------


@by_space
def test_a_key_is_never_longer_than_zenoh_can_write(space_name: str) -> None:
    """Texts of any length make a key of less than 64 KiB, or are refused; so does what is subscribed to."""
    space = KEYS[space_name]
    for text in (
        "x" * 200,
        "\U0001f916" * 200,
        "\U0001f916" * 255,
        "x" * 3061,
        "x" * 70_000,
        "\n" * 100_000,
        "é" * 40_000,
    ):
        fields: dict[str, int | str] = {name: 1 if name in NUMBERS else text for name in space.fields}
        fields |= {"block": 0} if "block" in fields and "id" in fields else {}
        for make in (space.of, space.every):
            try:
                key = make(**fields)
            except UsageError:
                assert len(text) > 255
            else:
                assert len(key.encode()) <= KEY_BYTES < 0xFFFF
                zenoh.KeyExpr(key)


@by_space
def test_longer_keys_are_nobodys(space_name: str) -> None:
    """What others put on a key of 60 000 characters is not looked at."""
    space = KEYS[space_name]
    assert space.parse(re.sub("{.*?}", "7" * 20_000, space.template)) is None


# -- there and back --------------------------------------------------------------------------------------------------


@by_space
@given(data=st.data())
def test_a_key_is_parsed_into_what_it_was_built_of(space_name: str, data: st.DataObject) -> None:
    """`parse` of `of` is the identity in every key space, and no other space takes the key for its own."""
    fields = data.draw(fields_of(KEYS[space_name]))
    key = KEYS[space_name].of(**fields)
    parsed = KEYS[space_name].parse(key)
    assert parsed is not None
    assert parsed._asdict() == fields
    assert keyexpr.parse(key) == (space_name, parsed)


@by_space
@given(data=st.data())
def test_zenoh_takes_a_key_as_it_is(space_name: str, data: st.DataObject) -> None:
    """Every key is a canonical key expression that names exactly one key, whatever its fields contain."""
    space = KEYS[space_name]
    key = space.of(**data.draw(fields_of(space)))
    assert str(zenoh.KeyExpr(key)) == str(zenoh.KeyExpr.autocanonize(key)) == key
    assert key.count("/") == space.template.count("/")
    assert not set("*$?#") & set(key)
    assert key.isascii()
    assert key.isprintable()


@by_space
@settings(max_examples=examples(40))
@given(data=st.data())
def test_every_includes_of(space_name: str, data: st.DataObject) -> None:
    """The expression for some fields includes each key with these fields, and none that differs in one of them."""
    space = KEYS[space_name]
    fields = data.draw(fields_of(space))
    key = zenoh.KeyExpr(space.of(**fields))
    for count in range(len(fields) + 1):
        for names in itertools.combinations(fields, count):
            expression = zenoh.KeyExpr(space.every(**{name: fields[name] for name in names}))
            assert expression.includes(key)
            assert str(zenoh.KeyExpr.autocanonize(str(expression))) == str(expression)
    for name in fields:
        other = data.draw(NUMBERS.get(name, texts).filter(lambda value, name=name: value != fields[name]))
        assert not zenoh.KeyExpr(space.every(**{name: other})).intersects(key)


@pytest.mark.parametrize(("one", "other"), list(itertools.combinations(KEYS, 2)))
def test_the_key_spaces_are_disjoint(one: str, other: str) -> None:
    """No key is in two spaces, so nobody receives a sample twice for having subscriptions in both."""
    assert not zenoh.KeyExpr(KEYS[one].every()).intersects(zenoh.KeyExpr(KEYS[other].every()))


def test_a_tail_that_is_not_given_is_one_wildcard() -> None:
    """Fields missing at the end become `**`, those missing before a given one become `*`."""
    assert UNICAST.every(type=1, id=7) == "macs/to/ros/0/7/**"
    assert UNICAST.every(id=7) == "macs/to/*/0/7/**"
    assert CALL.every(id=7) == "macs/call/*/7/**"
    assert STREAM.every(node="nd_x") == "macs/from/*/*/nd_x"
    assert GROUP.every() == "macs/group/**"


# -- characters ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("character", [*FORBIDDEN, "\0", "\n", "\x7f", "é", "\U0001f916", "**", "$*", "//", "%2F"])
@pytest.mark.parametrize("place", ["{}", "a{}", "{}b", "a{}b"])
def test_forbidden_characters_never_reach_a_key(character: str, place: str) -> None:
    """A character with a meaning to Zenoh is escaped wherever it stands in a chunk, and comes back."""
    node = place.format(character)
    key = STREAM.of(type=1, id=7, node=node)
    chunk = key.removeprefix("macs/from/ros/7/")
    assert not set(chunk) & set("/*$?#\0\n\x7fé")
    assert STREAM.parse(key) == StreamFields(type=1, id=7, node=node)
    assert STREAM.every(type=1, node=node) == f"macs/from/ros/*/{chunk}"


@pytest.mark.parametrize("node", ["@", "@adminspace", "@@", "a@b"])
def test_a_chunk_hides_from_no_wildcard(node: str) -> None:
    """A name that starts with @, which Zenoh hides from wildcards, is heard by who listens to all names."""
    key = zenoh.KeyExpr(STREAM.of(type=1, id=7, node=node))
    assert zenoh.KeyExpr(STREAM.every(type=1, id=7)).includes(key)


@pytest.mark.parametrize("values", [{"node": ""}, {"node": "x", "id": -1}, {"node": "x", "id": "7"}, {"type": "car"}])
def test_what_cannot_be_written_is_refused(values: dict[str, int | str]) -> None:
    """An empty chunk, a negative or textual number and an unknown type raise UsageError."""
    fields: dict[str, int | str] = {"type": 1, "id": 7, "node": "x", **values}
    with pytest.raises(UsageError):
        STREAM.of(**fields)


@pytest.mark.parametrize(
    "values",
    [
        {"type": 0},
        {"type": 256},
        {"type": -1},
        {"id": 65536},
        {"id": True},
        {"block": 256},
        {"node": "\ud800"},
    ],
)
def test_what_the_table_does_not_allow_is_refused(values: dict[str, int | str]) -> None:
    """A number outside the ranges of keyexpr_map.md, or text that is no Unicode, raises UsageError."""
    space = UNICAST if "block" in values else STREAM
    fields: dict[str, int | str] = {
        "type": 1,
        "id": 7,
        "node": "x",
        "block": 0,
        "from_type": 2,
        "from_id": 8,
        **values,
    }
    with pytest.raises(UsageError):
        space.of(**{name: fields[name] for name in space.fields})


def test_fields_must_be_those_of_the_space() -> None:
    """A field that is missing, or that the space does not have, raises UsageError that names it."""
    with pytest.raises(UsageError, match="node"):
        STREAM.of(type=1, id=7)
    with pytest.raises(UsageError, match="verb"):
        STREAM.of(type=1, id=7, node="x", verb="y")
    with pytest.raises(UsageError, match="verb"):
        STREAM.every(verb="y")


# -- keys of others --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "key",
    [
        "",
        "macs",
        "macs/from",
        "macs/from/ros/7",
        "macs/from/ros/7/",
        "macs/from/ros/7/nd_x/more",
        "macs/from/ros//nd_x",
        "/macs/from/ros/7/nd_x",
        "site1/macs/from/ros/7/nd_x",
        "MACS/from/ros/7/nd_x",
        "macs/from/car/7/nd_x",
        "macs/from/ROS/7/nd_x",
        "macs/from/0/7/nd_x",
        "macs/from/256/7/nd_x",
        "macs/from/ros/seven/nd_x",
        "macs/from/ros/-7/nd_x",
        "macs/from/ros/+7/nd_x",
        "macs/from/ros/7.0/nd_x",
        "macs/from/ros/٧/nd_x",  # noqa: RUF001 - a digit, but not one of ours
        "macs/from/ros/" + "7" * 5000 + "/nd_x",
        "macs/from/*/7/nd_x",
        "macs/from/ros/7/*",
        "macs/from/ros/7/**",
        "macs/from/ros/7/nd_x\n/",
    ],
)
def test_a_key_that_is_not_ours_is_none(key: str) -> None:
    """Wildcards, other spaces, wrong depths and numbers that are none give None, never an error."""
    assert STREAM.parse(key) is None
    assert keyexpr.parse(key) is None


@pytest.mark.parametrize(
    "key",
    ["macs/from/1/7/x", "macs/from/ros/007/x", "macs/from/03/7/x", "macs/from/ros/65536/x", "macs/from/ros/7/%6e"],
)
def test_a_key_that_we_would_write_otherwise_is_none(key: str) -> None:
    """Only the one way to write an agent is read, so access rules for `ros/7` cover all that is taken for it."""
    assert STREAM.parse(key) is None


@given(st.text(max_size=40) | st.lists(st.sampled_from(["macs", "to", "from", "ros", "7", "x", ""])).map("/".join))
def test_any_text_is_a_key_or_none(text: str) -> None:
    """Parsing any text gives fields of a space or None, never an error."""
    parsed = keyexpr.parse(text)
    assert parsed is None or parsed[1]._fields == KEYS[parsed[0]].fields


# -- types and blocks ------------------------------------------------------------------------------------------------


def test_every_type_has_one_name() -> None:
    """Types 1 to 255 have names of their own that lead back to them; robots and headsets have words."""
    names = [type_name(number) for number in range(1, 256)]
    assert [type_number(name) for name in names] == list(range(1, 256))
    assert len(set(names)) == 255
    assert names[:3] == ["ros", "unity", "3"]


@pytest.mark.parametrize("name", ["", "0", "256", "-1", "Ros", "robot", "1.0", "²", "٣"])
def test_a_name_of_no_type_is_refused(name: str) -> None:
    """What is neither a word for a type nor a number from 1 to 255 raises UsageError."""
    with pytest.raises(UsageError):
        type_number(name)


def test_types_may_be_given_by_name() -> None:
    """A key is the same whether its type is given as number or by name."""
    assert CALL.of(type="ros", id=7, verb="offers", from_type="unity", from_id=8) == CALL.of(
        type=1, id=7, verb="offers", from_type=2, from_id=8
    )
    assert PRESENCE.every(type="unity") == PRESENCE.every(type=2)


@pytest.mark.parametrize("space", [UNICAST, PRESENCE])
def test_an_id_is_only_in_its_own_block(space: Key) -> None:
    """Its block is put before it, and a key with another one is nobody's: who may say it is judged by the block."""
    fields: dict[str, int | str] = {"type": 2, "id": 300, "group": 0, "zid": "a1", "from_type": 1, "from_id": 7}
    mine = {name: fields[name] for name in space.fields if name != "block"}
    key = space.of(**mine)
    assert "/unity/1/300/" in key
    assert space.of(**mine, block=1) == key
    assert space.every(type=2, id=300) == space.every(type=2, block=1, id=300)
    parsed = space.parse(key)
    assert parsed is not None
    assert parsed._asdict() == {**mine, "block": 1}
    for other in (0, 2):
        assert space.parse(key.replace("/1/300/", f"/{other}/300/")) is None
        with pytest.raises(UsageError, match="block 1"):
            space.of(**mine, block=other)
        with pytest.raises(UsageError, match="block 1"):
            space.every(type=2, block=other, id=300)


def test_the_block_of_an_id_is_its_high_byte() -> None:
    """Each of the 256 blocks has 256 ids in a row."""
    assert [block_of(agent_id) for agent_id in (0, 1, 255, 256, 511, 512, 65535)] == [0, 0, 0, 1, 1, 2, 255]


@by_space
@settings(deadline=None)
@given(data=st.data())
def test_a_key_of_ours_fits_what_every_gives(space_name: str, data: st.DataObject) -> None:
    """The expression for some fields fits each key with these fields, whatever they contain."""
    space = KEYS[space_name]
    fields = data.draw(fields_of(space))
    some = data.draw(st.sets(st.sampled_from(space.fields)))
    assert fits(space.every(**{name: fields[name] for name in some}), space.of(**fields))


# -- keys beside the table -------------------------------------------------------------------------------------------


def test_a_sources_key_names_its_key_and_itself() -> None:
    """What heartbeats are heard on is taken apart again; other keys name no source."""
    assert zenoh.KeyExpr(keyexpr.sources("macs/from/ros/7/n")).includes(
        zenoh.KeyExpr("macs/from/ros/7/n/@adv/pub/a1/3/_")
    )
    assert keyexpr.source_of("macs/from/ros/7/n/@adv/pub/a1/3/_") == ("macs/from/ros/7/n", "a1/3")
    assert keyexpr.sources("macs/from/ros/7/n", "a1/3") == "macs/from/ros/7/n/@adv/pub/a1/3/**"
    assert keyexpr.source_of("macs/from/ros/7/n") == ("", "")
    assert [keyexpr.is_recovery(key) for key in keyexpr.with_recovery(["macs/x"])] == [False, True]


@pytest.mark.parametrize("namespace", ["", "site1", "site1/hall2"])
def test_a_namespace_is_found_before_a_key(namespace: str) -> None:
    """What is put before a key is what is found there; routers' own keys get nothing."""
    key = keyexpr.PRESENCE.of(type="ros", id=7, group=0, zid="a1")
    inside = keyexpr.inside(namespace or None, key)
    assert keyexpr.namespace_of(keyexpr.PRESENCE, inside) == namespace
    assert keyexpr.namespace_of(keyexpr.LEASE, inside) is None
    assert zenoh.KeyExpr(keyexpr.everywhere(keyexpr.PRESENCE)).includes(zenoh.KeyExpr(inside))
    assert keyexpr.inside("site1", keyexpr.ROUTERS) == keyexpr.ROUTERS


def test_an_expression_for_each_robot() -> None:
    """Where an id is the only wildcard it is filled in; an expression without any is one key; others are not."""
    assert keyexpr.of_each("macs/from/ros/*/nd__map", 1, [7, 8]) == [
        "macs/from/ros/7/nd__map",
        "macs/from/ros/8/nd__map",
    ]
    assert keyexpr.of_each("macs/from/ros/7/nd__map", 1, [7, 8]) == ["macs/from/ros/7/nd__map"]
    for other in ("macs/from/ros/*/nd__*", "macs/from/**", "macs/from/unity/*/n"):
        assert keyexpr.of_each(other, 1, [7, 8]) == []
