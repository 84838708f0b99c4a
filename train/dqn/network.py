"""The Q network, its gradient, and Adam over its parameters in one flat vector.

The network is an MLP with LayerNorm, which bounds how far values can extrapolate away from the
data. That keeps off-policy learning on logs and fresh experience together stable (RLPD,
arXiv:2302.02948).

Adam's step, the target's update and the average of weights are one operation on one tensor each.

If compiled code is available (`restock.native`), a kernel makes the forward and backward pass of a
plain network for PyTorch's autograd. It returns action values and takes their gradient, so it
depends on no loss.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, ClassVar, Literal, Protocol, TypeVar

import numpy as np
import torch
from torch import Tensor, nn
from torch.optim.adam import adam

from restock import native
from restock.arrays import F32
from restock.state import Stateful

N = TypeVar("N", bound=nn.Module)


class QNetwork(nn.Module):
    """A LayerNorm MLP from observations (B, D) float32 to action values (B, A) float32."""

    def __init__(
        self,
        observation_size: int,
        actions: int,
        *,
        hidden: Sequence[int] = (256, 256),
        layer_norm: bool = True,
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__()
        self.observation_size, self.actions = observation_size, actions
        layers: list[nn.Module] = []
        width = observation_size
        for size in hidden:
            layers.append(nn.Linear(width, size))
            if layer_norm:
                layers.append(nn.LayerNorm(size))
            layers.append(nn.ReLU())
            width = size
        self.body = nn.Sequential(*layers)
        self.advantage = nn.Linear(width, actions)
        self._initialise(generator)

    def _initialise(self, generator: torch.Generator | None) -> None:
        """Initialise all Linear layers as PyTorch does by default, but from `generator`."""
        for module in self.modules():
            if isinstance(module, nn.Linear):
                bound = module.in_features**-0.5
                with torch.no_grad():
                    module.weight.uniform_(-bound, bound, generator=generator)
                    module.bias.uniform_(-bound, bound, generator=generator)

    def forward(self, observation: Tensor) -> Tensor:
        """Return action values (B, A)."""
        features = self.body(observation)
        values: Tensor = self.advantage(features)
        return values


class Ensemble(nn.Module):
    """The networks of several runs, as one network that returns the mean of their values.

    Each run explored by itself, so their errors differ: an action that one of them overestimates is
    rarely overestimated by all (arXiv:1611.01929).
    """

    def __init__(self, members: Sequence[nn.Module]) -> None:
        super().__init__()
        self.members = nn.ModuleList(members)
        self.observation_size: int = members[0].observation_size  # type: ignore[assignment]
        self.actions: int = members[0].actions  # type: ignore[assignment]

    def forward(self, observation: Tensor) -> Tensor:
        """Return action values (B, A)."""
        values: Tensor = sum(member(observation) for member in self.members)
        return values / len(self.members)


def members_of(network: nn.Module) -> list[Any]:
    """Return the networks of an ensemble, or a list of the network itself."""
    return list(network.members) if isinstance(network, Ensemble) else [network]


def clone(network: N) -> N:
    """Return a copy without gradients, such as a target network."""
    import copy

    copied = copy.deepcopy(network)
    for parameter in copied.parameters():
        parameter.requires_grad_(False)
    return copied


@contextmanager
def torch_threads(number: int) -> Iterator[None]:
    """Set the number of torch's CPU threads while the block runs.

    Small networks are slower on several threads, and much slower if other processes use the cores.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(number)
    try:
        yield
    finally:
        torch.set_num_threads(before)


UpdatePath = Literal["native", "autograd"]


class Differentiable(Protocol):
    """A network, or a kernel that computes the same values and gradients."""

    def __call__(self, observation: Tensor) -> Tensor:
        """Return action values (B, A) of observations (B, D)."""
        ...

    def zero_grad(self, set_to_none: bool = True) -> None:
        """Reset the gradient; `set_to_none=False` keeps its tensors allocated."""
        ...


def update_path(device: str, threads: int = 1) -> UpdatePath:
    """Return how the gradients of a run are computed; `config.json` has it as `update_path`.

    The kernel computes on one thread of the CPU. A run with more threads or on another device uses
    PyTorch's operations, as does a network that is not a plain `QNetwork`.
    """
    on_cpu = torch.device(device).type == "cpu"
    return "native" if on_cpu and threads == 1 and native.IS_USED else "autograd"


def differentiable(
    path: UpdatePath, network: nn.Module, values: Tensor, gradient: Tensor | None = None
) -> Differentiable:
    """Return a kernel of the network, or the network itself, to compute the loss with.

    Args:
        path: "native" for a kernel; only a plain `QNetwork` has one.
        network: a network whose parameters `FlatParameters` moved into `values`.
        values: all parameters, flat.
        gradient: the gradients of all parameters, flat; None if the network does not learn.
    """
    if path == "native" and type(network) is QNetwork:
        return Kernel(network, values, gradient)
    return network


