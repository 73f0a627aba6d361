"""What is refused of a command line of `train` before its methods are imported, whose options only they know."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path

from glassplat.files.folders import check_capture_folder
from glassplat.interface.layers import LAYERS
from glassplat.train.run_directory import RunDirectory, check_output

HELP, FULL_HELP = ("-h", "--help"), "--help-advanced"


def check_places(arguments: Sequence[str]) -> None:
    """Refuses a capture that is not there, and an output that something would be lost in.

    What it does not understand it leaves to the parser, as it does questions for help.

    Raises:
        FileNotFoundError: there is no capture.
        InputError, NotADirectoryError, PermissionError: as `check_output` does.
    """
    if {*HELP, FULL_HELP} & set(arguments) or not LAYERS.keys() & set(arguments):
        return
    output, data = last_value(arguments, "--output"), last_value(arguments, "--data")
    if output:
        resumes = [argument == "--resume" for argument in arguments if argument in ("--resume", "--no-resume")]
        check_output(RunDirectory(Path(output)), resume=resumes[-1:] == [True])
    if data:
        check_capture_folder(Path(data))


def last_value(arguments: Sequence[str], option: str) -> str | None:
    """The value that arguments give to an option last; None where they give none."""
    found = None
    for before, argument in itertools.pairwise(["", *arguments]):
        if argument.startswith(f"{option}="):
            found = argument.removeprefix(f"{option}=")
        elif before == option and not argument.startswith("-"):
            found = argument
    return found
