"""A policy as an ONNX file, and the checks before ONNX Runtime gets it.

A file may come from a stranger, or be damaged. `OnnxFile` reads it with protobuf and refuses what
a policy network does not need: operators beyond `ONNX_OPERATORS`, subgraphs, weights in other
files, more numbers than the limits allow. The runtime gets only the fields of `_MESSAGES`, so
nothing unchecked reaches it. A file written by Restock also has a digest of all its bytes.

The digest detects damage. It is not a signature: anyone who changes a file can compute it again.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from google.protobuf.descriptor_pb2 import (  # type: ignore[import-untyped]
    FieldDescriptorProto,
    FileDescriptorProto,
)
from google.protobuf.descriptor_pool import DescriptorPool  # type: ignore[import-untyped]
from google.protobuf.message import DecodeError  # type: ignore[import-untyped]
from google.protobuf.message_factory import GetMessageClass  # type: ignore[import-untyped]
from numpy.typing import NDArray

from restock.arrays import F32
from restock.errors import ConfigError
from restock.files import first_line
from restock.ingest.profile.profile import Profile, load_profile, parse_profile
from restock.ingest.task.task import Task
from restock.process import import_extra

FORMAT = "restock-policy/2"
MAX_BYTES = 16 << 20  # limit of a file: 4 million weights, which take .8 GB at most when parsed
MAX_PARTS = 256  # nodes, constants, metadata entries
MAX_WIDTH = 1 << 16  # numbers that a node computes from one observation
_TOO_LONG = f"is longer than {MAX_BYTES >> 20} MiB"
ROWS = (1 << 31) - 1  # stands for N, the first dimension of values computed from observations
_EXPORT = "restock export RUN --to onnx --out policy.onnx"
_DIGEST = "sha256"

Shape = tuple[int, ...]


class PolicyFile:
    """A policy and its profile.

    Raises:
        ConfigError: the file does not exist, is not a policy of Restock, or is damaged; its profile
            cannot be read or defines another task; or the extra `onnx` is not installed.
    """

    def __init__(self, path: Path, profile: Path | str | None = None) -> None:
        """Read the policy; `profile`, a file or a name, replaces the profile in its file."""
        self.path, self._file = path, OnnxFile(path)
        metadata = self._file.metadata
        if not self._file.of_restock:
            raise _refusal(path, "is an ONNX model without a task: it was not exported by Restock")
        self.version = f"{metadata.get('run', '')} {metadata.get('version', '')}".strip()
        self.profile: Profile = (
            parse_profile(metadata.get("profile_toml", ""), where=f"{path}: profile_toml")
            if profile is None
            else load_profile(profile)
        )
        self._file.expect(self.profile.task, f"profile {self.profile.name!r}")

    def act(self, observation: F32) -> int | None:
        """Return the best action for an observation (D,); None if its value is not finite."""
        (values,) = self._file.values(observation[None])
        # If a value is NaN, `argmax` returns its index, an action without meaning.
        action = int(values.argmax())
        return action if np.isfinite(values[action]) else None


class OnnxFile:
    """A checked ONNX model that computes action values (N, A) from observations (N, D).

    Raises:
        ConfigError: the file does not exist, is not ONNX, is damaged or contains something that a
            policy network does not need; or the runtime is not installed.
    """

    def __init__(self, path: Path) -> None:
        runtime = import_extra("onnxruntime", "an exported policy")
        self.path, data = path, _read(path)
        try:
            model = _Model.FromString(data)
        except DecodeError as error:
            raise _refusal(path, f"is not an ONNX model: {first_line(error)}") from error
        self.metadata = {entry.key: entry.value for entry in model.metadata_props}
        self.of_restock = bool({"format", _DIGEST} & self.metadata.keys())
        if self.of_restock:
            self._expect_digest(data)
        try:
            self._shapes = graph_shapes(model)
        except ValueError as error:
            raise _refusal(path, str(error)) from error
        self._input = model.graph.input[0].name
        self._outputs = [value.name for value in model.graph.output]
        self._values = ""  # name of the output with action values
        model.DiscardUnknownFields()
        options = runtime.SessionOptions()
        options.intra_op_num_threads = 1  # the network is too small for more
        options.inter_op_num_threads = 1
        options.log_severity_level = 4
        options.graph_optimization_level = runtime.GraphOptimizationLevel.ORT_DISABLE_ALL
        try:
            self._session = runtime.InferenceSession(
                model.SerializeToString(), options, providers=["CPUExecutionProvider"]
            )
        except Exception as error:
            raise _refusal(path, f"is not an ONNX model: {first_line(error)}") from error

    def _expect_digest(self, data: bytes) -> None:
        written = self.metadata.get("format", FORMAT)
        if written != FORMAT:
            raise _refusal(
                self.path,
                f"was exported by another Restock: its format is {written}, not {FORMAT}",
                f"export the run {self.metadata.get('run', '')} again: {_EXPORT}",
            )
        size = len(_digest_entry(b""))
        if data[-size:] != _digest_entry(data[:-size]):
            raise _refusal(
                self.path,
                "is damaged, or was changed: its digest is not that of its bytes",
                f"copy it again from where it was made, or {_EXPORT}",
            )

    def expect(self, task: Task, who: str) -> None:
        """Raise ConfigError unless it is a policy for this task, which `who` defines."""
        metadata, again = self.metadata, f"export it again from a run of this task: {_EXPORT}"
        if self.of_restock and metadata.get("task_hash") != task.hash:
            why = f"was made for task {metadata.get('task_hash')}, {who} defines {task.hash}"
            raise _refusal(self.path, why, again)
        for key, value in (("observation", task.observation_names), ("actions", task.actions)):
            if self.of_restock and metadata.get(key) != msgspec.json.encode(value).decode():
                raise _refusal(self.path, f"has other {key} in its metadata than {who}", again)
        taken, wanted = self._shapes[self._input], (ROWS, task.observation_size)
        if taken != wanted:
            why = f"takes {_shape_text(taken)}, the task's observation is {_shape_text(wanted)}"
            raise _refusal(self.path, why, again)
        made = {name: self._shapes[name] for name in self._outputs}
        wanted = (ROWS, len(task.actions))
        self._values = next((name for name, shape in made.items() if shape == wanted), "")
        if not self._values:
            every = ", ".join(f"{name} {_shape_text(shape)}" for name, shape in made.items())
            why = f"computes {every}, the task's action values are {_shape_text(wanted)}"
            raise _refusal(self.path, why, again)
        try:
            self.values(np.zeros((1, task.observation_size), np.float32))
        except Exception as error:  # the runtime has its own classes of errors
            raise _refusal(self.path, f"cannot be run: {first_line(error)}") from error

    def values(self, observation: F32) -> F32:
        """Return action values (N, A) for observations (N, D); call `expect` before."""
        (values,) = self._session.run([self._values], {self._input: observation})
        return np.asarray(values, np.float32)


def with_digest(data: bytes) -> bytes:
    """Append the digest of a serialised model to its bytes, as the last metadata entry.

    Raises:
        ValueError: `OnnxFile` would refuse it.
    """
    graph_shapes(_Model.FromString(data))
    if len(data) + len(_digest_entry(b"")) > MAX_BYTES:
        raise ValueError(_TOO_LONG)
    return data + _digest_entry(data)


def _digest_entry(data: bytes) -> bytes:
    # A protobuf message can be extended by appending fields; this one always takes 75 bytes.
    entry = {"key": _DIGEST, "value": hashlib.sha256(data).hexdigest()}
    content: bytes = _Model(metadata_props=[entry]).SerializeToString()
    return content


def _read(path: Path) -> bytes:
    if not path.is_file():
        raise _refusal(path, "is a folder, not an ONNX file" if path.is_dir() else "no such file")
    with path.open("rb") as file:
        data = file.read(MAX_BYTES + 1)
    if len(data) > MAX_BYTES:
        raise _refusal(path, _TOO_LONG)
    return data


def _refusal(
    path: Path, why: str, remedy: str = f"give a file that `{_EXPORT}` wrote"
) -> ConfigError:
    """Return the error about a file; shorten it, as names in a hostile file may be very long."""
    return ConfigError(why[:400], where=str(path), remedy=remedy[:400])


# The part of onnx.proto that a policy needs. Other fields never reach the runtime.
_MESSAGES = {
    "Model": "1 int64 ir_version, 2 string producer_name, 3 string producer_version, 7 Graph graph,"
    " 8 Opset* opset_import, 14 Entry* metadata_props",
    "Opset": "1 string domain, 2 int64 version",
    "Entry": "1 string key, 2 string value",
    "Graph": "1 Node* node, 2 string name, 5 Tensor* initializer, 11 Value* input,"
    " 12 Value* output",
    "Node": "1 string* input, 2 string* output, 3 string name, 4 string op_type,"
    " 5 Attribute* attribute, 7 string domain",
    "Attribute": "1 string name, 2 float f, 3 int64 i, 20 int32 type",
    "Tensor": "1 int64* dims, 2 int32 data_type, 8 string name, 9 bytes raw_data",
    "Value": "1 string name, 2 Type type",
    "Type": "1 TensorType tensor_type",
    "TensorType": "1 int32 elem_type, 2 Shape shape",
    "Shape": "1 Dim* dim",
    "Dim": "1 int64 dim_value, 2 string dim_param",
}
_FLOAT, _INT = 1, 2  # types of attributes
_TYPES: dict[int, np.dtype[Any]] = {
    1: np.dtype("<f4"),
    7: np.dtype("<i8"),
}  # types of tensors: float32 and int64


def _model_class() -> Any:
    file = FileDescriptorProto(name="policy.proto", syntax="proto3")
    for message, fields in _MESSAGES.items():
        made = file.message_type.add(name=message)
        for number, kind, field in map(str.split, fields.split(",")):
            many = FieldDescriptorProto.LABEL_REPEATED if "*" in kind else None
            one = made.field.add(name=field, number=int(number), label=many)
            if (kind := kind.rstrip("*")) in _MESSAGES:
                one.type, one.type_name = FieldDescriptorProto.TYPE_MESSAGE, f".{kind}"
            else:
                one.type = getattr(FieldDescriptorProto, f"TYPE_{kind.upper()}")
    pool = DescriptorPool()
    pool.Add(file)
    return GetMessageClass(pool.FindMessageTypeByName("Model"))


_Model = _model_class()


def graph_shapes(model: Any) -> dict[str, Shape]:
    """Return the shape of every value in a model's graph, by name.

    Raises:
        ValueError: an operator is not in ONNX_OPERATORS, shapes do not fit, or a limit is exceeded.
    """
    graph = model.graph
    if [(opset.domain, opset.version > 0) for opset in model.opset_import] != [("", True)]:
        raise ValueError("needs operators other than those of ONNX itself")
    for many in (graph.node, graph.initializer, model.metadata_props):
        if len(many) > MAX_PARTS:
            kind = "nodes, constants or metadata entries"
            raise ValueError(f"has {len(many):,} {kind}, more than {MAX_PARTS}")
    if len(graph.input) != 1:
        raise ValueError(f"takes {len(graph.input)} inputs, not one observation")
    observation = graph.input[0]
    sizes = [dim.dim_value for dim in observation.type.tensor_type.shape.dim]
    if len(sizes) != 2:
        raise ValueError(f"takes an input of {len(sizes)} dimensions, not observations (N, D)")
    shapes: dict[str, Shape] = {observation.name: (ROWS, sizes[1])}
    constants: dict[str, NDArray[Any]] = {}

    def add(name: str, shape: Shape) -> None:
        if name in shapes:
            raise ValueError(f"has {name!r} twice")
        shapes[name] = shape

    for tensor in graph.initializer:
        constants[tensor.name] = _constant(tensor)
        add(tensor.name, constants[tensor.name].shape)
    for node in graph.node:
        operator = ONNX_OPERATORS.get(node.op_type)
        if operator is None or node.domain or len(node.output) != 1:
            kind = f"{node.domain}.{node.op_type}".lstrip(".")
            raise ValueError(
                f"has the operator {kind}; a policy may have {', '.join(ONNX_OPERATORS)}"
            )
        if unknown := [name for name in node.input if name not in shapes]:
            raise ValueError(f"reads {unknown[0]!r} before anything computes it")
        settings = {}
        for given in node.attribute:
            if given.type not in (_FLOAT, _INT):
                raise ValueError(f"sets {given.name} of {node.op_type}, which is not a number")
            settings[given.name] = given.i if given.type == _INT else given.f
        values = [constants.get(name) for name in node.input]
        try:
            shape = operator([shapes[name] for name in node.input], settings, values)
        except (ValueError, IndexError) as error:
            every = ", ".join(_shape_text(shapes[name]) for name in node.input)
            raise ValueError(f"does not fit: {node.op_type} of {every}") from error
        width = math.prod(size for size in shape if size != ROWS)
        if width > MAX_WIDTH or ROWS in shape[1:]:
            raise ValueError(f"computes {_shape_text(shape)}, more than {MAX_WIDTH} numbers a row")
        add(node.output[0], shape)
    if unknown := [value.name for value in graph.output if value.name not in shapes]:
        raise ValueError(f"returns {unknown[0]!r}, which nothing computes")
    return shapes


def _constant(tensor: Any) -> NDArray[Any]:
    """Return a tensor's numbers, which must be in the file and finite (a scalar may be -inf)."""
    kind, dims = _TYPES.get(tensor.data_type), tuple(tensor.dims)
    if kind is None or len(dims) > 2 or min(dims, default=1) < 1:
        raise ValueError(f"has {tensor.name!r}: neither a matrix nor a vector of float32 or int64")
    size, held = math.prod(dims) * kind.itemsize, len(tensor.raw_data)
    if size != held:
        raise ValueError(
            f"contains {held} of the {size} bytes of {tensor.name!r} {_shape_text(dims)}"
        )
    value: NDArray[Any] = np.frombuffer(tensor.raw_data, kind).reshape(dims)
    if not np.isfinite(value).all() and (dims or value != -np.inf):
        raise ValueError(f"has weights {tensor.name!r} that are not finite numbers")
    return value


