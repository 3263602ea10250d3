"""Control laws: the paper's law, its baselines and rivals, learned laws, and the registry."""
