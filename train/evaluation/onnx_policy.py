"""A policy as an ONNX file, for robots without PyTorch and for other programs.

The file's metadata has all that is needed to use it, as JSON: the task with its control period, the
names of the observation's entries in order, and the table of actions in m/s and rad/s.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from restock import __version__
from restock.arrays import F32, Ints
from restock.errors import ConfigError, RunError
from restock.files import expect_file_place, write_bytes
from restock.ingest.live.policy_file import FORMAT, OnnxFile, with_digest
from restock.ingest.profile.profile import profile_toml
from restock.ingest.task.task import Task
from restock.process import import_extra
from restock.train.dqn.behaviour import FilteredNetwork, PolicyNetwork, ProposalNetwork
from restock.train.dqn.network import Ensemble, QNetwork
from restock.train.evaluation.policies import load_agent
from restock.train.run.run import Run
from restock.train.run.run_profile import profile_of_run

_OPSET = 18


def export_onnx(run_path: Path, out: Path) -> dict[str, Any]:
    """Write a run's policy to `out`: input `observation` (N, D), outputs `values` and `action`.

    `values` are (N, A), `action` is (N,). If a teacher filters actions, its network is in the
    file, too, and the values of implausible actions are -inf.

    Raises:
        RunError: there is no such run, it has no policy yet, or `out` already exists.
        ConfigError: the extra `onnx` is not installed, or `out` is inside a store, a panel or
            another run.
    """
    onnx = _onnx()
    run = Run.open(run_path)
    if out.exists():
        raise RunError("already exists", where=str(out), remedy="choose another --out")
    expect_file_place(out, "--out")
    agent = load_agent(run)
    profile = profile_of_run(run)
    model = to_onnx(agent.network)
    metadata = {
        "format": FORMAT,
        "task": msgspec.json.encode(profile.task).decode(),
        "task_hash": profile.task.hash,
        "observation": msgspec.json.encode(profile.task.observation_names).decode(),
        "actions": msgspec.json.encode(profile.task.actions).decode(),
        "profile": profile.name,
        "profile_toml": profile_toml(profile),
        "run": run.path.resolve().name,
        "version": agent.version,
        "trained": "" if agent.origin is None else agent.origin.text,
        "restock_version": __version__,
    }
    onnx.helper.set_model_props(model, metadata)
    onnx.checker.check_model(model, full_check=True)
    try:
        content = with_digest(model.SerializeToString())
    except ValueError as error:
        raise RunError(f"its policy {error}", where=str(run.path)) from error
    write_bytes(out, content)
    return {"path": str(out), "bytes": out.stat().st_size, **metadata}


def to_onnx(network: PolicyNetwork) -> Any:
    """Translate a policy network, with its filter or proposals, into an ONNX model."""
    onnx = _onnx()
    graph = _Graph(onnx)
    if isinstance(network, FilteredNetwork):
        values = graph.filter(network, graph.values(network.values, "q"), "plausible_values")
    elif isinstance(network, ProposalNetwork):
        values = graph.propose(network, graph.values(network.values, "q"), "preferred_values")
    else:
        values = graph.values(network, "q")
    graph.node("Identity", [values], "values")
    graph.node("ArgMax", ["values"], "action", axis=1, keepdims=0)
    tensor, kinds = onnx.helper.make_tensor_value_info, onnx.TensorProto
    opsets = [onnx.helper.make_opsetid("", _OPSET)]
    return onnx.helper.make_model(
        onnx.helper.make_graph(
            graph.nodes,
            "policy",
            [tensor("observation", kinds.FLOAT, ["N", network.observation_size])],
            [
                tensor("values", kinds.FLOAT, ["N", network.actions]),
                tensor("action", kinds.INT64, ["N"]),
            ],
            graph.constants,
        ),
        opset_imports=opsets,
        # The oldest format that has these operators: old runtimes on robots refuse newer formats.
        ir_version=onnx.helper.find_min_ir_version_for(opsets),
        producer_name="restock",
        producer_version=__version__,
    )


class _Graph:
    """The nodes and constants of a graph that is being built."""

    def __init__(self, onnx: Any) -> None:
        self._onnx = onnx
        self.nodes: list[Any] = []
        self.constants: list[Any] = []

    def node(self, kind: str, inputs: Sequence[str], output: str, **settings: Any) -> str:
        self.nodes.append(self._onnx.helper.make_node(kind, list(inputs), [output], **settings))
        return output

    def constant(self, name: str, value: NDArray[Any]) -> str:
        self.constants.append(self._onnx.numpy_helper.from_array(value, name))
        return name

    def linear(self, layer: nn.Linear, inputs: str, name: str) -> str:
        weight = self.constant(f"{name}.weight", _array(layer.weight))
        bias = self.constant(f"{name}.bias", _array(layer.bias))
        return self.node("Gemm", [inputs, weight, bias], name, transB=1)

    def values(self, network: nn.Module, name: str) -> str:
        """Add the nodes that compute a network's action values (N, A), or an ensemble's mean."""
        if isinstance(network, Ensemble):
            total, *others = [
                self.values(member, f"{name}.{index}")
                for index, member in enumerate(network.members)
            ]
            for index, values in enumerate(others):
                total = self.node("Add", [total, values], f"{name}.sum.{index}")
            count = self.constant(f"{name}.members", np.array(len(network.members), np.float32))
            return self.node("Div", [total, count], f"{name}.mean")
        if type(network) is not QNetwork:  # the algorithm has its own kind of network
            raise ConfigError(
                f"a {type(network).__name__} cannot be written as ONNX",
                where="loss.algorithm",
                remedy="export it with torch.onnx; only a plain QNetwork can be exported here",
            )
        now = "observation"
        for index, layer in enumerate(network.body):
            place = f"{name}.{index}"
            if isinstance(layer, nn.Linear):
                now = self.linear(layer, now, place)
            elif isinstance(layer, nn.LayerNorm):
                scale = self.constant(f"{place}.scale", _array(layer.weight))
                bias = self.constant(f"{place}.shift", _array(layer.bias))
                now = self.node(
                    "LayerNormalization", [now, scale, bias], place, axis=-1, epsilon=layer.eps
                )
            else:
                now = self.node("Relu", [now], place)
        return self.linear(network.advantage, now, f"{name}.advantage")

    def filter(self, network: FilteredNetwork, values: str, output: str) -> str:
        """Add the nodes that set values (N, A) of implausible actions to -inf."""
        logits = self.values(network.behaviour, "behaviour")
        axes = self.constant("behaviour.axes", np.array([1], np.int64))
        largest = self.node("ReduceMax", [logits, axes], "behaviour.largest", keepdims=1)
        below = self.constant("behaviour.log_ratio", _array(network.ratio.log()))
        least = self.node("Add", [largest, below], "behaviour.least")
        plausible = self.node("GreaterOrEqual", [logits, least], "plausible")
        none = self.constant("behaviour.none", np.array(-np.inf, np.float32))
        return self.node("Where", [plausible, values, none], output)

    def propose(self, network: ProposalNetwork, values: str, output: str) -> str:
        """Add the nodes that raise the proposed action's value by the margin; values are (N, A)."""
        nearest = self.constant("proposal.nearest", _array(network.nearest))
        offset = self.constant("proposal.offset", _array(network.offset))
        near = self.node("Gemm", ["observation", nearest, offset], "proposal.near", transB=1)
        axes = self.constant("proposal.axes", np.array([1], np.int64))
        largest = self.node("ReduceMax", [near, axes], "proposal.largest", keepdims=1)
        proposed = self.node("GreaterOrEqual", [near, largest], "proposed")
        lead = self.constant("proposal.lead", _array(network.lead)[:, None])
        margin = self.node("MatMul", ["observation", lead], "proposal.margin")
        preferred = self.node("Add", [values, margin], "proposal.preferred")
        return self.node("Where", [proposed, preferred, values], output)


class OnnxPolicy:
    """A greedy policy from an ONNX file.

    Raises:
        ConfigError: there is no such file, it is not a policy of this task, or the extra `onnx` is
            not installed.
    """

    def __init__(self, path: Path, task: Task) -> None:
        self._file = OnnxFile(path)
        self._file.expect(task, "this task")
        self.name, self.version = f"onnx:{path}", self._file.metadata.get("version", "")

    def act(self, env: Any, observation: F32) -> tuple[Ints, F32]:
        """Return the best actions (N,) for observations (N, D), and their probabilities, all 1."""
        action = self._file.values(observation).argmax(axis=1)
        return action, np.ones(len(action), np.float32)


def _array(tensor: torch.Tensor) -> F32:
    return np.ascontiguousarray(tensor.detach().cpu().numpy())


def _onnx() -> Any:
    return import_extra("onnx", "the export of a policy")
