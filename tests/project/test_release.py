"""Releases: one version everywhere, workflows and a container file whose commands exist."""

import re
import shlex
import tomllib
from contextlib import redirect_stdout
from io import StringIO
from typing import Any

import pytest
from ruamel.yaml import YAML
from support.paths import ROOT

from restock import cli

WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def workflow(name: str) -> dict[str, Any]:
    text = (ROOT / ".github" / "workflows" / f"{name}.yml").read_text(encoding="utf-8")
    document: dict[str, Any] = YAML(typ="safe", pure=True).load(text)
    return document


def steps(document: dict[str, Any]) -> list[dict[str, Any]]:
    return [step for job in document["jobs"].values() for step in job["steps"]]


def test_version_is_the_same_everywhere() -> None:
    version = PROJECT["version"]
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert re.search(r"^version: (.*)$", citation, re.MULTILINE)[1] == version  # type: ignore[index]
    changes = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert re.search(r"^## (\S+?),? ", changes, re.MULTILINE)[1] == version  # type: ignore[index]
    for path in (ROOT / ".github" / "workflows" / "restock-check.yml", ROOT / "docs" / "audit.md"):
        named = re.findall(r"restock-check\.yml@v([\d.]+\d)", path.read_text(encoding="utf-8"))
        assert set(named) == {version}, path


def test_release_checks_each_supported_python() -> None:
    promised = [
        line.rsplit(" ", 1)[1] for line in PROJECT["classifiers"] if re.search(r":: 3\.\d+$", line)
    ]
    release = workflow("release")
    assert release["jobs"]["check"]["strategy"]["matrix"]["python"] == promised
    assert release["jobs"]["check"]["needs"] == "build"
    built = " ".join(step.get("run", "") for step in steps(release))
    assert "python -m build" in built
    assert "publish" not in built
    assert "upload dist" not in built


def test_example_workflow_sets_required_options() -> None:
    inputs = workflow("restock-check")["on"]["workflow_call"]["inputs"]
    required = {name for name, of in inputs.items() if of.get("required")}
    assert required == {"restock", "store"}  # there is no index that has a `restock` to install
    page = (ROOT / "docs/audit.md").read_text(encoding="utf-8")
    (block,) = re.findall(r"```yaml\n(.*?)```", page, re.DOTALL)
    given = YAML(typ="safe", pure=True).load(block)["jobs"]["gate"]["with"]
    assert required <= set(given) <= set(inputs)
    assert given["restock"].endswith(f"@v{PROJECT['version']}")


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.stem)
def test_commands_in_workflows_exist(path: Any) -> None:
    document = workflow(path.stem)
    assert document["permissions"] == {"contents": "read"}
    commands = 0
    for step in steps(document):
        assert ("run" in step) != ("uses" in step)
        for line in step.get("run", "").replace("\\\n", " ").splitlines():
            commands += check_command(line)
    assert commands > 0


def options_of(verb: str) -> set[str]:
    with redirect_stdout(StringIO()) as text:
        assert cli.main([verb, "--help"]) == 0
    return set(re.findall(r"--[a-z][\w-]*", text.getvalue()))


def check_command(line: str) -> int:
    """Return a `restock` call's verb and options are those that there are; 1 where it is one."""
    found = re.search(r"(?:^|/)restock ([\w-]+)(.*)", line.strip())
    if found is None:
        return "python -m" in line
    verb, rest = found[1], found[2]
    if verb.startswith("--"):
        return 1
    assert verb in cli.VERBS, line
    options = set(re.findall(r"(?<=[\s+])--[a-z][\w-]*", rest))
    assert options <= set(options_of(verb)), line
    return 1


def test_workflow_inputs_go_through_environment() -> None:
    """A text of the caller in `run:` would be a command of the caller's."""
    for path in WORKFLOWS:
        for step in steps(workflow(path.stem)):
            assert "${{" not in step.get("run", ""), step


def test_container_file_runs_the_demo() -> None:
    lines = (ROOT / "Containerfile").read_text(encoding="utf-8").replace("\\\n", " ").splitlines()
    reported = dict(line.split(" ", 1) for line in lines if line and not line.startswith("#"))
    minor = re.search(r"python:3\.(\d+)", reported["FROM"])
    assert minor is not None
    assert f"Programming Language :: Python :: 3.{minor[1]}" in PROJECT["classifiers"]
    entry, command = (
        reported["ENTRYPOINT"].strip('[]" '),
        reported["CMD"].strip("[] ").replace(",", " "),
    )
    verb, *options = shlex.split(command)
    assert entry in PROJECT["scripts"]
    assert {option for option in options if option.startswith("--")} <= set(options_of(verb))
    ignored = (ROOT / ".containerignore").read_text(encoding="utf-8").split()
    assert not {"sample_logs", "src", "ingest", "replay", "train", "README.md"} & set(ignored)
