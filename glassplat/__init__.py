"""glassplat: Gaussian splatting for scenes with window panes, showcases and mirrors."""

__version__ = "0.1.0"
