"""Which learner? The shipped recipe on the sample logs, and what else it might be, seed by seed.

    python benchmarks/learner.py --out /tmp/learner [--arms NAME,NAME] [--seeds 0,1] [--quick]
    python benchmarks/learner.py --out /tmp/learner --table      # of what is there

Arms are those of benchmarks/learner/arms.toml, a study's file (docs/compare.md): settings of
`restock train`. Each run is trained and then judged by the policy that it kept, on episodes that no
choice was made on, with one process at a time, whose CPU seconds are counted: wall time says little
on a machine that does other work. What is done is not done again; a run that was cut off goes on.

The table has means over seeds, and each arm less its baseline, paired by seed, with the 95 %
interval of Student's t. `rare` is the mean over wheel slip, blocked aisles and near collisions;
`area` is that under the curve of rare success on the way.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import msgspec
import numpy as np
from harness import markdown, run_restock

from restock.errors import RestockError
from restock.files import write_text
from restock.train.study.contrasts import RunCurve, contrast
from restock.train.study.study import Study, StudyJob, StudyPlan, load_study
from restock.train.study.study_run import train_words

HERE = Path(__file__).parent
ARMS = HERE / "learner" / "arms.toml"
LOGS = HERE.parent / "sample_logs"
CELLS = {
    "rare": "success_rare",
    "area": "auc_rare",
    "nominal": "success_nominal",
    "slip": "success_wheel_slip",
    "blocked": "success_blocked_aisle",
    "near": "success_near_collision",
}
CONTRASTS = ("success_rare", "auc_rare")


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--study", type=Path, default=ARMS, help="another file of arms")
    parser.add_argument("--arms", help="only these and their baselines; default: all")
    parser.add_argument("--seeds", help="these; default: the file's")
    parser.add_argument("--table", action="store_true", help="train nothing")
    parser.add_argument("--quick", action="store_true", help="tiny runs, to see that all works")
    options = parser.parse_args()
    try:
        plan = StudyPlan(_asked(options), options.study.parent, options.out.resolve())
        if not options.table:
            _run(plan)
    except RestockError as error:
        print(f"learner: {error}", file=sys.stderr)
        return int(error.exit_code)
    print(table(plan))
    return 0


def _asked(options: argparse.Namespace) -> Study:
    """Return the file's study with the requested arms and seeds, on panels of this folder."""
    study = load_study(options.study)
    names = options.arms.split(",") if options.arms else [arm.name for arm in study.arms]
    wanted = {study.base.name, *names}
    wanted |= {pair.baseline.name for pair in study.pairs if pair.arm.name in names}
    if unknown := wanted - {arm.name for arm in study.arms}:
        raise SystemExit(f"--arms: {', '.join(sorted(unknown))} not in {options.study}")
    if len(wanted) < 2:
        raise SystemExit(f"--arms: name one besides {study.base.name}, which is always there")
    panels = options.out.resolve() / "panels"
    arms = tuple(
        msgspec.structs.replace(arm, mixture=None, panel=str(panels / str(arm.mixture)))
        for arm in study.arms
        if arm.name in wanted
    )
    seeds = tuple(map(int, options.seeds.split(","))) if options.seeds else study.seeds
    settings = json.loads(json.dumps(study.settings))
    evaluation = study.evaluation
    if options.quick:
        settings["schedule"] |= {"env_steps": 2_000, "offline_updates": 200}
        settings["evaluation"] |= {"every_env_steps": 1_000, "episodes": 2}
        evaluation, seeds = msgspec.structs.replace(evaluation, episodes=4), seeds[:2]
    return msgspec.structs.replace(
        study, store=None, arms=arms, seeds=seeds, settings=settings, evaluation=evaluation
    )


