"""Check `gather_rows`, compiled and not."""

from collections.abc import Iterator

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from restock import native
from restock.train.feed.batches import gather_rows

TABLES = npst.arrays(
    np.float32,
    st.tuples(st.integers(1, 9), st.integers(1, 40)),
    elements=st.floats(width=32, allow_nan=True, allow_infinity=True, allow_subnormal=True),
)


@pytest.fixture(autouse=True, params=[True, False], ids=["compiled", "not compiled"])
def use_native(request: pytest.FixtureRequest) -> Iterator[None]:
    if request.param and not native.IS_USED:
        pytest.skip(f"native code is {native.state()}")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(native, "IS_USED", request.param)
        yield


def rows_match(given: torch.Tensor, rows: torch.Tensor, index: torch.Tensor) -> bool:
    return np.array_equal(given.numpy(), rows.numpy()[index.numpy()], equal_nan=True)


@settings(max_examples=60)
@given(TABLES, st.data())
def test_rows_are_gathered_in_order(table: np.ndarray, data: st.DataObject) -> None:
    rows = torch.from_numpy(table)
    numbers = data.draw(st.lists(st.integers(0, len(table) - 1), max_size=20))
    index = torch.tensor(numbers, dtype=torch.int64)
    given = gather_rows(rows, index)
    assert given.shape == (len(numbers), table.shape[1])
    assert rows_match(given, rows, index)


def test_gather_preserves_bits() -> None:
    bits = np.array([0x80000000, 0x7FC00001, 0x00000001, 0xFF800000], np.uint32)
    rows, index = torch.from_numpy(bits.view(np.float32).reshape(4, 1)), torch.tensor([3, 0, 1, 2])
    given = gather_rows(rows, index).numpy().view(np.uint32).ravel().tolist()
    assert given == bits[index.numpy()].tolist()


@pytest.mark.parametrize("number", [4, -1])
def test_row_out_of_range_is_rejected(number: int) -> None:
    with pytest.raises((IndexError, RuntimeError)):
        gather_rows(torch.zeros(4, 3), torch.tensor([0, number]))


@pytest.mark.parametrize(
    "rows",
    [
        torch.arange(20, dtype=torch.float64).view(4, 5),
        torch.arange(20, dtype=torch.int64).view(4, 5),
        torch.arange(40, dtype=torch.float32).view(4, 10)[:, ::2],
        torch.arange(4, dtype=torch.float32),
    ],
)
def test_gather_accepts_other_dtypes_and_strides(rows: torch.Tensor) -> None:
    index = torch.tensor([3, 3, 0])
    assert rows_match(gather_rows(rows, index), rows, index)
