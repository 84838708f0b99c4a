"""Policy files that nobody should drive by: an exported one changed, with a digest that fits."""

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any


def changed_policy(policy: Path, out: Path, change: Callable[[Any], object]) -> Path:
    """Write what `change` makes of the model of `policy`, as an attacker would: digest and all."""
    import onnx

    model = onnx.load(policy, load_external_data=False)
    assert model.metadata_props.pop().key == "sha256"
    change(model)
    data = model.SerializeToString()
    digest = onnx.StringStringEntryProto(key="sha256", value=hashlib.sha256(data).hexdigest())
    out.write_bytes(data + onnx.ModelProto(metadata_props=[digest]).SerializeToString())
    return out
