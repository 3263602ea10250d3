"""One file a law: its parameters, its two functions, and a `LAW` that says what it is.

The registry finds every file here by itself. `PRESETS` names the parameters by which a law is
known; a name that begins with an underscore is not offered.
"""
