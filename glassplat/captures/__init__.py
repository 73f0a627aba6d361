"""Captures: photographs, poses, masks and points, in the formats that others write."""
