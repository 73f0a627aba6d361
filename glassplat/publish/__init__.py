"""Publishing: pages and films of a scene."""
