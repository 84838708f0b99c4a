"""How often each episode was drawn: the rows of the run's table `sampled_episodes`.

Rows of one episode are drawn together and are alike, so what a critic was fed is only as certain as
its episodes are many. `restock compare` resamples these.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

_MOST_CELLS = 1 << 22  # of a dense count; wider ranges of episodes are sorted instead


def episode_columns(
    episode: NDArray[np.int64],  # (n,) of each row drawn
    stratum: NDArray[np.int64],  # (n,)
    weight: NDArray[np.float32],  # (n,)
    strata: int,
) -> dict[str, NDArray[Any]]:
    """Draws summed by episode and stratum: columns episode, stratum, drawn_rows, weight."""
    first = int(episode.min(initial=0))
    key = (episode.astype(np.int64) - first) * strata + stratum
    if int(key.max(initial=0)) < _MOST_CELLS:
        drawn = np.bincount(key)
        cells = np.flatnonzero(drawn)
        count, total = drawn[cells], np.bincount(key, weight)[cells]
    else:
        cells, place, count = np.unique(key, return_inverse=True, return_counts=True)
        total = np.bincount(place, weight)
    return {
        "episode": cells // strata + first,
        "stratum": cells % strata,
        "drawn_rows": count,
        "weight": total,
    }


__all__ = ["episode_columns"]
