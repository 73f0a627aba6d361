"""Models that are rendered, edited and saved; training runs and their directories."""
