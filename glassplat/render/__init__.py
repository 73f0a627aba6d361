"""Renderers: one file per method, each a frozen dataclass `(scene, camera) -> Frame`."""
