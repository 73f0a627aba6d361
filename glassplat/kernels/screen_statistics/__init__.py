"""What the views of a step saw of each Gaussian, added up for densification."""

from glassplat.kernels.screen_statistics.operation import add_views
from glassplat.kernels.screen_statistics.views import Sums, Views

__all__ = ["Sums", "Views", "add_views"]
