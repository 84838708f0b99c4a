"""Ragged columns from lists."""

import numpy as np

from restock.ingest.decoding.columns import Ragged, offsets_of


def ragged(rows: list[list]) -> Ragged:
    flat = [item for row in rows for item in row]
    strings = any(isinstance(item, str) for item in flat)
    values = np.array([*flat, None], object)[:-1] if strings else np.array(flat, float)
    return Ragged(values, offsets_of(np.array([len(row) for row in rows])))


def nested(rows: list[list[list]]) -> Ragged:
    inner = ragged([item for row in rows for item in row])
    return Ragged(inner, offsets_of(np.array([len(row) for row in rows])))
