"""The laws that RPS is compared with: by touch alone, by force, and by sight of the object.

Each file is one law, written from its authors' equations, with `init`, `step`, `check` and BOUNDS.
"""
