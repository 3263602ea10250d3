"""What runs leave behind: files written whole or not at all, run folders, and who made them."""
