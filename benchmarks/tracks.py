"""How well are people and forklifts tracked? By the truth in the twin, and on recordings.

    python benchmarks/tracks.py [--episodes 60] [--recordings PATH:PROFILE ...] [--quick] [--json]

The operator drives missions of each kind. At every step the tracks within 4 m are compared with who
is there. Somebody who is in sight (a beam ends on them) and has moved at .2 m/s or faster for .6 s
should have a track within .8 m (forklifts: 1.2 m) of their middle. A track that is farther than
that from everybody is false. A recording has no truth: of each one the command counts its tracks,
and those faster than 2.5 m/s.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from harness import finish, markdown, option_parser

from restock.arrays import F64, Bools
from restock.ingest.containers.open_recording import open_recording
from restock.ingest.profile.profile import load_profile
from restock.ingest.steps.episodes import steps_of
from restock.ingest.steps.needs import as_recorded, read_topics
from restock.ingest.task.task import TRACK_SIGNALS
from restock.ingest.task.tracks import CONFIRM_S
from restock.train.evaluation.evaluate import fixed_episodes
from restock.train.twin.env.drivers import Operator
from restock.train.twin.env.vector_env import WarehouseVectorEnv
from restock.train.twin.floors.layout import FORKLIFT_HALF_M, PEOPLE, PERSON_RADIUS_M
from restock.train.twin.missions import KINDS
from restock.train.twin.physics.scenery import HIDDEN

TRACKS = 4
WITHIN_M = 4.0
NEAR_M = (0.8, 1.2)  # of a person's middle, of a forklift's
SEEN_M = 0.12  # of an outline: a beam ends on it
MOVING_MPS, MOVING_STEPS = 0.2, 3
FAST_MPS = 2.5
EVALUATION_SEED = 20_000
TASK = msgspec.structs.replace(load_profile("warehouse_amr").task, tracks=TRACKS)


def main() -> int:
    parser = option_parser(__doc__, "2 episodes: it shows that all runs")
    parser.add_argument("--episodes", type=int, default=60, help="of each kind")
    parser.add_argument("--recordings", nargs="*", default=[], metavar="PATH:PROFILE")
    options = parser.parse_args()
    episodes = 2 if options.quick else options.episodes
    rows = [_in_the_twin(kind, episodes) for kind in KINDS]
    recorded = [_recorded(*one.rsplit(":", 1)) for one in options.recordings]
    lines = [_as_markdown(rows), _as_markdown(recorded) if recorded else ""]
    return finish(options, {"twin": rows, "recordings": recorded}, [], lines)


def _in_the_twin(kind: str, episodes: int) -> dict[str, Any]:
    env = WarehouseVectorEnv(16, task=TASK, seed=0)
    env.set_episodes(fixed_episodes([kind], episodes, EVALUATION_SEED))
    driver = Operator(epsilon=0.0)
    _, info = env.reset(seed=0)
    moving = np.zeros(env.simulation.traffic.state.shape, np.int64)  # steps
    place = env.simulation.traffic.position_m.copy()
    number = info["episode_number"]
    due = found = false = steps = 0
    off: list[float] = []
    speed_off: list[float] = []
    velocity_off: list[float] = []
    while (number >= 0).any():
        _, _, _, _, info = env.step(driver.choose(env))
        traffic, counted = env.simulation.traffic, number >= 0
        begun = info["episode_number"] != number
        number = info["episode_number"]
        velocity = (traffic.position_m - place) / TASK.control_period_s  # (N, G, 2)
        place = traffic.position_m.copy()
        moves = (traffic.state != HIDDEN) & (np.hypot(*np.moveaxis(velocity, -1, 0)) > MOVING_MPS)
        moving = np.where(moves & ~begun[:, None], moving + 1, 0)
        counted &= ~begun
        steps += int(counted.sum())
        x, y, vx, vy, _ = (env.signals[name] for name in TRACK_SIGNALS)
        pose = env.simulation.middle(env.simulation.pose())
        at = _turned(x, y, pose) + pose[:, None, :2]  # (N, K, 2)
        way = _turned(vx, vy, pose)
        gap = np.linalg.norm(at[:, :, None] - place[:, None], axis=-1)  # (N, K, G)
        limit = np.where(np.arange(place.shape[1]) < PEOPLE, *NEAR_M)
        with np.errstate(invalid="ignore"):
            fits = gap < limit
            near = np.hypot(x, y) < WITHIN_M
        false += int((near & ~fits.any(axis=2))[counted].sum())
        distance = np.linalg.norm(place - pose[:, None, :2], axis=-1)
        seen = _in_sight(env, pose) & (distance < WITHIN_M) & counted[:, None]
        for env_id, agent in zip(*np.nonzero(seen & (moving >= MOVING_STEPS)), strict=True):
            due += 1
            tracks = np.flatnonzero(fits[env_id, :, agent])
            if not len(tracks):
                continue
            found += 1
            best = tracks[gap[env_id, tracks, agent].argmin()]
            true = velocity[env_id, agent]
            off.append(gap[env_id, best, agent])
            speed_off.append(np.hypot(*way[env_id, best]) - np.hypot(*true))
            velocity_off.append(np.hypot(*(way[env_id, best] - true)))
    minutes = steps * TASK.control_period_s / 60
    return {
        "missions": kind,
        "minutes": round(minutes, 1),
        "moving people seen": due,
        "tracked": round(found / due, 3) if due else None,
        "place off by, m": _middle(off),
        "speed off by, m/s": _middle(np.abs(speed_off)),
        "velocity off by, m/s": _middle(velocity_off),
        "s of false tracks per minute": round(false * TASK.control_period_s / minutes, 2),
    }


def _middle(values: Any) -> str | None:
    """Return the median and the 90th percentile."""
    return "{:.2f}, {:.2f}".format(*np.percentile(values, [50, 90])) if len(values) else None


def _turned(x: F64, y: F64, pose: F64) -> F64:
    cos, sin = np.cos(pose[:, 2:3]), np.sin(pose[:, 2:3])
    return np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)


def _in_sight(env: WarehouseVectorEnv, pose: F64) -> Bools:
    """Return which agents (N, G) a beam ends on."""
    traffic, sim = env.simulation.traffic, env.simulation
    bearing = pose[:, 2:3] + sim.bearings_rad
    ranges = np.where(np.isfinite(env.sensing.ranges_m), env.sensing.ranges_m, 1e3)
    ends = pose[:, None, :2] + ranges[..., None] * np.stack(
        [np.cos(bearing), np.sin(bearing)], axis=-1
    )
    off = ends[:, None] - traffic.position_m[:, :, None]  # (N, G, B, 2)
    cos, sin = np.cos(traffic.heading_rad)[..., None], np.sin(traffic.heading_rad)[..., None]
    along = np.abs(cos * off[..., 0] + sin * off[..., 1])
    aside = np.abs(-sin * off[..., 0] + cos * off[..., 1])
    person = np.hypot(along, aside) < PERSON_RADIUS_M + SEEN_M
    truck = (along < FORKLIFT_HALF_M[0] + SEEN_M) & (aside < FORKLIFT_HALF_M[1] + SEEN_M)
    is_person = (np.arange(off.shape[1]) < PEOPLE)[:, None]
    seen: Bools = np.where(is_person, person, truck).any(axis=2) & (traffic.state != HIDDEN)
    return seen


def _recorded(path: str, profile: str) -> dict[str, Any]:
    loaded = load_profile(profile)
    with open_recording(Path(path)) as recording:
        fitted = as_recorded(loaded, recording.topics)
        task = msgspec.structs.replace(fitted.task, tracks=TRACKS)
        fitted = msgspec.structs.replace(fitted, task=task)
        columns = read_topics(recording, fitted)
        steps = steps_of(fitted, columns)
    x, _, vx, vy, age = (steps.signals[name] for name in TRACK_SIGNALS)
    usable = np.array([not problem for problem in steps.problem])
    known = np.isfinite(x) & usable[:, None]
    speed = np.hypot(vx, vy)
    minutes = float(usable.sum() * task.control_period_s / 60)
    first = known & (age < CONFIRM_S + 2 * task.control_period_s)
    return {
        "recording": Path(path).name,
        "minutes": round(minutes, 2),
        "steps with a track": round(float(known.any(axis=1).sum() / max(usable.sum(), 1)), 3),
        "tracks per step": round(float(known.sum() / max(usable.sum(), 1)), 2),
        "new per minute": round(float(first.sum()) / minutes, 1) if minutes else None,
        "speed, m/s": _middle(speed[known]),
        "faster than 2.5 m/s": round(float((speed[known] > FAST_MPS).mean()), 3)
        if known.any()
        else None,
        "longest, s": round(float(age[known].max()), 1) if known.any() else None,
    }


def _as_markdown(rows: list[dict[str, Any]]) -> str:
    return markdown(list(rows[0]), [list(row.values()) for row in rows])


if __name__ == "__main__":
    sys.exit(main())
