"""A robot's outline, from its description or the command line."""

import numpy as np
import pytest
from support.paths import SHARED

from restock.errors import ConfigError
from restock.ingest.containers.open_recording import open_recording
from restock.ingest.propose.footprint import (
    RobotText,
    descriptions,
    footprint_of,
    of_urdf,
    parse_footprint,
)

URDF = """<robot name="cart">
  <link name="base_footprint"/>
  <link name="base_link">
    <visual><geometry><mesh filename="package://cart/cart.stl"/></geometry></visual>
    <collision><origin xyz="0.1 0 0.2"/><geometry><box size="0.6 0.4 0.3"/></geometry></collision>
  </link>
  <link name="wheel">
    <collision><geometry><cylinder radius="0.1" length="0.06"/></geometry></collision>
  </link>
  <link name="lidar"/>
  <link name="arm"><collision><geometry><box size="3 3 3"/></geometry></collision></link>
  <joint name="a" type="fixed"><parent link="base_footprint"/><child link="base_link"/></joint>
  <joint name="b" type="continuous"><parent link="base_link"/><child link="wheel"/>
    <origin xyz="0 0.25 0.1" rpy="-1.5707963267948966 0 0"/></joint>
  <joint name="c" type="fixed"><parent link="base_link"/><child link="lidar"/>
    <origin xyz="0.3 0 0.4" rpy="0 0 3.141592653589793"/></joint>
  <joint name="d" type="revolute"><parent link="base_link"/><child link="arm"/></joint>
</robot>"""


def test_outline_covers_base_and_wheels():
    found = of_urdf(RobotText("/robot_description", URDF), "lidar")
    assert not isinstance(found, str)
    # The box reaches from -0.2 to 0.4 m ahead and 0.2 m to the right; the left wheel to 0.28 m.
    assert (found.length_m, found.width_m) == pytest.approx((0.6, 0.48))
    assert found.lidar_x_m == pytest.approx(0.3 - 0.1)  # relative to the middle of the outline
    assert abs(found.lidar_yaw_rad or 0) == pytest.approx(np.pi)
    assert found.source == "shapes of 2 links in /robot_description"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<robot", "is not XML"),
        ("<robot><link name='x'/><link name='y'/></robot>", "none of the links base_link"),
        (URDF.replace("box", "mesh"), "a mesh's size is not in the recording"),
        (URDF.replace("0.6 0.4 0.3", "nan 1e400 x"), "a mesh's size"),
    ],
)
def test_unusable_description_is_reported(text, message):
    found = of_urdf(RobotText("/robot_description", text))
    assert isinstance(found, str)
    assert message in found


def test_parse_footprint():
    found = parse_footprint("0.281x0.306")
    assert (found.length_m, found.width_m) == (0.281, 0.306)
    for text in ("0.3", "1.2.3x4", "0x1", "900x1", "-1x1"):
        with pytest.raises(ConfigError, match="is not LENGTHxWIDTH in metres"):
            parse_footprint(text)


@pytest.mark.skipif(not SHARED.is_dir(), reason="../shared/bags is absent")
@pytest.mark.parametrize(
    ("bag", "length_m", "width_m"),
    [
        ("fleet-turtlebot3/full-topics/rosbag2_2025_11_06-16_53_28", 0.140, 0.178),  # a Burger
        ("turtlebot3-sim-humble", 0.281, 0.306),  # a Waffle Pi
        ("sim-time-husky", 0.990, 0.670),
    ],
)
def test_outlines_match_manufacturer_data(bag, length_m, width_m):
    with open_recording(SHARED / bag) as recording:
        found, notes = footprint_of(descriptions(recording), "base_scan")
    assert found is not None
    assert notes == []
    assert found.length_m == pytest.approx(length_m, abs=0.02)
    assert found.width_m == pytest.approx(width_m, abs=0.02)
