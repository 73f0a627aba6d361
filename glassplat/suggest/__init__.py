"""Panes proposed from photographs and poses alone: what they mirror is found a second time, seen directly."""
