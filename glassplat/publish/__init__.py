"""Publishing: web pages and videos of a scene, camera paths, and removal of floaters."""
