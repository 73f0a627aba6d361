"""Names that `import glassplat` offers."""
