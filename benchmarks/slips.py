"""How many slips are enough? Rare success against the number of logged rare missions.

    python benchmarks/slips.py --out DIR [--cql PYTHON] [--seeds 5] [--counts 1 2 4 ...] [--quick]

A run's logs are six hours of R's day (benchmarks/evidence.py, whose --out may be given: nothing is
recorded twice) and n missions of each rare kind, of 160 that were recorded of each. The labels say
which missions count: those in which a kind's situation was met. The day's own are left out. The n
are nested: a seed's n are among its 2n; another seed has others. After 3,000 offline updates (R
goes on online; this costs a tenth of it and shows what the logs alone teach) the policy drives 60
missions of each kind, the same ones for all runs. Rare success is the mean over the rare kinds.

`--cql` names a Python with d3rlpy (`python -m venv V && V/bin/pip install d3rlpy`, then
`V/bin/python`); without it that arm is left out. Runs go seed by seed, each third count first, and
what is done is not done again. `slips.md`, `slips.json` and `slips.png` in DIR are of the counts
that the first seed has, then of whole seeds.

Pre-registration, written before any run of this file but `--quick`:

- Arms. `uniform`: all rows alike, with DQfD's margin (.5) on the operator's rows, as R's
  `uniform-margin`; `quotas`: the n missions of each rare kind are a fifth of each batch however
  few they are, with the same margin; `cloning`: what the operator did and what other drivers did
  in missions that they managed alone, from the quotas' batches, no Q (`teacher.source = "logs"`,
  `teacher.ratio = 1.0`); `cql`: d3rlpy's discrete CQL on the rows of `uniform`
  (benchmarks/discrete_cql.py). All make as many updates: R's cloning makes up to ten times as many,
  and was cut before any of its results was read, because it took 5 times as long as other arms.
- Primary: rare success of `quotas` less `uniform`, the mean over the counts, paired by seed,
  Student's t, 95 %. Expected: above 0.
- Secondary, corrected by Holm together: the same at each count; and the mean over the counts of
  `cloning` less `quotas` and of `cql` less `uniform`.
- "Enough" is the smallest count from which on an arm's mean is within .05 of its mean at the
  largest. It is a description, not a test.
- Five seeds, 0 to 4. No run is left out; a run that fails is repeated with the same seed.
"""

from __future__ import annotations

import argparse
import itertools
import json
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from evidence import LOGS, RARE, make_store
from harness import markdown, option_parser, run_restock
from numpy.typing import NDArray
from twin_runs import drive_missions

from restock.cli.output import plain
from restock.errors import ConfigError, RestockError
from restock.files import write_text
from restock.replay import Store
from restock.stats import MIN_PAIRS, holm, interval_text, paired_t
from restock.train import Run
from restock.train.evaluation.policies import load_agent
from restock.train.twin.env.drivers import Operator, PlannerFollower
from restock.train.twin.env.interface import Policy
from restock.train.twin.missions import KINDS

COUNTS = (1, 2, 4, 8, 16, 32, 64)
SEEDS = 5
UPDATES, MISSIONS, FIRST_SEED = 3_000, 60, 10_000
ARMS = {  # mixture and settings
    "uniform": ("uniform", ["teacher.source=none", "loss.margin=0.5"]),
    "quotas": ("quotas", ["teacher.source=none", "loss.margin=0.5"]),
    "cloning": (
        "quotas",
        ["teacher.source=logs", "teacher.ratio=1.0", "teacher.offline_updates={updates}"],
    ),
    "cql": ("uniform", []),
}
COLOURS = dict(zip(ARMS, ("#94a3b8", "#0f766e", "#d97706", "#7c3aed"), strict=True))
SETTINGS = ["schedule.offline_updates={updates}", "schedule.env_steps=0"]
SETTINGS += ["evaluation.episodes=1", "record.trackers=[]"]
REFERENCES = {"planner": PlannerFollower, "operator": Operator}
SITUATIONS = {  # of a rare kind: exposure, and in how many steps, as in R's quotas
    "wheel_slip": ("slippery_floor", 5),
    "blocked_aisle": ("plan_blocked", 10),
    "near_collision": ("closing_traffic", 3),
}
MIXTURE = """
n_step = 3
where = "{where}"
evaluation_split = {{ by = "none" }}
correction = {{ post = "none" }}
[[strata]]
name = "day"
where = "true"
priority = 9
timing = "pre"
share = {day}
"""
QUOTA = """
[[strata]]
name = "{kind}_missions"
where = "{where}"
priority = {priority}
timing = "pre"
share = 0.2
"""
MET = """
    SELECT episode_id, archive, situation
    FROM (
        SELECT episode_id, tags['archive'] AS archive, unnest(exposures) AS situation
        FROM transitions
    )
    GROUP BY ALL HAVING count(*) >= {steps} ORDER BY ALL
"""


