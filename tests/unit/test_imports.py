"""Imports point one way: tests -> bridge -> macs_zenoh -> msgspec and eclipse-zenoh."""

from __future__ import annotations

import ast
import importlib
import importlib.util
import re
import subprocess
import sys
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path
from types import ModuleType

import pytest

import macs_zenoh
from macs_zenoh import errors
from tests.support.sources import nodes, parsed

ROOT = Path(__file__).parents[2]
CORE = sorted((ROOT / "macs_zenoh").rglob("*.py"))
BRIDGE = sorted((ROOT / "bridge").rglob("*.py"))

PURE = sorted((ROOT / "macs_zenoh" / "protocol").rglob("*.py"))
WITH_ZENOH = set((ROOT / "macs_zenoh" / "mesh").glob("*.py"))
WITH_ASYNCIO = WITH_ZENOH | {
    ROOT / "macs_zenoh" / name
    for name in (
        "anew.py",
        "agent.py",
        "awareness.py",
        "calls_together.py",
        "claims.py",
        "deadline.py",
        "identity.py",
        "joining.py",
        "known.py",
        "late.py",
        "locked_out.py",
        "nodes.py",
        "presence.py",
        "presses.py",
        "timeouts.py",
        "registration_calls.py",
        "ros.py",
        "serving.py",
        "streams.py",
        "topics.py",
    )
}
NEEDED_FROM_OUTSIDE = {"msgspec", "zenoh", "tomli", "async_timeout"}
OFFERED = ROOT / "macs_zenoh" / "__init__.py"
"""It names what users import, of the bridge as well, for the type checker; it loads that when it is used."""
INPUT_OUTPUT = {
    "socket",
    "socketserver",
    "selectors",
    "ssl",
    "subprocess",
    "multiprocessing",
    "rclpy",
    "bridge",
    "tests",
}


@cache
def imported(path: Path) -> frozenset[tuple[str, bool]]:
    """The modules that a file imports, absolute, each with whether it is imported when the file is."""
    return frozenset(_imported(path))


def _imported(path: Path) -> Iterator[tuple[str, bool]]:
    package = path.relative_to(ROOT).with_suffix("").parts[:-1]
    waiting: list[tuple[ast.AST, bool]] = [(parsed(path), True)]
    while waiting:
        node, at_once = waiting.pop()
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else ()
            module = ".".join([*base, *([node.module] if node.module else [])])
            names = [module, *(f"{module}.{alias.name}" for alias in node.names)]
        elif isinstance(node, ast.expr):
            continue  # there are no statements in it
        else:
            inside = at_once and not runs_later(node)
            waiting += [(child, inside) for child in ast.iter_child_nodes(node)]
            continue
        for name in names:
            yield name, at_once


def runs_later(scope: ast.AST) -> bool:
    """Whether what is inside runs not when the file is imported: in a function, or for the type checker only."""
    if isinstance(scope, ast.If):
        return isinstance(scope.test, ast.Name) and scope.test.id == "TYPE_CHECKING"
    return isinstance(scope, ast.FunctionDef | ast.AsyncFunctionDef)


def short(path: Path) -> str:
    """A file's name, as it is told."""
    return str(path.relative_to(ROOT))


def those(wrong: Iterable[tuple[Path, set[str]]]) -> dict[str, set[str]]:
    """Files with what is wrong in them, where anything is."""
    return {short(path): names for path, names in wrong if names}


def roots(path: Path) -> set[str]:
    """The top-level packages that a file imports anywhere."""
    return {name.partition(".")[0] for name, _ in imported(path)}


def test_there_is_something_to_walk() -> None:
    """The walk below covers real files."""
    assert {path.name for path in CORE} >= {"wire.py", "keyexpr.py", "agent.py"}
    assert set(CORE) > WITH_ASYNCIO > WITH_ZENOH > set()
    assert BRIDGE


def test_the_core_imports_no_input_or_output() -> None:
    """In macs_zenoh: no bridge, no ROS, no sockets; asyncio and zenoh only where they are said to be."""
    used = {
        path: {name.partition(".")[0] for name, at_once in imported(path) if at_once or path != OFFERED}
        for path in CORE
    }
    assert those((path, names & INPUT_OUTPUT) for path, names in used.items()) == {}
    assert those((path, names & {"zenoh"}) for path, names in used.items() if path not in WITH_ZENOH) == {}
    assert those((path, names & {"asyncio"}) for path, names in used.items() if path not in WITH_ASYNCIO) == {}


