"""Rows of a packed table by number, for tables larger than the processor's caches.

`torch.index_select` copies one row after the other and waits for the memory of each. The compiled
gather (`restock.native`) asks for rows well ahead of the one that it copies. Without it, the kernel
behind `torch.nn.EmbeddingBag` does so, a little less far, with those that it adds up: with one row
in every bag the sum is the row. That kernel is not part of PyTorch's public interface, so it is
tried on a small table before it is used: where it is missing, or gives anything but the rows,
`index_select` takes its place.
"""

from __future__ import annotations

from functools import cache, lru_cache

import torch
from torch import Tensor

from restock import native

_TRIED_WIDTHS = (1, 16, 189)  # floats: below, at and above what a vector register holds


def gather_rows(rows: Tensor, index: Tensor) -> Tensor:
    """Gather rows `index` (B,) int64 of `rows` (n, W) into a new tensor (B, W) on their device.

    Values equal those of `rows.index_select(0, index)`, NaN and infinities included; without the
    compiled gather the sign of a negative zero may be lost.

    Raises:
        RuntimeError, IndexError: a row number outside the table.
    """
    if _has_a_faster_way(rows) and _is_plain(index):
        if native.is_used():
            batch = rows.new_empty(len(index), rows.shape[1])
            native.compiled.gather(rows.detach().numpy(), index.numpy(), batch.numpy())
            return batch
        if _prefetching_works():
            return _sum_of_one_each(rows, index)
    return rows.index_select(0, index)


def _has_a_faster_way(rows: Tensor) -> bool:
    """Return whether such a table can be read ahead: float32 in main memory, row by row."""
    return (
        rows.dtype == torch.float32
        and rows.device.type == "cpu"
        and rows.dim() == 2
        and rows.is_contiguous()
        and not (rows.requires_grad and torch.is_grad_enabled())  # it has no gradient
    )


def _is_plain(index: Tensor) -> bool:
    """Return whether these are row numbers as samplers give them.

    Those are int64, in main memory and contiguous.
    """
    return index.dtype == torch.int64 and index.device.type == "cpu" and index.is_contiguous()


def _sum_of_one_each(rows: Tensor, index: Tensor) -> Tensor:
    """Gather rows with `torch.embedding_bag`'s kernel; bag i is row `index[i]` alone."""
    summed: Tensor = torch._embedding_bag_forward_only(rows, index, _counted(len(index)))[0]
    return summed


@cache
def _prefetching_works() -> bool:
    """Return whether that kernel is there and gives the rows, tried on tables of a few widths."""
    index = torch.tensor([6, 0, 3, 3, 1])
    for width in _TRIED_WIDTHS:
        rows = torch.linspace(-3.0, 7.0, 7 * width).view(7, width)
        rows[1], rows[3, 0], rows[6, -1] = torch.inf, torch.nan, torch.finfo().tiny / 4
        try:
            given = _sum_of_one_each(rows, index)
        except (AttributeError, RuntimeError, TypeError):  # gone, or called otherwise
            return False
        if not torch.equal(given.nan_to_num(9.0), rows[index].nan_to_num(9.0)):
            return False
    return True


@lru_cache(maxsize=64)
def _counted(count: int) -> Tensor:
    """(count,): where each bag begins."""
    return torch.arange(count)


__all__ = ["gather_rows"]
