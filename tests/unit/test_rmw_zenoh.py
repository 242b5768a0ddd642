"""What rmw_zenoh puts on a network, read and written: held by recordings of the real one, and by bad input."""

from __future__ import annotations

import random
import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bridge.rmw_zenoh.goals import ENDED, statuses
from macs_zenoh.protocol.rmw_zenoh import keyexpr
from macs_zenoh.protocol.rmw_zenoh.attachment import ATTACHMENT_BYTES, encode_attachment, gid_of, parse_attachment
from macs_zenoh.protocol.rmw_zenoh.cdr import looks_like_cdr, read_text, written_text
from macs_zenoh.protocol.rmw_zenoh.graph import Graph
from macs_zenoh.protocol.rmw_zenoh.keyexpr import BadName, BadToken, Endpoint, Kind, Node, parse_token
from macs_zenoh.protocol.rmw_zenoh.qos import (
    ENDLESS_NS,
    Durability,
    History,
    Liveliness,
    Qos,
    Reliability,
    parse_qos,
    written_qos,
)
from tests.support.rmw_vectors import all_rows, golden_qos, rows, tokens

TOKENS = tokens()
LYRICAL = (
    "@ros2_lv/0/4493ccfffcb3c37b5cb73b748ed4de8d/0/7/MS/%/%/viewer/%camera/sensor_msgs::msg::dds_::Image_/"
    "RIHS01_d31d41a9a4c4bc8eae9be757b0beed306564f7526c88ea6a4588fb9582527d47/::,10:,:,:,,/backends:cpu:"
)
HUMBLE = (
    "@ros2_lv/0/4493ccfffcb3c37b5cb73b748ed4de8d/0/7/MP/%/%/talker/%chatter/std_msgs::msg::dds_::String_/"
    "TypeHashNotSupported/::,7:,:,:,,"
)


def written(found: Node | Endpoint) -> str:
    return keyexpr.node_token(found) if isinstance(found, Node) else keyexpr.endpoint_token(found)


def test_there_are_recordings() -> None:
    """What follows is held by recordings: more than a hundred tokens, of every kind."""
    assert len(TOKENS) > 100
    kinds = {found.kind for found in map(parse_token, TOKENS) if isinstance(found, Endpoint)}
    assert kinds == set(Kind) - {Kind.NODE}


@pytest.mark.parametrize("token", [*TOKENS, LYRICAL, HUMBLE])
def test_every_token_is_read_and_written_as_it_was(token: str) -> None:
    """A token is understood, and what was understood makes the same token."""
    assert written(parse_token(token)) == token


def test_what_a_token_says() -> None:
    """Names, types and QoS of a token are those of the node that it stands for."""
    found = next(
        found
        for found in map(parse_token, TOKENS)
        if isinstance(found, Endpoint) and found.topic == "/robot1/latched" and found.kind is Kind.PUBLISHER
    )
    assert found.node.full_name == "/robot1/talker"
    assert found.type == "std_msgs/msg/String"
    assert found.qos == Qos(durability=Durability.TRANSIENT_LOCAL, depth=1)
    hidden = {found.full_name for found in map(parse_token, TOKENS) if isinstance(found, Node)}
    assert {"/root_node", "/a/b_c/_hidden_node", "/remap/ped/new_name"} <= hidden


def test_newer_and_older_releases() -> None:
    """A chunk behind the QoS says who takes buffers; a hash that is none is taken as it is."""
    lyrical, humble = parse_token(LYRICAL), parse_token(HUMBLE)
    assert isinstance(lyrical, Endpoint)
    assert lyrical.takes_cpu_buffers
    assert keyexpr.cpu_key(lyrical.key) == f"{lyrical.key}/_buf_cpu"
    assert isinstance(humble, Endpoint)
    assert humble.key == "0/chatter/std_msgs::msg::dds_::String_/TypeHashNotSupported"


def test_every_message_goes_to_the_key_of_an_endpoint() -> None:
    """The keys of recorded messages, requests and replies are those of endpoints whose tokens were recorded."""
    keys = {found.key for found in map(parse_token, TOKENS) if isinstance(found, Endpoint)}
    used = {row["key"] for row in rows("puts") if row["kind"] == "put" and "@adv" not in row["key"]}
    used |= {
        row["key"] for row in rows("wire_service_call") if row["kind"] in ("query", "request", "reply", "response")
    }
    assert len(used) > 8
    assert used <= keys


def test_attachments_are_read_and_written_as_they_were() -> None:
    """Every attachment that was recorded, byte for byte."""
    seen = 0
    for _, row in all_rows():
        data = bytes.fromhex(row.get("attachment_hex") or "")
        if not data:
            continue
        found = parse_attachment(data)
        assert found is not None
        assert encode_attachment(*found) == data
        if told := row.get("attachment"):
            assert (found.number, found.time_ns, found.gid.hex()) == (told["seq"], told["timestamp_ns"], told["gid"])
        seen += 1
    assert seen > 50


