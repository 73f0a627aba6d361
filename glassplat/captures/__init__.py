"""Readers of captures: photographs, poses, masks and points in the formats of other programs.

Unusable data raise an InputError whose message names the file and the remedy. A missing capture or file raises a
FileNotFoundError.
"""
