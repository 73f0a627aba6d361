"""Scenes and photographs for others, and scenes from others."""
