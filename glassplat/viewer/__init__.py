"""Looking at a scene in the browser while this program renders it."""
