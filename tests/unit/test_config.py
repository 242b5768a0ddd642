"""The settings: ranges, errors that name file and field, and what reaches Zenoh."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import msgspec
import pytest
import zenoh

from bridge.settings import GatewaySettings, RobotSettings, Settings, TopicRule, load, parse
from macs_zenoh.config import MeshSettings, TrafficRule
from macs_zenoh.errors import ConfigError
from macs_zenoh.sections import changed

SHIPPED = sorted((Path(__file__).parents[2] / "config").glob("*.toml"))


def test_an_empty_file_is_all_defaults() -> None:
    """A settings file may be empty."""
    assert parse("") == Settings()


def test_a_file_sets_its_fields(tmp_path: Path) -> None:
    """Each section of a file reaches its struct, and other fields keep their defaults."""
    file = tmp_path / "macs.toml"
    file.write_text(
        '[mesh]\nconnect = ["tcp/10.0.0.1:7447"]\nlease_ms = 3000\n'
        "[gateway]\nport = 7001\n"
        "[robot]\nid = 7\ngroup = 3\n"
    )
    settings = load(file)
    assert settings.mesh == MeshSettings(connect=["tcp/10.0.0.1:7447"], lease_ms=3000)
    assert settings.gateway == GatewaySettings(port=7001)
    assert settings.robot == RobotSettings(id=7, group=3)


@pytest.mark.parametrize(
    ("text", "path", "problem"),
    [
        ("[gateway]\nprot = 1", "f.toml: gateway", "did you mean `port`?"),
        ("[gatway]\nport = 1", "f.toml", "did you mean `gateway`?"),
        ("[robot]\nwheels = 4", "f.toml: robot", "unknown name `wheels`"),
        ("[gateway]\nport = 70000", "f.toml: gateway.port", "expected `int` <= 65535"),
        ("[gateway]\nport = '7000'", "f.toml: gateway.port", "expected `int`, got `str`"),
        ("[robot]\nid = 0", "f.toml: robot.id", ">= 1"),
        ("[robot]\ngroup = 256", "f.toml: robot.group", "<= 255"),
        ("[[robot.rules]]\nmatch = 'cmd_vel'", "f.toml: robot.rules[0].match", "a full name that begins with /"),
        ("[robot]\nexpose = ['cmd_vel']", "f.toml: robot.expose[0]", "a full name that begins with /"),
        ("[robot]\nstop_topic = 'stop'", "f.toml: robot.stop_topic", "the full name of a topic, which begins with /"),
        ("[[robot.rules]]\nmatch = '/a'\nmaxhz = 5", "f.toml: robot.rules[0]", "did you mean `max_hz`?"),
        ("[[robot.rules]]\nmatch = '/a'\ndeadman_s = 1", "f.toml: robot.rules.deadman_s", "needs a deadman_message"),
        ("[[traffic]]\nmatch = 'macs/all/**'\nmax_hz = 0", "f.toml: traffic[0].max_hz", "expected `float` > 0"),
        ("[[traffic]]\nmatch = 'macs/all/**'\npriority = 'high'", "f.toml: traffic[0].priority", "'high'"),
        ("[[traffic]]\nmatch = 'macs/all/**'\ncache = 0", "f.toml: traffic[0].cache", ">= 1"),
        ("[[traffic]]\nmatch = 'macs/all/**'\nmaxhz = 5", "f.toml: traffic[0]", "did you mean `max_hz`?"),
        ("[[traffic]]\nmax_hz = 5", "f.toml: traffic[0]", "missing required field `match`"),
        ("[[traffic]]\nmatch = '/cmd_vel'", "f.toml: traffic.match", "'/cmd_vel' is not a key expression"),
        ("[[traffic]]\nmatch = 'macs/nd__cam*'", "f.toml: traffic.match", "write nd__cam$*"),
        ("[trafic]\nmatch = 'macs/**'", "f.toml", "did you mean `traffic`?"),
        ("[robot]\nstop_allow = ['someone in group 3']", "f.toml: robot.stop_allow[0]", "names no agents"),
        ("[robot]\nstop_allow = ['bob']", "f.toml: robot.stop_allow[0]", "'bob' names no agents, as *, unity"),
        ("[robot]\nrelease_allow = ['*', 'operator5']", "f.toml: robot.release_allow[1]", "operator/5"),
        ("[robot]\nregister_allow = ['group/0']", "f.toml: robot.register_allow[0]", "'group/0' names no agents"),
        ("[robot]\nregister_allow = ['group/9']", "f.toml: robot.register_allow[0]", "say in robot.groups whom"),
        ("[robot]\ngroups = { 0 = [] }", "f.toml: robot.groups.0", "is no group"),
        ("[robot]\ngroups = { 9 = ['group/3'] }", "f.toml: robot.groups.9", "'group/3' names no agents"),
        ("[gateway]\ngroups = { 9 = ['x'] }", "f.toml: gateway.groups.9", "'x' is not a network"),
        ("[gateway]\ngroups = { x = [] }", "f.toml: gateway.groups.x", "is no group"),
        ("[robot]\nregister_allow = ['block/256']", "f.toml: robot.register_allow[0]", "'block/256' names no agents"),
        ("[robot]\nregister_allow = ['unity/']", "f.toml: robot.register_allow[0]", "'unity/' names no agents"),
        ("[robot]\nregister_allow = ['ros/70000']", "f.toml: robot.register_allow[0]", "'ros/70000' names no agents"),
        ("[robot]\nregister_allow = ['1']", "f.toml: robot.register_allow[0]", "'1' names no agents"),
        ("[mesh]\nconnect = ['tcp/a:1', 5]", "f.toml: mesh.connect[1]", "expected `str`"),
        ("[mesh]\nconnect = ['10.0.0.1:7447']", "f.toml: mesh.connect", "write tcp/10.0.0.1:7447"),
        ("[mesh]\nconnect = ['tcp/127.0.0.1']", "f.toml: mesh.connect", "needs a host and a port, as in tcp/10.0.0.1"),
        ("[mesh]\nconnect = ['foo/1.2.3.4:7530']", "f.toml: mesh.connect", "'foo', which is no protocol"),
        ("[mesh]\nconnect = ['tcp/127.0.0.1:75300']", "f.toml: mesh.connect", "port 75300, allowed is 1..65535"),
        ("[mesh]\nconnect = ['tls/[::1]:0#a=b:1']", "f.toml: mesh.connect", "port 0, allowed is 1..65535"),
        ("[mesh]\nlisten = ['udp/:7447']", "f.toml: mesh.listen", "needs a host and a port"),
        ("[operator]\nidd = 5", "f.toml: operator", "did you mean `id`?"),
        ("[operator]\nid = 0", "f.toml: operator.id", ">= 1"),
        ("[mesh]\nlisten = ['everywhere']", "f.toml: mesh.listen", "as in tcp/"),
        ("[mesh]\ntx_queue_batches = 17", "f.toml: mesh.tx_queue_batches", "<= 16"),
        ("[mesh]\nretry_min_ms = 500", "f.toml: mesh.retry_min_ms", "above retry_max_ms, 200"),
        ("[mesh]\noverrides = ['mode']", "f.toml: mesh.overrides", "not PATH:JSON5"),
        ("[mesh]\nnamespace = 'a/**'", "f.toml: mesh.namespace", "not a plain key"),
        ("[mesh]\nmode = 'broker'", "f.toml: mesh.mode", "broker"),
        ("[mesh", "f.toml", "not TOML"),
        ("a = " + "[" * 20_000 + "]" * 20_000, "f.toml", "nests too deep"),
        ("a = " + "9" * 100_000, "f.toml", "not TOML"),
        ("a = 2020-99-99", "f.toml", "not TOML"),
    ],
)
def test_an_error_names_file_and_field(text: str, path: str, problem: str) -> None:
    """Whatever is wrong in a file, the error says where and what."""
    with pytest.raises(ConfigError) as caught:
        parse(text, "f.toml")
    assert caught.value.path == path
    assert problem in caught.value.problem


def test_a_file_has_rules_for_traffic_and_topics() -> None:
    """Rules keep their order, and what a rule does not say is unset."""
    settings = parse(
        "[[traffic]]\nmatch = 'macs/from/**'\nmax_hz = 5\npriority = 'data_low'\n"
        "[[traffic]]\nmatch = '**'\nmax_bytes = 1000\nmax_bytes_per_s = 2000\ncache = 10\n"
        "[[robot.rules]]\nmatch = '/a'\npriority = 'data_high'\n"
    )
    assert settings.traffic == [
        TrafficRule(match="macs/from/**", max_hz=5.0, priority="data_low"),
        TrafficRule(match="**", max_bytes=1000, max_bytes_per_s=2000, cache=10),
    ]
    assert settings.traffic[0].cache is None
    assert settings.robot.rules == [TopicRule(match="/a", priority="data_high")]


def test_patterns_of_agents() -> None:
    """Everybody, a type by word or number, one agent, a group and a block can be allowed."""
    patterns = ["*", "ros", "unity", "operator", "7", "unity/5", "operator/0", "7/65535", "group/255", "block/0"]
    assert RobotSettings(stop_allow=patterns, release_allow=[], groups={"255": ["block/0"]}).stop_allow == patterns


def test_a_later_file_wins_setting_by_setting(tmp_path: Path) -> None:
    """Of two files, what both say is the later one's, and the rest of a section is the earlier one's; errors name the
    file that brings them."""
    first, second = tmp_path / "first.toml", tmp_path / "second.toml"
    first.write_text('[mesh]\nlease_ms = 3000\n[robot]\nid = 1\ngroup = 3\n[[robot.rules]]\nmatch = "/a"\n')
    second.write_text('[mesh]\nconnect = ["tls/a:1"]\n[robot]\nid = 7\n')
    settings = load(first, second)
    assert settings.mesh == MeshSettings(connect=["tls/a:1"], lease_ms=3000)
    assert settings.robot == RobotSettings(id=7, group=3, rules=[TopicRule(match="/a")])
    second.write_text("[robot]\nidd = 7\n")
    with pytest.raises(ConfigError, match=r"second\.toml: robot: unknown name `idd`"):
        load(first, second)


def test_a_missing_file_is_a_config_error(tmp_path: Path) -> None:
    """A file that cannot be read is named, with the reason."""
    with pytest.raises(ConfigError, match=r"none\.toml: No such file"):
        load(tmp_path / "none.toml")


def test_a_file_that_is_not_text_is_a_config_error(tmp_path: Path) -> None:
    """Bytes that are not UTF-8 are refused with their place."""
    (tmp_path / "x.toml").write_bytes(b"[mesh]\n\xff")
    with pytest.raises(ConfigError, match="not UTF-8 at byte 7"):
        load(tmp_path / "x.toml")


@pytest.mark.parametrize(
    ("make", "path"),
    [
        (lambda: MeshSettings(tx_queue_batches=17), "mesh.tx_queue_batches"),
        (lambda: MeshSettings(connect="tcp/127.0.0.1:7447"), "mesh.connect"),  # type: ignore[arg-type]
        (lambda: changed(GatewaySettings(), port=-1), "gateway.port"),
    ],
)
def test_ranges_hold_in_python_too(make: Any, path: str) -> None:
    """A struct made in Python is checked like one from a file."""
    with pytest.raises(ConfigError) as caught:
        make()
    assert caught.value.path == path


def test_an_option_that_was_not_given_changes_nothing() -> None:
    """`changed` leaves fields whose new value is None."""
    settings = RobotSettings(id=7)
    assert changed(settings, id=None, group=3) == RobotSettings(id=7, group=3)


def test_a_section_is_looked_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """msgspec evaluates every annotation of a class whose fields it is asked for: not for each session again."""
    MeshSettings(lease_ms=5000).zenoh()
    asked: list[object] = []
    monkeypatch.setattr(msgspec.structs, "fields", asked.append)
    MeshSettings(lease_ms=6000).zenoh()
    assert asked == []


def test_zenoh_accepts_every_entry() -> None:
    """Each path we write exists in Zenoh's configuration and keeps the value."""
    every = MeshSettings(namespace="site1", tx_queue_batches=16, connect=["tcp/127.0.0.1:1"])
    theirs = zenoh.Config()
    for entry in every.zenoh():
        theirs.insert_json5(entry.path, entry.json5)
    for entry in every.zenoh():
        got = json.loads(theirs.get_json(entry.path))
        want = json.loads(entry.json5)
        if isinstance(want, dict):  # Zenoh adds the members that were not given
            got = {name: got[name] for name in want}
        assert got == want, entry.path


