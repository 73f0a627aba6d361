"""What is refused of a command line before any command looks at it."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

from glassplat.data.errors import InputError


def check_arguments(arguments: Sequence[str]) -> None:
    """Refuses empty arguments after a command: as a path, an empty text is the folder that it was started in.

    Raises:
        InputError: an argument is empty; says which.
    """
    for before, argument in itertools.pairwise(arguments):
        option, is_joined, value = argument.partition("=")
        if argument == "" or (option.startswith("--") and is_joined and not value):
            name = option or before
            raise InputError(f"what follows {name} is empty, as of a shell variable that is not set; expected a value")
