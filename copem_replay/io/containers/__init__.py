"""The files recordings come in: MCAP, sound or damaged; rosbag2 folders; OSI traces."""
