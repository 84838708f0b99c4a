"""Benchmarks beside other libraries run where these are not installed."""

import subprocess
import sys

import pytest
from support.paths import ROOT

PEERS = ("cpprb", "mcap_ros2", "rerun", "stable_baselines3", "tianshou", "torchrl")


@pytest.mark.long
@pytest.mark.parametrize("name", ["ingest", "peers", "replay", "slips", "train", "train_loop"])
def test_benchmark_starts_without_its_peers(name: str) -> None:
    script = str(ROOT / "benchmarks" / f"{name}.py")
    code = f"""
import runpy, sys
sys.modules.update(dict.fromkeys({PEERS!r}))  # importing one is an ImportError
sys.argv = [{script!r}, "--help"]
sys.path.insert(0, {str(ROOT / "benchmarks")!r})
runpy.run_path({script!r}, run_name="__main__")
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "--check" in done.stdout
