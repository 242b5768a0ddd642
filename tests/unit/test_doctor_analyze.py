"""What the doctor makes of facts: recorded on a healthy mesh (two linked routers, a gateway, a robot), and changed."""

from __future__ import annotations

import io
import json
import re
import string
from collections.abc import Callable
from pathlib import Path

import msgspec
import pytest

from bridge.cli import terminal
from bridge.cli.doctor import shown
from bridge.doctor import report, transport
from bridge.doctor.analyze import analyze
from bridge.doctor.checks import CHECKS, ERROR, GROUPS, NOTE, OK, WARNING, Severity
from bridge.doctor.facts import Certificate, Clock, Echo, Endpoint, Facts, Rights, RouterInfo, Session, Tls
from bridge.doctor.findings import found, worst
from macs_zenoh.protocol import endpoints
from macs_zenoh.protocol.keyexpr import LEASE, NAME, PRESENCE
from macs_zenoh.protocol.ping import Pong

ROOT = Path(__file__).parents[2]
RECORDED = (ROOT / "tests" / "facts" / "healthy_mesh.json").read_bytes()


def healthy() -> Facts:
    """The recorded facts, to be changed."""
    return msgspec.json.decode(RECORDED, type=Facts)


def wrong(facts: Facts) -> dict[str, Severity]:
    """Everything above ok, by id."""
    return {finding.id: finding.severity for finding in analyze(facts) if finding.severity > OK}


def test_a_healthy_mesh_has_nothing_wrong() -> None:
    """The recorded facts make findings that are all ok, in the order of the groups."""
    findings = analyze(healthy())
    assert {finding.severity for finding in findings} == {OK}
    assert [finding.group for finding in findings] == sorted((finding.group for finding in findings), key=GROUPS.index)
    assert {finding.group for finding in findings} == set(GROUPS) - {"tls"}


Change = Callable[[Facts], object]
CHANGES: list[tuple[str, Severity, Change]] = []


def makes(name: str, severity: Severity) -> Callable[[Change], Change]:
    """Marks a change of the healthy facts that makes one finding, and no other."""

    def mark(change: Change) -> Change:
        CHANGES.append((name, severity, change))
        return change

    return mark


def _replace(facts: Facts, **settings: object) -> None:
    for name, value in settings.items():
        [path] = [path for path in facts.own.zenoh_settings if path.replace("/", "_").endswith(name)]
        facts.own.zenoh_settings[path] = value


def _first_router(facts: Facts) -> list[RouterInfo]:
    """One router as both endpoints show it."""
    return [endpoint.routers[0] for endpoint in facts.endpoints]


def _down(facts: Facts, **values: object) -> None:
    """The second endpoint does not open."""
    endpoint = Endpoint(endpoint=facts.endpoints[1].endpoint)
    for name, value in values.items():
        setattr(endpoint, name, value)
    facts.endpoints[1] = endpoint


@makes("refused", WARNING)
def _(facts: Facts) -> None:
    _down(facts, reach="refused", reach_detail="Connection refused")


@makes("silent", WARNING)
def _(facts: Facts) -> None:
    _down(facts, reach="silent", reach_detail="no answer within 3 s")


@makes("unknown_host", WARNING)
def _(facts: Facts) -> None:
    _down(facts, reach="unknown_host", reach_detail="Name or service not known")


@makes("unreachable", WARNING)
def _(facts: Facts) -> None:
    _down(facts, reach="unreachable", reach_detail="No route to host")


@makes("session_refused", ERROR)
def _(facts: Facts) -> None:
    _down(facts, reach="ok", problem="Unable to connect to any of [Single(tcp/127.0.0.1:7447)]. Timeout!")


@makes("is_gateway", ERROR)
def _(facts: Facts) -> None:
    _down(facts, reach="ok", problem="Unable to connect", speaker="gateway")


@makes("speaks_tls", ERROR)
def _(facts: Facts) -> None:
    _down(facts, reach="ok", problem="Unable to connect", speaks_tls=True)


@makes("admin_hidden", NOTE)
def _(facts: Facts) -> None:
    facts.endpoints[0].routers = []


@makes("versions_differ", NOTE)
def _(facts: Facts) -> None:
    for router in _first_router(facts):
        router.version = "v1.10.3-release built with rustc"


@makes("versions_differ", WARNING)
def _(facts: Facts) -> None:
    for router in _first_router(facts):
        router.version = "v1.9.0"


@makes("split", ERROR)
def _(facts: Facts) -> None:
    for endpoint in facts.endpoints:
        for router in endpoint.routers:
            router.routers = [router.zid]
            router.sessions = [session for session in router.sessions if session.whatami != "router"]


@makes("link_dead", ERROR)
def _(facts: Facts) -> None:
    for router in _first_router(facts):
        router.sessions.append(Session(zid="cc", whatami="router", shared_memory=False, address="tcp/10.0.0.9:1"))


