"""What commands have in common: the run that they open, edits of its scene, and the folder that pictures go to."""
