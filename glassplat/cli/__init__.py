"""The command line.

What the user can mend is an InputError or an OSError of a path, whose message says how; `console.ending` prints it.
"""