@makes("link_stale", ERROR)
def _(facts: Facts) -> None:
    facts.endpoints[0].misses = facts.endpoints[1].presence[:1]


@makes("slow", NOTE)
def _(facts: Facts) -> None:
    facts.endpoints[0].path.round_trips_ms = [210.0, 205.0, 300.0]


@makes("commands_wait", WARNING)
def _(facts: Facts) -> None:
    facts.endpoints[0].drops_commands = False


@makes("large_dropped", NOTE)
def _(facts: Facts) -> None:  # 4 x 252 KiB in 0.4 s
    facts.endpoints[0].path.echoes = [Echo(size_bytes=4096, took_s=0.1), Echo(size_bytes=262144, took_s=0.5)]


@makes("large_lost", WARNING)
def _(facts: Facts) -> None:
    facts.programs[0].path.lost_bytes = 65536


@makes("peer", NOTE)
def _(facts: Facts) -> None:
    for router in _first_router(facts):
        router.sessions[1].whatami = "peer"


@makes("peers", WARNING)
def _(facts: Facts) -> None:
    for router in _first_router(facts):
        router.sessions += [
            Session(zid=zid, whatami="peer", shared_memory=False, address="tcp/10.0.0.9:1") for zid in ("aa", "bb")
        ]


@makes("session_shared_memory", WARNING)
def _(facts: Facts) -> None:
    for router in _first_router(facts):
        router.sessions[2].shared_memory = True


@pytest.mark.parametrize("problem", [name.removeprefix("tls_") for name in CHECKS if name.startswith("tls_")])
def test_each_tls_problem_is_a_finding(problem: str) -> None:
    """Every way in which a handshake fails has words of its own; when Zenoh is content, none is said."""
    facts = healthy()
    _down(facts, reach="ok", problem="Timeout!", tls=Tls(problem=problem, detail="unknown ca"))  # type: ignore[arg-type]
    assert wrong(facts) == {f"tls_{problem}": ERROR}
    facts.endpoints[1].router = facts.endpoints[0].router
    assert not wrong(facts).keys() - {"admin_hidden"}


@makes("mtls_off", WARNING)
def _(facts: Facts) -> None:
    _replace(facts, connect_certificate="/etc/macs/robot-7.pem")


@makes("certificate_ends", WARNING)
def _(facts: Facts) -> None:
    facts.own.certificates = [Certificate(subject="robot-7.pem (CN=robot-7)", ends_s=facts.at_s + 3 * 86_400)]


@makes("certificate_expired", ERROR)
def _(facts: Facts) -> None:
    facts.own.certificates = [Certificate(subject="robot-7.pem (CN=robot-7)", ends_s=facts.at_s - 1)]


@makes("presence_denied", ERROR)
def _(facts: Facts) -> None:
    facts.endpoints[0].rights.seen = False


@makes("presence_unread", WARNING)
def _(facts: Facts) -> None:
    facts.own.who = ""
    facts.endpoints[0].rights = Rights(seen=False, sees=None, pings=True)


@makes("presence_unwatched", ERROR)
def _(facts: Facts) -> None:
    facts.endpoints[0].rights.watches = False


@makes("lease_denied", ERROR)
def _(facts: Facts) -> None:
    facts.endpoints[1].rights.leases = False


@makes("inbox_denied", ERROR)
def _(facts: Facts) -> None:
    facts.endpoints[1].rights.hears = False


@makes("call_denied", WARNING)
def _(facts: Facts) -> None:
    facts.programs[0].called = False


@makes("ping_denied", NOTE)
def _(facts: Facts) -> None:
    facts.endpoints[1].rights.pings = False


@makes("nobody", NOTE)
def _(facts: Facts) -> None:
    facts.programs = []


@makes("block_twice", ERROR)
def _(facts: Facts) -> None:
    facts.endpoints[1].leases.append(LEASE.of(block=1, zid="aa"))


@makes("id_twice", ERROR)
def _(facts: Facts) -> None:
    facts.endpoints[1].presence.append(PRESENCE.of(type="ros", id=7, group=0, zid="aa"))


@makes("name_twice", ERROR)
def _(facts: Facts) -> None:
    facts.endpoints[0].names += [NAME.of(name="drone0", type="ros", id=i, zid=f"a{i}") for i in (1, 2)]


@makes("id_outside", WARNING)
def _(facts: Facts) -> None:
    facts.programs[1].agents.append("unity/7")


@makes("id_in_block", WARNING)
def _(facts: Facts) -> None:
    facts.programs[0].agents.append("unity/300")


@makes("other_namespace", NOTE)
def _(facts: Facts) -> None:
    facts.endpoints[0].elsewhere = ["site1/macs/live/ros/0/1/0/aa"]


