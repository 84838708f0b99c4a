"""Policy files from strangers: rejected before the runtime reads anything unneeded."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from google.protobuf.message import DecodeError
from support.kept_run import kept_run
from support.paths import ROOT
from support.policy_files import changed_policy

from restock.cli import main, run_node
from restock.errors import ConfigError
from restock.ingest.live.policy_file import MAX_BYTES, MAX_PARTS, OnnxFile, PolicyFile
from restock.ingest.profile.profile import load_profile
from restock.train.dqn.config import NetworkConfig
from restock.train.evaluation.onnx_policy import OnnxPolicy, export_onnx

onnx = pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")

BAG = ROOT / "sample_logs" / "amr_tuesday"
TASK = load_profile("warehouse_amr").task
SMALL = NetworkConfig(hidden=(8,))
node, array = onnx.helper.make_node, onnx.numpy_helper.from_array


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return kept_run(tmp_path_factory.mktemp("runs") / "a", SMALL)


@pytest.fixture(scope="module")
def policy(run: Path) -> Path:
    out = run.parent / "policy.onnx"
    export_onnx(run, out)
    return out


def weight(model: Any) -> Any:
    return model.graph.initializer[0]


def insert(*nodes: Any, **constants: Any) -> Callable[[Any], None]:
    """Return a change that inserts `nodes` at the start, with these constants."""

    def change(model: Any) -> None:
        model.graph.initializer.extend(array(value, name) for name, value in constants.items())
        for at, inserted in enumerate(nodes):
            model.graph.node.insert(at, inserted)

    return change


def assign(key: str, value: str) -> Callable[[Any], None]:
    """Return a change of one metadata entry."""

    def change(model: Any) -> None:
        (entry,) = [prop for prop in model.metadata_props if prop.key == key]
        entry.value = value

    return change


def add_loop(model: Any) -> None:
    """Add a loop of 2^62 empty iterations."""
    info, kinds = onnx.helper.make_tensor_value_info, onnx.TensorProto
    again = node("Identity", ["more"], ["again"])
    body = onnx.helper.make_graph(
        [again],
        "body",
        [info("round", kinds.INT64, []), info("more", kinds.BOOL, [])],
        [info("again", kinds.BOOL, [])],
    )
    insert(node("Loop", ["rounds", ""], [], body=body), rounds=np.array(2**62))(model)


def store_externally(model: Any) -> None:
    """Store the weights in another file."""
    onnx.external_data_helper.set_external_data(weight(model), "/etc/passwd")
    weight(model).ClearField("raw_data")


def add_subgraph(model: Any) -> None:
    """Give an allowed operator a graph as its attribute."""
    model.graph.node[-1].attribute.append(onnx.helper.make_attribute("axis", model.graph))


def add_third_dimension(model: Any) -> None:
    weight(model).dims.append(1)


HOSTILE: dict[str, tuple[Callable[[Any], object], str]] = {
    "loop": (add_loop, "has the operator Loop"),
    "24 GB constant": (
        insert(node("ConstantOfShape", ["size"], ["much"]), size=np.array([6 * 10**9])),
        "has the operator ConstantOfShape",
    ),
    "24 GB by broadcasting": (
        insert(
            node("Add", ["column", "row"], ["much"]),
            column=np.ones((80_000, 1), np.float32),
            row=np.ones((1, 80_000), np.float32),
        ),
        "computes (80000, 80000)",
    ),
    "N x N by broadcasting": (
        insert(
            node("ReduceMax", ["observation", "axes"], ["a"], keepdims=0),
            node("ReduceMax", ["observation", "axes"], ["b"]),
            node("Add", ["a", "b"], ["much"]),
            axes=np.array([1]),
        ),
        "computes (N, N)",
    ),
    "reduction of all axes": (
        insert(node("ReduceMax", ["observation"], ["a"])),
        "does not fit: ReduceMax of (N, ",
    ),
    "external data": (store_externally, "contains 0 of the "),
    "another data type": (lambda m: setattr(weight(m), "data_type", 10), "neither a matrix"),
    "three dimensions": (add_third_dimension, "neither a matrix"),
    "dims unlike bytes": (lambda m: weight(m).dims.__setitem__(0, 2**40), "bytes of 'q.0.weight'"),
    "NaN weights": (
        lambda m: weight(m).CopyFrom(
            array(np.full(tuple(weight(m).dims), np.nan, np.float32), weight(m).name)
        ),
        "weights 'q.0.weight' that are not finite",
    ),
    "custom operator": (
        insert(node("Gemm", ["observation"], ["a"], domain="evil")),
        "has the operator evil.Gemm",
    ),
    "custom operators": (
        lambda m: m.opset_import.append(onnx.helper.make_opsetid("evil", 1)),
        "operators other than those of ONNX itself",
    ),
    "subgraph": (add_subgraph, "sets axis of ArgMax, which is not a number"),
    "many nodes": (
        insert(*(node("Relu", ["observation"], [f"r{i}"]) for i in range(MAX_PARTS))),
        f"more than {MAX_PARTS}",
    ),
    "many constants": (
        insert(**{f"c{i}": np.zeros((), np.float32) for i in range(MAX_PARTS)}),
        f"more than {MAX_PARTS}",
    ),
    "cycle": (insert(node("Relu", ["values"], ["a"])), "reads 'values' before"),
    "duplicate name": (insert(node("Relu", ["observation"], ["values"])), "has 'values' twice"),
    "undefined output": (
        lambda m: m.graph.output.append(onnx.helper.make_tensor_value_info("more", 1, ["N"])),
        "returns 'more'",
    ),
    "two inputs": (lambda m: m.graph.input.append(m.graph.input[0]), "takes 2 inputs"),
    "another input width": (
        lambda m: setattr(m.graph.input[0].type.tensor_type.shape.dim[1], "dim_value", 99),
        "does not fit: Gemm of (N, 99)",
    ),
    "weights of another width": (
        insert(node("LayerNormalization", ["observation", "s"], ["a"]), s=np.ones(3, np.float32)),
        "cannot be run",
    ),
    "no action values": (lambda m: m.graph.output.pop(0), "computes action (N,), the task's"),
    "other actions": (assign("actions", "[[9.0,0.0]]"), "has other actions in its metadata"),
    "other observation": (assign("observation", "[]"), "has other observation in its metadata"),
    "another task": (assign("task_hash", "0"), "was made for task 0"),
    "another format": (assign("format", "restock-policy/1"), "export the run a again: restock exp"),
    "too long": (assign("trained", "x" * MAX_BYTES), "is longer than 16 MiB"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_policy_is_rejected(name, policy, run, tmp_path, capsys):
    change, message = HOSTILE[name]
    file = changed_policy(policy, tmp_path / "p.onnx", change)
    assert run_node([str(file), "--on", str(BAG)]) == 2
    stderr = " ".join(capsys.readouterr().err.split())
    assert message in stderr
    assert "restock export RUN --to onnx" in stderr
    with pytest.raises(ConfigError):
        OnnxPolicy(file, TASK)


@pytest.mark.parametrize(
    "argv", [["gate", "--baseline"], ["eval", "--policies"]], ids=lambda argv: argv[0]
)
def test_every_command_rejects_damaged_policy(argv, policy, run, tmp_path, shell):
    damaged = bytearray(policy.read_bytes())
    damaged[len(damaged) // 2] ^= 1
    file = tmp_path / "damaged.onnx"
    file.write_bytes(damaged)
    baseline = str(file) if argv[0] == "gate" else f"onnx:{file}"
    assert "is damaged, or was changed" in " ".join(
        shell.err(argv[0], run, argv[1], baseline).split()
    )


def test_flipped_bits_are_rejected(policy: Path, tmp_path: Path) -> None:
    content, file = policy.read_bytes(), tmp_path / "p.onnx"
    rng = np.random.default_rng(0)
    for at in rng.choice(8 * len(content), 200, replace=False).tolist():
        flipped = bytearray(content)
        flipped[at // 8] ^= 1 << at % 8
        file.write_bytes(flipped)
        for read in (PolicyFile, OnnxFile):
            with pytest.raises(ConfigError):
                read(file)


def test_changed_graph_is_rejected_or_valid(policy: Path, tmp_path: Path) -> None:
    """Flip bits in the graph and recompute the digest: nothing crashes."""
    graph = onnx.load(policy).graph.SerializeToString()
    rng, num_usable = np.random.default_rng(1), 0
    observation = np.zeros(TASK.observation_size, np.float32)
    for at in rng.choice(8 * len(graph), 200, replace=False).tolist():
        flipped = bytearray(graph)
        flipped[at // 8] ^= 1 << at % 8

        def change(model: Any, flipped: bytearray = flipped) -> None:
            model.graph.ParseFromString(bytes(flipped))

        try:
            file = changed_policy(policy, tmp_path / "p.onnx", change)
            action = PolicyFile(file).act(observation)
        except (ConfigError, DecodeError):
            continue
        num_usable += 1
        assert action is None or 0 <= action < len(TASK.actions)
    assert num_usable  # a flipped bit of a weight gives another valid policy


def test_unchecked_model_parts_do_not_reach_runtime(policy: Path, tmp_path: Path) -> None:
    """The model defines its own Relu function and has comments."""

    def change(model: Any) -> None:
        opsets = [onnx.helper.make_opsetid("", 18)]
        model.functions.append(
            onnx.helper.make_function("", "Relu", ["x"], ["y"], [node("Neg", ["x"], ["y"])], opsets)
        )
        model.doc_string = model.graph.doc_string = "comment"

    before = PolicyFile(policy)
    after = PolicyFile(changed_policy(policy, tmp_path / "p.onnx", change))
    observation = np.random.default_rng(0).normal(size=(32, TASK.observation_size))
    rows = observation.astype(np.float32)
    expected = [before.act(row) for row in rows]
    assert [after.act(row) for row in rows] == expected
    assert len(set(expected)) > 1


def test_foreign_model_can_be_evaluated_but_not_driven(policy: Path, tmp_path: Path) -> None:
    model = onnx.load(policy)
    del model.metadata_props[:]
    other = tmp_path / "other.onnx"
    onnx.save(model, other)
    observation = np.random.default_rng(0).normal(size=(64, TASK.observation_size))
    rows = observation.astype(np.float32)
    (action, _), (expected, _) = (OnnxPolicy(p, TASK).act(None, rows) for p in (other, policy))
    assert action.tolist() == expected.tolist()
    with pytest.raises(ConfigError, match="was not exported by Restock"):
        PolicyFile(other)


def test_diverged_network_is_not_exported(tmp_path: Path) -> None:
    import torch

    from restock.train.run import checkpoint
    from restock.train.run.run import Run

    run = kept_run(tmp_path / "run", SMALL)
    state = checkpoint.load(Run.open(run).best)
    state["network"]["advantage.bias"] = torch.full((len(TASK.actions),), torch.nan)
    checkpoint.save(Run.open(run).best, state)
    assert main(["export", str(run), "--to", "onnx", "--out", str(tmp_path / "p.onnx")]) == 2
    assert not (tmp_path / "p.onnx").exists()
