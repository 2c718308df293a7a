"""``ssm-graph completion``: what a shell needs to complete commands, options and files."""

from __future__ import annotations

import argparse
from typing import Any, Final

from rich.console import Console

from ssm_graph.base.errors import MissingExtraError

SHELLS: Final = ("bash", "zsh", "tcsh")
DESCRIPTION = """\
Print a script that lets a shell complete commands, options, choices and files. For bash:

  ssm-graph completion bash > ~/.local/share/bash-completion/completions/ssm-graph

for zsh put the output as _ssm-graph into a folder of $fpath. Needs the extra 'completion'.
"""


def declare(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    parser.add_argument("shell", choices=SHELLS, help="which shell")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace, console: Console, _: Console) -> bool:
    """Print the script."""
    from ssm_graph.cli.main import whole_parser

    try:
        import shtab
    except ImportError as error:
        purpose = "completion in a shell"
        raise MissingExtraError("shtab", extra="completion", purpose=purpose) from error
    parser = whole_parser()
    _complete_files(parser, shtab.FILE)
    # A script is no text for people: nothing of it is wrapped.
    console.file.write(shtab.complete(parser, arguments.shell) + "\n")
    return True


def _complete_files(parser: argparse.ArgumentParser, files: Any) -> None:
    """Have every argument that is a path completed by files."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for inner in action.choices.values():
                _complete_files(inner, files)
        elif getattr(action.type, "__name__", "") == "Path":
            action.complete = files  # type: ignore[attr-defined]