@makes("ros_unnamed", NOTE)
def _(facts: Facts) -> None:
    facts.endpoints[0].ros_nodes = ["/robot1/talker"]


@makes("wrong_namespace", WARNING)
def _(facts: Facts) -> None:
    facts.programs = facts.programs[1:]
    facts.endpoints[0].elsewhere = ["site1/macs/live/ros/0/1/0/aa"]


@makes("program_silent", WARNING)
def _(facts: Facts) -> None:
    facts.programs[1].pong = None


@makes("programs_left_out", NOTE)
def _(facts: Facts) -> None:
    facts.programs[1].pong = None
    facts.unpinged = 1


@makes("clock_off", WARNING)
def _(facts: Facts) -> None:
    facts.programs[0].path.clock = Clock(offset_s=-2.5, within_s=0.01)


@makes("clock_off", WARNING)
def _(facts: Facts) -> None:
    facts.endpoints[0].path.clock = Clock(offset_s=0.2, within_s=0.01)


def _said(facts: Facts, **changes: object) -> None:
    pong = facts.programs[0].pong
    assert pong is not None
    facts.programs[0].pong = msgspec.structs.replace(pong, **changes)


@makes("macs_versions_differ", WARNING)
def _(facts: Facts) -> None:
    _said(facts, macs="0.2.0")


@makes("slots_differ", ERROR)
def _(facts: Facts) -> None:
    _said(facts, id_slots=20)


@makes("losses", NOTE)
def _(facts: Facts) -> None:
    _said(facts, drops={"backlog": 12})


@makes("wrong_settings", ERROR)
def _(facts: Facts) -> None:
    _said(facts, now={"wrong_settings": 1})


@makes("no_stop", ERROR)
def _(facts: Facts) -> None:
    _said(facts, now={"no_stop": 1})


@makes("shared_graph", WARNING)
def _(facts: Facts) -> None:
    _said(facts, now={"shared_graph": 1})


@makes("in_trouble", WARNING)
def _(facts: Facts) -> None:
    _said(facts, now={"waiting_for_id": 3})


@makes("program_shared_memory", WARNING)
def _(facts: Facts) -> None:
    _said(facts, shared_memory=True)


@makes("program_peer", WARNING)
def _(facts: Facts) -> None:
    _said(facts, mode="peer")


@makes("own_shared_memory", WARNING)
def _(facts: Facts) -> None:
    _replace(facts, shared_memory_enabled=None)  # Zenoh's default is on


@makes("own_multicast", NOTE)
def _(facts: Facts) -> None:
    _replace(facts, multicast_enabled=True)


@makes("own_mode", WARNING)
def _(facts: Facts) -> None:
    _replace(facts, mode="peer")


@makes("lease_short", WARNING)
def _(facts: Facts) -> None:
    _replace(facts, lease=500)


@makes("lease_long", WARNING)
def _(facts: Facts) -> None:
    _replace(facts, lease=60_000)


@makes("queue_long", ERROR)
def _(facts: Facts) -> None:
    _replace(facts, queue_size={"data": 32})


@makes("close_long", WARNING)
def _(facts: Facts) -> None:
    drop = {"max_wait_before_drop_fragments": 50_000}
    _replace(facts, congestion_control={"block": {"wait_before_close": 10_000_000}, "drop": drop})


@pytest.mark.parametrize(("name", "severity", "change"), CHANGES, ids=[name for name, _, _ in CHANGES])
def test_one_change_is_one_finding(name: str, severity: Severity, change: Change) -> None:
    """What is changed in the healthy facts is found, and nothing else."""
    facts = healthy()
    change(facts)
    assert wrong(facts) == {name: severity}


def test_nothing_that_answers_is_an_error() -> None:
    """Without any router that answers, the one endpoint's problem is an error, and nothing is said of the mesh."""
    facts = healthy()
    _down(facts, reach="refused")
    facts.endpoints, facts.programs = facts.endpoints[1:], []
    assert wrong(facts) == {"refused": ERROR}
    facts.endpoints = []
    assert wrong(facts) == {"no_endpoint": ERROR}


def test_routers_without_an_admin_space_are_judged_by_what_passes() -> None:
    """Where routers tell nothing, tokens that do not pass show a split; where tokens may not be seen, nothing does."""
    facts = healthy()
    for endpoint in facts.endpoints:
        endpoint.routers = []
    assert "split" not in wrong(facts)
    for endpoint in facts.endpoints:
        endpoint.meets = []
    assert wrong(facts)["split"] == ERROR
    facts.endpoints[0].rights.seen = False
    assert "split" not in wrong(facts)


def test_an_uncertain_clock_is_not_accused() -> None:
    """An offset that the way there may explain is no finding."""
    facts = healthy()
    facts.programs[0].path.clock = Clock(offset_s=0.4, within_s=0.35)
    assert not wrong(facts)


