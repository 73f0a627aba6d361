"""What commands print, how they follow work, and how they end."""
