"""Types of options, options that several commands share, and the examples below a help text."""

import math
import os
from collections.abc import Callable, Collection, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import partial, wraps
from pathlib import Path
from typing import Any

import click

from zsp_lite.choices import FACETS, MASKS


@dataclass(eq=False)
class Parsed(click.ParamType):
    """Type of an option.

    `parse` converts its text, `valid` tells whether the value can be used, and `expected` says in
    an error message what can be.
    """

    name: str  # as in the help text
    parse: Callable[[str], Any]
    expected: str
    valid: Callable[[Any], bool] = bool

    def convert(self, value, parameter, context):
        with suppress(ValueError):
            parsed = self.parse(value)
            if self.valid(parsed):
                return parsed
        self.fail(f"got {value!r}, expected {self.expected}", parameter, context)


COUNT = click.IntRange(1, 1_000_000)
INDEX = click.IntRange(min=0)
PATH = Parsed("path", Path, "a path", lambda path: "\0" not in str(path))
NAMES = Parsed(
    "a,b",
    parse=lambda text: [name for name in text.split(",") if name],
    expected="names separated by commas",
)
LENGTH = Parsed("metres", float, "a positive number below 1e9", lambda length: 0 < length < 1e9)
BOX = Parsed(
    "top,left,height,width",
    parse=lambda text: tuple(map(int, text.split(","))),
    valid=lambda box: len(box) == 4,
    expected="four integers",
)
INTRINSICS = Parsed(
    "fx,fy,cx,cy",
    parse=lambda text: tuple(map(float, text.split(","))),
    # The nine are those of K, row by row.
    valid=lambda values: len(values) in (4, 9) and all(map(math.isfinite, values)),
    expected="four numbers, or K",
)
UP = Parsed(
    "x,y,z",
    # `open_source` takes zeros to mean that no vertical is used.
    parse=lambda text: (0.0,) * 3 if text == "none" else tuple(map(float, text.split(","))),
    valid=lambda values: len(values) == 3 and all(map(math.isfinite, values)),
    expected="three numbers, or none",
)


def examples(*lines: str) -> str:
    """Return the end of a help text: one example of the command per line."""
    return "\b\nExamples:\n" + "\n".join(f"  zsp-lite {line}" for line in lines)


class Once(click.Command):
    """A command that refuses an option given twice, unless it may be repeated."""

    def parse_args(self, context, args):
        # The parser returns values, arguments, and the options as often as they stand in `args`.
        *_, given = self.make_parser(context).parse_args([*args])
        for option in given:
            if given.count(option) > 1 and not option.multiple:
                raise click.UsageError(f"{option.opts[0]} is given twice, expected once", context)
        return super().parse_args(context, args)


def refuse_options(given: Mapping[str, Any], taken: Collection[str], by: str) -> None:
    """Raise click.UsageError if an option was given that is not among those `taken`; `by` names
    what takes them."""
    for name, value in given.items():
        if value and name not in taken:
            raise click.UsageError(f"--{name.replace('_', '-')} does not go with {by}")


category_option = click.option(
    "--category", metavar="NAME", required=True, help="Name of the category."
)
replace_option = click.option(
    "--replace", is_flag=True, help="Replace existing files that have other content."
)


def _one_thread(context, option, name):
    """Let the default backbone, which is small, compute with one thread: more are slower. The
    user's setting stays. Libraries read it when they are imported, so that this option is eager."""
    if name == option.default:
        os.environ.setdefault("OMP_NUM_THREADS", "1")
    return name


def backbone_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add --backbone, --layer, --facet and --image-size; the command gets `backbone`, which
    `as_backbone` takes."""

    @click.option(
        "--backbone",
        "name",
        default="zsp-tiny",  # `load.DEFAULT`, whose module is slow to import
        is_eager=True,
        callback=_one_thread,
        help="Name of `weights list`, file, hf:NAME, module:thing.",
    )
    @click.option(
        "--layer",
        show_default="the backbone's own",
        help="Block of the descriptors: block0, ..., last.",
    )
    @click.option(
        "--facet", type=click.Choice(FACETS), default="key", help="Activation of that block to use."
    )
    @click.option(
        "--image-size",
        type=COUNT,
        show_default="usually 224",
        help="Side of the network's input in pixels.",
    )
    @wraps(command)
    def with_backbone(name, layer, facet, image_size, **others):
        from zsp_lite.backbones.named import named_backbone

        return command(backbone=named_backbone(name, layer, facet, image_size), **others)

    return with_backbone


workers_option = click.option("--workers", type=COUNT, default=1, help="Worker processes.")


def source_options(multiple: bool) -> Callable[..., Any]:
    """Add the options of `open_source` that images and captures have, once or for each of several
    objects."""
    option = partial(click.option, multiple=multiple)
    options = [
        option(
            "--mask",
            type=click.Choice(MASKS),
            help="given: mask files; box: by GrabCut; auto: by depth, colours.",
        ),
        option(
            "--box",
            type=BOX,
            help="Bounding box of the object in the first image in pixels, for GrabCut.",
        ),
        option(
            "--intrinsics",
            type=INTRINSICS,
            help="Of an image, a recording or TUM; pixel centres at half-integers.",
        ),
        option("--label", type=INDEX, help="Number of the object in masks that label several."),
        option(
            "--orientation",
            type=click.Choice(("stored", "displayed")),
            help="How depth, mask and camera refer to a photograph with EXIF.",
        ),
        option(
            "--depth-unit",
            type=LENGTH,
            help="Metres per stored depth value: 0.001 for millimetres.",
        ),
        option("--object", type=INDEX, help="Number of the object in a scene of BOP."),
    ]

    def decorate(command: Callable[..., Any]) -> Callable[..., Any]:
        # The last decorator is the first option of the help text.
        for add_option in reversed(options):
            command = add_option(command)
        return command

    return decorate
