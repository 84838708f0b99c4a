"""The robot of a URDF description: values taken from it, and notes on the rest."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.driven_robot import Drive, columns, typed_topics, write_topics

from restock.ingest.containers.open_recording import open_recording
from restock.ingest.decoding.columns import TopicColumns
from restock.ingest.profile.description import Description, read_description
from restock.ingest.profile.profile import parse_profile
from restock.ingest.propose.described_robot import DescribedRobot, described_robot
from restock.ingest.propose.drives import propose_profile
from restock.ingest.propose.footprint import descriptions, footprint_of
from restock.ingest.propose.gather import Given
from restock.ingest.propose.robot_choice import propose_robot
from restock.ingest.propose.roles import robots_in


def link(name: str, shape: str = "", mass: float = 0.0) -> str:
    collision = f"<collision><geometry>{shape}</geometry></collision>" if shape else ""
    inertial = f"<inertial><mass value='{mass}'/></inertial>" if mass else ""
    return f"<link name='{name}'>{collision}{inertial}</link>"


def joint(
    child: str, xyz: str, axis: str = "0 1 0", kind: str = "continuous", parent: str = "base_link"
) -> str:
    return (
        f"<joint name='{child}_joint' type='{kind}'><parent link='{parent}'/>"
        f"<child link='{child}'/><origin xyz='{xyz}'/><axis xyz='{axis}'/></joint>"
    )


WHEEL = "<cylinder radius='0.1' length='0.04'/>"
BASE = link("base_link", "<box size='0.8 0.5 0.2'/>", mass=20.0)
XACRO = "<robot name='x' xmlns:xacro='http://www.ros.org/wiki/xacro'>{}</robot>"


def robot(*parts: str) -> str:
    return f"<robot name='test'>{BASE}{''.join(parts)}</robot>"


def wheels(*places: tuple[float, float], radius: str = WHEEL, **how: str) -> str:
    return "".join(
        link(f"wheel_{index}", radius, mass=1.0) + joint(f"wheel_{index}", f"{x} {y} -0.05", **how)
        for index, (x, y) in enumerate(places)
    )


def described(text: str) -> DescribedRobot:
    description = read_description(text)
    assert isinstance(description, Description), description
    return described_robot(description, 0.0, "laser")


def test_one_axle_and_lidar() -> None:
    laser = link("laser") + joint("laser", "0.3 0 0.2", kind="fixed")
    found = described(robot(wheels((0.2, 0.22), (0.2, -0.22)), laser))
    assert found.values == {
        "drive": "differential",
        "wheel_radius_m": 0.1,
        "track_m": 0.44,
        "axle_x_m": 0.2,
        "mass_kg": 22.0,
        "height_m": 0.25,
        "lidar.z_m": 0.35,
    }


def test_two_axles_are_skid_steer_without_steering_joint() -> None:
    places = ((0.25, 0.2), (0.25, -0.2), (-0.25, 0.2), (-0.25, -0.2))
    values = described(robot(wheels(*places))).values
    assert (values["drive"], values["wheelbase_m"]) == ("skid_steer", 0.5)
    mecanum = robot(wheels(*places)).replace("wheel_", "mecanum_")
    assert described(mecanum).values["drive"] == "omnidirectional"
    steering = "".join(
        link(f"hub_{i}") + joint(f"hub_{i}", f"0.25 {y} -0.05", "0 0 1", "revolute")
        + link(f"front_{i}", WHEEL) + joint(f"front_{i}", "0 0 0", parent=f"hub_{i}")
        for i, y in enumerate((0.2, -0.2))
    )  # fmt: skip
    assert (
        described(robot(wheels((-0.25, 0.2), (-0.25, -0.2)), steering)).values["drive"]
        == "ackermann"
    )


def test_radius_of_mesh_wheel_follows_floor() -> None:
    mesh = "<mesh filename='package://none/wheel.stl'/>"
    footprint = link("base_footprint") + joint("base_footprint", "0 0 -0.12", kind="fixed")
    found = described(robot(wheels((0, 0.2), (0, -0.2), radius=mesh), footprint))
    assert found.values["wheel_radius_m"] == pytest.approx(0.07)
    assert "only meshes" in found.notes[-1]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (robot(), "'test' has no wheels: no joint of it turns without end"),
        (robot(wheels((0, 0.2), (0.1, 0.2))), "no driven pair on both sides"),
    ],
)
def test_robot_without_driven_wheels_is_reported(text: str, message: str) -> None:
    found = described(text)
    assert not found.values
    assert message in (found.problem or "")


DRIVEN = robot(wheels((0, 0.2), (0, -0.2)))
ENTITIES = "<!DOCTYPE r [<!ENTITY a 'ha'><!ENTITY b '&a;&a;'>]><robot>&b;</robot>"
LOOP = joint("b", "0 0 0", parent="a") + joint("a", "0 0 0", parent="b")
INVALID_DESCRIPTIONS = {
    "<robot": "is not XML",
    ENTITIES: "must not declare entities",
    DRIVEN.replace("0.8 0.5", "${length} 0.5"): "xacro file",
    XACRO.format("<link name='base_link'/><xacro:wheel prefix='left'/>"): "xacro file",
    "<sdf version='1.6'/>": "begins with <sdf>",
    "<robot/>": "has no links",
    "<robot><link name='a'/><link name='b'/></robot>": "'a', 'b' are not joined to each other",
    f"<robot><link name='a'/><link name='b'/>{LOOP}</robot>": "every link hangs on another",
    f"<robot>{' '.join(map(link, map(str, range(6000))))}</robot>": "too many",
}


@pytest.mark.parametrize("text", INVALID_DESCRIPTIONS)
def test_invalid_description_is_rejected(text: str) -> None:
    found = read_description(text)
    assert isinstance(found, str)
    assert INVALID_DESCRIPTIONS[text] in found


def test_urdf_generated_by_xacro_is_accepted() -> None:
    text = XACRO.format(BASE + wheels((0, 0.2), (0, -0.2)))
    assert described(text).values["track_m"] == 0.4


@pytest.mark.parametrize("base", ["chassis", "robot1_base_link"])
def test_root_link_of_another_name_is_the_base(base: str) -> None:
    laser = link("laser") + joint("laser", "0.3 0 0.2", kind="fixed")
    usual = robot(wheels((0.2, 0.22), (0.2, -0.22)), laser)
    found = described(usual.replace("base_link", base))
    assert found.values == described(usual).values
    assert found.notes[0].startswith(f"{base!r} is taken for the base")
    under = link("foot") + joint(base, "0 0 0.15", kind="fixed", parent="foot")
    above = described(usual.replace("base_link", base).replace("</robot>", under + "</robot>"))
    assert above.values == found.values
    assert "'foot' is taken for the base" in above.notes[0]


@given(
    st.lists(
        st.tuples(
            st.sampled_from(["continuous", "revolute", "fixed", "prismatic", "?"]),
            st.sampled_from(["base_link", "l0", "l1", "l2"]),
            st.sampled_from(["0 0.3 0", "0 -0.3 0", "nan 1 1", "1e400 0 0", "x", ""]),
            st.sampled_from(["0 1 0", "0 0 1", "0 0 0", "nan", "1 2"]),
            st.sampled_from(["<sphere radius='0.1'/>", "<sphere radius='-1'/>", "<box/>", ""]),
        ),
        max_size=6,
    )
)
def test_any_joint_tree_gives_finite_values_or_a_problem(parts):
    """Loops, orphans and invalid numbers raise nothing, and all values are finite."""
    body = "".join(
        link(f"l{i}", shape) + joint(f"l{i}", xyz, axis, kind, parent)
        for i, (kind, parent, xyz, axis, shape) in enumerate(parts)
    )
    found = described(robot(body))
    assert (found.problem is None) == bool(found.values)
    for value in found.values.values():
        assert value == value  # not NaN
        assert value != float("inf")


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_topics(typed_topics(Drive()), tmp_path_factory.mktemp("drive") / "bag")


def test_proposal_takes_robot_from_urdf_file(bag, tmp_path):
    urdf = tmp_path / "robot.urdf"
    urdf.write_text(robot(wheels((0.2, 0.22), (0.2, -0.22))))
    with open_recording(bag) as recording:
        proposed = propose_profile(recording, "mine", Given(urdf=urdf))
        plain = propose_profile(recording, "mine")
    own = parse_profile(proposed.toml, where="proposed")
    assert own.robot is not None
    assert (own.robot.track_m, own.robot.origin_of("track_m")) == (0.44, "urdf")
    assert own.robot.origin_of("lidar.beams") == "logs"
    assert own.task.body.length_m == pytest.approx(0.8)
    by_logs = parse_profile(plain.toml, where="proposed").robot
    assert by_logs is not None
    assert by_logs.origin_of("track_m") == "default"
    assert by_logs.lidar.beams == own.robot.lidar.beams


def test_arm_description_does_not_hide_base_description(tmp_path: Path) -> None:
    texts = {"/arm": robot(), "/base": robot(wheels((0.2, 0.22), (0.2, -0.22)))}
    topics = typed_topics(Drive())
    for place, text in texts.items():
        topics[f"{place}/robot_description"] = description_topic(text)
    with open_recording(write_topics(topics, tmp_path / "bag")) as recording:
        proposed = propose_profile(recording, "mine")
    own = parse_profile(proposed.toml, where="proposed").robot
    assert own is not None
    assert (own.track_m, own.origin_of("track_m")) == (0.44, "robot_description")


SMALL = robot(wheels((0.2, 0.22), (0.2, -0.22)))


def description_topic(text: str) -> tuple[str, TopicColumns]:
    data = {"data": np.array([text], object)}
    return "std_msgs/msg/String", columns(np.array([0.01]), data, stamped=False)


@pytest.mark.parametrize(
    ("texts", "outline", "source"),
    [
        # Its own description, although another comes first.
        (
            {
                "/robot1": robot(wheels((0.3, 0.32), (0.3, -0.32))),
                "/robot2": SMALL.replace("0.8 0.5", "0.6 0.4"),
                "": robot(),
            },
            *((0.6, 0.64), "/robot2/robot_description"),
        ),
        # A description without a namespace, if the robot has none of its own.
        ({"": SMALL}, (0.8, 0.64), "/robot_description; /robot2 has none of its own"),
        ({"/robot1": SMALL}, None, None),
    ],
)
def test_each_robot_gets_its_own_outline(texts, outline, source, tmp_path):
    short, whole = typed_topics(Drive(duration_s=1.0)), typed_topics(Drive(duration_s=2.0))
    used = ("/cmd_vel", "/amcl_pose", "/odom")
    topics = {f"/robot1{name}": short[name] for name in used}
    topics |= {f"/robot2{name}": whole[name] for name in used}
    topics |= {f"{name}/robot_description": description_topic(text) for name, text in texts.items()}
    with open_recording(write_topics(topics, tmp_path / "bag")) as recording:
        assert robots_in(recording) == ["/robot2", "/robot1"]
        found, notes = footprint_of(descriptions(recording))
        track_m = propose_robot(descriptions(recording), None).values.get("track_m")
    assert notes == []
    assert (found is None, track_m) == ((True, None) if outline is None else (False, 0.44))
    if found is not None:
        assert (found.length_m, found.width_m) == pytest.approx(outline)
        assert source in found.source
