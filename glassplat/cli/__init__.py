"""The command line.

Here, and in `annotate`, `prepare` and `viewer`, what the user can mend is an InputError, a ValueError of a file or an
OSError of a path, whose message says how; `console.classify_error` prints it.
"""
