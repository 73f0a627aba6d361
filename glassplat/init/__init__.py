"""The first scene from data: points to Gaussians, masks to planes and glass."""
