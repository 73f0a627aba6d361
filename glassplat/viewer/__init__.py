"""Viewer in the browser: this program renders the scene, the browser shows the images and controls."""
