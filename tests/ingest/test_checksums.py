"""MCAP's CRC-32: the same whoever computes it, with `isal` and without."""

import sys
import zlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from restock.ingest.containers.chunks import _fastest_crc32, crc32


@given(st.binary(max_size=300), st.integers(0, 300))
def test_equals_zlibs_in_one_piece_and_in_two(data: bytes, cut: int) -> None:
    assert crc32(data) == zlib.crc32(data)
    assert crc32(data[cut:], crc32(data[:cut])) == zlib.crc32(data)
    assert crc32(np.frombuffer(data, np.uint8).data) == zlib.crc32(data)


def test_without_isal_it_is_zlibs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "isal", None)
    assert _fastest_crc32() is zlib.crc32
