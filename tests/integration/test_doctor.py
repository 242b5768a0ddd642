"""`macs doctor` against real routers: what is wrong is found, what is right is left alone."""

from __future__ import annotations

import asyncio
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

import macs_zenoh
from macs_zenoh.config import MeshSettings
from macs_zenoh.mesh import Mesh
from macs_zenoh.protocol.keyexpr import LEASE, NAME, PRESENCE
from tests.integration.test_access_rules import RULES, USERS, credentials
from tests.support.certificates import Authority
from tests.support.programs import ROOT, Program, ended, free_port
from tests.support.routers import Router as Plain
from tests.support.routers import as_macs_router

POLICY = """\
routers: [{name: site, addresses: [127.0.0.1]}]
robots: [{name: robot-7, id: 7}, {name: robot-8, id: 8}]
gateways: [{name: hall, blocks: [1]}]
operators: [{name: anna}]
permissions: [{who: all, may: all, whom: all}]
"""


RULE = [line for line in as_macs_router(MeshSettings()) if line.startswith("qos/")]


class Router(Plain):
    """A router with the rule that ours have for messages."""

    def __init__(self, config: Path | None = None, *, overrides: Sequence[str] = (), **how: Any) -> None:
        super().__init__(config, overrides=[*RULE, *overrides], **how)


class Report:
    """What one run of `macs doctor` said."""

    def __init__(self, code: int, document: dict[str, Any]) -> None:
        self.code = code
        self.document = document

    @property
    def wrong(self) -> dict[str, str]:
        """Warnings and errors: id and severity."""
        return {
            finding["id"]: finding["severity"]
            for finding in self.document["findings"]
            if finding["severity"] in ("warning", "error")
        }

    def find(self, name: str) -> dict[str, str]:
        """The finding with this id."""
        [finding] = [finding for finding in self.document["findings"] if finding["id"] == name]
        return dict(finding)

    def has(self, name: str) -> bool:
        """Whether there is a finding with this id."""
        return any(finding["id"] == name for finding in self.document["findings"])


async def doctor(*argv: str, cfg: Sequence[str] = ()) -> Report:
    """Run `macs doctor --json` to its end."""
    options = [word for value in cfg for word in ("--cfg", value)]
    code, out, errors = await ended("doctor", "--json", *argv, *options)
    assert out, errors
    return Report(code, json.loads(out))


async def test_a_healthy_mesh_has_nothing_wrong() -> None:
    """With a router, a gateway and a robot all is well: exit code 0, with everybody's way, clock and version."""
    async with (
        Router() as router,
        Program("gateway", "--port", "0", "--block", "1", "-e", router.endpoint),
        macs_zenoh.join("ros", id=7, connect=[router.endpoint]),
    ):
        report = await doctor("-e", router.endpoint, "--as", "gateway/2")
    assert not report.wrong
    assert report.code == 0
    assert report.document["severity"] in ("ok", "note")
    facts = report.document["facts"]
    [endpoint] = facts["endpoints"]
    assert endpoint["router"]
    assert [echo["size_bytes"] for echo in endpoint["path"]["echoes"]][:2] == [4 << 10, 64 << 10]
    assert abs(endpoint["path"]["clock"]["offset_s"]) < 1
    assert endpoint["rights"] == dict.fromkeys(("seen", "sees", "watches", "leases", "hears", "pings"), True)
    programs = {tuple(program["agents"]): program for program in facts["programs"]}
    assert programs[("ros/7",)]["called"]
    assert programs[()]["blocks"] == [1]
    for program in programs.values():
        assert program["pong"]["zenoh"]
        assert len(program["path"]["round_trips_ms"]) == 5
    assert facts["probe_bytes"] > 0


@pytest.mark.parametrize("rule", [[], RULE], ids=["without", "with"])
async def test_a_router_in_which_commands_may_wait_is_found(rule: list[str]) -> None:
    """Whether a router drops what has the priority of commands, though its sender would wait, is tried, not read."""
    async with Plain(overrides=rule or ["qos/network:[]"]) as router:
        report = await doctor("-e", router.endpoint, "--quick")
    assert report.has("commands_wait") == (not rule)
    [endpoint] = report.document["facts"]["endpoints"]
    assert endpoint["drops_commands"] is bool(rule)


