"""Arrays by the type of their entries. Their shapes stand in comments, where they are declared."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

__all__ = ["F32", "F64", "Bools", "Ints"]
