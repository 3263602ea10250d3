"""The paper's own experiments: its table, its hardware, what it leaves open, all in one report."""
