"""Files that others can read: splat PLY, planes, cameras, images."""
