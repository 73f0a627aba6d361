"""What `import glassplat` offers: load, look, edit, train and save. The commands are written on top of it."""
