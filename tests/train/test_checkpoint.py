"""Check that checkpoints are exact and atomic, and that damaged files are reported."""

from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from restock.errors import RunError
from restock.state import restored, saved
from restock.train.run import checkpoint


def test_state_round_trips_exactly(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    rng.random(5)
    state = {
        "network": {"weight": torch.randn(3, 2), "step": torch.tensor(4.0)},
        "ring": {
            "rows": rng.random((4, 3)),
            "flags": np.array([True, False]),
            "empty": np.empty(0),
        },
        "names": np.array(["nominal", "wheel_slip"]),
        "list": [1, 2.5, None, True, "text", np.arange(3)],
        "generator": saved(rng),
        "nan": float("nan"),
    }
    checkpoint.save(tmp_path / "a.safetensors", state)
    back = checkpoint.load(tmp_path / "a.safetensors")

    assert torch.equal(back["network"]["weight"], state["network"]["weight"])
    assert back["network"]["step"].shape == ()
    for name, array in state["ring"].items():
        assert back["ring"][name].dtype == array.dtype
        np.testing.assert_array_equal(back["ring"][name], array)
    np.testing.assert_array_equal(back["names"], state["names"])
    assert back["list"][:5] == [1, 2.5, None, True, "text"]
    np.testing.assert_array_equal(back["list"][5], np.arange(3))
    assert np.isnan(back["nan"])

    other = np.random.default_rng(99)
    restored(other, back["generator"])
    assert other.random(8).tolist() == rng.random(8).tolist()


def test_failed_write_keeps_old_checkpoint(tmp_path: Path) -> None:
    path = tmp_path / "latest.safetensors"
    checkpoint.save(path, {"step": 1})
    with pytest.raises(TypeError, match="agent/policy: object"):
        checkpoint.save(path, {"agent": {"policy": object()}})
    assert checkpoint.load(path) == {"step": 1}
    assert [item.name for item in tmp_path.iterdir()] == ["latest.safetensors"]


def test_saved_tensors_are_copies(tmp_path: Path) -> None:
    weight = torch.zeros(2)
    checkpoint.save(tmp_path / "c", {"weight": weight, "same": weight})
    weight += 1
    assert checkpoint.load(tmp_path / "c")["same"].tolist() == [0.0, 0.0]


@pytest.mark.parametrize("content", [b"", b"not a checkpoint", b"\x08" + b"\x00" * 7 + b"{}      "])
def test_damaged_or_foreign_file_is_rejected(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "latest.safetensors"
    path.write_bytes(content)
    with pytest.raises(RunError, match=r"latest.safetensors: is (damaged|not a checkpoint)"):
        checkpoint.load(path)


@pytest.mark.parametrize("at", [0.3, 0.7])
def test_flipped_bit_is_reported_with_remedy(tmp_path: Path, at: float) -> None:
    path = tmp_path / "latest.safetensors"
    checkpoint.save(path, {"weight": torch.arange(100.0)})
    content = bytearray(path.read_bytes())
    content[int(at * len(content))] ^= 1
    path.write_bytes(content)
    with pytest.raises(RunError, match=r"is damaged.*\n.*restore it from a copy, or train again"):
        checkpoint.load(path)


def test_checkpoint_of_earlier_version_is_rejected(tmp_path: Path) -> None:
    path = tmp_path / "latest.safetensors"
    save_file({}, path, metadata={"format": "restock-checkpoint/1", "state": "{}"})
    with pytest.raises(RunError, match=r"by an earlier Restock .*\n.*train again with"):
        checkpoint.load(path)
