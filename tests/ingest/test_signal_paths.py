"""Signal paths: the values they find in columns, and errors for missing fields."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.ragged import nested, ragged

from restock.ingest.decoding.columns import FieldColumn, Leaf
from restock.ingest.decoding.definitions import distro_types
from restock.ingest.profile.signal_paths import PathProblem, SignalPath


def values_at(path: str, columns: dict[str, FieldColumn], end: str | None = None) -> list[list]:
    """Return the values that a path finds, message by message."""
    read = SignalPath.read(path)
    found = read.find(columns, end)
    count = len(next(iter(columns.values())))
    return [found.values[found.message == row].tolist() for row in range(count)]


JOINTS = {
    "name": ragged([["left", "right"], ["right", "left"], ["arm"], []]),
    "velocity": ragged([[1.0, 2.0], [3.0, 4.0], [5.0], []]),
}
STATUS = {
    "status[].name": ragged([["battery", "lidar"], ["lidar"], []]),
    "status[].level": ragged([[0, 1], [2], []]),
    "status[].values[].key": nested([[["v", "i"], ["n"]], [["n", "v"]], []]),
    "status[].values[].value": nested([[["24", "1"], ["7"]], [["8", "9"]], []]),
}


FIXED = {"covariance": np.arange(12.0).reshape(3, 4)}
PATHS_AND_VALUES = [
    (FIXED, "covariance[3]", [[3], [7], [11]]),
    (FIXED, "covariance[::3]", [[0, 3], [4, 7], [8, 11]]),
    # Selected by the neighbouring name; names without values find nothing.
    (JOINTS, "velocity[left]", [[1.0], [4.0], [], []]),
    (JOINTS, "velocity[arm]", [[], [], [5.0], []]),
    (JOINTS | {"velocity": ragged([[], [3.0], [], []])}, "velocity[left]", [[], [], [], []]),
    (JOINTS | {"velocity": ragged([[], [3.0], [], []])}, "velocity[right]", [[], [3.0], [], []]),
    # Selected by a field's value; the first of two matches counts.
    (STATUS, "status[name=battery].values[key=v].value", [["24"], [], []]),
    (STATUS, "status[name=lidar].values[key=v].value", [[], ["9"], []]),
    (STATUS, "status[name=lidar].level", [[1], [2], []]),
    (STATUS, "status[level=2].name", [[], ["lidar"], []]),
    (STATUS, "status[0].values[-1].value", [["1"], ["9"], []]),
    (STATUS, "status[].values[].value", [["24", "1", "7"], ["8", "9"], []]),
    (STATUS, "status[].values[key=n].value", [["7"], ["8"], []]),
    ({"s[].k": ragged([["a", "a"]]), "s[].v": ragged([[1, 2]])}, "s[k=a].v", [[1]]),
]


@pytest.mark.parametrize(("columns", "path", "values"), PATHS_AND_VALUES)
def test_path_finds_values(columns, path, values):
    assert values_at(path, columns) == values


@given(
    st.lists(st.lists(st.integers(-9, 9), max_size=6), min_size=1, max_size=5),
    st.one_of(st.none(), st.integers(-7, 7)),
    st.one_of(st.none(), st.integers(-7, 7)),
    st.integers(1, 4),
)
def test_slices_match_python(rows, start, stop, step):
    text = f"x[{'' if start is None else start}:{'' if stop is None else stop}:{step}]"
    assert values_at(text, {"x": ragged(rows)}) == [row[start:stop:step] for row in rows]


@given(st.lists(st.lists(st.integers(-9, 9), max_size=6), min_size=1, max_size=5))
def test_index_matches_python(rows):
    for index in range(-7, 7):
        expected = [[row[index]] if -len(row) <= index < len(row) else [] for row in rows]
        assert values_at(f"x[{index}]", {"x": ragged(rows)}) == expected


@pytest.mark.parametrize(
    ("path", "problem_text"),
    [
        ("", "ends without a field"),
        ("a.", "ends without a field"),
        ("a..b", "cannot be read at '.b'"),
        ("a[0", "cannot be read"),
        ("a[0][1]", "cannot be read"),
        ("1a", "cannot be read"),
        ("a b", "cannot be read"),
        ("a[::0]", "a step of 0"),
        ("a[-99999999999999999999]", "an index has at most 9 digits"),
        ("a[::9999999999]", "an index has at most 9 digits"),
    ],
)
def test_invalid_path_is_rejected(path, problem_text):
    with pytest.raises(PathProblem) as problem:
        SignalPath.read(path)
    assert problem_text in str(problem.value)


def leaves(kind: str) -> list[Leaf]:
    from restock.ingest.decoding.definitions import RosType

    return RosType(kind, "humble", distro_types("humble")).leaves()


@pytest.mark.parametrize(
    ("kind", "path", "problem_text"),
    [
        ("sensor_msgs/msg/BatteryState", "voltge", "did you mean 'voltage'"),
        ("sensor_msgs/msg/BatteryState", "voltage[0]", "voltage does not repeat"),
        ("sensor_msgs/msg/LaserScan", "ranges", "ranges repeats: write ranges[0]"),
        ("sensor_msgs/msg/LaserScan", "header.seq", "no field 'header.seq'"),
        ("nav_msgs/msg/Odometry", "pose.covariance", "covariance repeats"),
        ("nav_msgs/msg/Odometry", "pose.pose", "no field 'pose.pose'"),
        ("sensor_msgs/msg/LaserScan", "ranges[front]", "no field 'name'"),
        ("diagnostic_msgs/msg/DiagnosticArray", "status.level", "status repeats"),
        ("diagnostic_msgs/msg/DiagnosticArray", "status[nam=x].level", "'status[].name'"),
        ("diagnostic_msgs/msg/DiagnosticArray", "status[0].values[0].valu", "].value'"),
    ],
)
def test_path_missing_from_type_is_rejected(kind, path, problem_text):
    with pytest.raises(PathProblem) as problem:
        SignalPath.read(path).check(leaves(kind))
    assert problem_text in str(problem.value)
