"""Files that others can read: splat PLY, planes, cameras, images.

What reads a file raises FileNotFoundError where there is none and ValueError where it cannot be read, is damaged or of
another kind; what writes one raises ValueError for what the format cannot hold. The message names the file.
"""