def test_gids_are_those_of_the_tokens() -> None:
    """Whose a message is: the hash of its endpoint's token, for each recorded put whose token was recorded as well."""
    pytest.importorskip("xxhash", reason="GIDs need xxhash: pip install 'macs-zenoh[rmw-zenoh]'")
    of_tokens = {gid_of(token) for token in TOKENS}
    puts = [bytes.fromhex(row["attachment_hex"]) for row in rows("puts") if row.get("attachment_hex")]
    found = [parse_attachment(data) for data in puts]
    assert len(found) >= 22
    assert [one for one in found if one is None or one.gid not in of_tokens] == []


@pytest.mark.parametrize(
    ("text", "qos"),
    [
        ("::,10:,:,:,,", Qos(depth=10)),
        ("::,:,:,:,,", Qos()),
        ("2::,5:,:,:,,", Qos(reliability=Reliability.BEST_EFFORT, depth=5)),
        (":1:,1:,:,:,,", Qos(durability=Durability.TRANSIENT_LOCAL, depth=1)),
        (
            "2:1:,5:,:,:,,",
            Qos(reliability=Reliability.BEST_EFFORT, durability=Durability.TRANSIENT_LOCAL, depth=5),
        ),
        ("::2,10:,:,:,,", Qos(history=History.KEEP_ALL, depth=10)),
        (
            "::,7:0,100000000:2,0:3,3,5",
            Qos(
                depth=7,
                deadline_ns=100_000_000,
                lifespan_ns=2_000_000_000,
                liveliness=Liveliness.MANUAL_BY_TOPIC,
                lease_ns=3_000_000_005,
            ),
        ),
        (":1:,1000:,:10,0:,,", Qos(durability=Durability.TRANSIENT_LOCAL, depth=1000, lifespan_ns=10_000_000_000)),
    ],
)
def test_profiles_as_they_were_seen(text: str, qos: Qos) -> None:
    """The profiles of the documentation, both ways."""
    assert parse_qos(text) == qos
    assert written_qos(qos) == text


def test_golden_lines_of_the_real_functions() -> None:
    """All lines that rmw_zenoh's own C++ functions have written or read, as a crate of others keeps them."""
    lines = 0
    for name, text in golden_qos().items():
        for line in text.splitlines():
            lines += 1
            if line.startswith("#"):
                continue
            left, _, right = line.partition("\t")
            chunk, numbers = (left, right) if name == "qos_decode.tsv" else (right, left)
            found = parse_qos(chunk)
            if numbers == "NULL":
                assert found is None, line
                continue
            assert found == _profile(list(map(int, numbers.split()))), line
            if name != "qos_decode.tsv":
                assert written_qos(found) == chunk, line
    assert lines == 1018


def _profile(numbers: list[int]) -> Qos:
    reliability, durability, history, depth, *times = numbers
    deadline, lifespan, lease = ((times[at], times[at + 1]) for at in (0, 2, 5))
    return Qos(
        reliability=Reliability(reliability),
        durability=Durability(durability),
        history=History(history),
        depth=depth,
        deadline_ns=deadline[0] * 10**9 + deadline[1],
        lifespan_ns=lifespan[0] * 10**9 + lifespan[1],
        liveliness=Liveliness(times[4]),
        lease_ns=lease[0] * 10**9 + lease[1],
    )


DURATIONS = st.integers(0, ENDLESS_NS)
PROFILES = st.builds(
    Qos,
    reliability=st.sampled_from(Reliability),
    durability=st.sampled_from(Durability),
    history=st.sampled_from(History),
    depth=st.integers(0, 1 << 31),
    deadline_ns=DURATIONS,
    lifespan_ns=DURATIONS,
    liveliness=st.sampled_from(Liveliness),
    lease_ns=DURATIONS,
)
NAMES = st.lists(st.from_regex(r"[A-Za-z_][A-Za-z0-9_]{0,8}", fullmatch=True), min_size=1, max_size=4).map(
    lambda levels: "/" + "/".join(levels)
)


@given(PROFILES)
def test_any_profile_survives_its_text(qos: Qos) -> None:
    """What is written is read as it was."""
    assert parse_qos(written_qos(qos)) == qos


@given(st.integers(0, 232), NAMES, NAMES, NAMES, PROFILES, st.sampled_from(sorted(set(Kind) - {Kind.NODE}, key=str)))
def test_any_endpoint_survives_its_token(
    domain: int, namespace: str, topic: str, enclave: str, qos: Qos, kind: Kind
) -> None:
    """What is declared is read as it was, and its key is one of Zenoh's."""
    node = Node(domain, "ab12", 3, enclave, namespace, "talker")
    endpoint = Endpoint(node, 9, kind, topic, "std_msgs/msg/String", f"RIHS01_{'a' * 64}", qos)
    assert parse_token(keyexpr.endpoint_token(endpoint)) == endpoint
    assert parse_token(keyexpr.node_token(node)) == node
    assert re.fullmatch(r"[^*$?#]+", endpoint.key)


