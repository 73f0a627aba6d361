"""Pictures of a scene: in the browser, as a film, layer by layer."""
