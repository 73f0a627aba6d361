"""Panes marked by hand: corners in a few photographs become planes, masks and a page in the browser to do it in."""