class Script:
    """A policy saved as TorchScript, (N, D) to actions (N,)."""

    name, version = "cql", ""

    def __init__(self, path: Path) -> None:
        self.module = torch.jit.load(str(path))

    def act(self, env: Any, observation: NDArray[np.float32]) -> tuple[Any, Any]:
        with torch.no_grad():
            action = self.module(torch.from_numpy(observation)).numpy().reshape(-1)
        return action.astype(np.int64), np.ones(len(action), np.float32)


def main() -> int:
    parser = option_parser(__doc__, quick="ten minutes, counts 1 and 2, two seeds: no result")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seeds", type=int, default=SEEDS)
    parser.add_argument("--counts", type=int, nargs="+", default=list(COUNTS))
    parser.add_argument("--cql", type=Path, metavar="PYTHON", help="a Python that has d3rlpy")
    options = parser.parse_args()
    try:
        return answer(options)
    except RestockError as error:
        print(f"slips: {error}", file=sys.stderr)
        return int(error.exit_code)


def answer(options: argparse.Namespace) -> int:
    out: Path = options.out / "quick" if options.quick else options.out
    seeds, counts = (2, [1, 2]) if options.quick else (options.seeds, sorted(options.counts))
    if not options.quick and seeds < MIN_PAIRS:
        raise ConfigError(
            f"--seeds {seeds}: the primary contrast has no interval",
            remedy=f"give {MIN_PAIRS} or more; what an interrupted study has is a figure, too",
        )
    arms = [arm for arm in ARMS if arm != "cql" or options.cql is not None]
    store = logs(out, options.quick)
    found, others = missions(store)
    least = min(found, key=lambda kind: len(found[kind]))
    if counts[0] < 1 or counts[-1] > len(found[least]):
        raise ConfigError(
            f"--counts {counts[-1]}: the store holds {len(found[least])} missions of {least}",
            where=str(store),
            remedy=f"give counts from 1 to {len(found[least])}",
        )
    for name, make in REFERENCES.items():
        file = out / "runs" / f"{name}.json"
        if not file.exists():
            write_json(file, driven(make(), options.quick))
    order = sorted(counts, key=lambda count: counts.index(count) % 3)
    for seed, count in itertools.product(range(seeds), order):
        todo = [arm for arm in arms if not run_file(out, seed, count, arm).exists()]
        if todo:
            kept = subset(found, seed, count)
            unused = {one for own in found.values() for one in own}.difference(*kept.values())
            rows = Rows(store, kept, sorted(unused.union(others)))
            learn(out, rows, todo, seed, count, options)
        if seed and count != order[-1]:
            continue
        done = counts if seed else sorted(order[: order.index(count) + 1])
        figures = judged(out, list(range(seed + 1)), done, arms)
        write_json(out / "slips.json", figures)
        write_text(out / "slips.md", "\n".join([*lines(figures), ""]))
        figure(figures, out / "slips.png")
    print(json.dumps(figures, indent=1) if options.json else "\n".join(lines(figures)))
    missed = not (figures["contrasts"][0]["low"] or 0.0) > 0
    if missed:
        print("missed: quotas are not ahead of uniform draws", file=sys.stderr)
    return int(options.check and missed)


