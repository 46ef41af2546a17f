"""The command `estimate`: the pose between two objects of the user's own."""

from pathlib import Path

import click

from zsp_lite.choices import MASKS, SOLVERS
from zsp_lite.cli.common import (
    COUNT,
    PATH,
    SEED,
    backbone_config,
    backbone_options,
    examples,
    four_integers,
    four_numbers,
    out_option,
    positive,
)

_TWICE = "May be given twice: for REFERENCE, then for TARGET."


@click.command(
    epilog=examples(
        "estimate data_samples/motorcycle/scooter data_samples/motorcycle/scooter2",
        "estimate path/to/scan path/to/other_scan --box 120,200,300,280 --box 90,160,320,300",
        "estimate my_cup.jpg other_cup.jpg --intrinsics 600,600,320,240 --solver both",
        "estimate my_cup.jpg path/to/scan --intrinsics 600,600,320,240 --mask auto --json",
    )
)
@click.argument("reference", type=PATH)
@click.argument("target", type=PATH)
@click.option("--solver", type=click.Choice(SOLVERS), default="verified", help="Solver of the pose.")
@click.option(
    "--reference-frame", type=SEED, metavar="N", show_default="the first with an object and depth",
    help="Number of the reference frame in its sequence or capture.",
)  # fmt: skip
@click.option("--targets", type=COUNT, metavar="N", default=5, help="Number of target views, evenly spaced.")
@click.option(
    "--mask", type=click.Choice(MASKS), multiple=True, show_default="box with --box, else given, else auto",
    help="Masks of the objects: given with the images, GrabCut from a box, or auto: what stands on a plane, found from "
    f"depth alone. {_TWICE}",
)  # fmt: skip
@click.option(
    "--box", type=four_integers, metavar="T,L,H,W", multiple=True,
    help="Bounding box of the object in the first image in pixels: top, left, height, width. Once for REFERENCE, "
    "twice for both; for TARGET alone once, with --mask given --mask box (or auto, box).",
)  # fmt: skip
@click.option(
    "--intrinsics", type=four_numbers, metavar="FX,FY,CX,CY", multiple=True,
    help="Camera intrinsics of an image, or of a capture in TUM's format, in pixels, with pixel centres at "
    f"half-integers (0.5 more than OpenCV's cx and cy). Once for both. {_TWICE}",
)  # fmt: skip
@click.option(
    "--depth", type=PATH, metavar="FILE", multiple=True, show_default="NAME_depth.png or NAME_depth.npy beside it",
    help="Depth of the image NAME.jpg, registered to its colours: a 16-bit PNG or .npy. With two images twice.",
)  # fmt: skip
@click.option(
    "--depth-unit", type=positive, metavar="M", multiple=True, show_default="0.001",
    help="Metres per stored depth value of an image, or of a capture given as lists: 0.001 for millimetres, 1 for "
    f"metres. Once for both. {_TWICE}",
)  # fmt: skip
@click.option(
    "--not-upright", is_flag=True,
    help="The reference image may be turned, as phones store pictures: try its four turns by 90 degrees.",
)  # fmt: skip
@click.option("--json", "as_json", is_flag=True, help="Print JSON instead of tables.")
@backbone_options
@out_option("outputs/estimate", "Folder for the report and the point clouds.")
def estimate(
    reference: Path, target: Path, solver: str, reference_frame: int | None, targets: int, mask: tuple[str, ...],
    box: tuple[tuple[int, ...], ...], intrinsics: tuple[tuple[float, ...], ...], depth: tuple[Path, ...],
    depth_unit: tuple[float, ...], not_upright: bool, as_json: bool, out: Path, **backbone,
) -> None:  # fmt: skip
    """Estimate the pose between two objects of one category; no label is needed.

    REFERENCE and TARGET are each a sequence of a data folder (ROOT/CATEGORY/SEQUENCE), the folder of a capture (see
    `zsp-lite data import --help`), or an image NAME.jpg with its depth NAME_depth.png and, if there is one, its mask
    NAME_mask.png.

    The pose maps points of the reference camera to points of the camera of the chosen target view. OUT gets
    report.html and point clouds: target.ply, and aligned_SOLVER.ply, the reference after the pose. Where the verified
    solver cannot decide between two poses, the report shows both, and aligned_SOLVER_2.ply is the other. Where both
    are labelled sequences of one category, the rotation error is shown too.
    """
    import matplotlib

    matplotlib.use("Agg")  # figures are written to files, without a display
    import json

    from zsp_lite.backbones.load import load_backbone
    from zsp_lite.io.locks import writing
    from zsp_lite.own_objects import estimate_pose, open_pair, write_pair

    options = {"mask": mask, "box": box, "intrinsics": intrinsics, "depth": depth, "depth_unit": depth_unit}
    with writing(out):
        sources = open_pair(reference, target, options)
        model = load_backbone(backbone_config(**backbone))
        found = estimate_pose(*sources, solver, reference_frame, targets, backbone=model, upright=not not_upright)
        files = write_pair(found, out)
    if as_json:
        print(json.dumps(found.as_json() | {"files": [str(path) for path in files]}, indent=1, allow_nan=False))
    else:
        _print_tables(found)
        for path in files:
            print(f"Written: {path}")


def _print_tables(found) -> None:
    """Print the answers, the other hypotheses, the matrices and the flags."""
    from rich.console import Console
    from rich.table import Table

    from zsp_lite.viz.report import COLUMNS, legend, table_rows

    console, labelled = Console(markup=False, highlight=False), bool(found.errors)
    kept = [k for k, name in enumerate(COLUMNS) if k > 0 and (labelled or name != "error")]
    table = Table(title=f"Pose from {found.title}, backbone {found.backbone}")
    for column in [*(COLUMNS[k] for k in kept), "scale"]:
        table.add_column(column, justify="left" if column == "solver" else "right")
    for row, one in zip(table_rows(found), found.estimates.values()):
        table.add_row(*(row[k] for k in kept), f"{one.sim3.scale:.3f}")
    console.print(f"Reference: {found.sources[0]} (mask: {found.masks[0]})", soft_wrap=True)
    console.print(f"Target: {found.sources[1]} (masks: {found.masks[1]})", soft_wrap=True)
    console.print(table)
    console.print(legend([COLUMNS[k] for k in kept]))
    for solver, one in found.estimates.items():
        view = f"view {one.view + 1} ({found.targets[one.view].name})"
        console.print(f"{solver}: reference-camera points to camera points of {view}")
        for line in one.sim3.matrix:
            console.print("  " + " ".join(f"{value:10.5f}" for value in line))
        if one.reference_turn:
            console.print(f"  features of the reference turned by {one.reference_turn}° counterclockwise")
        for other in one.alternatives:
            console.print(
                f"  hypothesis {other.rank}: turned by {other.angle:.0f}° from the best, "
                f"score {other.deficit:.1f} nats below it, probability {other.probability:.2f}"
            )
        for flag in one.flags:
            console.print(f"  flag: {flag}", soft_wrap=True)
    if found.disagreement is not None:
        console.print(f"The rotations of both solvers differ by {found.disagreement:.0f}°.")
    if not labelled:
        console.print("No pose labels: the rotation error is unknown.")
