"""What leaves the house: pages and films of a scene."""