def logs(out: Path, quick: bool) -> Path:
    """Return the store of R's hours and of the rare missions, made if it is not there."""
    day = LOGS["store-rare"]
    folder = out / day.folder
    folder.mkdir(parents=True, exist_ok=True)
    number, minutes, hours = ("12", "10", 1) if quick else ("160", "60", 6)
    requested = [
        (
            folder / f"hour{hour:02}.mcap",
            ["--minutes", minutes, "--seed", str(day.first_seed + hour)],
            day.conditions,
        )
        for hour in range(1, hours + 1)
    ]
    requested += [
        (
            folder / f"events_{kind}.mcap",
            ["--missions", number, "--seed", str(351 + place), "--tag", f"archive={kind}"],
            f"{kind}=1",
        )
        for place, kind in enumerate(RARE)
    ]
    make_store(out / "store-slips", requested, 1)
    return out / "store-slips"


def missions(path: Path) -> tuple[dict[str, list[str]], list[str]]:
    """Return the recorded missions in which their kind's situation was met, by kind.

    And the other episodes that are no part of a nominal day: the missions of a kind that did not
    meet it, and those of the day that met any.
    """
    found: dict[str, list[str]] = {}
    with Store(path) as store:
        every = "SELECT DISTINCT episode_id FROM transitions WHERE tags['archive'] IS NOT NULL"
        archived = {row[0] for row in store.sql(every).fetchall()}
        others = set(archived)
        for kind, (situation, steps) in SITUATIONS.items():
            met = [
                (episode, archive)
                for episode, archive, one in store.sql(MET.format(steps=steps)).fetchall()
                if one == situation
            ]
            found[kind] = [episode for episode, archive in met if archive == kind]
            others |= {episode for episode, archive in met if archive is None}
    return found, sorted(others.difference(*found.values()))


class Rows(NamedTuple):
    """What a run's logs are."""

    store: Path
    kept: dict[str, list[str]]  # episodes of each rare kind
    left_out: list[str]  # episodes

    @property
    def where(self) -> str:
        return f"NOT {among(self.left_out)}"

    def mixture(self, name: str) -> str:
        quotas = name == "quotas"
        text = MIXTURE.format(where=self.where, day=0.4 if quotas else 1.0)
        for place, (kind, own) in enumerate(self.kept.items() if quotas else ()):
            text += QUOTA.format(kind=kind, where=among(own), priority=place + 1)
        return text


def among(episodes: Sequence[str]) -> str:
    return f"list_contains([{', '.join(repr(one) for one in episodes)}], episode_id)"


def subset(found: dict[str, list[str]], seed: int, count: int) -> dict[str, list[str]]:
    """Return `count` missions of each rare kind: the first ones in the seed's order."""
    rng = np.random.default_rng(seed)
    return {kind: rng.permutation(own)[:count].tolist() for kind, own in found.items()}


def learn(
    out: Path,
    logged: Rows,
    arms: Sequence[str],
    seed: int,
    count: int,
    options: argparse.Namespace,
) -> None:
    """Train and drive these arms on the same rows."""
    updates = 50 if options.quick else UPDATES
    with tempfile.TemporaryDirectory(dir=out) as made:
        for arm in arms:
            print(f"seed {seed}, {count} of each kind: {arm}", file=sys.stderr, flush=True)
            began = cpu_s()
            if arm == "cql":
                policy: Policy = outside(Path(made), logged, updates, seed, options.cql)
            else:
                policy = trained(Path(made), logged, arm, updates, seed)
            ended = cpu_s()
            result = driven(policy, options.quick)
            result |= {"train_cpu_s": ended - began, "drive_cpu_s": cpu_s() - ended}
            write_json(run_file(out, seed, count, arm), result)


def trained(place: Path, logged: Rows, arm: str, updates: int, seed: int) -> Policy:
    """Return the policy of one of Restock's arms."""
    mixture, settings = ARMS[arm]
    panel, run, file = place / mixture, place / f"run-{arm}", place / f"{mixture}.toml"
    if not panel.exists():
        write_text(file, logged.mixture(mixture))
        run_restock(["mix", str(logged.store), "--mixture", str(file), "--out", str(panel)])
    every = [one.format(updates=updates) for one in (*SETTINGS, *settings, f"seed={seed}")]
    words = [word for one in every for word in ("--set", one)]
    run_restock(["train", "--panel", str(panel), "--out", str(run), *words])
    return load_agent(Run.open(run))


