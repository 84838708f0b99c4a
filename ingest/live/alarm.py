"""The alarm of a policy file: on where the robot is as it was before logged failures began.

The score of an observation is linear: it separates the last second before bumps, takeovers and
stops from drives without any (Fisher's discriminant). Its threshold is by split conformal
prediction over episodes, as the warning regions of arXiv:2501.04823 are: a new episode that fails
has no alarm in the window before with probability `miss_rate` at most, if it is exchangeable with
those that set the threshold. It is not if another policy drives, on another site, or in another mix
of missions.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence

import msgspec
import numpy as np

from restock.arrays import F32, F64, Bools
from restock.errors import ConfigError

KEY = "alarm"  # of a policy file's metadata
WINDOW_S = 2.0  # before a failure in which an alarm counts
FITTED_S = 1.0  # of that, the last
APART_S = 1.0  # between two alarms that count as two
_RIDGE = 0.1  # of standardised entries


class Alarm(msgspec.Struct, frozen=True):
    """A score of observations, and the threshold from which the alarm is on."""

    miss_rate: float  # that was requested
    weights: list[float]  # (D,)
    threshold: float
    failures: dict[str, int]  # episodes by how they failed: half of them set the threshold
    false_alarms_per_h: float  # in drives without a failure that it was not fitted to
    on_share: float  # of their time
    safe_h: float  # how long they are

    def on(self, observation: F32) -> Bools:
        """Return whether the alarm is on, (N,), at observations (N, D); never at NaN."""
        return np.asarray(self.score(observation) >= self.threshold, np.bool_)

    def score(self, observation: F32) -> F64:
        """Return the scores (N,) of observations (N, D)."""
        return np.asarray(observation.astype(np.float64) @ np.array(self.weights), np.float64)


def alarm_of(metadata: Mapping[str, str], size: int, where: str) -> Alarm | None:
    """Return the alarm in a policy file's metadata; None if it has none.

    Raises:
        ConfigError: it cannot be read, or is of observations of another size.
    """
    text = metadata.get(KEY)
    if text is None:
        return None
    try:
        alarm = msgspec.json.decode(text, type=Alarm)
    except msgspec.DecodeError as error:
        raise ConfigError(f"its alarm cannot be read: {error}", where=where) from error
    if len(alarm.weights) != size:
        raise ConfigError(
            f"its alarm weighs {len(alarm.weights)} entries, the observation has {size}",
            where=where,
        )
    return alarm


def fit_alarm(
    windows: Sequence[F32],
    failures: Sequence[str],
    safe: Sequence[F32],
    *,
    miss_rate: float,
    period_s: float,
    seed: int = 0,
) -> Alarm:
    """Fit an alarm to episodes.

    Args:
        windows: observations (n, D) before each episode's failure, at most the last WINDOW_S.
        failures: how each of them failed.
        safe: observations (n, D) of episodes without a failure.
        miss_rate: how often a failure may come without an alarm, above 0 and below 1.
        period_s: between two observations.

    Raises:
        ConfigError: no such rate, or too few failures or episodes without one.
    """
    if not 0 < miss_rate < 1:
        raise ConfigError(f"must be above 0 and below 1, got {miss_rate:g}", where="--alarm")
    fitted, count = len(windows) // 2, len(windows) - len(windows) // 2
    place = math.floor(miss_rate * (count + 1) + 1e-9)
    if not place or not fitted:
        needed = max(2 * math.ceil(1 / miss_rate - 1e-9) - 3, 2)
        least = f"; with these, the lowest rate is {1 / (count + 1):.2g}" if fitted else ""
        raise ConfigError(
            f"a miss rate of {miss_rate:g} needs {needed} episodes that failed, there are"
            f" {len(windows)}{least}",
            where="--alarm",
            remedy="ask for a higher rate, or log more failures",
        )
    if len(safe) < 2:
        raise ConfigError(
            f"needs 2 episodes without a failure, there are {len(safe)}", where="--alarm"
        )
    rng = np.random.default_rng(seed)
    order, others = rng.permutation(len(windows)), rng.permutation(len(safe))
    last = max(round(FITTED_S / period_s), 1)
    unsafe = np.concatenate([windows[index][-last:] for index in order[:fitted]])
    rest = np.concatenate([safe[index] for index in others[: len(safe) // 2]])
    weights = _discriminant(unsafe.astype(np.float64), rest.astype(np.float64))
    highest = sorted(float((windows[index] @ weights).max()) for index in order[fitted:])
    threshold = highest[place - 1]
    drives = [safe[index] @ weights >= threshold for index in others[len(safe) // 2 :]]
    hours = sum(map(len, drives)) * period_s / 3600
    return Alarm(
        miss_rate=miss_rate,
        weights=weights.tolist(),
        threshold=threshold,
        failures=dict(sorted(Counter(failures).items())),
        false_alarms_per_h=sum(count_alarms(on, period_s) for on in drives) / hours,
        on_share=float(np.concatenate(drives).mean()),
        safe_h=hours,
    )


def count_alarms(on: Bools, period_s: float) -> int:
    """Return the number of alarms of a drive, given at which steps (N,) they are on."""
    steps = np.flatnonzero(on)
    return len(steps) and 1 + int((np.diff(steps) * period_s > APART_S + 1e-9).sum())


def _discriminant(unsafe: F64, safe: F64) -> F64:
    """Return the weights (D,) of Fisher's discriminant, larger for rows like the unsafe ones."""
    spread = np.concatenate([unsafe, safe]).std(axis=0)
    varies = spread > 1e-6
    weights = np.zeros(len(spread))
    unsafe, safe = (rows[:, varies] / spread[varies] for rows in (unsafe, safe))
    within = _RIDGE * np.eye(int(varies.sum()))
    for rows in (unsafe, safe):
        within += np.cov(rows.T, bias=True) / 2
    apart = unsafe.mean(axis=0) - safe.mean(axis=0)
    weights[varies] = np.linalg.solve(within, apart) / spread[varies]
    return weights
