"""Profiles: shipped ones, invalid files, and the key that each error names."""

import pickle

import pytest
from support.driven_robot import Drive, typed_topics, write_bag, write_topics
from support.profile_texts import WAREHOUSE as TEXT

from restock.cli import main
from restock.errors import ConfigError, RecordingError
from restock.ingest.pipeline import ingest
from restock.ingest.profile.profile import (
    load_profile,
    parse_profile,
    profile_toml,
    shipped_profiles,
)


def test_shipped_profiles_load():
    assert shipped_profiles() == ["turtlebot3", "warehouse_amr"]
    for name in shipped_profiles():
        profile = load_profile(name)
        assert profile.name == name
        assert {c.name for c in profile.conditions} >= {"wheel_slip", "blocked_aisle"}


def test_hash_excludes_conditions():
    assert parse_profile(TEXT, where="a").hash == load_profile("warehouse_amr").hash
    changed = parse_profile(TEXT.replace("max_gap_s = 0.5", "max_gap_s = 0.6"), where="a")
    assert changed.hash != load_profile("warehouse_amr").hash
    assert changed.task.hash == load_profile("warehouse_amr").task.hash
    fewer = parse_profile(TEXT.replace('"recovery", ', ""), where="a")
    assert fewer.hash == load_profile("warehouse_amr").hash
    assert fewer.labels_version != load_profile("warehouse_amr").labels_version


def test_hash_survives_pickling_and_writing():
    profile = load_profile("warehouse_amr")
    assert pickle.loads(pickle.dumps(profile)).hash == profile.hash
    written = parse_profile(profile_toml(profile), where="written")  # contains every default
    assert written.hash == profile.hash


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("sectors = 36", "sectrs = 36", "unknown key `task.sectrs`"),
        ("[clock]", "[klock]", "unknown key `klock`"),
        ('topic = "/scan"', "topic = 3", "`inputs.scan.topic`: Expected `str`, got `int`"),
        ("sectors = 36", "sectors = 5", "task.sectors must be even and 4 or more, or 0, got 5"),
        ("sectors = 36", "sectors = 0", "`task.sectors` is 0 (a robot without a lidar)"),
        ("control_period_s = 0.2", "control_period_s = 200", "is in seconds, at most 10, got 200"),
        ("control_period_s = 0.2", "control_period_s = 0", "task.control_period_s must be above 0"),
        ("time_limit_steps = 240", "time_limit_steps = 0", "time_limit_steps must be at least 1"),
        ("range_min_m = 0.05", "range_min_m = 4.5", "range_max_m must be above range_min_m"),
        ("  [0.0, 0.0],", "  [0.1, 0.0],", "actions must start with the stop action [0, 0]"),
        ('"recovery"', '"recvery"', "no condition named 'recvery'"),
        ('"recovery"', '"recovery", "recovery"', "recovery is given twice"),
        ("conditions = [", 'conditions = ["closing_traffic", ', "no condition named 'closing_t"),
        ("{ x_m =", "{ x =", "`inputs.pose.fields`: unknown 'x', missing 'x_m'"),
        ('name = "warehouse_amr"', "", "missing key `name`"),
        ('goal = "route"', 'goal = "rout"', "`task.goal`: Invalid enum value 'rout'"),
        ("[task]", "[task", "is not TOML"),
        ("max_gap_s = 0.5", "max_gap_s = nan", "clock.max_gap_s must be above 0, got nan"),
        ("max_age_s = 0.5", "max_age_s = inf", "inputs.command.max_age_s must be finite, got inf"),
        # Keys that exclude each other.
        ("[inputs.wheels]", "[inputs.wheels]\noptional = true", "wheels has no fallback"),
        ("[inputs.plan]", "[inputs.plon]", "unknown key `inputs.plon`"),
        ('"/cmd_vel_nav"', '"/cmd_vel"', "`inputs.nav_command.topic` is the topic of the command"),
        ("[inputs.imu]", "[inputs.imu]\nupside_down = true", "upside_down` applies only to a scan"),
        (', angle_increment_rad = "angle_increment"', "", "missing 'angle_increment_rad'"),
        ('"angle_increment"', '"a", angle_max_rad = "b"', "angle_max_rad beside"),
        ('pressed = "data"', 'pressed = "front or 3sides"', "inputs.bumper.fields.pressed"),
        ("[clock]", '[goal]\nsource = "hindsight"\n[clock]', "would not be used"),
        ("[clock]", "[goal]\nstill_s = 5.0\n[clock]", "`goal.still_s` is given"),
        (
            "[clock]",
            '[[condition]]\nname = "x"\nkind = "exposure"\ntiming = "post"\nsql = "true"\n[clock]',
            "exposure is a situation known before acting",
        ),
    ],
)
def test_error_names_file_and_key(old, new, message):
    assert old in TEXT
    with pytest.raises(ConfigError) as error:
        parse_profile(TEXT.replace(old, new, 1), where="mine.toml")
    assert message in str(error.value)
    assert str(error.value).startswith("mine.toml: ")


