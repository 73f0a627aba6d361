"""Plain data: Gaussians, cameras, planes and the scene that holds them. Nothing here renders."""