async def test_quick_sends_nothing_large() -> None:
    """With --quick there are round trips and no echoes."""
    async with Router() as router:
        report = await doctor("-e", router.endpoint, "--quick")
    assert report.code == 0
    assert report.document["facts"]["probe_bytes"] == 0
    assert report.document["facts"]["endpoints"][0]["path"]["round_trips_ms"]
    assert not report.document["facts"]["endpoints"][0]["path"]["echoes"]


async def test_an_examination_leaves_no_trace() -> None:
    """Who watches presence hears of no agent while the doctor examines, and the robot whose rights it tries hears
    nothing."""
    async with Router() as router, macs_zenoh.join("ros", id=7, connect=[router.endpoint]) as robot:
        seen: list[tuple[int, int]] = []
        robot.on_presence(lambda agent, online: seen.append(agent.key))
        seen.clear()
        report = await doctor("-e", router.endpoint, "--as", "ros/7", "--quick")
        assert report.find("access_ok")
        with pytest.raises(asyncio.TimeoutError):
            await asyncio.wait_for(robot.receive(), 0.2)
        assert not seen
        assert not robot.drops


async def test_a_router_that_is_not_there() -> None:
    """A wrong port is an error; beside a router that answers it is a warning, since programs use the other."""
    wrong = f"tcp/127.0.0.1:{free_port()}"
    alone = await doctor("-e", wrong)
    assert alone.wrong == {"refused": "error"}
    assert alone.find("refused")["where"] == wrong
    assert alone.code == 1
    async with Router() as router:
        beside = await doctor("-e", wrong, "-e", router.endpoint, "--quick")
    assert beside.wrong == {"refused": "warning"}
    assert beside.code == 1


async def test_a_host_that_nobody_knows() -> None:
    """A host name that does not resolve is told apart from a host that does not answer."""
    report = await doctor("-e", "tcp/no-such-host.invalid:7447")
    assert report.wrong == {"unknown_host": "error"}


async def test_a_port_that_is_no_router() -> None:
    """Something that listens and speaks no Zenoh is named as such."""
    server = await asyncio.start_server(lambda reader, writer: None, "127.0.0.1", 0)
    async with server:
        port = server.sockets[0].getsockname()[1]
        report = await doctor("-e", f"tcp/127.0.0.1:{port}", "--timeout", "1")
    assert report.wrong == {"session_refused": "error"}


# -- TLS ---------------------------------------------------------------------------------------------------------


def tls_router(certificate: tuple[Path, Path], ca: Path | None = None) -> Router:
    """A router with this certificate; with ``ca`` it wants one of its clients."""
    mutual = [f"transport/link/tls/root_ca_certificate:'{ca}'", "transport/link/tls/enable_mtls:true"] if ca else []
    return Router(
        listen=[f"tls/127.0.0.1:{free_port()}"],
        overrides=[
            f"transport/link/tls/listen_certificate:'{certificate[0]}'",
            f"transport/link/tls/listen_private_key:'{certificate[1]}'",
            *mutual,
        ],
    )


def trusting(ca: Path) -> str:
    """The setting of a client that trusts this CA."""
    return f"transport/link/tls/root_ca_certificate:'{ca}'"


def showing(certificate: tuple[Path, Path], *, mtls: bool = True) -> list[str]:
    """The settings of a client with this certificate."""
    return [
        f"transport/link/tls/connect_certificate:'{certificate[0]}'",
        f"transport/link/tls/connect_private_key:'{certificate[1]}'",
        *(["transport/link/tls/enable_mtls:true"] if mtls else []),
    ]


@pytest.fixture
def authority(tmp_path: Path) -> Authority:
    """A CA."""
    return Authority(tmp_path / "ca")


@pytest.fixture
def foreign(tmp_path: Path) -> Authority:
    """Somebody else's CA."""
    return Authority(tmp_path / "foreign", "foreign CA")


async def test_an_expired_certificate_is_named(authority: Authority) -> None:
    """A router whose certificate has expired is an error that says so."""
    async with tls_router(authority.issue("router", days=-1)) as router:
        report = await doctor("-e", router.endpoint, cfg=[trusting(authority.ca)])
    assert report.wrong == {"tls_expired": "error"}
    assert report.code == 1


async def test_an_unknown_ca_is_named(authority: Authority, foreign: Authority) -> None:
    """A router whose certificate is from another CA is an error that says so."""
    async with tls_router(foreign.issue("router")) as router:
        report = await doctor("-e", router.endpoint, cfg=[trusting(authority.ca)])
    assert report.wrong == {"tls_unknown_ca": "error"}


