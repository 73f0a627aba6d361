"""Panes fitted to masks: planes, rectangles, glass and mirrors."""
