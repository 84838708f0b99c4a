"""The README's picture: the twin's robot in two of its situations, and what a batch is made of.

    python benchmarks/front_picture.py [--out docs/front.png]

The robot before a person and before a blocked aisle, as the planner comes to them in the twin; and
the shares of the conditions in `sample_logs/` and in a batch of the mixture `coverage`, as
`restock mix --dry-run` gives them. It needs EGL, with or without a GPU.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import sys
import tempfile
from pathlib import Path
from typing import Any

import altair as alt
import numpy as np
import vl_convert
from gymnasium.vector import AutoresetMode
from harness import run_restock
from numpy.typing import NDArray
from PIL import Image

from restock.cli import main as restock
from restock.train.twin.env.render import Camera
from restock.twin import PlannerFollower, WarehouseVectorEnv

HEIGHT_PX, SCENE_PX, CHART_PX, GAP_PX = 330, 440, 500, 10
# Where what a scene shows must be: bearing, and from and to which distance.
AHEAD = {"near_collision": (0.35, 1.6, 2.3), "blocked_aisle": (0.15, 1.8, 3.0)}
SEEDS = 60  # missions that are looked through
IN_LOGS, IN_BATCH = "in the logs", "in a batch"
COLOURS = ["#94a3b8", "#0f766e"]
REPOSITORY = Path(__file__).parents[1]


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=REPOSITORY / "docs" / "front.png")
    options = parser.parse_args()
    parts = [scene("near_collision"), scene("blocked_aisle"), shelves()]
    picture = Image.new(
        "RGB", (sum(p.width for p in parts) + GAP_PX * (len(parts) - 1), HEIGHT_PX), "white"
    )
    left = 0
    for part in parts:
        picture.paste(part, (left, 0))
        left += part.width + GAP_PX
    picture.quantize(128).save(options.out, optimize=True)
    print(f"wrote {options.out}: {picture.width} x {picture.height} pixels")
    return 0


def scene(kind: str) -> Image.Image:
    """Return the first moment in which what the kind is named for is close ahead of the robot."""
    for seed in range(SEEDS):
        env = WarehouseVectorEnv(1, conditions={kind: 1.0}, autoreset_mode=AutoresetMode.DISABLED)
        observation, _ = env.reset(seed=seed)
        planner, over = PlannerFollower(), False
        while not over:
            if ahead(env, kind):
                camera = Camera("chase", width=SCENE_PX, height=HEIGHT_PX)
                frame = Image.fromarray(camera.frame(env, 0))
                camera.close()
                env.close()
                return frame
            action, _ = planner.act(env, observation)
            observation, _, terminated, truncated, _ = env.step(action)
            over = bool(terminated[0] or truncated[0])
        env.close()
    raise SystemExit(f"no mission of {kind} of {SEEDS} shows it close ahead")


def ahead(env: WarehouseVectorEnv, kind: str) -> bool:
    """Return whether a person, or the pallets of a blocked aisle, are close ahead of the robot."""
    x, y, yaw = env.simulation.pose()[0]
    places = env.simulation.traffic.position_m[0]
    if kind == "blocked_aisle":
        places = env.simulation.pallets[0][:, :2]
    offset = places - np.array([x, y])
    distance = np.hypot(*offset.T)
    turn = np.arctan2(offset[:, 1], offset[:, 0]) - yaw
    bearing = np.abs((turn + np.pi) % (2 * np.pi) - np.pi)
    most_rad, least_m, most_m = AHEAD[kind]
    seen: NDArray[np.bool_] = (distance >= least_m) & (distance <= most_m) & (bearing <= most_rad)
    along = abs(np.sin(2 * yaw)) < 0.1  # in the middle of an aisle, not around a corner
    return bool(along and seen.any())


def shelves() -> Image.Image:
    """Draw the share of each condition in the sample logs and in a batch."""
    with tempfile.TemporaryDirectory() as folder:
        store = f"{folder}/store"
        run_restock(["ingest", str(REPOSITORY / "sample_logs"), "--store", store])
        with contextlib.redirect_stdout(io.StringIO()) as printed:
            restock(["mix", store, "--mixture", "coverage", "--dry-run", "--json"])
        plan = json.loads(printed.getvalue())
    rows: list[dict[str, Any]] = [
        {"condition": line["stratum"].replace("_", " "), "where": where, "share": line[key]}
        for line in plan["strata"]
        for where, key in ((IN_LOGS, "natural_share"), (IN_BATCH, "share"))
    ]
    order = [
        row["condition"]
        for row in sorted(rows, key=lambda row: -row["share"])
        if row["where"] == IN_LOGS
    ]
    base = alt.Chart(alt.Data(values=rows)).encode(
        y=alt.Y(
            "condition:N",
            sort=order,
            title=None,
            axis=alt.Axis(ticks=False, domain=False, labelPadding=8),
        ),
        yOffset=alt.YOffset("where:N", sort=[IN_LOGS, IN_BATCH]),
        x=alt.X("share:Q", title=None, axis=None, scale=alt.Scale(domain=[0, 0.85])),
    )
    colour = alt.Color(
        "where:N",
        sort=[IN_LOGS, IN_BATCH],
        scale=alt.Scale(domain=[IN_LOGS, IN_BATCH], range=COLOURS),
        legend=alt.Legend(title=None, orient="top", symbolType="square", labelLimit=0),
    )
    chart = (base.mark_bar().encode(color=colour)) + base.mark_text(align="left", dx=6).encode(
        text=alt.Text("share:Q", format=".0%")
    )
    chart = (
        chart.properties(width=330, height=HEIGHT_PX - 50)
        .configure_view(stroke=None)
        .configure_axis(labelFontSize=16, labelLimit=0, labelColor="#1f2937")
        .configure_legend(labelFontSize=16, symbolSize=220)
        .configure_text(fontSize=16, color="#1f2937")
    )
    image = Image.open(io.BytesIO(vl_convert.vegalite_to_png(chart.to_json(), scale=1)))
    ground = Image.new("RGB", (CHART_PX, HEIGHT_PX), "white")
    image.thumbnail((CHART_PX, HEIGHT_PX))
    ground.paste(image, (CHART_PX - image.width, 0), image if image.mode == "RGBA" else None)
    return ground


if __name__ == "__main__":
    sys.exit(main())
