"""What `restock start` decides between its stages, and what it says of it at the end."""

import re
from typing import Any

from support.driven_robot import Drive, start, up_to_the_panel, write_bag

from restock.cli.start.decisions import fit_is_worse


def test_a_worse_fit_is_reported_with_its_figures() -> None:
    def gap(*ends: tuple[str, str, float, float]) -> dict[str, Any]:
        rows = [
            {"condition": "nominal", "quantity": what, "source": source, "median": m, "p90": p}
            for what, source, m, p in ends
        ]
        return {"paths": rows}

    described = ("position", "nominal", 0.12, 0.3)
    worse = gap(described, ("position", "calibrated", 0.26, 0.5))
    assert "0.260 m from the log" in str(fit_is_worse(worse))
    assert "without it 0.120 m" in str(fit_is_worse(worse))
    assert fit_is_worse(gap(described, ("position", "calibrated", 0.13, 0.2))) is None
    assert fit_is_worse(gap(described, ("position", "calibrated", 0.08, 0.4))) is None
    assert fit_is_worse(gap(described, ("heading", "calibrated", 0.9, 0.9))) is None


def test_a_lidar_that_sees_into_the_robot_stops_it(tmp_path, capsys):
    """A robot of 4 x 3 m in a small room went all the way to a policy."""
    recording, out = write_bag(Drive(), tmp_path / "drive"), tmp_path / "out"
    argv = (str(recording), "--out", str(out), *up_to_the_panel(tmp_path))
    start(capsys, *argv)
    profile = out / "profile.toml"
    text = re.sub(r"(length_m|width_m) = [\d.]+", r"\1 = 8.0", profile.read_text())
    profile.write_text(text)  # the nearest return is 3 m away
    code, document = start(capsys, *argv)
    assert code == 3
    assert document["stages"][-1]["name"] == "check"
    assert "the robot's outline (8 x 8 m) is wrong" in document["stopped"]["why"]
    assert "inside it at 100% of the ticks" in document["stopped"]["why"]
    assert "length_m and width_m of [task.body]" in document["stopped"]["remedies"][0]
    _, document = start(capsys, *argv, "--accept")
    assert document["stages"][-1]["name"] == "mix"
