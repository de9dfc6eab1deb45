"""`realsim completion`: what a shell needs to complete commands, options and plan names."""

import os

import click
from click import shell_completion

from realsim.app.command import Command

SHELLS = ("bash", "zsh", "fish")
VARIABLE = "_REALSIM_COMPLETE"
"""The variable by which the shell asks for completions; click's own name."""


class ColonBash(shell_completion.BashComplete):
    """Completion in bash, which takes `shipped:NAME` for three words.

    The colon is one of the characters at which readline breaks words (COMP_WORDBREAKS): the words
    are joined again before they are completed, and only what follows the colon is answered.
    """

    def get_completion_args(self) -> tuple[list[str], str]:
        """Return the words before the incomplete one, and that one whole."""
        args, incomplete = super().get_completion_args()
        words = _joined([*args, incomplete])
        self._before_colon = len(words[-1].rpartition(":")[0]) + 1 if ":" in words[-1] else 0
        return words[:-1], words[-1]

    def format_completion(self, item: shell_completion.CompletionItem[str]) -> str:
        """Leave out what bash has on the line already."""
        item.value = str(item.value)[self._before_colon :] if self._before_colon else item.value
        return super().format_completion(item)

    _before_colon = 0
    """Characters of the incomplete word up to its last colon."""


def _joined(words: list[str]) -> list[str]:
    """Return the words with those around a colon as one."""
    joined: list[str] = []
    for word in words:
        if joined and (word.startswith(":") or joined[-1].endswith(":")):
            joined[-1] += word
        else:
            joined.append(word)
    return joined


def add_bash_completion() -> None:
    """Let bash's requests be answered by `ColonBash`."""
    if VARIABLE in os.environ:
        shell_completion.add_completion_class(ColonBash, "bash")


@click.command(
    "completion",
    cls=Command,
    examples=("realsim completion bash", "realsim completion zsh", "realsim completion fish"),
)
@click.argument("shell", type=click.Choice(SHELLS))
def completion_command(shell: str) -> None:
    """Print the script that completes commands, options and plan names in SHELL.

    \b
    bash   echo 'eval "$(realsim completion bash)"' >> ~/.bashrc
    zsh    echo 'eval "$(realsim completion zsh)"' >> ~/.zshrc
    fish   realsim completion fish > ~/.config/fish/completions/realsim.fish

    Open a new shell afterwards.
    """  # noqa: D301 - click's own mark for lines that stay as they are
    kind = shell_completion.get_completion_class(shell)
    assert kind is not None, "click knows all three"
    click.echo(kind(click.Group(), {}, "realsim", VARIABLE).source())
