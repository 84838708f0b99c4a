"""The evidence: does it pay to feed a critic what is rare? One command a question, start to end.

    python benchmarks/evidence.py twin-nominal --out /tmp/evidence [--workers 2] [--quick]

Questions, each a study of benchmarks/evidence/NAME.toml whose primary contrast was named before its
runs (docs/evidence.md):

    twin-nominal  the twin cannot make what is rare: quotas, PER, margins, cloning on the logs
    lead          the same for four times the steps: where the lead of quotas ends
    ring          a small ring of fresh rows, with and without its reserve
    practice      the twin can make it: practice by success, quotas on the logs, both, neither
    archive       the first again, with the incidents in a store of their own, weighted back to the
                  day's rates; and against half of the logged rows from it, as kept
    demonstrations  the first again: uniform draws have as many of the operator's rows as quotas
    planner-rows  the first again, with the planner's rows alone, so that no margin acts
    novelty       the first again, without the rule of one rare kind: a quota on what is novel

Records what a question needs of the stand-in fleet (a day of hours, and for all but `practice` an
archive of incident bags) and ingests it, then runs the study. What is there is not done again: the
same command goes on where it was cut off. Ends in OUT/NAME/study.md. `--primary` runs the two arms
of the primary contrast only, with all seeds; without it the same command adds the others. `--quick`
has those two arms, ten minutes of logs, two seeds and 2,000 steps, in OUT/quick: it shows that all
of it runs.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
from harness import markdown, once, run_restock

from restock.cli.output import plain
from restock.errors import RestockError
from restock.files import write_text
from restock.report import study_page, write_page
from restock.stats import paired_t
from restock.train.study.contrasts import RunCurve
from restock.train.study.study import DONE, Study, StudyPlan, load_study
from restock.train.study.study_run import findings, run_study

HERE = Path(__file__).parent / "evidence"
QUESTIONS = (
    "twin-nominal",
    "lead",
    "ring",
    "practice",
    "archive",
    "demonstrations",
    "planner-rows",
    "novelty",
)
RATES = "odom=10,imu=10,scan=5,joint_states=5,amcl_pose=5,tf=5,bumper=5"
RARE = ("wheel_slip", "blocked_aisle", "near_collision")


@dataclass(frozen=True)
class Logs:
    """A day of the fleet, at shares of missions, and an archive of incident bags."""

    rare_share: float  # of the missions, each rare kind
    first_seed: int
    incidents: int  # missions of each rare kind
    folder: str
    archive: str | None = None  # a store of the incidents alone; else they are in the day's

    @property
    def conditions(self) -> str:
        shares = {"nominal": 1 - len(RARE) * self.rare_share}
        shares |= dict.fromkeys(RARE, self.rare_share)
        return ",".join(f"{kind}={share:.4g}" for kind, share in shares.items())


LOGS = {
    "store-rare": Logs(1 / 250, 100, 30, "logs-rare"),
    "store-natural": Logs(0.04, 200, 0, "logs-natural"),
    "store-day": Logs(1 / 250, 100, 30, "logs-rare", archive="store-incidents"),
}


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("question", choices=QUESTIONS)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--hours", type=int, default=24, help="of logs, one recording each")
    parser.add_argument("--workers", type=int, default=1, help="recordings, then runs, at a time")
    parser.add_argument("--seeds", type=int, help="only the first so many")
    parser.add_argument("--primary", action="store_true", help="only the primary contrast's arms")
    parser.add_argument("--quick", action="store_true", help="a tiny one, to see that it runs")
    options = parser.parse_args()
    try:
        return _answer(options)
    except RestockError as error:
        print(f"evidence: {error}", file=sys.stderr)
        return int(error.exit_code)


def _answer(options: argparse.Namespace) -> int:
    study = load_study(HERE / f"{options.question}.toml")
    study = msgspec.structs.replace(study, seeds=study.seeds[: options.seeds])
    hours = 1 if options.quick else options.hours
    if options.primary or options.quick:
        study = primary_arms(study)
    out = options.out
    if options.quick:
        study, out = quick(study), out / "quick"  # its recordings are others
    store, logs = out / str(study.store), LOGS[str(study.store)]
    _make_stores(store, logs, hours, options.workers, options.quick)
    study = msgspec.structs.replace(study, store=str(store.resolve()))
    mixtures = HERE if logs.archive is None else _beside_the_stores(options.question, out)
    plan = StudyPlan(study, mixtures, out / options.question)
    comparisons = run_study(plan, workers=options.workers, say=_say)
    found = findings(plan, comparisons)
    content = study_page(plain(found), options.question)
    write_page(content, plan.out / "study.html", markdown=True)
    page = f"{(plan.out / 'study.md').read_text(encoding='utf-8')}\n{curves(plan)}"
    write_text(plan.out / "study.md", page)
    write_text(plan.out / "study.json", json.dumps(plain(found), indent=1) + "\n")
    sys.stdout.write(page)
    return int(any(one["verdict"] != "comparable" for one in found["comparisons"]))


def primary_arms(study: Study) -> Study:
    """Return the study with the two arms of its primary contrast alone."""
    assert study.primary is not None
    pair = next(pair for pair in study.pairs if pair.arm.name == study.primary.arm)
    base = msgspec.structs.replace(pair.baseline, treatment=None, baseline=None)
    return msgspec.structs.replace(study, arms=(base, pair.arm))


def quick(study: Study) -> Study:
    """Two seeds, for 2,000 steps."""
    settings = json.loads(json.dumps(study.settings))
    settings["schedule"] |= {"offline_updates": 200, "env_steps": 2_000, "warmup_env_steps": 500}
    settings["evaluation"] |= {"every_env_steps": 1_000, "episodes": 2}
    return msgspec.structs.replace(
        study,
        seeds=study.seeds[:2],
        settings=settings,
        evaluation=msgspec.structs.replace(study.evaluation, episodes=4),
    )


def _beside_the_stores(question: str, out: Path) -> Path:
    """Copy a question's mixtures beside its stores, as a mixture's paths start at its file."""
    folder = out / "mixtures"
    folder.mkdir(parents=True, exist_ok=True)
    for mixture in (HERE / question).glob("*.toml"):
        write_text(folder / mixture.name, mixture.read_text(encoding="utf-8"))
    return folder


def _make_stores(store: Path, logs: Logs, hours: int, workers: int, small: bool) -> None:
    """Record and ingest what is not there yet: a store that was cut short goes on.

    Raises:
        SystemExit: a store is of other recordings than are asked for.
    """
    folder = store.parent / logs.folder
    folder.mkdir(parents=True, exist_ok=True)
    minutes = "10" if small else "60"
    day = [
        (
            folder / f"hour{hour:02}.mcap",
            ["--minutes", minutes, "--seed", str(logs.first_seed + hour)],
            logs.conditions,
        )
        for hour in range(1, hours + 1)
    ]
    missions = 3 if small and logs.incidents else logs.incidents
    incidents = [
        (
            folder / f"incidents_{kind}.mcap",
            [
                *("--missions", str(missions), "--seed", str(logs.first_seed + 50 + number)),
                *("--tag", "archive=incidents"),
            ],
            f"{kind}=1",
        )
        for number, kind in enumerate(RARE)
        if missions
    ]
    if logs.archive is None:
        make_store(store, [*day, *incidents], workers)
    else:
        make_store(store, day, workers)
        make_store(store.with_name(logs.archive), incidents, workers)


def make_store(store: Path, requested: list[tuple[Path, list[str], str]], workers: int) -> None:
    """Make a store of recordings, given their paths, flags and conditions."""

    def make() -> None:
        with ThreadPoolExecutor(workers) as pool:
            list(pool.map(lambda one: _record(*one), requested))
        run_restock(["ingest", *(str(path) for path, *_ in requested), "--store", str(store)])

    reported = [
        f"{path.name} {' '.join(flags)} {conditions}" for path, flags, conditions in requested
    ]
    once(store.with_name(f"{store.name}.json"), reported, make)


def _record(recording: Path, flags: list[str], conditions: str) -> None:
    if not recording.exists():
        _say(f"recording {recording.name}")
        command = [
            sys.executable,
            "-m",
            "restock",
            "twin",
            "record",
            "--out",
            str(recording),
            *flags,
        ]
        command += ["--rates", RATES, "--conditions", conditions]
        subprocess.run(command, check=True, stdout=sys.stderr)


def curves(plan: StudyPlan) -> str:
    """Return success in rare conditions at each periodic evaluation, the mean over seeds.

    Beside it stands how far each arm is ahead of its baseline, paired by seed.
    """
    runs = {
        arm.name: [RunCurve(path) if (path / DONE).exists() else None for path in plan.runs(arm)]
        for arm in plan.study.arms
    }
    of = {
        name: [{} if run is None else run.curve("rare") for run in own]
        for name, own in runs.items()
    }
    steps = sorted({step for own in of.values() for curve in own for step in curve})
    levels = {
        name: {
            step: f"{np.mean([curve[step] for curve in own if step in curve]):.2f}"
            for step in steps
            if any(step in curve for curve in own)
        }
        for name, own in of.items()
    }
    leads = {
        f"{pair.arm.name} against {pair.baseline.name}": {
            step: _lead(
                [
                    one[step] - other[step]
                    for one, other in zip(of[pair.arm.name], of[pair.baseline.name], strict=True)
                    if step in one and step in other
                ]
            )
            for step in steps
        }
        for pair in plan.study.pairs
    }
    lines = ["## Success in the rare conditions on the way", "", _by_steps(steps, levels), ""]
    return "\n".join([*lines, "How far each is ahead:", "", _by_steps(steps, leads), ""])


def _lead(ahead: list[float]) -> str:
    if not ahead:
        return ""
    found, _ = paired_t(np.array(ahead))
    ends = "" if np.isnan(found.low) else f" [{found.low:+.2f}, {found.high:+.2f}]"
    return f"{found.value:+.2f}{ends}"


def _by_steps(steps: list[int], rows: dict[str, dict[int, str]]) -> str:
    table = [[name, *(at.get(step, "") for step in steps)] for name, at in rows.items()]
    return markdown(["steps", *(f"{step:,}" for step in steps)], table)


def _say(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


if __name__ == "__main__":
    raise SystemExit(main())
