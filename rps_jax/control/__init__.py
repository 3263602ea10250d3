"""What decides: the paper's law, its baselines, and strategies of one's own.

`law` is the Reactive Pushing Strategy, `aps` the baseline that sees the object, and `strategies`
finds a strategy by its name, by its parameters or in a user's file. Nothing here knows MuJoCo.
"""
