"""The command `zsp-lite models`: check and correct the orientation of textured meshes."""

from pathlib import Path

import click

from zsp_lite.cli.common import PATH, examples


@click.group(
    no_args_is_help=False,
    subcommand_metavar="ACTION ...",
    epilog=examples("models sheet path/to/models", "models turn path/to/models chair/oak --about up --degrees 90"),
)
def models() -> None:
    """Check and correct the orientation of your own 3D models."""


@models.command(epilog=examples("models sheet path/to/models --out outputs/models.html"))
@click.argument("folder", type=PATH)
@click.option("--out", type=PATH, metavar="FILE", default="outputs/models.html", help="HTML file to write.")
def sheet(folder: Path, out: Path) -> None:
    """Write a page with three pictures of every model: three-quarter view, front and left side.

    FOLDER holds CATEGORY/NAME.EXT or CATEGORY/NAME/FILE.EXT with EXT one of obj, glb, gltf, ply, stl, dae.
    """
    from tqdm import tqdm

    from zsp_lite.synthetic.model_sheet import write_contact_sheet

    print_left_out(write_contact_sheet(folder, out, tqdm))
    print(f"Written: {out}")


@models.command(
    epilog=examples(
        "models turn path/to/models chair/oak --about up --degrees 90",
        "models turn path/to/models chair/oak --about left --degrees -90",
    )
)
@click.argument("folder", type=PATH)
@click.argument("model", metavar="CATEGORY/NAME")
@click.option("--about", type=click.Choice(("front", "left", "up")), default="up", help="Axis of the rotation.")
@click.option(
    "--degrees", type=float, required=True, metavar="A",
    help="Angle, counter-clockwise as seen from the tip of the axis.",
)  # fmt: skip
def turn(folder: Path, model: str, about: str, degrees: float) -> None:
    """Rotate a model: write its new orientation to FOLDER/models.json."""
    from zsp_lite.synthetic.models import turn_model

    info = turn_model(folder, model, about, degrees)
    print(f"{model}: front {info.front}, up {info.up} in the axes of its file")


def print_left_out(reasons: dict[str, str]) -> None:
    """Print the models that were left out, each with its reason."""
    for key, reason in reasons.items():
        print(f"Left out {key}: {reason}")
