"""Training: stages as data, one loop without method names, typed messages out."""
