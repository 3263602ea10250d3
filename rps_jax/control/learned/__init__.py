"""Laws learned from touch: their observations, their network, and the files that hold them."""