def outside(place: Path, logged: Rows, updates: int, seed: int, python: Path) -> Policy:
    """Return d3rlpy's policy."""
    rows, saved = place / "rows.h5", place / "policy.pt"
    query = f"FROM transitions WHERE {logged.where}"
    words = ["export", str(logged.store), "--to", "d3rlpy", "--query", query]
    run_restock([*words, "--out", str(rows)])
    script = Path(__file__).with_name("discrete_cql.py")
    child = [str(python), str(script), str(rows), str(saved), str(updates), str(seed)]
    subprocess.run(child, check=True, stdout=sys.stderr)
    return Script(saved)


def cpu_s() -> float:
    """CPU seconds of this process and of those that it waited for."""
    own, children = time.process_time(), resource.getrusage(resource.RUSAGE_CHILDREN)
    return float(own + children.ru_utime + children.ru_stime)


def driven(policy: Policy, quick: bool) -> dict[str, Any]:
    """Return the success of each of the fixed missions, by kind."""
    results = drive_missions(policy, KINDS, 4 if quick else MISSIONS, FIRST_SEED)
    return {
        "success": {
            kind: [bool(one.success) for one in results if one.condition == kind] for kind in KINDS
        }
    }


def run_file(out: Path, seed: int, count: int, arm: str) -> Path:
    return out / "runs" / f"{arm}-{count}-{seed}.json"


def write_json(path: Path, value: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, json.dumps(value, indent=1) + "\n")


def judged(out: Path, seeds: Sequence[int], counts: Sequence[int], arms: Sequence[str]) -> Any:
    """Return means by arm and count, contrasts, and from which count on is enough."""
    rare: dict[str, NDArray[np.float64]] = {}  # (seeds, counts)
    rows = []
    for arm in arms:
        runs = [
            [json.loads(run_file(out, seed, count, arm).read_text()) for count in counts]
            for seed in seeds
        ]
        success = {
            kind: np.array([[np.mean(run["success"][kind]) for run in own] for own in runs])
            for kind in KINDS
        }
        rare[arm] = np.mean([success[kind] for kind in RARE], axis=0)
        success = {"rare": rare[arm], **success}
        for place, count in enumerate(counts):
            cells = {kind: interval(values[:, place]) for kind, values in success.items()}
            rows.append({"arm": arm, "count": count, **cells})
    references = {
        name: float(np.mean([np.mean(one["success"][kind]) for kind in RARE]))
        for name in REFERENCES
        for one in [json.loads((out / "runs" / f"{name}.json").read_text())]
    }
    ahead = rare["quotas"] - rare["uniform"]
    given = {"quotas - uniform, mean over the counts": ahead.mean(axis=1)}
    given |= {f"quotas - uniform, {n} of each kind": ahead[:, i] for i, n in enumerate(counts)}
    given["cloning - quotas, mean"] = (rare["cloning"] - rare["quotas"]).mean(axis=1)
    if "cql" in rare:
        given["cql - uniform, mean"] = (rare["cql"] - rare["uniform"]).mean(axis=1)
    tested = {name: paired_t(values) for name, values in given.items()}
    adjusted = [None, *holm([p for _, p in list(tested.values())[1:]])]
    return {
        "seeds": len(seeds),
        "missions": len(runs[0][0]["success"]["nominal"]),
        "arms": rows,
        "references": references,
        "contrasts": [
            {"contrast": name}
            | plain(
                {"value": one.value, "low": one.low, "high": one.high, "p": p, "p_adjusted": more}
            )
            for (name, (one, p)), more in zip(tested.items(), adjusted, strict=True)
        ],
        "enough": {arm: enough(values.mean(axis=0), counts) for arm, values in rare.items()},
    }


