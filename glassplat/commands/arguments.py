"""What is refused of a command line before any command looks at it."""

from __future__ import annotations

from collections.abc import Sequence

from glassplat.data.errors import InputError


def check_arguments(arguments: Sequence[str]) -> None:
    """Refuses empty arguments: as a path, an empty text is the folder that the command was started in.

    Raises:
        InputError: an argument is empty; says which.
    """
    for before, argument in zip(["", *arguments], arguments, strict=False):
        option, is_joined, value = argument.partition("=")
        if argument == "" or (option.startswith("--") and is_joined and not value):
            name = option or before or "the first argument"
            raise InputError(f"what follows {name} is empty, as of a shell variable that is not set; expected a value")
