"""Files of runs: atomic writing, checksums, run folders, checkpoints, provenance and options."""
