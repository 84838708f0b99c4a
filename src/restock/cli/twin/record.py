"""`restock twin record`: drives a simulated robot, and writes what a real one would log."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from restock.cli import output
from restock.cli.words import Option, Repeated
from restock.errors import ConfigError, RecordingError, RestockError

if TYPE_CHECKING:
    from restock.replay.fleet.missions_file import MissionsFile
    from restock.train.twin.env.interface import Policy

LEARNED = "dqn"  # `behaviour_policy` of recordings driven by a policy of `restock train`


@dataclass
class RecordCommand:
    """Drive a simulated robot and write what a real one would log.

    The simulated robot is the twin, with other friction, payload, wheels, latency and sensors than
    training assumes. It drives one mission after another and writes odometry, lidar, IMU,
    localisation, plans, commands, transforms and diagnostics, each at its own rate, delay and
    resolution, to an MCAP file or a rosbag2 folder that any ROS 2 tool can open. Recording pauses
    between missions. The same seed gives the same bytes. Existing files are never overwritten, and
    Ctrl-C leaves no partial file.

        restock twin record --out drive.mcap --minutes 5
        restock twin record --out icy --missions 20 --conditions nominal=.5,wheel_slip=.5
        restock twin record --out amr07.mcap --tag robot=amr-07 --start 2026-10-05T08:00
        restock twin record --out mine.mcap --policy run:runs/a --epsilon .05
        restock twin record --out next.mcap --missions next.toml
    """

    out: Path
    """The recording to write: FILE.mcap (zstd), or a folder without an ending (rosbag2 with
    sqlite3)."""
    minutes: float | None = None
    """Stop after the mission in which so many minutes of driving are recorded (default 5)."""
    missions: Annotated[str | None, Option("N|FILE")] = None
    """Stop after this number of missions instead. Or drive the missions of a file that `restock
    coverage gaps` wrote, until the ordered number of missions has met each condition."""
    tag: Annotated[tuple[str, ...], Repeated("KEY=VALUE")] = ()
    """A tag of the recording, such as robot=amr-07. It is stored as a metadata record of the MCAP
    file, or as custom_data of the rosbag2 folder. May be given several times."""
    start: Annotated[str | None, Option("TIME")] = None
    """Start time of the first mission, in UTC. Default: 2026-03-02T08:00."""
    seed: int = 0
    """Seed of missions, floor, traffic, noise and delays."""
    conditions: str | None = None
    """Shares of missions, e.g. nominal=.8,wheel_slip=.1,near_collision=.1. Default:
    nominal=.8,wheel_slip=.07,blocked_aisle=.07,near_collision=.06."""
    policy: str = "handover"
    """The driver: handover, planner, operator, random, run:DIRECTORY (the policy that the run
    kept), or onnx:FILE. With handover, a planner drives, an operator takes over when the planner is
    stuck, and an operator drives some missions from start to end."""
    epsilon: float | None = None
    """Share of random actions. Default: the scripted drivers' own share; 0 for a learned policy."""
    perturbation: str | None = None
    """Effective parameters that replace the default ones: nominal, friction, latency, payload,
    wheels, sensors, or a TOML file with a perturbation, or with a schedule that draws one for every
    mission; or exact, the nominal twin without sensor noise, to check a pipeline."""
    layouts: str = "default"
    """The floors, as for `restock train`: default, generated:train, FILE.toml, map.yaml, … The
    floor of each mission is drawn by its seed."""
    rates: str | None = None
    """Rates of topics in Hz, e.g. odom=20,scan=5."""
    dry_run: bool = False
    """Print what would be driven and written, as JSON; write nothing."""
    json: bool = False
    """Print one JSON document: {"path", "format", "missions", "messages", "topics", …}."""

    def run(self) -> None:
        """Drive and record the missions, and print a summary."""
        from restock.files import expect_place
        from restock.ingest.profile.tag_rules import parse_tags
        from restock.replay.fleet.missions_file import MissionsFile
        from restock.train.twin.env.episode_queue import MissionOrders
        from restock.train.twin.floors.floors import open_floors
        from restock.train.twin.floors.planner import planners
        from restock.train.twin.missions import NATURAL
        from restock.train.twin.physics.episode import refuse_unfit, report_unreachable
        from restock.train.twin.physics.perturbation import find_perturbation
        from restock.train.twin.recording.bag_writer import refuse_existing
        from restock.train.twin.recording.fleet import parse_shares
        from restock.train.twin.recording.recorder import (
            FIRST_NS,
            HARDWARE,
            NOISELESS,
            RecordingPlan,
            parse_rates,
            parse_start,
            record,
        )

        if self.minutes is not None and self.missions is not None:
            raise RestockError("--minutes and --missions cannot be combined", remedy="give one")
        known = {None: HARDWARE, "exact": NOISELESS}
        plan = RecordingPlan(
            format=self._format(),
            minutes=5.0 if self.minutes is None and self.missions is None else self.minutes,
            missions=_parse_missions(self.missions),
            seed=self.seed,
            conditions=parse_shares(self.conditions) if self.conditions is not None else NATURAL,
            policy=self.policy,
            epsilon=self.epsilon,
            layouts=self.layouts,
            rates=parse_rates(self.rates or ""),
            start_ns=FIRST_NS if self.start is None else parse_start(self.start),
            tags=parse_tags(self.tag),
            hardware=(
                known.get(self.perturbation)
                or find_perturbation(str(self.perturbation), where="--perturbation")
            ),
        )
        policy = load_policy(plan.policy)
        floors = open_floors(plan.layouts)
        refuse_unfit(floors, [kind for kind, share in plan.kinds.items() if share])
        if isinstance(plan.missions, MissionsFile):
            if self.conditions is not None:
                raise RestockError("--conditions and a missions file cannot be combined")
            MissionOrders(plan.orders(), floors, planners(floors), where="the missions file")
        refuse_existing(self.out)
        expect_place(self.out, RecordingError)
        if self.dry_run:
            output.print_json({"path": str(self.out), "dry_run": True, **plan.describe()})
            return
        if (origin := getattr(policy, "origin", None)) is not None:
            output.say(f"{plan.policy}: {origin.text}")
        for line in report_unreachable(floors):
            output.say(line)
        ordered_missions = sum(order.missions or 0 for order in plan.orders())
        counted = plan.missions if isinstance(plan.missions, int) else ordered_missions
        total = plan.minutes if plan.minutes is not None else float(counted)
        with output.progress(f"recording {self.out.name}", total) as advance:

            def driven(missions: int, minutes: float) -> None:
                advance(minutes if plan.minutes is not None else missions)

            done = record(self.out, plan, policy=policy, on_mission=driven).describe()
        if self.json:
            output.print_json(done)
        else:
            _print_recording(done)

    def _format(self) -> Literal["mcap", "rosbag2"]:
        ending = self.out.suffix[1:]  # "drive.2026-10-05" is a valid folder: no ending
        if ending != "mcap" and ending.isalnum() and not ending.isdigit():
            raise ConfigError(
                f"{self.out} is not the name of a recording",
                where="--out",
                remedy="name a file that ends in .mcap, or a folder without an ending for rosbag2",
            )
        return "mcap" if ending == "mcap" else "rosbag2"


