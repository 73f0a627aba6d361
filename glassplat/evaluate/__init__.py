"""Metrics of a trained scene, LPIPS, comparison sheets and the overview page."""
