"""Drive episodes of an evaluation again and film them: worst failures and rescues by condition.

An episode is determined by its spec, so the episodes that `restock eval` recorded can be driven
again with the kept policy. If the outcome differs from the recorded one, no film is made, as it
would show another episode. A rescue shows two drives side by side: one that failed, and the
agent's. Pictures are drawn from above and need no OpenGL.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from restock.arrays import F32, Ints
from restock.errors import RestockError, RunError, policy_words, quoted
from restock.files import write_bytes, write_text
from restock.train.evaluation.eval_run import CLEAN, EvaluationPlan, make_policy
from restock.train.evaluation.evaluate import EpisodeResult, run_episodes
from restock.train.run.kept_evaluations import read_evaluations
from restock.train.run.run_profile import profile_of_run
from restock.train.twin.env.interface import Step
from restock.train.twin.env.render import draw_map
from restock.train.twin.physics.episode import EpisodeSpec

FOLDER = Path("eval") / "films"  # relative to the run's folder
DOCUMENT = "films.json"
WORST, RESCUE = "worst failure", "rescue"
RESCUED_FROM = ("planner", "cloned", "operator")  # whose failures count if no other run failed
OTHER_RUN = "run:"
CAPTION_PIXELS, GAP_PIXELS = 44, 12
MAX_FRAMES = 60
FRAME_MS = 100
_SAME = ("success", "bumps", "time_s", "failure")


@dataclass(frozen=True)
class Scene:
    """A recorded episode that is worth watching."""

    kind: str  # WORST or RESCUE
    row: dict[str, Any]  # the agent's row of RUN/eval/episodes.parquet
    other: dict[str, Any] | None = None  # for a rescue: the row of a policy that failed there

    @property
    def name(self) -> str:
        return f"{self.row['condition']}-{self.kind.split()[0]}"


def scenes(rows: Sequence[dict[str, Any]]) -> list[Scene]:
    """Choose, per condition, the agent's worst failure and best rescue in unperturbed episodes.

    The worst failure has the lowest return. A rescue is a success of the agent in an episode in
    which another policy failed; the best one has the highest return. Failures of other runs are
    preferred, first of the run that arrives least often. A condition may lack either scene.
    """
    clean = [row for row in rows if row["perturbation"] == CLEAN and row["success"] is not None]
    others = {
        (row["policy"], row["condition"], row["episode_seed"], row["layouts"]): row
        for row in clean
        if not row["success"]
    }
    arrived: dict[str, int] = {}  # policy of another run -> episodes in which it arrived
    for row in clean:
        if row["policy"].startswith(OTHER_RUN):
            arrived[row["policy"]] = arrived.get(row["policy"], 0) + row["success"]
    runs = sorted(arrived, key=lambda policy: arrived[policy])
    found = []
    for condition in dict.fromkeys(row["condition"] for row in clean):
        own = [r for r in clean if r["policy"] == "agent" and r["condition"] == condition]
        failed = [row for row in own if not row["success"]]
        if failed:
            found.append(Scene(WORST, min(failed, key=lambda row: row["return"])))
        for policies in (*((policy,) for policy in runs), RESCUED_FROM):
            rescued = [
                Scene(RESCUE, row, others[key])
                for row in own
                if row["success"]
                for policy in policies
                if (key := (policy, condition, row["episode_seed"], row["layouts"])) in others
            ]
            if rescued:
                found.append(max(rescued, key=lambda scene: scene.row["return"]))
                break
    return found


def film_evaluation(
    plan: EvaluationPlan, progress: Callable[[int], None] | None = None
) -> tuple[list[Path], list[str]]:
    """Film the scenes of a run's recorded evaluation.

    Returns the files in RUN/eval/films, and the scenes that could not be filmed, with reasons.

    Raises:
        RunError: no episode was driven on the plan's floors, or the run has no policy.
    """
    version = make_policy("agent", plan).version
    rows = [
        row
        for row in read_evaluations(plan.run.path).to_pylist()
        if row["layouts"] == plan.layouts
        and (row["policy"] != "agent" or row["version"] == version)
    ]
    chosen = scenes(rows)
    if not rows:
        raise RunError(
            f"has no episode on floors {plan.layouts} to film",
            where=str(plan.run.path),
            remedy=f"run `restock eval {quoted(plan.run.path)}` first",
        )
    folder = plan.run.path / FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    paths, films, missing = [], [], []
    for scene in chosen:
        result, frames = drive_again(plan, scene.row)
        if progress is not None:
            progress(1)
        if differing := differing_fields(scene.row, result):
            missing.append(f"{scene.name}: driven again it has another {', '.join(differing)}")
            continue
        if scene.other is not None:
            before = _film_failure(plan, scene.other)
            if before is None:
                other = scene.other["policy"]
                missing.append(f"{scene.name}: the drive of {other} cannot be repeated exactly")
            else:
                frames = _side_by_side(before, frames, [_caption(scene.other), _caption(scene.row)])
        file = folder / f"{scene.name}.webp"
        write_bytes(file, _animation(frames))
        paths.append(file)
        films.append(_document(scene, file.name))
    write_text(folder / DOCUMENT, json.dumps({"films": films}) + "\n")
    return paths, missing


def _film_failure(plan: EvaluationPlan, row: dict[str, Any]) -> list[NDArray[np.uint8]] | None:
    """Film another policy's drive; None if it cannot be repeated exactly.

    The drive cannot be repeated if the policy's run is missing or has changed, or if the policy's
    actions depend on the other environments that it drove at the same time.
    """
    try:
        result, frames = drive_again(plan, row)
    except RestockError:
        return None
    return None if differing_fields(row, result) else frames


def drive_again(
    plan: EvaluationPlan, row: dict[str, Any]
) -> tuple[EpisodeResult, list[NDArray[np.uint8]]]:
    """Drive an episode once more with the same policy.

    Returns its outcome, and a picture (H, W, 3) of the start and of each step.
    """
    from restock.train.twin.env.vector_env import WarehouseVectorEnv

    profile, frames = profile_of_run(plan.run), list[NDArray[np.uint8]]()
    task = profile.task
    env = WarehouseVectorEnv(
        1,
        task=task,
        robot=profile.robot,
        layouts=plan.layouts,
        conditions={row["condition"]: 1.0},
        nav_command=profile.inputs.nav_command is not None,
        autoreset_mode=AutoresetMode.DISABLED,
    )

    def step(_: F32, action: Ints) -> Step:
        if not frames:
            frames.append(draw_map(env, 0))
        made = env.step(action)
        frames.append(draw_map(env, 0))
        return made

    (result,) = run_episodes(
        env,
        make_policy(row["policy"], plan),
        [EpisodeSpec(row["condition"], row["episode_seed"])],
        control_period_s=task.control_period_s,
        time_limit_steps=task.time_limit_steps,
        goal=task.goal != "none",
        discount=plan.config.loss.discount,
        step=step,
    )
    env.close()
    return result, frames


def differing_fields(row: dict[str, Any], result: EpisodeResult) -> list[str]:
    """List the fields in which an episode driven again differs from the recorded one."""
    now = {**result.row, "failure": result.failure}
    differing = [name for name in _SAME if now[name] != row[name]]
    ends = np.array([result.end_x_m - row["end_x_m"], result.end_y_m - row["end_y_m"]])
    return differing + (["end"] if float(np.abs(ends).max()) > 1e-3 else [])


def _document(scene: Scene, file: str) -> dict[str, Any]:
    row = scene.row
    return {
        "kind": scene.kind,
        "file": file,
        "condition": row["condition"],
        "block": row["block"],
        "episode_seed": row["episode_seed"],
        "layouts": row["layouts"],
        "layout": row["layout"],
        "success": row["success"],
        "failure": row["failure"],
        "time_s": row["time_s"],
        "bumps": row["bumps"],
        "version": row["version"],
        "rescued_from": None if scene.other is None else scene.other["policy"],
        "other_failure": None if scene.other is None else scene.other["failure"],
    }


def _caption(row: dict[str, Any]) -> str:
    """Return who drove and how the episode ended, short enough to fit above a picture."""
    ended = "arrives" if row["success"] else row["failure"]
    who = policy_words([row["policy"]])[row["policy"]]
    return f"{who}: {ended}, {row['time_s']:.1f} s"


def _side_by_side(
    left: list[NDArray[np.uint8]], right: list[NDArray[np.uint8]], captions: Sequence[str]
) -> list[NDArray[np.uint8]]:
    """Put two drives side by side from their first steps, each under its caption.

    The last picture of the shorter drive stays until the longer one ends.
    """
    height, width = left[0].shape[:2]
    font = ImageFont.load_default(size=28)
    canvas = Image.new("RGB", (2 * width + GAP_PIXELS, height + CAPTION_PIXELS), "white")
    draw = ImageDraw.Draw(canvas)
    for column, caption in enumerate(captions):
        draw.text((column * (width + GAP_PIXELS) + 4, 4), caption, fill="black", font=font)
    blank = np.asarray(canvas)
    frames = []
    for step in range(max(len(left), len(right))):
        frame = blank.copy()
        for column, pictures in enumerate((left, right)):
            x = column * (width + GAP_PIXELS)
            frame[CAPTION_PIXELS:, x : x + width] = pictures[min(step, len(pictures) - 1)]
        frames.append(frame)
    return frames


def _animation(frames: Sequence[NDArray[np.uint8]]) -> bytes:
    """Encode frames as an endless WebP of at most MAX_FRAMES; the last is shown for a second."""
    picked = np.unique(np.linspace(0, len(frames) - 1, MAX_FRAMES).round().astype(int))
    images = [Image.fromarray(frames[i]) for i in picked.tolist()]
    durations = [FRAME_MS] * (len(images) - 1) + [1000]
    out = BytesIO()
    images[0].save(
        out, "WEBP", save_all=True, append_images=images[1:], duration=durations, loop=0, quality=70
    )
    return out.getvalue()
