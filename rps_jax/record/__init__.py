"""What runs leave behind: files written whole or not at all, and who made them."""
