"""Fixtures that several tests of training share."""

import dataclasses

import pytest

from restock.train.judge import comparability


@pytest.fixture
def few_resamples(monkeypatch: pytest.MonkeyPatch) -> None:
    """Compare feeds with 300 resamples, enough for the differences planted in tests."""
    limits = dataclasses.replace(comparability.LIMITS, resamples=300)
    monkeypatch.setattr(comparability, "LIMITS", limits)
