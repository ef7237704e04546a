"""ROS bags: ROS 1, and ROS 2 as sqlite3 and MCAP, read by rosbags."""

from terrainloop.io.bags.recording import open_bag_recording

__all__ = ["open_bag_recording"]
