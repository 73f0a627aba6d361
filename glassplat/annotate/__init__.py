"""Manual marking of panes in the browser: corners in a few photographs become planes and masks."""
