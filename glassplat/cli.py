"""The command line: `glassplat train | eval | render | dereflect | demo | bench`."""

from __future__ import annotations

import logging
import sys
from collections.abc import Sequence
from typing import Annotated, Any

import torch
import tyro
from rich.console import Console
from rich.logging import RichHandler

from glassplat.commands.arguments import check_arguments
from glassplat.commands.bench import Bench
from glassplat.commands.demo import Demo
from glassplat.commands.dereflect import Dereflect
from glassplat.commands.evaluate import Evaluate
from glassplat.commands.render import Render
from glassplat.commands.train import Train
from glassplat.commands.train_options import train_command
from glassplat.data.errors import InputError
from glassplat.data.options import check_options
from glassplat.init.planes import PlaneFitError
from glassplat.kernels.devices import CudaUnavailableError
from glassplat.train.trainer import TrainingDivergedError

INPUT_ERRORS = (
    InputError,
    PlaneFitError,
    CudaUnavailableError,
    FileNotFoundError,
    NotADirectoryError,
    PermissionError,
)
GOES_ON = "interrupted; everything saved so far is intact: train --resume, or the same demo or bench command, goes on"
INPUT_ERROR_CODE, FAILURE_CODE, INTERRUPTED_CODE = 2, 1, 130


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs one command; returns the exit code (0 done, 1 failed, 2 bad input, 130 interrupted)."""
    arguments = sys.argv[1:] if arguments is None else arguments
    try:
        check_arguments(arguments)
    except InputError as error:
        return refused(error)
    train, arguments = train_command(arguments)
    any_command: Any = (
        Annotated[train, tyro.conf.subcommand("train")]
        | Annotated[Evaluate, tyro.conf.subcommand("eval")]
        | Annotated[Render, tyro.conf.subcommand("render")]
        | Annotated[Dereflect, tyro.conf.subcommand("dereflect")]
        | Annotated[Demo, tyro.conf.subcommand("demo")]
        | Annotated[Bench, tyro.conf.subcommand("bench")]
    )
    command = tyro.cli(
        any_command,
        prog="glassplat",
        description="Gaussian splatting for scenes with window panes, showcases and mirrors.",
        args=arguments,
        config=(tyro.conf.CascadeSubcommandArgs, tyro.conf.OmitSubcommandPrefixes),
    )
    console = Console()
    logging.basicConfig(
        level=logging.INFO, format="%(message)s", handlers=[RichHandler(console=console, show_path=False)]
    )
    return guarded(command, console)


def guarded(command: Train | Evaluate | Render | Dereflect | Demo | Bench, console: Console) -> int:
    """Runs a command and turns expected errors into one readable message and an exit code."""
    try:
        check_options(command)
        command.run(console)
    except INPUT_ERRORS as error:
        return refused(error)
    except (TrainingDivergedError, OSError) as error:
        Console(stderr=True).print(f"[red]stopped:[/red] {error}", highlight=False)
        return FAILURE_CODE
    except torch.OutOfMemoryError as error:
        reason = str(error).split(". ")[0]
        remedy = "pass a larger --downscale, cap the Gaussians, or use --device cpu; the last checkpoint stays"
        Console(stderr=True).print(f"[red]stopped:[/red] {reason}; {remedy}", highlight=False)
        return FAILURE_CODE
    except KeyboardInterrupt:
        Console(stderr=True).print(GOES_ON, highlight=False)
        return INTERRUPTED_CODE
    return 0


def refused(error: Exception) -> int:
    """Says what is wrong with the input; returns the exit code."""
    Console(stderr=True).print(f"[red]error:[/red] {error}", highlight=False)
    return INPUT_ERROR_CODE


if __name__ == "__main__":
    sys.exit(main())