def test_the_core_needs_only_what_it_declares() -> None:
    """Everything macs_zenoh imports is the standard library, itself or a declared dependency."""
    known = sys.stdlib_module_names | {"tomllib"} | NEEDED_FROM_OUTSIDE | {"macs_zenoh"}
    assert those((path, roots(path) - known - ({"bridge"} if path == OFFERED else set())) for path in CORE) == {}


def test_pure_modules_do_not_reach_back() -> None:
    """A pure module never imports the mesh or the agent API."""
    pure = [path for path in CORE if path not in WITH_ASYNCIO and path.name != "__init__.py"]
    upwards = {"macs_zenoh.mesh", "macs_zenoh.agent"}
    assert those((path, {name for name, _ in imported(path)} & upwards) for path in pure) == {}


def test_the_bridge_does_not_import_tests_or_zenoh() -> None:
    """The bridge reaches Zenoh through macs_zenoh only, ROS only in the robot's packages, and never tests."""
    assert those((path, roots(path) & {"tests", "zenoh"}) for path in BRIDGE) == {}
    without_ros = [path for path in BRIDGE if path.parent.name not in {"ros", "awareness"}]
    assert those((path, roots(path) & {"rclpy"}) for path in without_ros) == {}


def test_help_is_instant() -> None:
    """A CLI module imports what is heavy inside its functions, not when it is loaded."""
    ours = (
        "macs_zenoh.mesh",
        "macs_zenoh.agent",
        "macs_zenoh.join",
        "bridge.ros",
        "bridge.gateway",
        "bridge.headset",
    )
    verbs = [path for path in BRIDGE if path.parent.name == "cli"]
    at_once = {path: {name for name, when_loaded in imported(path) if when_loaded} for path in verbs}
    assert len(verbs) > 20
    heavy = {
        path: {name for name in names if name.startswith(ours) or name.partition(".")[0] in HEAVY}
        for path, names in at_once.items()
    }
    assert those(heavy.items()) == {}


def test_the_protocol_stands_alone() -> None:
    """What decides without input or output needs nothing but itself and the pure modules beside it."""
    allowed = tuple(f"macs_zenoh.{name}" for name in ("protocol", "errors", "plain", "config", "sections", "versions"))
    ours = {path: {name for name, _ in imported(path) if name.startswith("macs_zenoh.")} for path in PURE}
    assert (
        those((path, {name for name in names if not name.startswith(allowed)}) for path, names in ours.items()) == {}
    )


HEAVY = {"zenoh", "rosbags", "rich", "argcomplete"}
KEY = re.compile(r"/?(macs/|@/|@adv\b)|\*\*/$")
ENDPOINT = re.compile(r"(tcp|tls|quic|ws)/$")


def test_one_module_spells_keys_and_one_endpoints() -> None:
    """No other text in the code begins as a key of the mesh or of Zenoh, or puts an endpoint together."""
    keys, endpoints = {}, {}
    for path in (*CORE, *BRIDGE):
        inside = nodes(path)
        documents = {id(node.value) for node in inside if isinstance(node, ast.Expr)}
        texts = {
            node.value
            for node in inside
            if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in documents
        }
        if path.name != "keyexpr.py":
            keys[path] = {text for text in texts if KEY.match(text) and " " not in text}
        if path.name != "endpoints.py":
            made = [part for node in inside if isinstance(node, ast.JoinedStr) for part in node.values[:1]]
            begin = {str(part.value) for part in made if isinstance(part, ast.Constant)}
            endpoints[path] = {text for text in begin if ENDPOINT.fullmatch(text)}
    assert those(keys.items()) == {}
    assert those(endpoints.items()) == {}


def test_the_oldest_python_can_load_it() -> None:
    """No class is a named tuple and something else as well, such as generic: Python 3.10 refuses to load that."""
    for path in (*CORE, *BRIDGE):
        for node in nodes(path):
            if isinstance(node, ast.ClassDef) and len(node.bases) > 1:
                assert "NamedTuple" not in {ast.unparse(base) for base in node.bases}, f"{path.name}: {node.name}"


def test_the_public_names_are_there() -> None:
    """Each name that macs_zenoh lists can be had, errors among them, and it knows its version."""
    for name in macs_zenoh.__all__:
        if importlib.util.find_spec("as2_ca_msgs") or ("Gateway" not in name and name != "Mode"):
            assert getattr(macs_zenoh, name).__module__.startswith(("macs_zenoh.", "bridge."))
    assert isinstance(macs_zenoh.__version__, str)
    with pytest.raises(AttributeError, match="nothing_of_ours"):
        _ = macs_zenoh.nothing_of_ours  # type: ignore[attr-defined]


