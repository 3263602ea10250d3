"""What decides: the paper's law, its baselines, and strategies of one's own.

`law` is the Reactive Pushing Strategy, `rps_plus` a law of our own, `rivals` the laws that both are
compared with, `learned` what is learned from touch, and `strategies` finds a strategy by its name,
by its parameters or in a user's file. Nothing here knows MuJoCo.
"""