@given(st.binary(max_size=64))
def test_any_bytes_are_an_attachment_or_none(data: bytes) -> None:
    """Nothing is raised, whatever comes."""
    found = parse_attachment(data)
    assert (found is None) or (len(data) == ATTACHMENT_BYTES and encode_attachment(*found) == data)
    assert looks_like_cdr(data) == (len(data) > 4 and data[:2] in (b"\0\0", b"\0\1"))


@given(st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"])))
def test_any_text_survives_as_a_string_message(text: str) -> None:
    """What is written as a std_msgs/String is read as it was; cut off anywhere, it is none."""
    cdr = written_text(text.encode())
    assert read_text(cdr) == text.encode()
    with pytest.raises(ValueError, match="string"):
        read_text(cdr[:-1])


def test_a_thousand_malformed_tokens() -> None:
    """Tokens with pieces changed, cut, doubled or put elsewhere raise BadToken or are read: nothing else happens, and
    a graph counts them."""
    chance = random.Random(20)
    graph, bad = Graph(), 0
    for _ in range(1000):
        token = mutated(chance, chance.choice(TOKENS))
        try:
            written(parse_token(token))
        except BadToken:
            bad += 1
        graph.put(token)
        if chance.random() < 0.5:
            graph.delete(mutated(chance, token))
    assert bad > 300
    assert 0 < graph.malformed <= bad


def mutated(chance: random.Random, token: str) -> str:
    chunks = token.split("/")
    at = chance.randrange(len(chunks))
    how = chance.randrange(6)
    if how == 0:
        del chunks[at]
    elif how == 1:
        chunks[at] = "".join(chance.choice("%:,*?#$\0ü_a1-") for _ in range(chance.randrange(12)))
    elif how == 2:
        chunks.insert(at, chunks[at])
    elif how == 3:
        chunks[at] = chunks[at][: chance.randrange(len(chunks[at]) + 1)] + "9" * chance.randrange(40)
    elif how == 4:
        chance.shuffle(chunks)
    else:
        chunks[at] += "x" * 5000
    return "/".join(chunks)


@pytest.mark.parametrize("name", ["", "x", "/", "/a//b", "/a/", "/a b", "/a*", "/ü", "/" + "a" * 5000])
def test_names_that_ros_does_not_have(name: str) -> None:
    """No key is made of them."""
    with pytest.raises(BadName):
        keyexpr.data_key(0, name, "std_msgs/msg/String", "RIHS01_ab")


def test_deaths_are_followed() -> None:
    """Tokens that are deleted once, twice or without having been there: what lives is what was not deleted."""
    for name in ("graph_kill9", "graph_clean_destroy", "graph_lease_timeout"):
        graph, alive = Graph(), set[str]()
        for row in rows(name):
            if not row["key"].startswith("@ros2_lv/"):
                continue
            (graph.put if row["kind"] == "token" else graph.delete)(row["key"])
            (alive.add if row["kind"] == "token" else alive.discard)(row["key"])
            assert len(graph) == len(alive)
        assert graph.malformed == 0


def test_a_graph_knows_whose_endpoints_are_whose() -> None:
    """By topic, by kind, and without our own."""
    graph = Graph("ffff")
    for token in TOKENS:
        graph.put(token)
    own = Endpoint(
        Node(50, "ffff", 0, "/", "/", "rosagent"), 1, Kind.SUBSCRIPTION, "/robot1/latched", "std_msgs/msg/String",
        "RIHS01_ab", Qos(),
    )  # fmt: skip
    assert graph.put(keyexpr.endpoint_token(own)) == own
    assert graph.put(keyexpr.endpoint_token(own)) is None
    assert own in graph.on("/robot1/latched", Kind.SUBSCRIPTION)
    assert own not in graph.on("/robot1/latched", others=True)
    assert {one.kind for one in graph.on("/robot1/latched", Kind.PUBLISHER)} == {Kind.PUBLISHER}
    assert ("/robot1/latched", ["std_msgs/msg/String"]) in graph.names_and_types(Kind.PUBLISHER)
    before = len(graph)
    assert len(graph.clear()) == before
    assert len(graph) == 0
    assert graph.on("/robot1/latched") == []


def test_how_goals_stand_as_recorded() -> None:
    """The real server's status messages name its goals, each until it has ended; what is cut short says no more."""
    recorded = [
        bytes.fromhex(row["payload_hex"])
        for row in rows("wire_action_server")
        if row["kind"] == "put" and "GoalStatusArray" in row["key"] and "@adv" not in row["key"]
    ]
    found = [dict(statuses(cdr)) for cdr in recorded]
    assert recorded
    assert all(found)
    assert {status for each in found for status in each.values()} <= set(range(1, 7))
    assert any(status >= ENDED for each in found for status in each.values())
    for cdr in recorded:
        for end in range(len(cdr)):
            assert len(list(statuses(cdr[:end]))) <= len(found[recorded.index(cdr)])
    assert list(statuses(b"\0\1\0\0\xff\xff\xff\xff")) == []