def test_every_error_can_be_caught() -> None:
    """Whatever is raised is offered by name; an answer that does not come in time is a TimeoutError to everybody."""
    of_errors = {name for name, kind in vars(errors).items() if isinstance(kind, type)}
    assert of_errors | {"BadCdr", "BadValue", "UnknownType"} <= set(macs_zenoh.__all__)
    late = macs_zenoh.CallTimeout("ros/7 look", 2.0)
    assert isinstance(late, TimeoutError)
    assert isinstance(late, macs_zenoh.Unreachable)
    assert str(late) == "ros/7 look cannot be reached: no answer within 2 s"
    assert late.timeout_s == 2.0


def test_what_is_listed_is_what_the_type_checker_sees() -> None:
    """Each public name is imported for the type checker, from where it is loaded."""
    tree = parsed(OFFERED)
    seen = {
        alias.name: f"{'macs_zenoh.' if node.level else ''}{node.module}"
        for scope in ast.walk(tree)
        if isinstance(scope, ast.If) and runs_later(scope)
        for node in scope.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    assert seen == macs_zenoh._MODULES


def test_help_needs_no_zenoh() -> None:
    """A command line that only explains itself loads neither Zenoh nor asyncio's programs."""
    code = "import sys, bridge.cli; bridge.cli.build_parser(); sys.exit('zenoh' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=False).returncode == 0


def test_a_verb_loads_no_other() -> None:
    """A command line loads the module of its verb, not those of all verbs."""
    code = "import sys, bridge.cli; bridge.cli.build_parser('keys'); print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True, capture_output=True, text=True).stdout
    assert "bridge.cli.keys" in loaded.split()
    assert not {"bridge.cli.doctor", "bridge.cli.up", "bridge.cli.security"} & set(loaded.split())


OURS = ("macs_zenoh", "bridge", "tests.support")
OTHERS = sorted(path for folder in ("tests", "benchmarks", "examples") for path in (ROOT / folder).rglob("*.py"))


def test_tests_and_benchmarks_name_what_exists() -> None:
    """Whatever tests, benchmarks and examples import of us is there, and so is each attribute of a module of ours
    that they use: else only a whole run would tell of a name that has moved."""
    gone = [f"{path.relative_to(ROOT)}:{line} {name}" for path in OTHERS for line, name in nowhere(path)]
    assert gone == []


def test_tests_import_each_other_by_full_names() -> None:
    """As ``tests.ros.driven``: a name without its folder is found in none of the ways in which tests are run, and a
    module that is imported by two names exists twice."""
    alone = {path.stem for path in (ROOT / "tests").rglob("*.py")} - sys.stdlib_module_names
    used = {(path, name) for path in (ROOT / "tests").rglob("*.py") for name in roots(path) & alone}
    assert sorted(f"{path.relative_to(ROOT)} imports {name}" for path, name in used) == []


def nowhere(path: Path) -> Iterator[tuple[int, str]]:
    """Names of ours in a file that do not exist, with their lines. What needs ROS is looked at where ROS is."""
    inside = nodes(path)
    modules: dict[str, ModuleType] = {}
    for node in inside:
        if not isinstance(node, ast.ImportFrom) or node.level or not (node.module or "").startswith(OURS):
            continue
        try:
            module = importlib.import_module(node.module or "")
        except ModuleNotFoundError as error:
            if (error.name or "").startswith(OURS):
                yield node.lineno, str(node.module)
            continue
        for alias in node.names:
            if not hasattr(module, alias.name) and _submodule(module, alias.name) is None:
                yield node.lineno, f"{node.module}.{alias.name}"
            elif isinstance(found := getattr(module, alias.name), ModuleType):
                modules[alias.asname or alias.name] = found
    hidden = {node.id for node in inside if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)}
    hidden |= {node.arg for node in inside if isinstance(node, ast.arg)}
    for node in inside:
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id not in hidden:
            used = modules.get(node.value.id)
            if used is not None and not hasattr(used, node.attr):
                yield node.lineno, f"{used.__name__}.{node.attr}"


def _submodule(module: ModuleType, name: str) -> ModuleType | None:
    try:
        return importlib.import_module(f"{module.__name__}.{name}")
    except ModuleNotFoundError:
        return None
