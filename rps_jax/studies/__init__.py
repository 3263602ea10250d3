"""Questions with an answer: each file is one study, resumable, with its table.

`study` runs the paper's trials under any conditions. The scripts in `sweeps/` and `rps paper` call
these files, and a new study is one more of them.
"""
