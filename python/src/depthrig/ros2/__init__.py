"""A running rig as ROS 2 topics, without ROS: `depthrig-ros2` speaks the format of `rmw_zenoh`.

ROS 2 nodes with `RMW_IMPLEMENTATION=rmw_zenoh_cpp` (Jazzy or later) see images, depth, points, IMUs, `/tf_static`,
`/diagnostics` and the robot's signals; topics of ROS 2 become signals of the rig with `--subscribe`. docs/ros2.md.
"""
