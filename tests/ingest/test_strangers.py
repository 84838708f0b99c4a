"""Other people's robots by the proposed profile, as `benchmarks/strangers.py` measures it."""

import json
import subprocess
import sys

import pytest
from support.paths import ROOT, SHARED


@pytest.mark.slow
@pytest.mark.skipif(not SHARED.is_dir(), reason="../shared/bags is absent")
def test_most_recordings_give_rows_for_most_of_their_time():
    script = ROOT / "benchmarks" / "strangers.py"
    command = [sys.executable, str(script), "--bags", str(SHARED), "--json"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    said = json.loads(done.stdout)
    assert said["give_rows"] >= 0.9 * said["recordings"]
    assert said["usable_s"] >= 0.85 * said["known_s"]
    assert said["missed"] == []
