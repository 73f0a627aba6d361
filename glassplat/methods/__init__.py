"""Methods: their recipes and training stages."""
