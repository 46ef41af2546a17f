"""Option types, shared options and the examples under a help text, used by every command.

The command line uses click and not typer: click's usage errors are public classes that `main` can print as one line,
and `--help` does not import pydantic.
"""

import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import click

from zsp_lite.backbones.facets import FACETS

if TYPE_CHECKING:
    from zsp_lite.backbones.load import BackboneConfig

Command = TypeVar("Command", bound=Callable)

COUNT = click.IntRange(1, 1_000_000)
SEED = click.IntRange(min=0)


class _Path(click.Path):
    """A path as `pathlib.Path`; an empty one, and null bytes, which no file system has, are refused."""

    def convert(self, value, parameter, context):
        if "\0" in str(value):
            self.fail(f"got {value!r}, expected a path without null bytes", parameter, context)
        if not str(value):
            self.fail("got an empty path", parameter, context)
        return Path(super().convert(value, parameter, context))


PATH = _Path()


def names(text: str) -> list[str]:
    """Parse "A,B" into ["A", "B"]."""
    found = [name.strip() for name in text.split(",") if name.strip()]
    if not found:
        raise click.BadParameter(f"got {text!r}, expected names separated by commas")
    return found


def positive(text: str | float) -> float:
    """Parse a positive, finite number."""
    value = _number(text)
    if not 0 < value < math.inf:
        raise click.BadParameter(f"got {text!r}, expected a positive number")
    return value


def four_numbers(text: str) -> tuple[float, ...]:
    """Parse "A,B,C,D" into four finite numbers."""
    values = tuple(_number(word) for word in text.split(","))
    if len(values) != 4 or not all(map(math.isfinite, values)):
        raise click.BadParameter(f"got {text!r}, expected four numbers separated by commas")
    return values


def four_integers(text: str) -> tuple[int, ...]:
    """Parse "A,B,C,D" into four integers."""
    values = four_numbers(text)
    if any(value != int(value) for value in values):
        raise click.BadParameter(f"got {text!r}, expected four integers separated by commas")
    return tuple(int(value) for value in values)


def _number(text: str | float) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan


def examples(*lines: str) -> str:
    """Return the end of a help text: one example of the command per line."""
    return "\b\nExamples:\n" + "\n".join(f"  zsp-lite {line}" for line in lines)


def out_option(default: str | None, text: str) -> Callable[[Command], Command]:
    """Return the option --out, a folder to write."""
    return click.option("--out", type=PATH, metavar="DIR", default=default, help=text)


seed_option = click.option("--seed", type=SEED, metavar="SEED", default=0, help="Seed of every random draw.")
replace_option = click.option("--replace", is_flag=True, help="Replace existing files that have other content.")


def backbone_options(command: Command) -> Command:
    """Add --backbone, --layer, --facet and --image-size to a command; `backbone_config` takes their values."""
    options = (
        click.option(
            "--backbone", metavar="NAME", default="zsp-tiny",
            help="zsp-tiny, dino_vits8, dino_vits16, dino_vitb8, dino_vitb16, a checkpoint file, or hf:NAME for a "
            "vision transformer from the Hugging Face hub or a local folder in its format.",
        ),
        click.option(
            "--layer", metavar="L", show_default="the backbone's own",
            help="Transformer block that gives the descriptors: block0, block1, ..., last, or a number. The published "
            "code uses block9.",
        ),
        click.option(
            "--facet", type=click.Choice(FACETS), default="key",
            help="Activation of that block used as descriptor; the paper uses the keys.",
        ),
        click.option(
            "--image-size", type=COUNT, metavar="PX", show_default="the checkpoint's, usually 224",
            help="Input size of the backbone in pixels, rounded to a multiple of the patch size.",
        ),
    )  # fmt: skip
    for option in reversed(options):
        command = option(command)
    return command


def backbone_config(backbone: str, layer: str | None, facet: str, image_size: int | None) -> "str | BackboneConfig":
    """Return what `load_backbone` takes: the name alone where every other option has its default."""
    from zsp_lite.backbones.load import BackboneConfig

    config = BackboneConfig(backbone, layer, facet, image_size)
    return backbone if config == BackboneConfig(backbone) else config
