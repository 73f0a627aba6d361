"""Captures: photographs, poses, masks and points, in the formats that others write.

What cannot be used of a capture is an InputError, whose message names the file and says what to do; a capture or file
that is not there is a FileNotFoundError.
"""
