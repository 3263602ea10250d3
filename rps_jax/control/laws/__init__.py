"""Laws of the package, one file each: parameters, two functions, `LAW` and `PRESETS`.

The registry imports every file here. `PRESETS` maps the names of a law to its parameters; a name
that begins with an underscore is not listed.
"""
