"""Fixtures that several tests of training share."""

import dataclasses

import pytest

from restock.train.judge import comparability


@pytest.fixture
def few_resamples(monkeypatch: pytest.MonkeyPatch) -> None:
    """Compare feeds by 300 resamples, which tell what is planted in tests."""
    limits = dataclasses.replace(comparability.LIMITS, resamples=300)
    monkeypatch.setattr(comparability, "LIMITS", limits)