class Kernel:
    """A compiled plain `QNetwork`, from observations (B, D) to action values (B, A).

    Gradients add up until `zero_grad`, as in autograd. Only one thread at a time may call a kernel,
    but other Python threads can run while it computes.

    Args:
        network: float32 on the CPU, its parameters moved into `values` by `FlatParameters`.
        values: all parameters, flat.
        gradient: receives the parameters' gradients; None if the network does not learn.
        wide: whether AVX-512 may be used; the result is the same.
    """

    def __init__(
        self,
        network: QNetwork,
        values: Tensor,
        gradient: Tensor | None = None,
        *,
        wide: bool = True,
    ) -> None:
        modules = list(network.body)
        widths = [module.out_features for module in modules if isinstance(module, nn.Linear)]
        norms = [module.eps for module in modules if isinstance(module, nn.LayerNorm)]
        self._actions = network.actions
        self._gradient = gradient
        self._adds = False  # whether the next backward pass adds to the gradient or overwrites it
        self._passes = 0  # forward passes so far; only the last one's activations are stored
        self._network = native.compiled.Network(
            (network.observation_size, *widths, network.actions),
            norms[0] if norms else -1.0,
            values.numpy(),
            None if gradient is None else gradient.numpy(),
            wide,
        )

    def __call__(self, observation: Tensor) -> Tensor:
        """Return action values (B, A), as a leaf of autograd's graph if the network learns.

        The kernel's backward pass runs as soon as autograd has accumulated the leaf's gradient.
        """
        values = torch.from_numpy(self.values(observation.numpy()))
        if self._gradient is not None and torch.is_grad_enabled():
            made_by = self._passes
            values.requires_grad_().register_post_accumulate_grad_hook(  # type: ignore[no-untyped-call]
                lambda leaf: self._backward(observation, made_by, leaf.grad)
            )
        return values

    def zero_grad(self, set_to_none: bool = True) -> None:
        """Make the next backward pass overwrite the gradient instead of adding to it."""
        self._adds = False

    def values(self, *observation: F32) -> F32:
        """Return action values (n * B, A) of n arrays of observations (B, D), outside autograd."""
        out = np.empty((len(observation) * len(observation[0]), self._actions), np.float32)
        self._network.forward(observation, out)
        self._passes += 1
        return out

    def descend(self, gradient: F32) -> None:
        """Backpropagate `gradient` (B, A), that of the last forward pass's first B rows."""
        self._network.backward(gradient)

    def _backward(self, observation: Tensor, made_by: int, gradient: Tensor | None) -> None:
        assert self._gradient is not None
        assert gradient is not None
        if made_by != self._passes:  # a later pass overwrote the activations: repeat this pass
            self.values(observation.numpy())
        earlier = self._gradient.clone() if self._adds else None
        self.descend(gradient.contiguous().numpy())
        if earlier is not None:
            self._gradient.add_(earlier)
        self._adds = True


_ALIGNMENT = 16  # elements, a cache line: every parameter begins on one, as its own tensor would
_SLICE = 4096  # elements per slice for Adam on a GPU, which would run in two blocks if not sliced


