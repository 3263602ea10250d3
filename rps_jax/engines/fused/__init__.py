"""engines.fused."""
