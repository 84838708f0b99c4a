"""Custom signals: from any message field to table columns, conditions and queries."""

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from deltalake.schema import ArrayType, Field
from support.driven_robot import Drive, columns
from support.ingested import ingested
from support.paths import ROOT, sample_transitions
from support.profile_texts import WAREHOUSE as TEXT
from support.ragged import nested, ragged

from restock.cli import main
from restock.errors import ConfigError, RecordingError, StoreError
from restock.ingest.decoding.columns import FieldColumn
from restock.ingest.profile.profile import parse_profile
from restock.ingest.profile.tables import refuse_other_signals
from restock.ingest.steps.episodes import Steps, steps_of

SAMPLE = ROOT / "sample_logs" / "amr_tuesday"
ROWS = sample_transitions("amr_tuesday")


def signal(name: str, path: str, *more: str, topic: str = "/x", kind: str = "x/msg/X") -> str:
    lines = [f"[signals.{name}]", f'topic = "{topic}"', f'type = "{kind}"', f"path = '{path}'"]
    return "\n".join([*lines, *more, *(['unit = "1"'] if "unit" not in str(more) else [])]) + "\n"


def with_signals(*tables: str) -> str:
    return TEXT + "\n" + "\n".join(tables)


def steps_with(
    table: str, fields: dict[str, FieldColumn], times: list[float] | None = None
) -> Steps:
    """Return a 6 s drive with messages of /x at these times (default: every second)."""
    at = np.arange(0.0, 6.0) if times is None else np.array(times)
    topics = Drive().topics() | {"/x": columns(at, fields)}
    return steps_of(parse_profile(with_signals(table), where="p"), topics)


def column(table: str, fields: dict[str, FieldColumn], times: list[float] | None = None) -> list:
    return steps_with(table, fields, times).custom.table["s"].to_pylist()


def test_value_is_held_until_its_maximum_age():
    fields = {"v": np.array([10.0, 20.0])}
    held = column(signal("s", "v", "max_age_s = 1.0"), fields, [0.5, 3.0])
    # Ticks are every 0.2 s, starting at 0.005 s.
    assert held[:3] == [None] * 3
    assert held[3:8] == [10.0] * 5
    assert held[8:15] == [None] * 7
    assert held[15:20] == [20.0] * 5
    assert held[20:] == [None] * 10


def test_messages_without_element_are_skipped():
    """Diagnostics come from many nodes: each message holds the statuses of one."""
    fields = {
        "status[].name": ragged([["battery"], ["lidar"], ["battery", "lidar"], [], [], []]),
        "status[].values[].key": nested([[["v"]], [["v"]], [["v"], ["v"]], [], [], []]),
        "status[].values[].value": nested([[["24"]], [["1"]], [["23.5"], ["2"]], [], [], []]),
    }
    path = "status[name=battery].values[key=v].value"
    held = column(signal("s", path), fields)
    assert held[1:10] == [24.0] * 9  # held over the message about the lidar
    assert held[11:] == [23.5] * 19


def test_empty_list_is_a_value_and_nan_is_null():
    ranges = ragged([[1.0, np.inf, 3.0, 4.0], [], [np.nan] * 3, [2.0], [2.0], [2.0]])
    lists = column(signal("s", "ranges[::2]"), {"ranges": ranges})
    assert [lists[i] for i in (1, 6, 11, 16)] == [[1.0, 3.0], [], [None, None], [2.0]]
    nearest = column(signal("s", "ranges[]", 'reduce = "min"'), {"ranges": ranges})
    assert [nearest[i] for i in (1, 6, 11, 16)] == [1.0, None, None, 2.0]