def test_every_kind_of_finding_is_tried() -> None:
    """Each finding of the table is made by some change above, and has all that its words need."""
    made = {name for name, _, _ in CHANGES} | {"no_endpoint"} | {name for name in CHECKS if name.startswith("tls_")}
    made |= {finding.id for finding in analyze(healthy())}
    assert made == set(CHECKS)
    for name, kind in CHECKS.items():
        fields = [field for _, field, _, _ in string.Formatter().parse(kind.text + kind.remedy) if field]
        finding = found(name, **dict.fromkeys(fields, "something"))
        assert kind.group in GROUPS
        assert finding.remedy or kind.severity == OK or name in ("nobody", "programs_left_out")


def test_the_page_explains_every_finding() -> None:
    """docs/doctor.md has each finding with its severity, and no other."""
    page = (ROOT / "docs" / "doctor.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `(\w+)` \| (\w+) \|", page, re.MULTILINE)
    assert len(rows) == len(dict(rows))
    assert dict(rows) == {name: kind.severity.name.lower() for name, kind in CHECKS.items()}


class Terminal(io.StringIO):
    """A stream that says that it is one."""

    def isatty(self) -> bool:
        return True


# -- reports -----------------------------------------------------------------------------------------------------


def test_the_exit_code_says_whether_something_is_wrong() -> None:
    """0 for notes, 1 for warnings and errors; 2 is left to wrong usage, as with every verb."""
    findings = {severity: found("nobody", severity=severity) for severity in Severity}
    assert [report.exit_code([findings[severity]]) for severity in Severity] == [0, 0, 1, 1]
    assert report.exit_code([]) == 0
    assert report.exit_code(list(findings.values())) == 1


def test_the_json_has_findings_and_facts() -> None:
    """The JSON report has the worst severity, each finding in full, and facts from which the same follows."""
    facts = healthy()
    _down(facts, reach="refused")
    document = json.loads(report.as_json(analyze(facts), facts))
    assert document["severity"] == "warning"
    [refused] = [finding for finding in document["findings"] if finding["severity"] == "warning"]
    assert refused == {
        "id": "refused",
        "group": "routers",
        "severity": "warning",
        "where": facts.endpoints[1].endpoint,
        "what": CHECKS["refused"].text,
        "remedy": CHECKS["refused"].remedy,
    }
    assert analyze(msgspec.convert(document["facts"], Facts)) == analyze(facts)


def test_the_text_is_grouped_and_says_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    """People read the groups, the signs, and behind an arrow what to do: in colour and within its width on a terminal,
    each in one line in a pipe."""
    monkeypatch.setenv("TERM", "xterm")
    for name in ("NO_COLOR", "FORCE_COLOR", "COLUMNS"):
        monkeypatch.delenv(name, raising=False)
    facts = healthy()
    _down(facts, reach="refused")
    blocks = list(shown(analyze(facts), facts))
    text = terminal.drawn(blocks, io.StringIO())
    assert text.splitlines()[0] == "Routers"
    assert f"  warning  {facts.endpoints[1].endpoint}: nobody listens there" in text.splitlines()
    assert "           → start the router there, or correct host and port" in text.splitlines()
    assert text.splitlines()[-1].startswith("1 warning; measured with ")
    assert "\033" not in text
    monkeypatch.setenv("COLUMNS", "60")
    in_colour = terminal.drawn(blocks, Terminal())
    assert "\033[33m" in in_colour
    shown_lines = re.sub("\033\\[[0-9;]*m", "", in_colour).splitlines()
    assert max(map(len, shown_lines)) <= 60
    assert "".join("".join(shown_lines).split()) == "".join(text.split())


def test_the_worst_finding_counts() -> None:
    """The severity of a report is that of its worst finding."""
    assert worst([]) == OK
    assert worst([found("nobody"), found("refused"), found("slow", round_trip="1 s")]) == ERROR


# -- looking -----------------------------------------------------------------------------------------------------


def test_an_endpoint_may_bring_its_own_tls_settings() -> None:
    """What an endpoint says after # comes before the configuration; null there is nothing."""
    zenoh = {"root_ca_certificate": "a.pem", "connect_certificate": None}
    settings = endpoints.tls_settings("tls/h:1#root_ca_certificate=b.pem;enable_mtls=true", zenoh)
    assert settings == {"root_ca_certificate": "b.pem", "enable_mtls": "true"}
    assert not transport.presents_certificate(settings)
    assert transport.presents_certificate({**settings, "connect_certificate": "c.pem"})


def test_a_pong_of_another_version_is_read() -> None:
    """A program that says more, or less, than we know is understood as far as it goes."""
    pong = msgspec.json.decode(b'{"time_s": 5.0, "mood": "fine"}', type=Pong)
    assert (pong.time_s, pong.macs, pong.drops) == (5.0, "", {})
