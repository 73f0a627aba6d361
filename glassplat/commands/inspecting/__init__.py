"""What a folder or file is."""