def test_only_what_was_asked_for_is_chosen() -> None:
    """A default gives way to a Zenoh file, a field that was set does not."""
    chosen = {entry.path for entry in MeshSettings(lease_ms=5000, mode="peer").zenoh() if entry.chosen}
    assert chosen == {"mode", "transport/link/tx/lease"}


@pytest.mark.parametrize(
    ("settings", "routers"),
    [
        (MeshSettings(), ["tcp/127.0.0.1:7447"]),
        (MeshSettings(connect=["tcp/a:1"]), ["tcp/a:1"]),
        (MeshSettings(mode="router"), []),
        (MeshSettings(mode="peer"), []),
        (MeshSettings(config_file="z.json5"), []),
    ],
)
def test_a_client_without_endpoints_uses_the_local_router(settings: MeshSettings, routers: list[str]) -> None:
    """Only a client that names no router, and no Zenoh file, falls back to the one on this host."""
    assert settings.routers == routers


@pytest.mark.parametrize(
    "endpoint",
    [
        "tcp/a.example:1",
        "tls/[fe80::1%eth0]:7447#iface=eth0",
        "udp/10.0.0.1:65535?rel=0",
        "quic/10.0.0.1:7447",
        "ws/a:80",
        "unixsock-stream//tmp/zenoh.sock",
        "unixpipe/zenoh.pipe",
        "serial//dev/ttyUSB0#baudrate=115200",
        "vsock/2:1234",
    ],
)
def test_every_kind_of_link_may_be_an_endpoint(endpoint: str) -> None:
    """Endpoints that Zenoh understands are taken as they are; to listen, any port will do."""
    assert MeshSettings(connect=[endpoint]).routers == [endpoint]
    assert MeshSettings(listen=[endpoint, "tcp/[::]:0"]).listen[0] == endpoint


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.name)
def test_shipped_files_load(path: Path) -> None:
    """Every file in config/ is valid, also with all its comments taken for settings."""
    load(path)
    uncommented = "\n".join(
        line.removeprefix("#") if line.startswith("#") and " = " in line else line
        for line in path.read_text().splitlines()
    )
    parse(uncommented, path.name)