def _run(plan: StudyPlan) -> None:
    """Train and judge what is not there yet, seeds first."""
    store = plan.out / "store"
    run_restock(["ingest", str(LOGS), "--store", str(store)])  # skips what it has
    for job in plan.jobs:
        panel = Path(str(job.arm.panel))
        if not panel.exists():
            own = plan.folder / panel.name
            mixture = str(own) if own.is_file() else panel.name
            run_restock(["mix", str(store), "--mixture", mixture, "--out", str(panel)])
        if job.done.exists():
            if job.done.read_text(encoding="utf-8") == plan.fingerprint(job):
                continue
            raise SystemExit(f"{job.path} was made with other settings: remove it")
        _train(plan, job, panel)
        episodes, seed = str(plan.study.evaluation.episodes), str(plan.study.evaluation.seed)
        judge = ["eval", str(job.path), "--policies", "agent", "--perturbations", "none"]
        _restock([*judge, "--episodes", episodes, "--seed", seed], plan, job)
        write_text(job.done, plan.fingerprint(job))


def _train(plan: StudyPlan, job: StudyJob, panel: Path) -> None:
    """Train a run or go on with it, and add up what it costs."""
    seconds = job.path / "cpu_seconds"
    words = train_words(job.path, plan.settings(job.arm, job.seed), panel)
    spent = _restock(words, plan, job)
    write_text(seconds, f"{spent + (float(seconds.read_text()) if seconds.exists() else 0):.2f}\n")


def _restock(arguments: Sequence[str], plan: StudyPlan, job: StudyJob) -> float:
    """Run one verb in a process of its own, logging its output; return its CPU seconds."""
    print(f"{job.path.name}: {arguments[0]}", file=sys.stderr, flush=True)
    log = plan.out / "logs" / f"{job.path.name}.log"
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("a", encoding="utf-8") as file:
        command = [sys.executable, "-m", "restock", *arguments]
        process = subprocess.Popen(command, stdout=file, stderr=file, stdin=subprocess.DEVNULL)
        _, status, usage = os.wait4(process.pid, 0)
    if os.waitstatus_to_exitcode(status) not in (0, 3):
        raise SystemExit(f"{job.path.name}: `restock {arguments[0]}` failed: see {log}")
    return usage.ru_utime + usage.ru_stime


def table(plan: StudyPlan) -> str:
    """Return what there is, arm by arm, and how far each is ahead of its baseline."""
    runs = {
        arm.name: {
            job.seed: job.path
            for job in plan.jobs
            if job.arm.name == arm.name and job.done.exists()
        }
        for arm in plan.study.arms
    }
    curves = {path: RunCurve(path) for of in runs.values() for path in of.values()}
    baselines = {pair.arm.name: pair.baseline.name for pair in plan.study.pairs}
    rows = []
    for name, of in runs.items():
        if not of:
            continue
        base = runs.get(baselines.get(name, ""), {})
        pairs = [(curves[of[seed]], curves[base[seed]]) for seed in of if seed in base]
        rows.append(
            [
                name,
                len(of),
                f"{np.mean([float((p / 'cpu_seconds').read_text()) for p in of.values()]):.0f}",
                *(
                    _mean([curves[path].value(measure) for path in of.values()])
                    for measure in CELLS.values()
                ),
                *_ahead(name, baselines.get(name, ""), pairs),
            ]
        )
    header = ["arm", "seeds", "CPU s", *CELLS, "rare ahead", "area ahead"]
    return markdown(header, rows)


def _mean(values: Sequence[float]) -> str:
    return f"{np.mean(values):.3f}".lstrip("0")


def _ahead(arm: str, baseline: str, pairs: Sequence[tuple[RunCurve, RunCurve]]) -> Iterator[str]:
    for measure in CONTRASTS:
        found = contrast(arm, baseline, measure, pairs) if baseline else None
        if found is None:
            yield ""
            continue
        ends = f" [{found.low:+.3f}, {found.high:+.3f}]" if found.low is not None else ""
        yield f"{found.difference:+.3f}{ends}"


if __name__ == "__main__":
    raise SystemExit(main())