async def test_a_certificate_for_another_host_is_named(authority: Authority) -> None:
    """A router whose certificate does not have the address that we connect to is an error that says so."""
    async with tls_router(authority.issue("router", address="192.0.2.1")) as router:
        report = await doctor("-e", router.endpoint, cfg=[trusting(authority.ca)])
    assert report.wrong == {"tls_wrong_name": "error"}


async def test_a_missing_client_certificate_is_named(authority: Authority) -> None:
    """A router that wants a client certificate and gets none, also because enable_mtls is forgotten."""
    async with tls_router(authority.issue("router"), authority.ca) as router:
        none = await doctor("-e", router.endpoint, cfg=[trusting(authority.ca)])
        settings = [trusting(authority.ca), *showing(authority.issue("robot-7"), mtls=False)]
        forgotten = await doctor("-e", router.endpoint, cfg=settings)
    assert none.wrong == {"tls_client_certificate_missing": "error"}
    assert forgotten.wrong == {"tls_client_certificate_missing": "error", "mtls_off": "warning"}


async def test_a_refused_client_certificate_is_named(authority: Authority, foreign: Authority) -> None:
    """A client certificate that is foreign or has expired is refused, and that is what the doctor says."""
    async with tls_router(authority.issue("router"), authority.ca) as router:
        for certificate, also in (
            (foreign.issue("thief"), {}),
            (authority.issue("late", days=-1), {"certificate_expired": "error"}),
        ):
            report = await doctor("-e", router.endpoint, cfg=[trusting(authority.ca), *showing(certificate)])
            assert report.wrong == {"tls_client_certificate_refused": "error", **also}


@pytest.mark.parametrize("broken", ["missing", "garbage", "mismatch"])
async def test_a_file_of_ours_that_is_broken_is_named(authority: Authority, tmp_path: Path, broken: str) -> None:
    """A key that is missing, is none or belongs to another certificate is an error that names the file."""
    certificate, _ = authority.issue("robot")
    wrong = tmp_path / "wrong.key"
    if broken == "garbage":
        wrong.write_text("garbage")
    elif broken == "mismatch":
        wrong = authority.issue("other")[1]
    async with tls_router(authority.issue("router"), authority.ca) as router:
        report = await doctor("-e", router.endpoint, cfg=[trusting(authority.ca), *showing((certificate, wrong))])
    assert "tls_own_files" in report.wrong
    assert str(wrong) in report.find("tls_own_files")["what"]


async def test_mutual_tls_that_works(authority: Authority) -> None:
    """With the right certificates nothing is wrong, except that one ends soon; a tcp endpoint for that port is."""
    async with tls_router(authority.issue("router", days=3), authority.ca) as router:
        settings = [trusting(authority.ca), *showing(authority.issue("robot-7"))]
        report = await doctor("-e", router.endpoint, "--quick", cfg=settings)
        plain = await doctor("-e", router.endpoint.replace("tls/", "tcp/"), "--timeout", "1")
    assert report.wrong == {"certificate_ends": "warning"}
    assert report.code == 1
    assert plain.wrong == {"speaks_tls": "error"}


# -- access rules ------------------------------------------------------------------------------------------------


@pytest.fixture
def guarded(tmp_path: Path) -> Router:
    """A router with the shipped access rules, and passwords in place of certificates."""
    rules = tmp_path / "rules.json5"
    rules.write_text(RULES.read_text().replace("cert_common_names", "usernames"))
    passwords = tmp_path / "passwords"
    passwords.write_text("".join(f"{user}:secret\n" for user in USERS))
    return Router(
        rules,
        listen=[f"tcp/127.0.0.1:{free_port()}"],
        overrides=[f"transport/auth/usrpwd/dictionary_file:'{passwords}'", *credentials("observer")],
    )


