"""Laws learned from touch: what they observe, their network, and the files that hold them."""
