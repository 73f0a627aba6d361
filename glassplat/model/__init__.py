"""Public names of `import glassplat`."""