class FlatParameters:
    """The parameters of `network`, moved into `values`; their gradients are views of `gradient`.

    Parameters become views, so `load_state_dict` and in-place writes change `values`. Replacing a
    parameter's `.data`, as `Module.to` does, ends that: call `Module.to` before.

    Args:
        network: the network whose parameters are moved.
        learns: whether the parameters have gradients; if not, `gradient` is empty.
    """

    def __init__(self, network: nn.Module, *, learns: bool) -> None:
        parameters = list(network.parameters())
        self._shapes = [parameter.shape for parameter in parameters]
        self._offsets, size = [], 0
        for parameter in parameters:
            self._offsets.append(size)
            size += -(-parameter.numel() // _ALIGNMENT) * _ALIGNMENT
        self.values = parameters[0].detach().new_zeros(size)
        self.gradient = self.values.new_zeros(size if learns else 0)
        for parameter, view in zip(parameters, self.views(self.values), strict=True):
            view.copy_(parameter.detach())
            parameter.data = view
        if learns:
            self.values.grad = self.gradient
            for parameter, view in zip(parameters, self.views(self.gradient), strict=True):
                parameter.grad = view

    def views(self, flat: Tensor) -> list[Tensor]:
        """Return views of a tensor as long as `values`: one per parameter, in network order."""
        return [
            flat[offset : offset + shape.numel()].view(shape)
            for offset, shape in zip(self._offsets, self._shapes, strict=True)
        ]

    def flat_of(self, pieces: list[Tensor]) -> Tensor:
        """Return a new flat tensor whose `views` are these pieces, with 0 in the padding."""
        flat = torch.zeros_like(self.values)
        for view, piece in zip(self.views(flat), pieces, strict=True):
            view.copy_(piece)
        return flat


_MOMENTS = ("exp_avg", "exp_avg_sq")  # PyTorch's names of Adam's two moments
_BETAS, _EPS = (0.9, 0.999), 1e-8  # PyTorch's defaults for Adam


AVERAGING = 0.001  # rate of the average of weights that is evaluated and kept


def averaging_rate(steps: int) -> float:
    """Return the rate of an average of weights at step number `steps` (from 1).

    The greedy policy of a single update is noisy: a small change of values changes many actions at
    once. The average over about the last 1 / AVERAGING updates is not (Polyak and Juditsky 1992).
    Before there are that many updates, the average is the mean over all of them.
    """
    return max(AVERAGING, 1.0 / steps)


class FlatAdam(Stateful):
    """Adam on all parameters of `network` as one tensor.

    It calls the function behind `torch.optim.Adam(fused=True)` and gives the same bits. That class
    spends a fifth of each step on hooks, groups and schedules, which are unused here.

    Args:
        network: its parameters are moved into `values`, their gradients into `gradient`.
        compiled: make steps by compiled code: the same bits in one pass over memory, which also
            moves the average of weights.
    """

    STATE: ClassVar[tuple[str, ...]] = ("moments",)

    def __init__(
        self,
        network: nn.Module,
        learning_rate: float,
        *,
        compiled: bool = False,
    ) -> None:
        self._flat = FlatParameters(network, learns=True)
        self.values, self.gradient = self._flat.values, self._flat.gradient
        self.learning_rate, self._compiled = learning_rate, compiled
        # From here on, write these tensors only in place: a CUDA graph refers to them.
        self._moments = [torch.zeros_like(self.values) for _ in _MOMENTS]
        # Lists for `adam`: whole tensors on the CPU, slices on a GPU; `_step` has a count for each.
        device = self.values.device
        size = len(self.values) if device.type == "cpu" else _SLICE
        whole = (self.values, self.gradient, *self._moments)
        self._moved = [list(torch.split(tensor, size)) for tensor in whole]
        self._step = torch.zeros(len(self._moved[0]), device=device)
        self._steps = 0
        if compiled:
            values, gradient, mean, square = (tensor.detach().numpy() for tensor in whole)
            self._arrays = values, gradient, mean, square

    @torch.no_grad()
    def step(self, average: Tensor | None = None, rate: float = 0.0) -> None:
        """Update the parameters by their gradient, then move `average` towards them by `rate`."""
        self.count(1)
        if not self._compiled:
            self.move(average, rate)
            return
        first, second = (1 - beta**self._steps for beta in _BETAS)
        native.compiled.adam(
            *self._arrays,
            None if average is None else average.numpy(),
            (*_BETAS, self.learning_rate / first, second**0.5, _EPS, rate),
        )

    def count(self, steps: int) -> None:
        """Count steps that were made by `move`."""
        self._steps += steps

    @torch.no_grad()
    def move(self, average: Tensor | None, rate: float | Tensor) -> None:
        """Make a step by operations on the device alone, which a CUDA graph can repeat."""
        values, gradient, moved, squares = self._moved
        adam(
            *(values, gradient, moved, squares, [], list(self._step.unbind())),
            fused=True,
            amsgrad=False,
            beta1=_BETAS[0],
            beta2=_BETAS[1],
            lr=self.learning_rate,
            weight_decay=0.0,
            eps=_EPS,
            maximize=False,
        )
        if average is not None:
            average.lerp_(self.values, rate)

    def forget(self) -> None:
        """Reset the moments after the parameters were replaced."""
        for tensor in (*self._moments, self._step):
            tensor.zero_()
        self._steps = 0

    @property
    def moved(self) -> list[Tensor]:
        """Return all tensors that `move` changes, without the average."""
        return [self.values, *self._moments, self._step]

    @property
    def moments(self) -> dict[str, dict[str, Tensor]]:
        """Return Adam's moments per parameter, in the network's order."""
        if not self._steps:
            return {}
        self._step.fill_(self._steps)
        moments = zip(*(self._flat.views(each) for each in self._moments), strict=True)
        return {
            str(index): {"step": self._step[0], **dict(zip(_MOMENTS, pair, strict=True))}
            for index, pair in enumerate(moments)
        }

    @moments.setter
    def moments(self, entries: Mapping[str, Mapping[str, Tensor]]) -> None:
        self.forget()
        if not entries:
            return
        ordered = [entries[str(index)] for index in range(len(entries))]
        self._step.copy_(ordered[0]["step"])
        self._steps = int(self._step)
        for moment, name in zip(self._moments, _MOMENTS, strict=True):
            moment.copy_(self._flat.flat_of([entry[name] for entry in ordered]))
