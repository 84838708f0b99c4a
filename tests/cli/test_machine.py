"""`restock info` without a recording: this machine, its packages, a store."""

import re
import sys
from importlib import metadata
from typing import Any

import pytest
from support.shell import Shell

from restock.cli.data import info
from restock.errors import ConfigError
from restock.process import import_extra, install_command


def reported(shell: Shell, *arguments: object, code: int = 0) -> dict[str, Any]:
    return {one["name"]: one for one in shell.json("info", *arguments, code=code)["findings"]}


def test_a_machine_on_which_the_tests_run_is_well(store_path, shell):
    found = reported(shell, store_path)
    assert " transitions of 3 recordings in 3 Parquet files" in found["rows"]["what"]
    found = reported(shell)
    assert found["duckdb"]["what"] == metadata.version("duckdb")
    assert found["torch"]["state"] == "ok"
    assert not {"ruff", "mypy", "pytest"} & set(found)  # what developers need is no extra


def test_what_is_missing_or_too_old_is_named_with_its_remedy(monkeypatch, shell):
    wanted = [
        *("duckdb>=99", "no-such-package>=1", "no-such-extra>=1; extra == 'onnx'"),
        "of-another-machine>=1; platform_machine == 'pdp11'",
    ]
    monkeypatch.setattr(info, "requires", lambda _: wanted)
    found = reported(shell, code=2)
    assert found["duckdb"]["state"] == "wrong"
    assert ">=99 is needed" in found["duckdb"]["what"]
    assert found["no-such-package"]["state"] == "wrong"
    extra = found["no-such-extra"]
    assert (extra["state"], extra["remedy"]) == ("missing", install_command("onnx"))
    assert found["duckdb"]["remedy"] == install_command()
    assert "of-another-machine" not in found


@pytest.mark.parametrize(
    ("direct_url", "command"),
    [
        (None, "pip install 'restock[onnx]'"),
        ('{"url": "file:///restock.whl", "archive_info": {}}', "pip install 'restock[onnx]'"),
        (
            '{"url": "file:///restock", "dir_info": {"editable": true}}',
            "pip install -e '.[onnx]' in the source tree",
        ),
    ],
)
def test_an_extra_is_added_to_the_restock_that_is_installed(direct_url, command, monkeypatch):
    monkeypatch.setattr(metadata.PathDistribution, "read_text", lambda *_: direct_url)
    assert install_command("onnx") == command
    monkeypatch.setitem(sys.modules, "onnx", None)
    with pytest.raises(ConfigError, match=f"^a policy needs onnx.*\n  {re.escape(command)}$"):
        import_extra("onnx", "a policy")