def test_route_needs_goal_and_plan():
    start, end = TEXT.index("[inputs.plan]"), TEXT.index("[inputs.bumper]")
    with pytest.raises(ConfigError, match=r"`inputs\.plan` is missing"):
        parse_profile(TEXT[:start] + TEXT[end:], where="mine.toml")


def test_hindsight_goal_needs_route():
    text = TEXT.replace('goal = "route"', 'goal = "none"') + '\n[goal]\nsource = "hindsight"\n'
    with pytest.raises(ConfigError, match=r"`task.goal` is 'none'"):
        parse_profile(text, where="mine.toml")


def test_goal_topics_are_not_needed_without_goal(tmp_path):
    topics = {
        name: topic
        for name, topic in typed_topics(Drive(3.0)).items()
        if name not in ("/goal_pose", "/plan")
    }
    bag = write_topics(topics, tmp_path / "bag")
    with pytest.raises(RecordingError, match=r"no topic /goal_pose \(goal\)"):
        ingest(bag, parse_profile(TEXT, where="p"), store=None)
    aimless = parse_profile(TEXT.replace('goal = "route"', 'goal = "none"'), where="p")
    assert ingest(bag, aimless, store=None).manifest["transitions"] == 14


def test_fallbacks_of_shipped_profiles():
    assert load_profile("warehouse_amr").fallbacks == {}
    assert set(load_profile("turtlebot3").fallbacks) == {
        "bumper", "nav_command", "behaviour_policy", "true_condition", "true_exposure",
        "perturbation", "goal", "plan",
    }  # fmt: skip


@pytest.fixture(scope="session")
def bag(tmp_path_factory):
    """Return a bag of a robot with a navigation stack."""
    return write_bag(Drive(), tmp_path_factory.mktemp("bag") / "drive")


def test_proposed_profile_reads_its_recording(bag, tmp_path, shell):
    file = tmp_path / "mine.toml"
    assert shell.out("profile", "new", bag, "--out", file) == ""
    profile = load_profile(file)
    assert profile.name == "mine"
    shipped = load_profile("warehouse_amr")
    for name, source in profile.inputs.items():
        wanted = getattr(shipped.inputs, name)
        assert (source.topic, source.type) == (wanted.topic, wanted.type), name
        assert source.fields == wanted.fields, name
    assert profile.task.goal == "route"
    assert profile.task.control_period_s == 0.2
    assert profile.clock.steps == "command"
    assert (0.4, 0.0) in profile.task.actions  # the commanded action
    check = shell.json("profile", "check", file, bag)
    assert check["problems"] == []
    assert check["outcome"]["transitions"] == 29
    assert {row["input"] for row in check["inputs"]} >= {"command", "pose", "scan", "plan"}