async def test_what_access_rules_allow_and_forbid(guarded: Router) -> None:
    """Robot 7 and a gateway may do their work, and the gateway calls robot 7; as robot 8, robot 7's credentials are
    good for nothing, and the doctor names each thing; an observer sees."""
    async with (
        guarded as router,
        macs_zenoh.join(
            "ros", id=7, group=3, settings=MeshSettings(connect=[router.endpoint], overrides=credentials("robot-7"))
        ),
    ):
        endpoint = router.endpoint

        robot = await doctor("-e", endpoint, "--as", "ros/7", "--quick", cfg=credentials("robot-7"))
        assert not robot.wrong
        assert robot.has("admin_hidden")

        gateway = await doctor("-e", endpoint, "--as", "gateway/0", "--quick", cfg=credentials("gateway-1"))
        assert not gateway.wrong
        assert [program["called"] for program in gateway.document["facts"]["programs"]] == [True]

        thief = await doctor("-e", endpoint, "--as", "ros/8", "--quick", cfg=credentials("robot-7"))
        assert thief.wrong == {"presence_denied": "error", "inbox_denied": "error"}
        assert "macs/live/ros/0/8/**" in thief.find("presence_denied")["remedy"]
        assert thief.code == 1

        observer = await doctor("-e", endpoint, "--as", "observer", "--quick", cfg=credentials("observer"))
        assert not observer.wrong
        assert not observer.has("admin_hidden")


async def test_rules_that_hide_everybody(guarded: Router, tmp_path: Path) -> None:
    """Without a rule for presence nobody is seen, and the doctor says that it may be the rules."""
    rules = tmp_path / "rules.json5"
    rules.write_text(rules.read_text().replace('"macs/live/**", "macs/block/**", ', ""))
    async with guarded as router:
        report = await doctor("-e", router.endpoint, "--as", "ros/7", "--quick", cfg=credentials("robot-7"))
    assert report.wrong == {"presence_unread": "warning", "presence_denied": "error"}


async def test_a_call_that_is_forbidden(guarded: Router, tmp_path: Path) -> None:
    """A gateway that may do all but call robots learns that it is online and does not answer it."""
    rules = tmp_path / "rules.json5"
    rules.write_text(rules.read_text().replace('"macs/**/unity/*"', '"macs/to/**"'))
    settings = MeshSettings(connect=[guarded.endpoint], overrides=credentials("robot-7"))
    async with guarded as router, macs_zenoh.join("ros", id=7, group=3, settings=settings):
        report = await doctor("-e", router.endpoint, "--as", "gateway/0", "--quick", cfg=credentials("gateway-1"))
    assert report.wrong == {"call_denied": "warning"}


async def test_a_wrong_password(guarded: Router) -> None:
    """A password that the router does not take: the port answers, no session opens."""
    async with guarded as router:
        wrong = [*credentials("robot-7")[:1], "transport/auth/usrpwd/password:'wrong'"]
        report = await doctor("-e", router.endpoint, "--timeout", "1", cfg=wrong)
    assert report.wrong == {"session_refused": "error"}


async def test_what_a_plan_gives(tmp_path: Path) -> None:
    """With the files of `macs security generate` robot, gateway and operator may do their work, by mutual TLS; with a
    robot's file another robot is refused, and the operator measures everything."""
    policy = tmp_path / "policy.yaml"
    policy.write_text(POLICY)
    made = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "bridge", "security", "generate", str(policy), "--into", str(tmp_path / "pki")),
        cwd=ROOT,
    )
    assert await made.wait() == 0
    endpoint = f"tls/127.0.0.1:{free_port()}"

    def of(name: str) -> tuple[str, ...]:
        return ("--settings", str(tmp_path / "pki" / name / "macs.toml"), "-e", endpoint)

    async with (
        Router(tmp_path / "pki" / "site" / "router.json5", listen=[endpoint]),
        Program("gateway", "--port", "0", *of("hall")),
    ):
        for who in ("robot-7", "hall"):
            report = await doctor(*of(who), "--quick")
            assert not report.wrong
            assert report.find("access_ok")
        thief = await doctor(*of("robot-7"), "--as", "ros/8", "--quick")
        assert thief.wrong.keys() >= {"presence_denied", "inbox_denied"}
        anna = await doctor(*of("anna"), "--quick")
        assert not anna.wrong
        assert anna.find("program_ok")["where"].endswith("(block 1)")
        assert not anna.has("admin_hidden")


# -- who is there ------------------------------------------------------------------------------------------------


async def test_two_peers_on_one_router() -> None:
    """Two programs in peer mode on one router are a warning that names both."""
    async with Router() as router:
        peer = MeshSettings(mode="peer", connect=[router.endpoint])
        async with await Mesh.open(peer) as one, await Mesh.open(peer) as other:
            report = await doctor("-e", router.endpoint, "--quick")
    assert report.wrong == {"peers": "warning"}
    assert all(mesh.zid[:8] in report.find("peers")["what"] for mesh in (one, other))


