"""`rtcd completion SHELL`: the script by which a shell completes the verbs and all of their options."""

import contextlib
import inspect
import io
from functools import reduce
from importlib import import_module
from inspect import cleandoc
from operator import or_
from typing import Annotated, Any, Literal

import tyro
from pydantic import Field

from rtcd_jax.cli.exits import Exit
from rtcd_jax.cli.options import Branch, Options, Positional, parser, section, shown
from rtcd_jax.system.console import Console


class CompletionOptions(Options):
    """Print the script that lets a shell complete rtcd's commands and options.

    Example: rtcd completion bash > ~/.local/share/bash-completion/completions/rtcd
    Example: rtcd completion zsh > ~/.zfunc/_rtcd
    """

    shell: Annotated[Positional[Literal["bash", "zsh"]], shown("{bash,zsh}")] = Field(description="for which shell")


def completion(options: CompletionOptions, console: Console) -> Exit:
    from rtcd_jax.cli.main import VERBS

    branches: Any = reduce(or_, (_subcommand(name, verb.function, verb.help) for name, verb in VERBS.items()))
    script = io.StringIO()
    with contextlib.suppress(SystemExit), contextlib.redirect_stdout(script):  # tyro prints it and leaves
        parser()(branches, prog="rtcd", args=("--tyro-print-completion", options.shell))
    # Most words that are no option are files.
    console.message(script.getvalue().replace("complete -F ", "complete -o default -F ").rstrip())
    return Exit.OK


def _subcommand(name: str, function: str, help: str) -> Any:
    """A verb and its options as tyro knows them."""
    module, called = function.split(":")
    parameters = inspect.signature(getattr(import_module(module), called), eval_str=True).parameters.values()
    first, *others = parameters
    branch = section(first.annotation, first.annotation.defaults(())) if others else Branch(())
    about = cleandoc(help)
    return Annotated[Branch, tyro.conf.subcommand(name, default=branch, description=about, prefix_name=False)]
