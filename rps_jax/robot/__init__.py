"""The robot: what its skin feels, and what its base believes and does.

`shell` is the base's outline and where its skin has boards; there `skin` turns the gap between base
and object into a contact, by an ideal sensor or by taxels. `base` is its odometry, the delays and
errors with which it follows a twist, and the load that it feels. `robot` has all that and the
limits of a base, with some robots that exist, and `drive` what these make of a twist.
"""
