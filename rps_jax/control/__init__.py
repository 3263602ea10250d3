"""What decides: the paper's law, its rivals, laws learned from touch, and laws of one's own.

`base` says what a law is and `observation` what it observes and commands. Each file of `laws` is
one law; `learned` has those that were learned, and `registry` finds a law by its text. Nothing
here knows MuJoCo.
"""
