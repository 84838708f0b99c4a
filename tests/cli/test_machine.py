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


def findings_by_name(shell: Shell, *arguments: object, code: int = 0) -> dict[str, Any]:
    return {one["name"]: one for one in shell.json("info", *arguments, code=code)["findings"]}


def test_info_about_this_machine_is_ok(store_path, shell):
    found = findings_by_name(shell, store_path)
    assert " transitions of 3 recordings in 3 Parquet files" in found["rows"]["what"]
    found = findings_by_name(shell)
    assert found["duckdb"]["what"] == metadata.version("duckdb")
    assert found["torch"]["state"] == "ok"
    assert not {"ruff", "mypy", "pytest"} & set(found)  # packages for developers are not listed


def test_missing_and_old_packages_have_remedy(monkeypatch, shell):
    wanted = [
        *("duckdb>=99", "no-such-package>=1", "no-such-extra>=1; extra == 'onnx'"),
        "of-another-machine>=1; platform_machine == 'pdp11'",
    ]
    monkeypatch.setattr(info, "requires", lambda _: wanted)
    found = findings_by_name(shell, code=2)
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
def test_install_command_fits_kind_of_installation(direct_url, command, monkeypatch):
    monkeypatch.setattr(metadata.PathDistribution, "read_text", lambda *_: direct_url)
    assert install_command("onnx") == command
    monkeypatch.setitem(sys.modules, "onnx", None)
    with pytest.raises(ConfigError, match=f"^a policy needs onnx.*\n  {re.escape(command)}$"):
        import_extra("onnx", "a policy")
