"""Figures: bounded, written as Prometheus reads them; rules and dashboard in config/ name only what there is."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

from bridge.metrics.answers import Answers
from bridge.metrics.endpoint import parse_address
from bridge.metrics.exposition import Exposition
from bridge.metrics.families import OTHERS, by_type, counter, drops, gauge
from bridge.metrics.hops import HopTimes
from bridge.metrics.watched import Watched
from macs_zenoh.errors import UsageError
from macs_zenoh.protocol.directory import AgentInfo, Directory
from macs_zenoh.protocol.trace import Report
from tests.support.processes import ROOT

CONFIG = ROOT / "config"
RULES = CONFIG / "prometheus" / "alerts.yml"
OF_OTHERS = {"macs_hop_seconds_bucket", "up", "process_cpu_seconds_total", "process_resident_memory_bytes"}
FIGURE = re.compile(r"\b(macs_[a-z_]+|process_[a-z_]+)\b")


def promtool(*argv: str, text: str | None = None) -> str:
    """What promtool says; skipped where it is not installed."""
    if shutil.which("promtool") is None:
        pytest.skip("no promtool here: apt-get install prometheus")
    ended = subprocess.run(
        ["promtool", *argv], input=text, capture_output=True, text=True, timeout=60, check=False, cwd=CONFIG
    )
    assert ended.returncode == 0, ended.stdout + ended.stderr
    return ended.stdout + ended.stderr


def test_a_figure_has_so_many_rows_and_no_more() -> None:
    """The largest keep their names, and the sum is that of all."""
    family = counter("macs_topic_messages", "messages")
    for number in range(1000):
        family.add(number, topic=f"/t{number}")
    bounded = family.bounded(20)
    assert len(bounded.rows) == 20
    assert sum(bounded.rows.values()) == sum(range(1000))
    assert bounded.rows[("topic", "/t999"),] == 999
    assert (("topic", OTHERS),) in bounded.rows
    assert gauge("macs_linked", "link").add(True).rows == {(): 1}
    assert by_type("macs_agents", "agents", ["ros", "unity", "ros"]).rows == {
        (("type", "ros"),): 2,
        (("type", "unity"),): 1,
    }
    lost = drops({"session": {"no_route": 2}, "robot": {"no_route": 1}})
    assert {dict(labels)["where"]: count for labels, count in lost.rows.items()} == {"session": 2, "robot": 1}


def answers(problems: tuple[str, ...] = ()) -> Answers:
    return Answers(
        Watched(
            "gateway",
            lambda: None,
            figures=lambda: [counter("macs_topic_messages", "m").add(3, topic='/a"\n', direction="out")],
            problems=lambda: list(problems),
            facts=lambda: {"more": 1},
        )
    )


def test_figures_are_written_as_prometheus_reads_them() -> None:
    """In the old text unless OpenMetrics is asked for, with names that its own tool finds nothing wrong with."""
    status, body, media_type = answers().answer("/metrics")
    assert (status, media_type.partition(";")[0]) == (200, "text/plain")
    text = body.decode()
    assert 'macs_topic_messages_total{direction="out",topic="/a\\"\\n"} 3.0' in text
    assert re.search(r'macs_build_info\{macs="[^"]+",program="gateway",python="3[^"]+",zenoh="[^"]+"\} 1.0', text)
    assert "process_cpu_seconds_total" in text
    promtool("check", "metrics", text=text)
    _, body, media_type = answers().answer("/metrics", "application/openmetrics-text; version=1.0.0")
    assert media_type.startswith("application/openmetrics-text")
    assert body.endswith(b"# EOF\n")


def test_hops_of_traced_messages_are_a_histogram() -> None:
    """A bucket for each bound, all hops of one message, and what a clock gets wrong counts as nothing."""
    hops = HopTimes()
    for _ in range(3):
        points = [("put", 0, "r"), ("sent", 400_000, "r"), ("router", 300_000, "x"), ("in", 5, "g"), ("done", 9, "g")]
        hops.take(Report(1, 1, "key", "loop", points))
    made = hops.histogram()
    assert set(made.rows) == {"into_zenoh", "to_router", "handled"}
    assert made.rows["into_zenoh"][0][:3] == [0, 3, 0]
    assert made.rows["into_zenoh"][1] == pytest.approx(0.0012)
    assert made.rows["to_router"] == ([3] + [0] * 7, 0.0)
    text = Exposition().write([], [made])[0].decode()
    assert 'macs_hop_seconds_bucket{hop="into_zenoh",le="0.0005"} 3.0' in text
    assert 'macs_hop_seconds_bucket{hop="into_zenoh",le="+Inf"} 3.0' in text
    promtool("check", "metrics", text=text)


def test_a_program_has_at_most_two_hundred_series() -> None:
    """Whatever there is on the mesh: counters of which nobody thought, agents of all types, hundreds of topics, and
    every hop."""
    directory = Directory()
    for kind in range(1, 255):
        directory.token(AgentInfo(kind, 1, 0, "z").presence, True, 0.0)
    topics = [gauge(f"macs_{name}", "of topics") for name in ("first", "second", "third")]
    for family in topics:
        for number in range(500):
            family.add(number, topic=f"/t{number}", direction="out")
    others = [gauge(f"macs_other_{number}", "one").add(1) for number in range(25)]
    lost = {where: {f"{where}{number}": number for number in range(300)} for where in ("gateway", "connections")}
    watched = Watched(
        "gateway",
        lambda: None,
        figures=lambda: [*(family.bounded(12) for family in topics), *others],
        lost=lambda: lost,
        directory=lambda: directory,
    )
    hops = HopTimes()
    names = ("ROS node", "taken", "put", "sent", "router", "router", "received", "in", "done")
    hops.take(Report(1, 1, "key", "loop", [(name, at * 1000, "c") for at, name in enumerate(names)]))
    hops.take(Report(1, 1, "key", "loop", [("socket", 0, "c"), ("put", 5, "c")]))
    text = Exposition().write(watched.figures(), [hops.histogram()])[0].decode()
    series = [line for line in text.splitlines() if line and not line.startswith("#")]
    assert 150 < len(series) <= 200
    promtool("check", "metrics", text=text)


def test_health_and_diagnostics() -> None:
    """Alive is who answers; not ready says why; all that is known is JSON; what there is not is told."""
    assert answers().answer("/healthz")[:2] == (200, b"ok\n")
    status, body, _ = answers(("it does not listen yet",)).answer("/readyz")
    assert (status, body) == (503, b"it is not on the mesh yet\n")
    said = json.loads(answers().answer("/diagnostics").body)
    assert (said["program"], said["ready"], said["more"]) == ("gateway", False, 1)
    assert said["problems"] == ["it is not on the mesh yet"]
    assert answers().answer("/secrets").status == 404


@pytest.mark.parametrize(
    ("text", "where"),
    [
        ("9447", ("127.0.0.1", 9447)),
        ("0.0.0.0:9000", ("0.0.0.0", 9000)),
        ("127.0.0.1:0", ("127.0.0.1", 0)),
        ("[::1]:9000", ("::1", 9000)),
        ("robot.local", ("robot.local", 9447)),
    ],
)
def test_where_figures_are_told(text: str, where: tuple[str, int]) -> None:
    """A port alone is one of this machine."""
    assert parse_address(text) == where


@pytest.mark.parametrize("text", ["", "99999", "a b:1", "tcp/127.0.0.1:9", "127.0.0.1:x"])
def test_a_wrong_place_is_told(text: str) -> None:
    """In one line."""
    with pytest.raises(UsageError, match="--metrics"):
        parse_address(text)


# -- what is shipped -------------------------------------------------------------------------------------------------


def figures_in_the_code() -> set[str]:
    """The name of every figure that the code makes, as it is told to Prometheus."""
    found = set()
    for path in (ROOT / "bridge").rglob("*.py"):
        text = path.read_text(encoding="utf-8")
        for kind, name in re.findall(r"\b(counter|gauge|by_type|Family|Histogram)\(\s*\"(macs_\w+)\"", text):
            found.add(f"{name}_total" if kind == "counter" else f"{name}_info" if kind == "Family" else name)
    server = (ROOT / "bridge" / "gateway" / "server.py").read_text(encoding="utf-8")
    amounts = server.partition("def amounts")[2].partition("]\n")[0]
    return found | set(re.findall(r'\("(\w+)", "', amounts))


def dashboard_expressions(value: Any) -> list[str]:
    """Every query of a dashboard."""
    if isinstance(value, dict):
        own = [value["expr"]] if isinstance(value.get("expr"), str) else []
        return own + [each for item in value.values() for each in dashboard_expressions(item)]
    return [each for item in value for each in dashboard_expressions(item)] if isinstance(value, list) else []


def test_the_page_has_every_figure() -> None:
    """docs/metrics.md names what the code tells, all of it and nothing else."""
    page = (ROOT / "docs" / "metrics.md").read_text(encoding="utf-8")
    table = page.partition("## Figures")[2].partition("## Logs")[0]
    assert set(re.findall(r"`(macs_\w+)", table)) == figures_in_the_code()


def test_rules_and_dashboard_name_figures_that_there_are() -> None:
    """A figure that was renamed would be noticed by nobody: its alert would never fire."""
    known = figures_in_the_code() | OF_OTHERS
    dashboard = json.loads((CONFIG / "grafana" / "macs.json").read_text(encoding="utf-8"))
    queries = dashboard_expressions(dashboard)
    assert len(queries) > 15
    for text in (RULES.read_text(encoding="utf-8"), *queries):
        expressions = re.findall(r"expr: (.*(?:\n {10}.*)?)", text) or [text]
        for expression in expressions:
            assert set(FIGURE.findall(expression)) <= known, expression


def test_promtool_accepts_rules_and_configuration(tmp_path: Path) -> None:
    """And every query of the dashboard, as the expression of a rule."""
    assert "SUCCESS" in promtool("check", "config", "prometheus/prometheus.yml")
    dashboard = json.loads((CONFIG / "grafana" / "macs.json").read_text(encoding="utf-8"))
    queries = [each.replace("$instance", ".*") for each in dashboard_expressions(dashboard)]
    rules = [{"record": f"panel:{number}", "expr": query} for number, query in enumerate(queries)]
    path = tmp_path / "panels.json"  # JSON is YAML
    path.write_text(json.dumps({"groups": [{"name": "panels", "rules": rules}]}))
    assert f"{len(queries)} rules found" in promtool("check", "rules", str(path))


def test_alerts_fire_when_they_should_and_only_then(tmp_path: Path) -> None:
    """Each rule against series that a program would tell."""
    cases = {
        "MacsProgramGone": ('up{job="macs-robot", instance="r7"}', "0x60", "1x60"),
        "MacsNotReady": ('macs_ready{job="macs-robot", instance="r7"}', "0x60", "1x60"),
        "MacsRouterLost": ('macs_linked{job="macs-robot", instance="r7"}', "0x60", "1x60"),
        "MacsRobotStopped": ('macs_robot_stopped{instance="r7"}', "1x60", "0x60"),
        "MacsDeadManActed": ('macs_robot_deadman_trips_total{instance="r7", topic="/cmd_vel"}', "0x50 1x10", "1x60"),
        "MacsLosing": ('macs_drops_total{instance="r7", where="session", counter="no_route"}', "0+50x60", "5x60"),
        "MacsLoopBehind": ('macs_drops_total{instance="r7", where="session", counter="backlog"}', "0+1x60", "9x60"),
        "MacsSlowReaders": ('macs_slow_agents{instance="g1"}', "3x60", "0x60"),
    }
    named = re.findall(r"- alert: (\w+)", RULES.read_text(encoding="utf-8"))
    assert sorted(named) == sorted(cases)
    if shutil.which("promtool") is None:
        pytest.skip("no promtool here: apt-get install prometheus")
    for alert, (series, bad, good) in cases.items():
        for values, fires in ((bad, True), (good, False)):
            path = tmp_path / f"{alert}.json"
            look = {"eval_time": "10m", "alertname": alert, "exp_alerts": []}
            one = {
                "interval": "10s",
                "input_series": [{"series": series, "values": values}],
                "alert_rule_test": [look],
            }
            path.write_text(json.dumps({"rule_files": [str(RULES)], "evaluation_interval": "10s", "tests": [one]}))
            ended = subprocess.run(
                ["promtool", "test", "rules", str(path)], capture_output=True, text=True, timeout=60, check=False
            )
            said = ended.stdout + ended.stderr
            assert (ended.returncode != 0) is fires, (
                alert,
                values,
                said,
            )  # nothing is expected, so one that fires fails
            assert not fires or f'alertname="{alert}"' in said, said