HALF = 0.3 / 2  # half of the turn
TURN = {"x": 0.0, "y": 0.0, "z": np.sin(HALF), "w": np.cos(HALF)}
NUMBERS = [
    # Reductions use finite elements only.
    *(
        (signal("s", "r[]", f'reduce = "{how}"'), {"r": ragged([[4.0, np.inf, 1.0]])}, expected)
        for how, expected in (
            ("min", 1.0),
            ("max", 4.0),
            ("mean", 2.5),
            ("sum", 5.0),
            ("count", 3.0),
        )
    ),
    (signal("s", "v", "scale = 1.8", "offset = 32", 'unit = "°F"'), {"v": np.array([100.0])}, 212),
    (signal("s", "b"), {"b": np.array([True])}, 1.0),
    (signal("s", "m", "values = { 3 = 30, 4 = 40 }"), {"m": np.array([4], np.uint8)}, 40.0),
    (
        signal("s", "t", "values = { Auto = 1, manual = 2 }"),
        {"t": np.array(["auto"], object)},
        1.0,
    ),
    (signal("s", "b", "values = { true = -1, false = 1 }"), {"b": np.array([True])}, -1.0),
    (
        signal("s", "pose.orientation", 'reduce = "yaw"', 'unit = "rad"'),
        {f"pose.orientation.{axis}": np.array([value]) for axis, value in TURN.items()},
        pytest.approx(0.3),
    ),
]


@pytest.mark.parametrize(("table", "fields", "expected"), NUMBERS)
def test_value_is_converted_to_number(table, fields, expected):
    held = column(table, fields, [0.5])
    assert held[:3] == [None] * 3
    assert held[3:] == [expected] * 27  # latched, as it has no maximum age


def test_non_numeric_text_is_counted_and_shown():
    texts = np.array(["24.5", "n/a", "n/a"], object)
    steps = steps_with(signal("s", "t"), {"t": texts}, [0.0, 1.0, 2.0])
    assert steps.custom.table["s"].to_pylist()[:12] == [24.5] * 5 + [None] * 7
    assert steps.notes == [
        "signals.s: 2 of 3 messages have a value that is not a number, such as 'n/a'"
    ]
    (row,) = steps.custom.rows()
    assert (row["messages"], row["found"], row["unread"], row["steps"]) == (3, 1, 2, 5)


def test_missing_topic_gives_nulls_and_is_reported():
    from restock.ingest.steps.aligned_inputs import fallbacks_used

    profile = parse_profile(with_signals(signal("s", "v"), signal("l", "v[]")), where="p")
    topics = Drive().topics()
    steps = steps_of(profile, topics)
    assert steps.custom.table["s"].null_count == steps.custom.table["l"].null_count == len(steps)
    assert fallbacks_used(profile, topics)["signals.s"] == "null: no message of /x"


@pytest.mark.parametrize(
    ("table", "message"),
    [
        (signal("clearance_m", "v"), "`signals.clearance_m`: Restock has a column of this name"),
        (signal("select", "v"), "`signals.select`: this name is a keyword of SQL"),
        (signal("s", "a..b"), "`signals.s`: path 'a..b' cannot be read at '.b'"),
        (signal("s", "a[].b[]"), "`signals.s`: path 'a[].b[]' gives lists of lists"),
        (signal("s", "a", 'reduce = "min"'), "there is nothing to reduce"),
        (signal("s", "a[]", 'reduce = "yaw"'), "takes one quaternion"),
        (signal("s", "a", "max_age_s = 0"), "max_age_s must be above 0"),
        (signal("s", "a", "unit = ''"), 'unit is empty: write "1"'),
        (signal("s", "a", "values = { a = 'b' }"), "`signals.s.values[...]`: Expected `float`"),
        ('[signals.s]\ntopic = "/x"\n', "missing key `signals.s."),
    ],
)
def test_invalid_signal_is_rejected(table, message):
    with pytest.raises(ConfigError) as error:
        parse_profile(with_signals(table), where="mine.toml")
    assert message in str(error.value)
    assert str(error.value).startswith("mine.toml: ")


def test_array_value_is_reported_with_its_key():
    with pytest.raises(RecordingError, match=r"`signals\.s\.path`: 'a' of /x gives an array"):
        steps_with(signal("s", "a"), {"a": np.zeros((1, 3))}, [0.0])


