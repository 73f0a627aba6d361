"""Readers and writers of exchange formats: splat files, planes, cameras, images.

Readers raise FileNotFoundError for a missing file, and ValueError for one that is unreadable, damaged or of another
kind. Writers raise ValueError for data that the format cannot store. The message names the file.
"""
