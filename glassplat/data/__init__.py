"""Captures: photographs, poses, pane masks and points, from any of the formats people have."""
