"""Types by name: installed ROS interfaces, and nothing else."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from typing import Any

import pytest
from geometry_msgs.msg import Twist
from rclpy.serialization import serialize_message
from std_msgs.msg import String
from std_srvs.srv import SetBool

from bridge.ros import types
from bridge.ros.shapes import least_cdr_bytes
from bridge.ros.types import InterfaceName, resolve, shape_of
from macs_zenoh.errors import Refused


@pytest.mark.parametrize("text", ["geometry_msgs/Twist", "geometry_msgs/msg/Twist"])
def test_a_message_type_is_found_by_both_spellings(text: str) -> None:
    """Headsets write pkg/Name, ROS writes pkg/msg/Name; both give the class."""
    assert resolve(text) is Twist


@pytest.mark.parametrize("text", ["std_srvs/SetBool", "std_srvs/srv/SetBool"])
def test_a_service_type_is_found_when_a_service_is_asked_for(text: str) -> None:
    """The same name is looked up among services when the node is one."""
    assert resolve(text, "srv") is SetBool


@pytest.mark.parametrize(
    ("text", "kind", "reason"),
    [
        ("", "msg", "is not the name of a ROS type"),
        ("Twist", "msg", "is not the name of a ROS type"),
        ("geometry_msgs/Twist/", "msg", "is not the name of a ROS type"),
        ("geometry_msgs/twist", "msg", "is not the name of a ROS type"),
        ("geometry_msgs/Twist\n", "msg", "is not the name of a ROS type"),
        ("../geometry_msgs/Twist", "msg", "is not the name of a ROS type"),
        ("geometry_msgs.msg/Twist", "msg", "is not the name of a ROS type"),
        ("geometry_msgs/idl/Twist", "msg", "is not the name of a ROS type"),
        ("geometry_msgs/_Twist", "msg", "is not the name of a ROS type"),
        ("geometry__msgs/Twist", "msg", "is not the name of a ROS type"),
        ("geometry_msgs_/Twist", "msg", "is not the name of a ROS type"),
        ("g" * 5000 + "/Twist", "msg", "is not the name of a ROS type"),
        ("std_srvs/srv/SetBool", "msg", "a msg type was expected"),
        ("geometry_msgs/msg/Twist", "srv", "a srv type was expected"),
        ("no_such_msgs/Twist", "msg", "there is no ROS interface package no_such_msgs"),
        ("geometry_msgs/NoSuch", "msg", "geometry_msgs is, but has no such type"),
        ("std_srvs/SetBool", "msg", "std_srvs is, but has no such type"),
        ("std_srvs/SetBool_Request", "srv", "is not the name of a ROS type"),
    ],
)
def test_what_is_no_installed_type_is_refused(text: str, kind: str, reason: str) -> None:
    """Every refusal says what is wrong in words for a person."""
    with pytest.raises(Refused, match=reason):
        resolve(text, kind)


@pytest.mark.parametrize("module", ["antigravity", "turtledemo", "rclpy", "rosidl_generator_py"])
def test_only_interface_packages_are_imported(module: str) -> None:
    """A name from the network never imports a module that is no ROS interface package, installed or not."""
    before = set(sys.modules)
    with pytest.raises(Refused, match="there is no ROS interface package"):
        resolve(f"{module}/Twist")
    assert set(sys.modules) == before


def test_a_registered_package_without_its_module_is_refused(monkeypatch: Any, tmp_path: Path) -> None:
    """A package that is in the index but cannot be imported is a refusal, not a crash."""
    index = tmp_path / types._INDEX
    index.mkdir(parents=True)
    (index / "broken_msgs").write_text("msg/Thing.idl\nmsg/Thing.msg\n")
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path))
    with pytest.raises(Refused, match="cannot be imported"):
        resolve("broken_msgs/Thing")


UNUSABLE = """
class Meta(type):
    {}
    @classmethod
    def __import_type_support__(cls):
        {}

class Thing(metaclass=Meta):
    pass
"""


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("class Thing:\n    def __init__(self, from): pass\n", "SyntaxError"),
        ("raise OSError('libother.so: cannot open shared object file')\n", "libother.so"),
        (UNUSABLE.format("_TYPE_SUPPORT = None", "pass"), "type support for Thing is missing"),
        (UNUSABLE.format("", "raise RuntimeError('no C')"), "no C"),
    ],
)
def test_a_type_that_cannot_be_used_is_refused(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, text: str, problem: str
) -> None:
    """Whatever is wrong with an installed type's code, who registers it hears it once, as a reason."""
    index = tmp_path / types._INDEX
    index.mkdir(parents=True)
    (index / "odd_msgs").write_text("msg/Thing.msg\n")
    (tmp_path / "odd_msgs" / "msg").mkdir(parents=True)
    (tmp_path / "odd_msgs" / "msg" / "__init__.py").write_text(text)
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path))
    monkeypatch.syspath_prepend(str(tmp_path))
    for name in ("odd_msgs", "odd_msgs.msg"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    with pytest.raises(Refused, match=f"odd_msgs/msg/Thing is registered on this robot, but cannot be .*{problem}"):
        resolve("odd_msgs/Thing")
    for name in ("odd_msgs", "odd_msgs.msg"):
        sys.modules.pop(name, None)


def test_a_name_is_written_in_both_ways() -> None:
    """ROS shows the long name, headsets get the short one."""
    name = InterfaceName.parse("geometry_msgs/Twist", "msg")
    assert (str(name), name.short) == ("geometry_msgs/msg/Twist", "geometry_msgs/Twist")


@pytest.mark.parametrize(("message", "least"), [(Twist, 52), (String, 8)])
def test_the_least_size_of_known_types(message: type[Any], least: int) -> None:
    """A Twist is 6 doubles behind 4 bytes of header; a String may be its length alone."""
    assert least_cdr_bytes(shape_of(message)) == least


def test_no_valid_message_is_below_the_least_size() -> None:
    """For every installed message type, the default message is at least as long as the least size says."""
    sizes = {name: (least_cdr_bytes(shape_of(kind)), len(serialize_message(kind()))) for name, kind in _installed()}
    assert len(sizes) > 100
    assert not {name: size for name, size in sizes.items() if size[0] > size[1]}


def _installed() -> list[tuple[str, type[Any]]]:
    found = []
    for package in sorted((Path(sys.prefix) / types._INDEX).iterdir()):
        for entry in package.read_text().split():
            if entry.startswith("msg/") and entry.endswith(".msg"):
                name = f"{package.name}/{entry[4:-4]}"
                found.append((name, resolve(name)))
    return found


def test_types_are_looked_up_once() -> None:
    """The second time costs no look at the disk."""
    resolve("std_msgs/String")
    before = dict(types._resolved)
    assert resolve("std_msgs/msg/String") is importlib.import_module("std_msgs.msg").String
    assert types._resolved == before