def _parse_missions(text: str | None) -> int | MissionsFile | None:
    """Read `--missions`: a number, or a missions file."""
    from restock.replay.fleet.missions_file import read_missions

    if text is None:
        return None
    number = text.removeprefix("-")
    return int(text) if number.isascii() and number.isdigit() else read_missions(text)


def load_policy(name: str) -> Policy | None:
    """Return the policy that `run:DIRECTORY` or `onnx:FILE` names; None for a scripted driver.

    Raises:
        ConfigError: there is no such policy, or it is for another task.
        RunError: the run has no policy, or is damaged.
    """
    from restock.train.twin.recording.fleet import SCRIPTED

    if name in SCRIPTED:
        return None
    from restock.ingest.profile.profile import load_profile
    from restock.train.evaluation import policies

    policy = policies.load_policy(name, load_profile("warehouse_amr").task)
    if policy is None:
        raise ConfigError(
            f"unknown policy {name!r}",
            where="--policy",
            remedy=f"choose one of {', '.join(SCRIPTED)}, run:DIRECTORY or onnx:FILE",
        )
    if policy.version:  # by Restock: a run and its exported ONNX file get the same tag
        policy.name = LEARNED
    else:
        file = Path(name.removeprefix("onnx:"))
        policy.name, policy.version = "onnx", hashlib.sha256(file.read_bytes()).hexdigest()[:12]
    return policy


def _print_recording(done: dict[str, Any]) -> None:
    kinds = [
        {
            "missions of": kind,
            "driven": count,
            "met it": done["met"][kind] if kind != "nominal" else None,
            "at the goal without a bump": done["succeeded"][kind],
        }
        for kind, count in done["missions"].items()
    ]
    title = (
        f"{done['path']}  {done['format']}  {done['minutes']:.1f} min of driving  "
        f"{done['messages']:,} messages  {done['size_bytes'] / 1e6:.1f} MB"
    )
    output.print_table(kinds, title=title)
    for what, key in (("truly", "steps"), ("driven by", "policy_steps"), ("topic", "topics")):
        unit = "messages" if key == "topics" else "steps"
        output.print_table([{what: name, unit: count} for name, count in done[key].items()])
    for kind, wanted in (done["ordered"] or {}).items():
        if done["met"].get(kind, 0) < wanted:
            output.say(
                f"{kind}: {done['met'].get(kind, 0)} of the {wanted} missions that were ordered met"
                f" it, of {done['missions'].get(kind, 0)} driven; no more were driven"
            )
    output.say(f"{done['handovers']} handovers; took {done['work_s']:.1f} s")
