"""The command `estimate`: the pose between two objects of the user's own."""

import json
from typing import Any

import click

from zsp_lite.choices import SOLVERS
from zsp_lite.cli.common import (
    COUNT,
    INDEX,
    PATH,
    UP,
    Once,
    backbone_options,
    examples,
    source_options,
)


class _Estimate(Once):
    """The command `estimate`, whose option --helpers takes all paths up to the next option."""

    def parse_args(self, context, args):
        words = []
        several = False
        for word in args:
            if word.startswith("-"):
                several = word == "--helpers"
            elif several and words[-1] != "--helpers":
                words.append("--helpers")
            words.append(word)
        return super().parse_args(context, words)


@click.command(
    cls=_Estimate,
    epilog=examples(
        "estimate data_samples/motorcycle/scooter data_samples/motorcycle/scooter2",
        "estimate path/to/scan path/to/other_scan --box 120,200,300,280 --box 90,160,320,300",
        "estimate my_cup.jpg path/to/scan --intrinsics 600,600,320,240 --mask auto --json",
        "estimate path/to/scan path/to/other_scan --helpers path/to/third_scan path/to/fourth_scan",
    ),
)
@click.argument("reference", type=PATH)
@click.argument("target", type=PATH)
@click.option(
    "--helpers",
    type=PATH,
    multiple=True,
    metavar="C [D ...]",
    help="Other objects, up to the next option.",
)
@click.option(
    "--solver", type=click.Choice(SOLVERS), default="verified", help="Solver of the pose."
)
@click.option(
    "--reference-frame",
    type=INDEX,
    show_default="first usable",
    help="Number in the name of its image; of CO3D, one less.",
)
@click.option(
    "--references",
    type=COUNT,
    show_default="4; 1 with --reference-frame",
    help="Frames of each object that are solved at most.",
)
@click.option(
    "--targets", type=COUNT, show_default="5", help="Number of target views, evenly spaced."
)
@source_options(multiple=True)
@click.option(
    "--depth",
    type=PATH,
    multiple=True,
    help="Depth of an image, if it is not beside it. Once per image.",
)
@click.option(
    "--up",
    type=UP,
    multiple=True,
    show_default="by format, or the floor",
    help="Vertical of the world, or none. Once per object.",
)
@click.option("--workers", type=COUNT, default=1, help="Frames that are solved at once.")
@click.option(
    "--not-upright", is_flag=True, help="Try four turns by 90 degrees of the reference images."
)
@click.option("--json", "as_json", is_flag=True, help="Print JSON instead of tables.")
@backbone_options
@click.option(
    "--out",
    type=PATH,
    default="outputs/estimate",
    help="Folder for the report and the point clouds.",
)
@click.option("--no-report", is_flag=True, help="Write the point clouds only.")
def estimate(
    reference,
    target,
    helpers,
    solver,
    reference_frame,
    references,
    targets,
    workers,
    not_upright,
    as_json,
    backbone,
    out,
    no_report,
    **once_per_object,
) -> None:
    """Estimate the pose between two objects of one category. No label is needed.

    REFERENCE and TARGET are each a sequence of a data folder (ROOT/CATEGORY/SEQUENCE), the folder
    or zip of a capture (see `zsp-lite data import --help`), or an image NAME.jpg, .png or .webp
    with its depth NAME_depth.png and, if there is one, its mask NAME_mask.png or .jpg.

    The options from --mask to --object may be given once for each object: REFERENCE, TARGET, then
    helpers. A single value is for all, a single --box for REFERENCE, or for the one whose --mask is
    box. By default, masks are given, or made by depth where there are none. Intrinsics may also be
    the 9 numbers of K in rows; cx and cy are 0.5 more than OpenCV's. Depth is a 16-bit PNG or TIFF,
    .npy, .npz, float .tiff or .pfm, registered to the colours.

    --helpers are scans of other objects of the category, without labels: what the pair alone cannot
    tell, such as front from back, all objects together mostly can.

    The pose maps points of the reference camera to points of the camera of the chosen target view;
    both cameras are those of the images as viewers display them, by their EXIF orientation, which
    makes a portrait upright. OUT gets report.html and point clouds: target.ply, and
    aligned_SOLVER.ply, the reference after the pose. Where the verified solver cannot decide
    between two poses, the report shows both, and aligned_SOLVER_2.ply is the other. Where both are
    labelled sequences of one category, the rotation error is shown too.
    """
    from zsp_lite.objects.estimate import estimate_pose

    if helpers and solver != "verified":
        raise click.UsageError("--helpers goes with --solver verified only")
    result = estimate_pose(
        reference,
        target,
        solver,
        reference_frame,
        targets,
        backbone=backbone,
        out=out,
        upright=not not_upright,
        references=references,
        helpers=helpers,
        workers=workers,
        report=not no_report,
        options=once_per_object,
    )
    if as_json:
        printed = {**result.as_json(), "files": [str(path) for path in result.files]}
        print(json.dumps(printed, indent=1, allow_nan=False))
    else:
        _print_tables(result)
        for path in result.files:
            print(f"Written: {path}")


def _print_tables(result: Any) -> None:
    """Print the answers of a `PairResult`, the other hypotheses, the matrices and the flags."""
    from zsp_lite.cli.terminal import print_rows
    from zsp_lite.viz.table import COLUMNS, legend, table_rows

    print(f"Reference: {result.sources[0]} (mask: {result.masks[0]})")
    print(f"Target: {result.sources[1]} (masks: {result.masks[1]})")
    # Without the first column, the name of the pair, which is in the title.
    rows = [row[1:] for row in table_rows(result)]
    print_rows(f"Pose from {result.title}, backbone {result.backbone}", COLUMNS[1:], rows)
    print(legend([name for name in COLUMNS[1:] if name != "error" or result.errors]))
    for solver, pose in result.estimates.items():
        view = f"view {pose.view + 1} ({result.targets[pose.view].name})"
        matrices = {
            f"camera points of {result.reference.name} to those of {view}": pose.sim3,
            "world points of the reference to those of the target": pose.world_sim3,
        }
        for points, sim3 in matrices.items():
            print(f"{solver}: {points}")
            for line in sim3.matrix:
                print("  " + " ".join(f"{value:10.5f}" for value in line))
        for rank, other in enumerate(pose.alternatives, 2):
            print(
                f"  hypothesis {rank}: turned by {pose.angle_to(other):.0f}° from the best, "
                f"score {other.score - pose.hypotheses[0].score:+.1f} nats, probability "
                f"{other.confidence:.2f}"
            )
        for flag in pose.flags:
            print(f"  flag: {flag}")
    if result.disagreement is not None:
        print(f"The rotations of both solvers differ by {result.disagreement:.0f}°.")
    if not result.errors:
        print("No pose labels: the rotation error is unknown.")
