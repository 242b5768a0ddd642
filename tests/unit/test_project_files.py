"""Workflows, templates and owners name what exists in this repository."""

from __future__ import annotations

import os
import re
from pathlib import Path

import pytest
import yaml
from reference_pages import repository

ROOT = Path(__file__).parents[2]
GITHUB = ROOT / ".github"
YAML = [*GITHUB.rglob("*.yml"), ROOT / ".pre-commit-config.yaml"]
WORKFLOWS = sorted((GITHUB / "workflows").glob("*.yml"))
MAKEFILE = (ROOT / "Makefile").read_text(encoding="utf-8")
PYPROJECT = (ROOT / "pyproject.toml").read_text(encoding="utf-8")


@pytest.mark.parametrize("path", YAML, ids=lambda path: path.name)
def test_it_is_yaml(path: Path) -> None:
    """Each file can be read; what it leads to is the repository of pyproject.toml."""
    text = path.read_text(encoding="utf-8")
    assert yaml.safe_load(text)
    owner, name = repository().split("/")[-2:]
    for found in re.findall(rf"https?://(?:github\.com/[\w-]+/{name}|[\w-]+\.github\.io/{name})", text):
        assert owner in found


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.name)
def test_workflows_run_what_exists(path: Path) -> None:
    """Each job has a limit of time and steps; targets of make, scripts and tests that it runs are there."""
    for job in yaml.safe_load(path.read_text(encoding="utf-8"))["jobs"].values():
        assert job["timeout-minutes"]
        for step in job["steps"]:
            command = step.get("run", "")
            for target in re.findall(r"^make ([\w-]+)", command, re.MULTILINE):
                assert re.search(rf"^{target}:", MAKEFILE, re.MULTILINE), target
            for file in re.findall(r"(?:^|\s)(tests/\S+|\.ci/\S+)", command):
                assert (ROOT / file).exists(), file
    assert os.access(ROOT / ".ci" / "run", os.X_OK)


def test_the_release_is_of_tags_that_are_versions() -> None:
    """What starts a release is what the version is taken from."""
    (tags,) = re.findall(r"tags: \[(.*)\]", (GITHUB / "workflows" / "release.yml").read_text(encoding="utf-8"))
    (pattern,) = re.findall(r"^tag_regex = '(.*)'$", PYPROJECT, re.MULTILINE)
    expressions = [tag.strip(' "').replace(".", r"\.") for tag in tags.split(",")]
    for tag in ("v1.2.3", "v0.10.0rc2"):
        assert re.match(pattern, tag)
        assert any(re.fullmatch(expression, tag) for expression in expressions)


def test_owners_are_of_what_exists() -> None:
    """No line of CODEOWNERS is about a folder that is gone."""
    paths = re.findall(r"^(/\S+)", (GITHUB / "CODEOWNERS").read_text(encoding="utf-8"), re.MULTILINE)
    assert [path for path in paths if not (ROOT / path.strip("/")).exists()] == []


def test_hooks_are_the_tools_of_make_lint() -> None:
    """What pre-commit runs is installed by `make install` and run by `make lint`."""
    hooks = re.findall(r"entry: \.venv/bin/(\w+)", (ROOT / ".pre-commit-config.yaml").read_text(encoding="utf-8"))
    (dev,) = re.findall(r"^dev = \[(.*?)^\]", PYPROJECT, re.MULTILINE | re.DOTALL)
    (lint,) = re.findall(r"^lint: .*?\n\n", MAKEFILE, re.MULTILINE | re.DOTALL)
    assert set(hooks) == set(re.findall(r"\$\(BIN\)/(\w+)", lint)) == set(re.findall(r'"(ruff|mypy|codespell)', dev))
