"""MCAP's CRC-32: the same whoever computes it, with `isal` and without."""

from __future__ import annotations

import zlib

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from restock.ingest.containers.mcap_records import crc32


@given(st.binary(max_size=300), st.integers(0, 300))
def test_equals_zlibs_in_one_piece_and_in_two(data: bytes, cut: int) -> None:
    assert crc32(data) == zlib.crc32(data)
    assert crc32(data[cut:], crc32(data[:cut])) == zlib.crc32(data)
    assert crc32(np.frombuffer(data, np.uint8).data) == zlib.crc32(data)