# A function that computes the shape of a node's output from the shapes of its inputs, its
# attributes, and the values of its inputs (None unless constant). It raises ValueError or
# IndexError if the inputs do not fit.
Rule = Callable[[Sequence[Shape], Mapping[str, float], Sequence[NDArray[Any] | None]], Shape]


def _same_shape(shapes: Sequence[Shape], settings: Mapping[str, float], values: Any) -> Shape:
    return shapes[0]


def _broadcast_shape(shapes: Sequence[Shape], settings: Mapping[str, float], values: Any) -> Shape:
    return np.broadcast_shapes(*shapes)


def _product_shape(shapes: Sequence[Shape], settings: Mapping[str, float], values: Any) -> Shape:
    """Return the shape of (N, k) @ (k, m) [+ (m,)]; the second matrix may be transposed."""
    (rows, inner), (taken, width) = shapes[0], shapes[1][:: -1 if settings.get("transB") else 1]
    if inner != taken or settings.get("transA") or (len(shapes) == 3 and shapes[2] != (width,)):
        raise ValueError
    return rows, width


def _reduced_shape(shapes: Sequence[Shape], settings: Mapping[str, float], values: Any) -> Shape:
    """Return the shape of (N, k) reduced along its second axis."""
    axes = np.array(values[1]).tolist() if len(shapes) == 2 else [settings.get("axis")]
    if len(shapes[0]) != 2 or axes not in ([1], [-1]):
        raise ValueError
    return (shapes[0][0], 1) if settings.get("keepdims", 1) else shapes[0][:1]


ONNX_OPERATORS: dict[str, Rule] = {  # all operators that a policy may have
    "Gemm": _product_shape,
    "MatMul": _product_shape,
    "LayerNormalization": _same_shape,
    "Relu": _same_shape,
    "Tanh": _same_shape,
    "Sigmoid": _same_shape,
    "Softmax": _same_shape,
    "Identity": _same_shape,
    "Add": _broadcast_shape,
    "Sub": _broadcast_shape,
    "Mul": _broadcast_shape,
    "Div": _broadcast_shape,
    "GreaterOrEqual": _broadcast_shape,
    "Where": _broadcast_shape,
    "ReduceMax": _reduced_shape,
    "ReduceMin": _reduced_shape,
    "ReduceSum": _reduced_shape,
    "ReduceMean": _reduced_shape,
    "ArgMax": _reduced_shape,
}


def _shape_text(shape: Shape) -> str:
    sizes = ["N" if size == ROWS else str(size) for size in shape]
    return f"({', '.join(sizes)}{',' if len(shape) == 1 else ''})"
