"""``terrainloop info``: what it prints, as JSON and as a table, and how it ends."""

import json

import numpy as np
import pytest
from bags_util import START, write_bag

POINTS = np.random.default_rng(0).uniform(-5, 5, (60, 3))


def drive(make):
    for i in range(4):
        yield "/odom", START + i, make.odometry(START + i, (i, 0, 0))
        yield "/points", START + i, make.cloud(START + i, POINTS, "lidar")


def only_clouds(make):
    return (item for item in drive(make) if item[0] == "/points")


def only_poses(make):
    return (item for item in drive(make) if item[0] == "/odom")


def test_a_bag_that_can_be_used(cli, tmp_path):
    code, out, err = cli("info", write_bag(tmp_path, "mcap", drive))
    assert code == 0, err
    for words in (
        "ROS 2 bag (MCAP)",
        "/odom",
        "base_link in odom",
        "sensor_msgs/msg/PointCloud2",
        "1700000003",
    ):
        assert words in out
    assert "Note: no TF from 'lidar' to 'base_link'" in out
    assert out.endswith("It can be used: 4 scans of a LiDAR.\n")


def test_several_files_as_json(cli, tmp_path):
    (tmp_path / "b").mkdir()
    paths = [write_bag(tmp_path, "ros1", only_clouds), write_bag(tmp_path / "b", "ros1", only_poses)]
    code, out, err = cli("info", *paths, "--json")
    assert code == 0, err
    found = json.loads(out)
    assert found["usable"]
    assert (found["kind"], found["sensor"], found["scans"]) == ("ROS 1 bag", "lidar", 4)
    by_name = {stream["name"]: stream for stream in found["streams"]}
    assert by_name["/points"] == {
        "name": "/points",
        "type": "sensor_msgs/msg/PointCloud2",
        "count": 4,
        "frame": "lidar",
        "start": pytest.approx(START),
        "end": pytest.approx(START + 3),
        "use": "scans",
    }
    assert found["missing"] == []


def test_what_is_missing_is_no_error(cli, tmp_path):
    code, out, _ = cli("info", write_bag(tmp_path, "sqlite3", only_clouds))
    assert code == 0
    assert "Missing: no odometry: run an odometry on the scans" in out
    assert out.endswith("It cannot be used as it is.\n")


def test_a_mission(cli, mission_folder):
    code, out, _ = cli("info", mission_folder, "--json")
    assert code == 0
    assert json.loads(out)["kind"] == "mission of submaps"


@pytest.mark.parametrize("options", [(), ("--cloud-topic", "/nothing"), ("--sensor-frame", "mast")])
def test_bad_input_ends_with_2_and_one_line(options, cli, tmp_path):
    path = write_bag(tmp_path, "mcap", drive) if options else tmp_path / "nothing.bag"
    code, out, err = cli("info", path, *options)
    assert (code, out) == (2, "")
    assert err.startswith("terrainloop: expected ")
    assert err.count("\n") == 1


def test_quiet(cli, tmp_path):
    assert cli("info", write_bag(tmp_path, "mcap", drive), "-q") == (0, "", "")


def test_names_from_a_bag_do_not_steer_the_terminal(cli, tmp_path):
    def odd(make):
        return (("/[red]\x1b[31m" if topic == "/odom" else topic, *rest) for topic, *rest in drive(make))

    code, out, _ = cli("info", write_bag(tmp_path, "ros1", odd))
    assert code == 0
    assert "\x1b" not in out
    assert "/[red]\\x1b[31m" in out
