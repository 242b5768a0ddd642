"""Imports point one way: tests -> bridge -> macs_zenoh -> msgspec and eclipse-zenoh."""

from __future__ import annotations

import ast
import importlib
import importlib.util
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest

import macs_zenoh
from macs_zenoh import errors

ROOT = Path(__file__).parents[2]
CORE = sorted((ROOT / "macs_zenoh").rglob("*.py"))
BRIDGE = sorted((ROOT / "bridge").rglob("*.py"))

PURE = sorted((ROOT / "macs_zenoh" / "protocol").rglob("*.py"))
WITH_ZENOH = set((ROOT / "macs_zenoh" / "mesh").glob("*.py"))
WITH_ASYNCIO = WITH_ZENOH | {
    ROOT / "macs_zenoh" / name
    for name in (
        "agent.py",
        "awareness.py",
        "claims.py",
        "deadline.py",
        "identity.py",
        "joining.py",
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


def imported(path: Path) -> Iterator[tuple[str, bool]]:
    """The modules that a file imports, absolute, each with whether it is imported when the file is."""
    package = path.relative_to(ROOT).with_suffix("").parts[:-1]
    tree = ast.parse(path.read_text(encoding="utf-8"))
    later = {id(node) for scope in ast.walk(tree) if runs_later(scope) for node in ast.walk(scope)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else ()
            module = ".".join([*base, *([node.module] if node.module else [])])
            names = [module, *(f"{module}.{alias.name}" for alias in node.names)]
        else:
            continue
        for name in names:
            yield name, id(node) not in later


def runs_later(scope: ast.AST) -> bool:
    """Whether what is inside runs not when the file is imported: in a function, or for the type checker only."""
    if isinstance(scope, ast.If):
        return isinstance(scope.test, ast.Name) and scope.test.id == "TYPE_CHECKING"
    return isinstance(scope, ast.FunctionDef | ast.AsyncFunctionDef)


def roots(path: Path) -> set[str]:
    """The top-level packages that a file imports anywhere."""
    return {name.partition(".")[0] for name, _ in imported(path)}


def test_there_is_something_to_walk() -> None:
    """The walk below covers real files."""
    assert {path.name for path in CORE} >= {"wire.py", "keyexpr.py", "agent.py"}
    assert set(CORE) > WITH_ASYNCIO > WITH_ZENOH > set()
    assert BRIDGE


@pytest.mark.parametrize("path", CORE, ids=lambda path: path.name)
def test_the_core_imports_no_input_or_output(path: Path) -> None:
    """In macs_zenoh: no bridge, no ROS, no sockets; asyncio and zenoh only where they are said to be."""
    used = {name.partition(".")[0] for name, at_once in imported(path) if at_once or path != OFFERED}
    assert not used & INPUT_OUTPUT
    assert "zenoh" not in used or path in WITH_ZENOH
    assert "asyncio" not in used or path in WITH_ASYNCIO


@pytest.mark.parametrize("path", CORE, ids=lambda path: path.name)
def test_the_core_needs_only_what_it_declares(path: Path) -> None:
    """Everything macs_zenoh imports is the standard library, itself or a declared dependency."""
    offered = {"bridge"} if path == OFFERED else set()
    assert roots(path) <= sys.stdlib_module_names | {"tomllib"} | NEEDED_FROM_OUTSIDE | {"macs_zenoh"} | offered


@pytest.mark.parametrize(
    "path", [p for p in CORE if p not in WITH_ASYNCIO and p.name != "__init__.py"], ids=lambda p: p.name
)
def test_pure_modules_do_not_reach_back(path: Path) -> None:
    """A pure module never imports the mesh or the agent API."""
    assert not {name for name, _ in imported(path)} & {"macs_zenoh.mesh", "macs_zenoh.agent"}


@pytest.mark.parametrize("path", BRIDGE, ids=lambda path: str(path.relative_to(ROOT)))
def test_the_bridge_does_not_import_tests_or_zenoh(path: Path) -> None:
    """The bridge reaches Zenoh through macs_zenoh only, ROS only in the robot's packages, and never tests."""
    used = roots(path)
    assert not used & {"tests", "zenoh"}
    if path.parent.name not in {"ros", "awareness"}:
        assert "rclpy" not in used


@pytest.mark.parametrize("path", [p for p in BRIDGE if p.parent.name == "cli"], ids=lambda path: path.name)
def test_help_is_instant(path: Path) -> None:
    """A CLI module imports what is heavy inside its functions, not when it is loaded."""
    heavy = (
        "macs_zenoh.mesh",
        "macs_zenoh.agent",
        "macs_zenoh.join",
        "bridge.ros",
        "bridge.gateway",
        "bridge.headset",
    )
    at_once = {name for name, when_loaded in imported(path) if when_loaded}
    assert not {name for name in at_once if name.startswith(heavy) or name.partition(".")[0] in HEAVY}


@pytest.mark.parametrize("path", PURE, ids=lambda path: path.name)
def test_the_protocol_stands_alone(path: Path) -> None:
    """What decides without input or output needs nothing but itself and the pure modules beside it."""
    ours = {name for name, _ in imported(path) if name.startswith("macs_zenoh.")}
    allowed = tuple(f"macs_zenoh.{name}" for name in ("protocol", "errors", "plain", "config", "sections", "versions"))
    assert not {name for name in ours if not name.startswith(allowed)}


HEAVY = {"zenoh", "rosbags", "rich", "argcomplete"}
KEY = re.compile(r"/?(macs/|@/|@adv\b)|\*\*/$")
ENDPOINT = re.compile(r"(tcp|tls|quic|ws)/$")


@pytest.mark.parametrize("path", [*CORE, *BRIDGE], ids=lambda path: str(path.relative_to(ROOT)))
def test_one_module_spells_keys_and_one_endpoints(path: Path) -> None:
    """No other text in the code begins as a key of the mesh or of Zenoh, or puts an endpoint together."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    documents = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    texts = [
        node.value
        for node in ast.walk(tree)
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in documents
    ]
    if path.name != "keyexpr.py":
        assert [text for text in texts if KEY.match(text) and " " not in text] == []
    if path.name != "endpoints.py":
        made = [part for node in ast.walk(tree) if isinstance(node, ast.JoinedStr) for part in node.values[:1]]
        assert [p.value for p in made if isinstance(p, ast.Constant) and ENDPOINT.fullmatch(str(p.value))] == []


def test_the_oldest_python_can_load_it() -> None:
    """No class is a named tuple and something else as well, such as generic: Python 3.10 refuses to load that."""
    for path in (*CORE, *BRIDGE):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
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
    tree = ast.parse(OFFERED.read_text(encoding="utf-8"))
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
    short = {path.stem for path in (ROOT / "tests").rglob("*.py")} - sys.stdlib_module_names
    used = {(path, name) for path in (ROOT / "tests").rglob("*.py") for name in roots(path) & short}
    assert sorted(f"{path.relative_to(ROOT)} imports {name}" for path, name in used) == []


def nowhere(path: Path) -> Iterator[tuple[int, str]]:
    """Names of ours in a file that do not exist, with their lines. What needs ROS is looked at where ROS is."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    nodes = list(ast.walk(tree))
    modules: dict[str, ModuleType] = {}
    for node in nodes:
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
    hidden = {node.id for node in nodes if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)}
    hidden |= {node.arg for node in nodes if isinstance(node, ast.arg)}
    for node in nodes:
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id not in hidden:
            used = modules.get(node.value.id)
            if used is not None and not hasattr(used, node.attr):
                yield node.lineno, f"{used.__name__}.{node.attr}"


def _submodule(module: ModuleType, name: str) -> ModuleType | None:
    try:
        return importlib.import_module(f"{module.__name__}.{name}")
    except ModuleNotFoundError:
        return None