@pytest.mark.parametrize("admin_space", [True, False])
async def test_two_routers_that_are_not_linked(admin_space: bool) -> None:
    """A mesh in two halves is an error, whether or not the routers tell; linked routers are none."""
    hidden = [] if admin_space else ["adminspace/enabled:false"]
    async with Router(overrides=hidden) as one:
        async with Router(overrides=hidden) as other:
            report = await doctor("-e", one.endpoint, "-e", other.endpoint, "--quick")
            assert report.wrong == {"split": "error"}
        async with Router(connect=[one.endpoint], overrides=hidden) as other:
            report = await doctor("-e", one.endpoint, "-e", other.endpoint, "--quick")
            assert not report.wrong
            assert report.has("admin_hidden") is not admin_space


async def test_everything_that_may_be_taken_twice() -> None:
    """Blocks, ids and names that two sessions have, a headset outside of its gateway's blocks, and one that answers no
    ping."""
    async with Router() as router:
        settings = MeshSettings(connect=[router.endpoint])
        async with await Mesh.open(settings) as one, await Mesh.open(settings) as other:
            tokens = [
                mesh.declare_token(key)
                for mesh in (one, other)
                for key in (
                    LEASE.of(block=3, zid=mesh.zid),
                    PRESENCE.of(type="ros", id=5, group=0, zid=mesh.zid),
                    PRESENCE.of(type="unity", id=1000 if mesh is one else 1, group=0, zid=mesh.zid),
                    NAME.of(name="drone", type="ros", id=5, zid=mesh.zid),
                )
            ]
            await other.tokens(PRESENCE.every())  # what a session declares arrives before what it asks afterwards
            report = await doctor("-e", router.endpoint, "--quick")
            assert tokens
    assert report.wrong == {
        "block_twice": "error",
        "id_twice": "error",
        "name_twice": "error",
        "id_outside": "warning",
        "program_silent": "warning",
    }


async def test_another_namespace() -> None:
    """Agents in another namespace than ours are told of: as a warning where they are the only ones."""
    async with Router() as router:
        settings = MeshSettings(connect=[router.endpoint], namespace="site1")
        async with macs_zenoh.join("ros", id=7, settings=settings):
            without = await doctor("-e", router.endpoint, "--quick")
            other = await doctor("-e", router.endpoint, "--quick", "--namespace", "site2")
            same = await doctor("-e", router.endpoint, "--quick", "--namespace", "site1")
    assert without.wrong == {"wrong_namespace": "warning"}
    assert "site1" in without.find("wrong_namespace")["what"]
    assert other.wrong == {"wrong_namespace": "warning"}
    assert not same.wrong
    assert [program["agents"] for program in same.document["facts"]["programs"]] == [["ros/7"]]


async def test_the_wheels_router_tells_of_itself() -> None:
    """`macs router` has its admin space on, as zenohd has: version and sessions are known."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    async with Program("router", "-l", endpoint):
        report = await doctor("-e", endpoint, "--quick")
    assert report.code == 0
    [router] = report.document["facts"]["endpoints"][0]["routers"]
    assert router["version"]
    assert router["sessions"]


async def test_settings_that_zenoh_does_not_forgive() -> None:
    """A queue that makes Zenoh panic, shared memory and a long lease are found in the configuration, before it is
    used."""
    report = await doctor(
        "-e",
        f"tcp/127.0.0.1:{free_port()}",
        cfg=[
            "transport/link/tx/queue/size/data:32",
            "transport/shared_memory/enabled:true",
            "transport/link/tx/lease:60000",
        ],
    )
    wrong = {"refused": "error", "queue_long": "error", "own_shared_memory": "warning", "lease_long": "warning"}
    assert report.wrong == wrong


async def test_people_get_text() -> None:
    """Without --json there are lines to read, without colours on a pipe, and nothing on stderr."""
    async with Router() as router:
        code, out, errors = await ended("doctor", "--quick", "-e", router.endpoint)
    lines = out.splitlines()
    assert code == 0
    assert not errors
    assert lines[0] == "Routers"
    assert any(line.startswith(f"  ok       {router.endpoint}: Zenoh ") for line in lines)
    assert "\033" not in out
