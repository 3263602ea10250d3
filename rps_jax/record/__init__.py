"""What runs leave behind: files written whole or not at all, and who made them.

`files` writes and checks them, `folder` claims and locks a run's folder, `checkpoint` keeps its
finished parts, and `provenance` notes command, versions, device and commit, for which alone JAX is
imported.
"""
