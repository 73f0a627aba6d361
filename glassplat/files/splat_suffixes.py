"""How the names of splat files end that are read."""

SPLAT_SUFFIXES = (".ply", ".spz", ".glb", ".splat")
