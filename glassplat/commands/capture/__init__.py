"""From photographs to a capture with marked panes."""
