"""Studies of laws: one question in each file, with its report and figures."""
