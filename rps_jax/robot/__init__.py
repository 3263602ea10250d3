"""The robot: what its skin feels, and what its base believes and does.

`skin` turns the gap between base and object into a contact, by an ideal sensor or by 42 taxels.
`base` is its odometry and the delays and errors with which it follows a twist. `robot` has the
limits of a base, with some that exist, and `drive` what these make of a twist.
"""