def test_proposal_lists_missing_inputs(tmp_path, shell):
    class IncompleteDrive(Drive):
        drop = ("/odom", "/plan", "/imu", "/amcl_pose")

    bag = write_bag(IncompleteDrive(), tmp_path / "bag")
    document = shell.json("profile", "new", bag, code=3)
    assert document["missing"] == ["pose"]
    out = document["toml"]
    assert 'source = "hindsight"' in out
    lines = out[out.index("# [inputs.pose]") : out.index("# [inputs.imu]")].splitlines()
    named = "\n".join(line[2:] for line in lines if "[inputs.wheels]" not in line)
    assert parse_profile(out + named, where="p").inputs.pose.fields["yaw_rad"] == "FIELD"


def test_existing_profile_is_not_overwritten(bag, tmp_path):
    file = tmp_path / "mine.toml"
    file.write_text("mine")
    assert main(["profile", "new", str(bag), "--out", str(file)]) == 2
    assert file.read_text() == "mine"


OWN = '\n[[condition]]\nfile = "{}"\n'
TIGHT = "-- There is little room.\n-- timing: pre\n-- priority: 44\nclearance_m < 0.3\n"


def test_condition_file_beside_profile(tmp_path):
    (tmp_path / "tight.sql").write_text(TIGHT)
    file = tmp_path / "p.toml"
    file.write_text(TEXT + OWN.format("tight.sql"))
    found = load_profile(file).own_conditions[0]
    assert (found.name, found.timing, found.priority) == ("tight", "pre", 44)
    assert (found.sql, found.doc) == ("clearance_m < 0.3", "There is little room.")
    before = load_profile(file)
    (tmp_path / "tight.sql").write_text(TIGHT.replace("0.3", "0.4"))
    assert load_profile(file).hash == before.hash
    assert load_profile(file).labels_version != before.labels_version
    file.write_text(TEXT + OWN.format("tight.sql") + 'name = "narrow"\npriority = 3\n')
    found = load_profile(file).own_conditions[0]
    assert (found.name, found.priority) == ("narrow", 3)


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ('file = "../tight.sql"', "`condition[0].file` is outside the profile's folder"),
        ('file = "link.sql"', "`condition[0].file` is outside the profile's folder"),
        ('file = "none.sql"', "`condition[0].file` cannot be read: none.sql"),
        ('file = "p.toml"', "`condition[0].file` must name a .sql file"),
        ('file = "big.sql"', "`condition[0].file` is larger than 100,000 bytes"),
        ('file = "tight.sql"\nsql = "true"', "`condition[0].file` is given together with `sql`"),
        ('file = "bare.sql"', "missing key `condition[0].timing`"),
    ],
)
def test_invalid_condition_file_is_rejected(entry, message, tmp_path):
    folder = tmp_path / "profiles"
    folder.mkdir()
    (tmp_path / "tight.sql").write_text(TIGHT)
    (folder / "link.sql").symlink_to(tmp_path / "tight.sql")
    (folder / "tight.sql").write_text(TIGHT)
    (folder / "bare.sql").write_text("true")
    (folder / "big.sql").write_text("-- " + "x" * 100_000)
    file = folder / "p.toml"
    file.write_text(TEXT + f"\n[[condition]]\n{entry}\n")
    with pytest.raises(ConfigError) as error:
        load_profile(file)
    assert message in str(error.value)


@pytest.mark.parametrize(
    ("sql", "message"),
    [
        ("clearance_mm < 1", 'Referenced column "clearance_mm" not found'),
        ("clearance_m", "its SQL gives FLOAT, not a boolean"),
        ("lead(bumped) OVER episode", "lead() may look at later steps"),
    ],
)
def test_invalid_condition_sql_is_rejected_with_its_key(sql, message):
    own = f'\n[[condition]]\nname = "x"\ntiming = "pre"\nsql = """{sql}"""\n'
    with pytest.raises(ConfigError) as error:
        parse_profile(TEXT + own, where="mine.toml")
    assert str(error.value).startswith("mine.toml: `condition[0].sql` ('x'): ")
    assert message in str(error.value)