def test_profile_check_suggests_existing_fields(tmp_path, shell):
    profile = tmp_path / "p.toml"
    joints = {"topic": "/joint_states", "kind": "sensor_msgs/msg/JointState"}
    profile.write_text(
        with_signals(
            signal("a", "velocty[left_wheel_joint]", **joints),
            signal("b", "header.stmp", **joints),
            signal("c", "velocity", **joints),
            signal("d", "data", topic="/bumper", kind="std_msgs/msg/Float64"),
            signal("e", "data", topic="/bumpr", kind="std_msgs/msg/Bool"),
        )
    )
    check = shell.json("profile", "check", profile, SAMPLE, code=2)
    assert check["outcome"] is None
    assert [problem.split(":")[0] for problem in check["problems"]] == [
        "/bumper holds std_msgs/msg/Bool, not std_msgs/msg/Float64 (signals.d)",
        *("`signals.a.path`", "`signals.b.path`", "`signals.c.path`"),
    ]
    assert "did you mean 'velocity'?" in check["problems"][1]
    assert "write velocity[0] for one element" in check["problems"][3]


OWN = [
    signal("left_radps", "velocity[left_wheel_joint]", "max_age_s = 1.5", 'unit = "rad/s"',
           topic="/joint_states", kind="sensor_msgs/msg/JointState"),
    signal("beams_m", "ranges[::45]", "max_age_s = 0.5", 'unit = "m"', 'doc = "some beams"',
           topic="/scan", kind="sensor_msgs/msg/LaserScan"),
    signal("battery_v", "status[name=battery].values[key=voltage].value", 'unit = "V"',
           topic="/diagnostics", kind="diagnostic_msgs/msg/DiagnosticArray"),
]  # fmt: skip
FAST = """
[[condition]]
name = "fast_wheel"
timing = "pre"
priority = 1
sql = "left_radps > {} AND len(beams_m) = 2 AND battery_v > 20"
"""


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a store of the sample bag with custom signals and a condition that uses them."""
    folder = tmp_path_factory.mktemp("custom")
    (folder / "p.toml").write_text(with_signals(*OWN, FAST.format(5)))
    ingested(SAMPLE, folder / "p.toml", folder / "store").close()
    return folder / "store"


def test_custom_signals_are_columns_with_units(store, shell):
    (row,) = shell.json(
        "sql",
        store,
        "SELECT count(*) AS rows, count(left_radps) AS left, count(beams_m) AS beams,"
        " min(len(beams_m)) AS fewest, min(battery_v) AS battery,"
        " corr(left_radps, wheel_speed_mps) AS follows FROM transitions",
    )
    assert row["rows"] == row["beams"] == ROWS
    # sampled every 2 s: unknown at some ticks after a pause
    assert 0.8 * ROWS < row["left"] <= ROWS
    assert row["fewest"] == 2
    assert 20 < row["battery"] < 30
    assert row["follows"] > 0.5
    docs = shell.json("sql", store, "FROM columns WHERE view = 'transitions'")
    described = {doc["column_name"]: (doc["type"], doc["unit"], doc["meaning"]) for doc in docs}
    assert described["left_radps"] == (
        "DOUBLE",
        "rad/s",
        "velocity[left_wheel_joint] of /joint_states",
    )
    assert described["beams_m"] == ("FLOAT[]", "m", "some beams")
    (file,) = (store / "transitions").glob("*/*.parquet")
    field = pq.read_schema(file).field("left_radps")
    assert field.metadata[b"unit"] == b"rad/s"
    rows = shell.json("sql", store, "SELECT unnest(signals, recursive := true) FROM recordings")
    stored = [(row["name"], row["unit"], row["type"], row["messages"]) for row in rows]
    assert stored == [
        ("left_radps", "rad/s", "number", 83),
        ("beams_m", "m", "list", 779),
        ("battery_v", "V", "number", 38),
    ]


def test_relabelling_uses_stored_custom_signals(store, tmp_path, shell):
    """Relabelling reads no recording, and no row keeps an old labels version."""
    by_hand = "SELECT count(*) AS n FROM transitions WHERE left_radps > {} AND battery_v > 20"
    labelled = "SELECT count(*) AS n FROM transitions WHERE primary_condition = 'fast_wheel'"
    (before,), (five,) = (
        shell.json("sql", store, labelled),
        shell.json("sql", store, by_hand.format(5)),
    )
    assert before == five
    assert before["n"] > 0
    changed = tmp_path / "changed.toml"
    changed.write_text(with_signals(*OWN, FAST.format(7)))
    assert main(["store", "label", str(store), "--profile", str(changed)]) == 0
    (after,), (seven,) = (
        shell.json("sql", store, labelled),
        shell.json("sql", store, by_hand.format(7)),
    )
    assert after == seven
    assert 0 < after["n"] < before["n"]
    versions = "SELECT count(DISTINCT labels_version) AS n FROM transitions"
    assert shell.json("sql", store, versions) == [{"n": 1}]


def test_condition_on_unstored_signal_needs_ingest(store, tmp_path, shell):
    more = signal("imu_z", "linear_acceleration.z", topic="/imu", kind="sensor_msgs/msg/Imu")
    own = '[[condition]]\nname = "heavy"\ntiming = "pre"\nsql = "imu_z > 9"\n'
    profile = tmp_path / "p.toml"
    profile.write_text(with_signals(*OWN, more, own))
    stderr = shell.err("store", "label", store, "--profile", profile)
    assert "condition 'heavy'" in stderr
    assert "imu_z" in stderr
    assert "ingest the recordings again" in stderr


def test_signal_with_another_unit_is_rejected(store, tmp_path, shell):
    other = OWN[0].replace('"rad/s"', '"rpm"')
    profile = tmp_path / "p.toml"
    profile.write_text(with_signals(other))
    command = ["ingest", str(SAMPLE), "--store", str(store), "--profile", str(profile)]
    stderr = shell.err(*command)
    assert "its column `left_radps` is a number in rad/s, and `signals.left_radps`" in stderr
    assert "rename the signal" in stderr
    assert shell.json("sql", store, "SELECT count(*) AS n FROM transitions") == [{"n": ROWS}]


def test_vectors_of_wrong_length_are_null_and_counted():
    fields = {"v": ragged([[1, 2], [3, 4, 5], [6, 7], []])}
    table = signal("s", "v[]", "length = 2", "max_age_s = 1.0")
    steps = steps_with(table, fields, [0.0, 1.0, 2.0, 3.0])
    held = steps.custom.table["s"].to_pylist()
    assert held[:5] == [[1.0, 2.0]] * 5
    assert held[5:10] == [None] * 5
    assert held[10:15] == [[6.0, 7.0]] * 5
    assert held[15:] == [None] * 15
    (row,) = steps.custom.rows()
    assert (row["type"], row["messages"], row["found"], row["unread"]) == ("list[2]", 4, 2, 2)
    assert any("2 of 4 messages do not have the length 2" in note for note in steps.notes)


def test_vector_length_must_match_stored_column():
    with pytest.raises(ConfigError, match="the length of a vector needs a list"):
        parse_profile(with_signals(signal("s", "v[0]", "length = 2")), where="p")
    two, three, none = (
        parse_profile(with_signals(signal("s", "v[]", *more)), where="p").signals["s"].field("s")
        for more in (["length = 2"], ["length = 3"], [])
    )
    stored_fields = {
        "s": Field("s", ArrayType("float", True), metadata={"unit": "1", "length": "2"})
    }
    refuse_other_signals(stored_fields, pa.schema([two]), "store")
    for other in (three, none):
        with pytest.raises(StoreError, match="is a vector of 2 in 1"):
            refuse_other_signals(stored_fields, pa.schema([other]), "store")
