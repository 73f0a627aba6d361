"""The command line `glassplat`, with the commands in `COMMANDS`.

A command's module is imported only when the command is chosen, so that the list of commands appears at once and Ctrl-C
works from the start. PyTorch and the code that does the work are imported by the command's method `set_up`, after its
options and paths were checked.
"""

from __future__ import annotations

import importlib
import re
import sys
from collections.abc import Mapping, Sequence
from contextlib import nullcontext, redirect_stderr, redirect_stdout, suppress
from dataclasses import field, make_dataclass
from io import StringIO
from typing import Annotated, Any, NamedTuple, Union

from glassplat.errors import InputError, RankLostError

FAILURE_CODE, USAGE_CODE, INTERRUPTED_CODE, BROKEN_PIPE_CODE = 1, 2, 130, 141
"""The last two are those that shells report after Ctrl-C or a closed pipe."""
DESCRIPTION = "Gaussian splatting for scenes with window panes, showcases and mirrors."


class Command(NamedTuple):
    """Entry of the list of commands: module in this package, class, and first sentence of its docstring."""

    module: str
    kind: str
    summary: str


COMMANDS = {
    "prepare": Command("capture", "Prepare", "Estimate the camera poses of photographs and write them as a capture."),
    "annotate": Command(
        "capture",
        "Annotate",
        "Mark the panes of a capture in the browser: their corners in a few photographs, and what occludes them.",
    ),
    "train": Command("train", "Train", "Train a scene from photographs."),
    "eval": Command("scene", "Evaluate", "Evaluate a run on its test views and write comparison sheets."),
    "render": Command("scene", "Render", "Render the layers of a run from its cameras, with original or edited panes."),
    "dereflect": Command(
        "scene",
        "Dereflect",
        "Remove the reflections from the photographs of a planar run; writes one PNG per photograph.",
    ),
    "clean": Command("scene", "Clean", "Remove floaters from a scene and scale it to metres; writes a new scene."),
    "view": Command("scene", "View", "View a scene in the browser, layer by layer, with original or edited panes."),
    "video": Command(
        "scene", "Video", "Render a video along a camera path: one layer, several side by side, or a wipe between two."
    ),
    "export": Command(
        "scene", "Export", "Export a scene to PLY, SPZ, GLB or a web page with live panes, along with its panes."
    ),
    "info": Command("info", "Info", "Describe a folder or file, check it, and suggest the next step."),
    "demo": Command(
        "train",
        "Demo",
        "Train planar and splat on the bundled shop window and compare them; continues an interrupted demo.",
    ),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs one command; returns the exit code.

    The code is 0 for success, 1 for failure, 2 for bad input, 130 for Ctrl-C (143 and 129 for SIGTERM and SIGHUP), and
    141 for a closed output pipe.

    Raises:
        SystemExit: after help.
    """
    try:
        return run_guarded(sys.argv[1:] if arguments is None else list(arguments), is_program=arguments is None)
    except KeyboardInterrupt:  # Before handlers are installed, or while the end is reported.
        print("interrupted", file=sys.stderr)
        return INTERRUPTED_CODE
    except Exception as error:  # noqa: BLE001 - Even the report failed, as it can when out of memory.
        reason = "out of memory" if isinstance(error, MemoryError) else type(error).__name__
        print(f"stopped: {reason}", file=sys.stderr)
        return FAILURE_CODE


def run_guarded(arguments: list[str], *, is_program: bool) -> int:
    """Runs a command so that a failure ends in one readable message and an exit code; ranks exit at once."""
    from glassplat.training.ranks import exit_at_once

    try:
        code = run_to_exit_code(arguments, is_program=is_program)
    except SystemExit as end:
        if is_program and end.code:
            exit_at_once(USAGE_CODE)
        raise
    if is_program:
        exit_at_once(code)
    return code


def run_to_exit_code(arguments: list[str], *, is_program: bool) -> int:
    """Runs a command and reports how it ended; returns the exit code."""
    from glassplat.cli import console
    from glassplat.training.ranks import await_leader, is_leader, report_failure

    console.make_streams_robust()
    is_training = arguments[:1] == ["train"]
    if is_training and not is_leader():
        console.silence_output()
    command = None
    with console.raise_on_signals(is_program=is_program) as raised:
        try:
            with console.exit_on_signals() if is_program else nullcontext():
                command = prepare_command(arguments)
            run(command)
        except KeyboardInterrupt as stop:
            return report_interrupt(stop, command)
        except SystemExit:
            raise
        except BrokenPipeError:
            console.drop_output()
            return BROKEN_PIPE_CODE
        except BaseException as error:  # noqa: BLE001 - The last guard against tracebacks.
            is_lost = isinstance(error, RankLostError)
            if raised and not is_lost:
                return report_interrupt(raised[-1], command)
            end = console.classify_error(error)
            if command is not None and not is_lost and console.is_shortage(error):
                end = end._replace(text=f"{end.text}; {command.interrupt_message()}")
            with suppress(OSError):  # Fails if the output is full or closed.
                console.print_error(end.label, end.text)
            if is_training and not is_lost:
                report_failure(*end)
            await_leader()
            return end.code
    return 0


def prepare_command(arguments: list[str]) -> Any:
    """The command that the arguments describe, with its inputs checked and its modules imported.

    Raises:
        InputError, OSError: an option is unknown or out of range, a path does not exist, or it must not be overwritten.
        SystemExit: as in `parse_arguments`.
    """
    command = parse_arguments(arguments)
    command.set_up()
    return command


def parse_arguments(arguments: list[str]) -> Any:
    """The command that the arguments describe.

    Raises:
        InputError: the command is unknown, or an option is unknown, missing or out of range.
        SystemExit: they ask for help or the version.
    """
    import tyro

    from glassplat.cli.console import check_arguments, unknown_name_message, versions
    from glassplat.options import check_options

    if arguments[:1] == ["--version"]:
        print(versions())
        raise SystemExit(0)
    name = arguments[0] if arguments else ""
    if name in COMMANDS:
        check_arguments(arguments)
        command = parse_options(name, arguments[1:])
        check_options(command)
        return command
    complete = name.startswith("--tyro-")
    if not complete and name not in ("-h", "--help"):
        raise InputError(unknown_name_message("command", name, COMMANDS, "glassplat --help"))
    # After the list of commands, nothing is run; only shell completion needs every option, as the full help does.
    full = ["--help-advanced"]
    kinds = {known: command_line(known, full)[0] if complete else command_stub(known) for known in COMMANDS}
    tyro.cli(overview_type(kinds), prog="glassplat", description=DESCRIPTION, args=arguments, config=tyro_settings())
    raise SystemExit(USAGE_CODE)


def tyro_settings() -> tuple[Any, ...]:
    """Settings of tyro for all command lines."""
    import tyro

    return tyro.conf.CascadeSubcommandArgs, tyro.conf.OmitSubcommandPrefixes


def parse_options(name: str, arguments: list[str]) -> Any:
    """The command of this name that the arguments describe.

    Raises:
        InputError: an option or method is unknown, a value is invalid, or something is missing.
        SystemExit: they ask for help.
    """
    import tyro

    from glassplat.cli.console import tyro_error_line, wrong_number_message

    kind, options = command_line(name, arguments)
    tyro_output = StringIO()
    try:
        with redirect_stderr(tyro_output):
            command, unknown = tyro.cli(
                kind, prog=f"glassplat {name}", args=options, config=tyro_settings(), return_unknown_args=True
            )
    except SystemExit as end:
        if not end.code:
            raise
        wrong, _, others = tyro_error_line(tyro_output.getvalue()).partition("Unrecognized options: ")
        unknown = others.split()
        if not unknown:
            wrong = wrong_number_message(tyro_output.getvalue(), options) or wrong
            raise InputError(f"{wrong}; {help_pointer(name, options)}") from None
    if unknown:
        raise InputError(unknown_option_message(name, options, unknown))
    return command


def help_pointer(name: str, options: list[str]) -> str:
    """Pointer to the list of all options of a command, or of the method that its options name."""
    if name == "train":
        from glassplat.cli.train import help_of_method

        return help_of_method(options)
    return f"all options: glassplat {name} --help"


def unknown_option_message(name: str, options: list[str], unknown: list[str]) -> str:
    """Message about unknown arguments, with similar ones and the methods that have them."""
    from glassplat.cli.console import closest_words

    option, command, methods = unknown[0].partition("=")[0], f"glassplat {name}", []
    if not option.startswith("-"):
        return f"{command} takes no further argument {option!r}; {help_pointer(name, options)}"
    chosen = []
    if name == "train":
        from glassplat.cli.train import RECIPES, named_method

        chosen = [method for method in [named_method(options)] if method]
        methods = [method for method in RECIPES if [method] != chosen and option in options_in_help(name, [method])]
    known = options_in_help(name, chosen)
    meant = closest_words(option, known, 0.7) or [other for other in known if option.strip("-") in other][:3]
    guess = f"; did you mean {' or '.join(meant)}?" if meant else ";"
    elsewhere = f"; it is an option of {' and '.join(methods)};" if methods else ""
    return f"{' '.join([command, *chosen])} has no option {option}{elsewhere or guess} {help_pointer(name, options)}"


def options_in_help(name: str, words: list[str]) -> list[str]:
    """Options in the full help of a command, given its subcommand."""
    import tyro

    kind, arguments = command_line(name, [*words, "--help-advanced" if name == "train" else "--help"])
    tyro_output = StringIO()
    with redirect_stdout(tyro_output), suppress(SystemExit):
        tyro.cli(kind, prog=f"glassplat {name}", args=arguments, config=tyro_settings())
    return re.findall(r"(?<![\w`-])--[a-z0-9.-]+", re.sub(r"\x1b\[[0-9;]*m", "", tyro_output.getvalue()))


def command_line(name: str, options: list[str]) -> tuple[Any, list[str]]:
    """Type and settings for tyro of a command line; that of `train` depends on its options."""
    if name == "train":
        from glassplat.cli.train import train_command

        return train_command(options)
    return command_class(name), options


def command_class(name: str) -> type:
    """The class of a command, from its module, which is imported now."""
    entry = COMMANDS[name]
    return getattr(importlib.import_module(f"glassplat.cli.{entry.module}"), entry.kind)


def command_stub(name: str) -> type:
    """Entry in the list of commands for one whose module is not imported."""
    return make_dataclass(COMMANDS[name].kind, [], namespace={"__doc__": COMMANDS[name].summary})


def overview_type(kinds: Mapping[str, type]) -> type:
    """Options of `glassplat` itself: one of the commands, or the version."""
    import tyro

    commands: Any = Union[tuple(Annotated[kind, tyro.conf.subcommand(name)] for name, kind in kinds.items())]  # noqa: UP007
    version = tyro.conf.arg(help="show version information and exit", help_behavior_hint="")
    return make_dataclass(
        "Glassplat",
        [
            ("command", Annotated[commands, tyro.conf.arg(name="")]),
            ("version", Annotated[bool, tyro.conf.FlagCreatePairsOff, version], field(default=False)),
        ],
    )


def run(command: Any) -> None:
    """Runs a command whose console also shows log records and warnings."""
    from glassplat.cli.console import message_console, print_log_records

    is_for_programs = getattr(command, "json", False)  # The output is one JSON document, without log lines.
    with print_log_records(message_console(stderr=is_for_programs)):
        command.run(message_console())


def report_interrupt(stop: KeyboardInterrupt, command: Any) -> int:
    """Prints what an interrupted command leaves behind, and how to continue."""
    from glassplat.cli.console import drop_output, interrupt_code, message_console, print_line

    left = "" if command is None else f"; {command.interrupt_message()}"
    try:
        print_line(message_console(stderr=True), f"{str(stop) or 'interrupted'}{left}")
    except OSError:  # The terminal may be closed.
        drop_output()
    return interrupt_code(stop)


if __name__ == "__main__":
    sys.exit(main())
