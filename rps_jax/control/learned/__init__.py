"""Laws learned from touch: what they are told, their network, and the files that hold them.

`observation` makes numbers of what the skin's taxels and odometry tell, `network` is the function
that is learned and the law made of it, and `policy` reads and writes it. It is learned in `tuning`.
"""
