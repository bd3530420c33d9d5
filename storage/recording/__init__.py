"""Recordings in MCAP files: written in Foxglove's schemas, read back from them and from ROS 2 bags."""
