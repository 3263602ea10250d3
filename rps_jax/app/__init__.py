"""User interfaces: the command line, the viewer in the browser, films, and the doctor.

`cli` holds the commands, `viewer` and `drawing` show a live push, `film` shows many trials side by
side, `notebooks` copies notebooks, and `doctor` says what works on this machine. Nothing imports
this room.
"""
