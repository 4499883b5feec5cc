"""The online service: a ROS 2 lifecycle node, MAVLink and Zenoh links around one identification session."""
