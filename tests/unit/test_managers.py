"""Managers are found where they are listed or offered, keep the naming rule, and take no name that is taken."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from msgspec import Struct

from macs_zenoh import managers
from macs_zenoh.errors import BadField, ConfigError, UnknownManager
from macs_zenoh.managers import Asker, Manager
from macs_zenoh.protocol.messages import MANAGERS, Custom, decode_management

MODULE = """
import msgspec
from macs_zenoh.managers import Manager

class {name}(Manager):
    class Data(msgspec.Struct, rename="camel"):
        how_many: int = 0

    def manage(self, data, asker):
        return None
"""


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A directory from which modules are imported; what was imported there is forgotten afterwards."""
    monkeypatch.syspath_prepend(tmp_path)
    before = set(sys.modules)
    yield tmp_path
    for name in set(sys.modules) - before:
        del sys.modules[name]


def module(place: Path, name: str, text: str) -> None:
    """Write a module."""
    (place / f"{name}.py").write_text(text)


def offer(place: Path, package: str, value: str) -> None:
    """What an installed package leaves behind that offers a manager."""
    info = place / f"{package}-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[{managers.GROUP}]\nit = {value}\n")


class Number(Struct, rename="camel"):
    """Some data."""

    how_many: int


@pytest.mark.parametrize(
    ("name", "module_name"),
    [
        ("WorldClassManager", "world_class_manager"),
        ("Greeter", "greeter"),
        ("Area51Guard", "area51_guard"),
        ("HTTPGetter", "h_t_t_p_getter"),
    ],
)
def test_a_listed_manager_is_created(name: str, module_name: str, place: Path) -> None:
    """A class in a module of its name in snake case is imported and created under its own name."""
    module(place, module_name, MODULE.format(name=name))
    found = managers.load([f"{module_name}:{name}"])
    assert list(found) == [name]
    assert isinstance(found[name], Manager)


def test_a_manager_in_a_package(place: Path) -> None:
    """Of a dotted module only the last part has to be the class's name."""
    (place / "my_site").mkdir()
    (place / "my_site" / "__init__.py").touch()
    module(place / "my_site", "greeter", MODULE.format(name="Greeter"))
    assert list(managers.load(["my_site.greeter:Greeter"])) == ["Greeter"]


def test_an_offered_manager_is_created(place: Path) -> None:
    """An installed package's entry point is taken without being listed, unless that is not wanted."""
    module(place, "greeter", MODULE.format(name="Greeter"))
    offer(place, "macs_greeter", "greeter:Greeter")
    assert list(managers.load([])) == ["Greeter"]
    assert dict(managers.load([], offered=False)) == {}


WRONG = {
    "no class": ("greeter", "greeter", "greeter' is not MODULE:CLASS"),
    "no module": ("nothing_here:Greeter", "greeter", "cannot be imported: No module named 'nothing_here'"),
    "no such class": ("greeter:Grater", "greeter", "cannot be imported: .* no attribute 'Grater'"),
    "another file": ("hello:Greeter", "hello", "Greeter must live in a module called greeter"),
    "no manager": ("greeter:Greeting", "greeter", "Greeting is not a macs_zenoh.managers.Manager"),
    "a function": ("greeter:greet", "greeter", "greet is not a macs_zenoh.managers.Manager"),
    "no data": ("shy:Shy", "shy", "Shy does not say its Data, a msgspec.Struct"),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_manager_is_a_configuration_error(name: str, place: Path) -> None:
    """What breaks a rule says which one, and which line of the settings it is."""
    listed, module_name, problem = WRONG[name]
    text = MODULE.format(name="Greeter") + "\nclass Greeting: pass\ndef greet(): pass\n"
    if module_name == "shy":
        text = "from macs_zenoh.managers import Manager\nclass Shy(Manager):\n    def manage(self, data, asker): ...\n"
    module(place, module_name, text)
    with pytest.raises(ConfigError, match=problem) as caught:
        managers.load([listed])
    assert caught.value.path == listed


def test_the_error_of_an_entry_point_names_it(place: Path) -> None:
    """A package that offers something unusable is named."""
    offer(place, "macs_greeter", "greeter:Greeter")
    with pytest.raises(ConfigError) as caught:
        managers.load([])
    assert caught.value.path == "entry point it"


@pytest.mark.parametrize("name", sorted(MANAGERS))
def test_names_of_the_protocol_are_taken(name: str, place: Path) -> None:
    """Nobody replaces a manager that the protocol has."""
    module_name = "".join("_" + c.lower() if c.isupper() else c for c in name).lstrip("_")
    module(place, module_name, MODULE.format(name=name))
    with pytest.raises(ConfigError, match=f"there is a manager called {name} already"):
        managers.load([f"{module_name}:{name}"])


def test_a_name_is_taken_once(place: Path) -> None:
    """Two managers of one name are an error, wherever they come from."""
    module(place, "greeter", MODULE.format(name="Greeter"))
    offer(place, "macs_greeter", "greeter:Greeter")
    with pytest.raises(ConfigError, match="there is a manager called Greeter already"):
        managers.load(["greeter:Greeter"])


def test_management_data_becomes_the_managers_data() -> None:
    """The JSON of an added manager is typed, in each spelling of its keys, and wrong types are refused."""
    custom = {"Counter": Number}
    for text in (b'{"messageManager":"Counter","howMany":3}', b'{"how_many": 3, "message_manager": "Counter"}'):
        assert decode_management(text, custom) == Custom("Counter", Number(3))
    with pytest.raises(BadField):
        decode_management(b'{"messageManager":"Counter","howMany":"3"}', custom)
    with pytest.raises(UnknownManager):
        decode_management(b'{"messageManager":"Counter","howMany":3}')


@pytest.mark.parametrize("name", ["os.path", "subprocess", "antigravity", "this:that", "../evil", "lib2to3.main"])
def test_a_name_in_a_message_imports_nothing(name: str) -> None:
    """An unknown manager is an error and nothing more."""
    before = set(sys.modules)
    with pytest.raises(UnknownManager):
        decode_management(b'{"messageManager":"%s"}' % name.encode(), {"Counter": Number})
    assert set(sys.modules) == before


def test_an_asker_is_who_its_connection_is() -> None:
    """Type, id and group, in this order."""
    assert Asker(2, 7, 3)._asdict() == {"type": 2, "id": 7, "group": 3}
