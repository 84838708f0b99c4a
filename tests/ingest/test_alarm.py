"""The alarm of a policy file: its miss rate holds, and no rate is stated that cannot be."""

import msgspec
import numpy as np
import pytest
from scipy.stats import binomtest

from restock.errors import ConfigError
from restock.ingest.live.alarm import Alarm, alarm_of, count_alarms, fit_alarm


def fitted(
    rng: np.random.Generator, failures: int, miss_rate: float, safe: int = 4
) -> tuple[Alarm, np.ndarray]:
    """Return an alarm of exchangeable episodes, and the window of one more that failed."""
    windows = [
        # Episodes differ more than their steps do, in how long they are as well.
        (rng.normal(2 * rng.random(), 1, (rng.integers(1, 11), 3)) + rng.exponential()).astype("f4")
        for _ in range(failures + 1)
    ]
    drives = [rng.normal(size=(50, 3)).astype("f4") for _ in range(safe)]
    kinds = ["bump"] * failures
    alarm = fit_alarm(windows[1:], kinds, drives, miss_rate=miss_rate, period_s=0.2)
    return alarm, windows[0]


@pytest.mark.parametrize(("miss_rate", "failures"), [(0.1, 17), (0.25, 12), (0.5, 2), (0.3, 40)])
def test_new_failures_are_missed_at_most_as_stated(miss_rate: float, failures: int) -> None:
    rng, trials = np.random.default_rng(7), 600
    pairs = [fitted(rng, failures, miss_rate) for _ in range(trials)]
    missed = sum(not alarm.on(window).any() for alarm, window in pairs)
    assert binomtest(missed, trials, miss_rate, "greater").pvalue > 1e-4
    assert missed > 0.5 * miss_rate * trials  # and no alarm is on all the time


def test_an_alarm_counts_its_false_alarms_on_other_drives() -> None:
    rng = np.random.default_rng(1)
    alarm, _ = fitted(rng, 40, 0.2, safe=400)
    drives = [alarm.on(rng.normal(size=(50, 3)).astype("f4")) for _ in range(400)]
    hours = 400 * 50 * 0.2 / 3600
    assert alarm.safe_h == pytest.approx(hours / 2)
    assert alarm.on_share == pytest.approx(np.mean(drives), rel=0.2)
    expected = sum(count_alarms(on, 0.2) for on in drives) / hours
    assert alarm.false_alarms_per_h == pytest.approx(expected, rel=0.2)


def test_alarms_a_second_apart_count_as_two() -> None:
    on = np.zeros(30, bool)
    assert count_alarms(on, 0.2) == 0
    on[[3, 4, 9, 15, 29]] = True  # 1.0, 1.2 and 2.8 s after the one before
    assert count_alarms(on, 0.2) == 3


@pytest.mark.parametrize(
    ("miss_rate", "failures", "safe", "why"),
    [
        *((rate, 9, 2, "must be above 0 and below 1") for rate in (0.0, 1.0, -0.1, float("nan"))),
        (0.1, 0, 2, "needs 17 episodes that failed, there are 0"),
        (0.1, 16, 2, "needs 17 episodes that failed, there are 16; with these, the lowest rate is"),
        (0.05, 22, 2, "there are 22; with these, the lowest rate is 0.083"),
        (0.1, 17, 1, "needs 2 episodes without a failure, there are 1"),
    ],
)
def test_a_rate_that_cannot_be_stated_is_refused(miss_rate, failures, safe, why):
    with pytest.raises(ConfigError, match=why):
        fitted(np.random.default_rng(0), failures, miss_rate, safe)


def test_an_alarm_is_read_from_metadata_or_refused() -> None:
    alarm, window = fitted(np.random.default_rng(0), 20, 0.1)
    text = msgspec.json.encode(alarm).decode()
    assert alarm_of({}, 3, "p.onnx") is None
    assert alarm_of({"alarm": text}, 3, "p.onnx") == alarm
    assert not alarm.on(np.full_like(window, np.nan)).any()
    for metadata, size, why in (
        ({"alarm": "{}"}, 3, "p.onnx.*its alarm cannot be read"),
        ({"alarm": text}, 4, "weighs 3 entries, the observation has 4"),
    ):
        with pytest.raises(ConfigError, match=why):
            alarm_of(metadata, size, "p.onnx")