def interval(values: NDArray[np.float64]) -> list[float]:
    """[mean, low, high] over seeds; the ends of one seed are its value."""
    found = paired_t(values)[0].within(0.0, 1.0)
    ends = [found.value if np.isnan(end) else end for end in (found.low, found.high)]
    return [found.value, *ends]


def enough(means: NDArray[np.float64], counts: Sequence[int]) -> int:
    """Return the smallest count from which on the mean is within .05 of that at the largest."""
    short = np.flatnonzero(means < means[-1] - 0.05)
    return counts[int(short[-1]) + 1] if len(short) else counts[0]


def lines(figures: Any) -> list[str]:
    """Return the tables as the docs have them."""
    counts = list(dict.fromkeys(row["count"] for row in figures["arms"]))
    arms = list(dict.fromkeys(row["arm"] for row in figures["arms"]))
    at = {(row["arm"], row["count"]): row for row in figures["arms"]}
    named = "seed" if figures["seeds"] == 1 else "seeds"
    text = [f"{figures['seeds']} {named}, {figures['missions']} missions of each kind.", ""]
    header = ["arm", "success in", *counts, "enough"]
    table = [
        [arm, kind.replace("_", " ")]
        + [interval_text(*at[arm, count][kind]) for count in counts]
        + [figures["enough"][arm] if kind == "rare" else ""]
        for arm in arms
        for kind in ("rare", *KINDS)
    ]
    text += [markdown(header, table), ""]
    text += [f"{name}: rare {value:.2f}" for name, value in figures["references"].items()]
    text.append("")
    for place, row in enumerate(figures["contrasts"]):
        line = f"{row['contrast']}: "
        line += interval_text(row["value"], row["low"], row["high"], "+.3f")
        if row["low"] is not None:
            line += f", p {row['p']:.3f}"
            line += ", primary" if not place else f", adjusted {row['p_adjusted']:.3f}"
        text.append(line)
    return text


def figure(figures: Any, path: Path) -> None:
    """Draw rare success against the count, with intervals over seeds."""
    import altair as alt
    import vl_convert

    rows = [
        {"arm": row["arm"], "count": row["count"]}
        | dict(zip(("rare", "low", "high"), row["rare"], strict=True))
        for row in figures["arms"]
    ]
    counts = list(dict.fromkeys(row["count"] for row in rows))
    arms = list(dict.fromkeys(row["arm"] for row in rows))
    base = alt.Chart(alt.Data(values=rows)).encode(
        x=alt.X(
            "count:Q",
            scale=alt.Scale(type="log", base=2),
            axis=alt.Axis(values=counts, grid=False),
            title="logged missions of each rare kind",
        ),
        color=alt.Color(
            "arm:N",
            scale=alt.Scale(domain=arms, range=[COLOURS[arm] for arm in arms]),
            legend=alt.Legend(title=None, orient="top", symbolOpacity=1),
        ),
    )
    success = alt.Y("rare:Q", scale=alt.Scale(domain=[0, 1]), title="success in rare missions")
    band = base.mark_area(opacity=0.15).encode(y="low:Q", y2="high:Q")
    line = base.mark_line(point=alt.OverlayMarkDef(size=60), strokeWidth=3).encode(y=success)
    ends = [{"name": name, "rare": value} for name, value in figures["references"].items()]
    others = alt.Chart(alt.Data(values=ends)).encode(y="rare:Q")
    rule = others.mark_rule(strokeDash=[4, 4], color="#475569")
    text = others.mark_text(align="right", dy=-8, color="#475569").encode(
        x=alt.value(600), text="name:N"
    )
    chart = (
        alt.layer(band, line, rule, text)
        .properties(width=600, height=340, background="white")
        .configure_axis(labelFontSize=16, titleFontSize=16, gridColor="#e2e8f0")
        .configure_legend(labelFontSize=16, symbolSize=160)
        .configure_text(fontSize=15)
    )
    path.write_bytes(vl_convert.vegalite_to_png(chart.to_json(), scale=1.5))


if __name__ == "__main__":
    sys.exit(main())
