"""Write docs/command_line.md from the help of the commands: `python -m tools.command_line`."""

from collections.abc import Iterator
from pathlib import Path

import click

from zsp_lite.cli.main import cli

PAGE = Path(__file__).parents[1] / "docs" / "command_line.md"
HEAD = """# The command line

`zsp-lite COMMAND --help` explains the options of a command and gives examples. `python -m zsp_lite` is the same
program. A wrong input is one line on stderr and exit code 2.
"""


def commands(group: click.Group, name: str = "zsp-lite") -> Iterator[tuple[str, click.Command]]:
    """Yield every command below a group with its full name, in alphabetical order."""
    for word, command in sorted(group.commands.items()):
        if isinstance(command, click.Group):
            yield from commands(command, f"{name} {word}")
        else:
            yield f"{name} {word}", command


def page() -> str:
    """Return the page: of each command the arguments and the first paragraph of its help."""
    text = HEAD
    for name, command in commands(cli):
        usage = " ".join([name, *command.collect_usage_pieces(click.Context(command, info_name=name))[1:]])
        summary = " ".join(command.help.partition("\n\n")[0].split())
        text += f"\n## {usage}\n\n{summary}\n"
    return text


if __name__ == "__main__":
    PAGE.write_text(page())
