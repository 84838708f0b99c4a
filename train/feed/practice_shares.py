"""Shares of practice: arithmetic over weights, floors, the logs, and arms without their orders."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from restock.arrays import F64
from restock.train.feed.logs import Coded
from restock.train.twin.env.episode_queue import MissionArm


def with_floors(weights: F64, floors: F64) -> F64:
    """Shares (K,) in proportion to weights, none below its floor; they sum to 1.

    Those that would be below it get it, the others share the rest. Without any weight beside them
    the rest is shared evenly. `floors` sum to at most 1, `weights` to more than 0.
    """
    shares: F64 = floors
    held = np.zeros(len(weights), np.bool_)
    while not held.all():
        rest = max(1.0 - floors[held].sum(), 0.0)
        weight = np.where(held, 0.0, weights)
        if not weight.sum() > 0:
            weight = (~held).astype(np.float64)
        part = rest * weight / weight.sum()
        below = ~held & (part < floors)
        if not below.any():
            shares = np.where(held, floors, part)
            break
        held |= below
    whole: F64 = shares / shares.sum()
    return whole


def moved(shares: F64, wanted: F64, most: float) -> F64:
    """From shares toward those wanted, no share by more than `most`; they still sum to 1.

    All go the same part of their way, so what holds for both (a floor, a sum) holds for the result.
    """
    farthest = float(np.abs(wanted - shares).max())
    part = 1.0 if farthest <= most else most / farthest
    return np.add(shares, part * (wanted - shares))


def unordered(arms: Sequence[MissionArm]) -> list[MissionArm]:
    """The arms without those of orders, whose shares go to their kinds' own."""
    own = [arm for arm in arms if arm.order < 0]
    for order in (arm for arm in arms if arm.order >= 0):
        total = sum(arm.share for arm in own if arm.kind == order.kind)
        if not total:
            own.append(MissionArm(order.kind, order.kind, order.share))
            continue
        own = [
            replace(arm, share=arm.share * (1 + order.share / total))
            if arm.kind == order.kind
            else arm
            for arm in own
        ]
    return own


def logged_shares(condition: Coded, episode: Coded, kinds: Sequence[str]) -> dict[str, float]:
    """Of the logs' episodes, the share that met each kind's condition; the rest is nominal.

    An episode that met several counts for each. Empty where the logs have none of the kinds.
    """
    codes = {name: code for code, name in enumerate(condition.names)}
    everyone = np.unique(episode.codes)
    observed: dict[str, int] = {}
    rare = np.zeros(0, np.int64)
    for kind in kinds:
        if kind == "nominal" or kind not in codes:
            continue
        of_kind = np.unique(episode.codes[condition.codes == codes[kind]])
        observed[kind], rare = len(of_kind), np.union1d(rare, of_kind)
    if "nominal" in kinds:
        observed = {"nominal": len(everyone) - len(rare), **observed}
    total = sum(observed.values())
    return {kind: count / total for kind, count in observed.items()} if total else {}


__all__ = ["logged_shares", "moved", "unordered", "with_floors"]
