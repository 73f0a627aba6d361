"""What `import glassplat` offers."""
