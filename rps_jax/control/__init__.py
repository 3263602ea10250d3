"""What decides: the paper's law, its rivals, laws learned from touch, and laws of one's own."""
