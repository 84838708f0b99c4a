"""Earlier fuzzing findings stay fixed, and the fuzz target itself works (see fuzz/readers.py)."""

import importlib.util
import random
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest
from support.paths import ROOT

FUZZ = ROOT / "fuzz"
FINDINGS = sorted((FUZZ / "found").iterdir())


def target() -> ModuleType:
    sys.path.insert(0, str(FUZZ))  # as for a script in that folder
    spec = importlib.util.spec_from_file_location("fuzz_readers", FUZZ / "readers.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


READERS = target()
SEEDS: list[bytes] = list(READERS.seeds())


@pytest.mark.parametrize("path", FINDINGS, ids=lambda path: path.name)
def test_earlier_fuzz_findings_stay_fixed(path: Path) -> None:
    READERS.examine(path.read_bytes())


def test_fuzz_seeds_are_valid_recordings() -> None:
    assert {seed[0] for seed in SEEDS} == set(range(len(READERS.TARGETS)))
    for seed in SEEDS:
        READERS.examine(seed)


def test_hundreds_of_mutations_find_nothing() -> None:
    rng = random.Random(0)
    for _ in range(300):
        READERS.examine(READERS.mutated(rng, SEEDS))


def test_each_fuzz_finding_is_kept_once(tmp_path: Path) -> None:
    findings = READERS.Findings(tmp_path)
    for data in (b"a", b"b"):
        try:
            READERS.require(False, "wrong")
        except READERS.Wrong as error:
            findings.keep(data, error)
    assert findings.count() == 1
    assert [item.read_bytes() for item in tmp_path.iterdir() if not item.suffix] == [b"a"]


def test_fuzz_one_input_from_the_shell(tmp_path: Path) -> None:
    (tmp_path / "seed").write_bytes(SEEDS[-1])
    command = [sys.executable, str(FUZZ / "readers.py"), "--again", str(tmp_path / "seed")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "nothing wrong" in done.stdout
