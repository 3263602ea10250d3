"""A pushing law on a robot: the controller without ROS."""
