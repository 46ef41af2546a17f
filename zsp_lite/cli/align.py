"""The command `align`: a whole category in one frame."""

from pathlib import Path

import click

from zsp_lite.cli.common import (
    COUNT,
    NAMES,
    PATH,
    Once,
    Parsed,
    backbone_options,
    category_option,
    examples,
    replace_option,
    workers_option,
)


def _read_mark(text: str):
    """Read the mark of --mark."""
    from zsp_lite.scans.marks import Mark  # slow to import, and most calls have no mark

    return Mark.parse(text)


def _read_axes(text: str):
    """Read the tail and the tip of --axes: names of marks, or marks of their own."""
    name, given, arrow = text.partition(":front=")
    if not given:
        tail, tip = text.split(",")
        return tail, tip
    tail_x, tail_y, tip_x, tip_y = arrow.split(",")  # each x has its frame before it: FRAME:X
    tail = _read_mark(f"{name}:{tail_x},{tail_y}:tail of --axes")
    return tail, _read_mark(f"{name}:{tip_x},{tip_y}:tip of --axes")


@click.command(
    cls=Once,
    epilog=examples(
        "align path/to/scans --category cup",
        "align data_samples --category car --out outputs/cars --propose",
    ),
)
@click.argument("data", type=PATH)
@category_option
@click.option(
    "--sequences", type=NAMES, show_default="all of the category", help="Sequences, one per object."
)
@click.option(
    "--pairs",
    type=COUNT,
    show_default="all; 6 from twelve objects on",
    help="Partners of each object.",
)
@click.option(
    "--out",
    type=PATH,
    show_default="outputs/align/NAME",
    help="Folder; an existing run is continued.",
)
@click.option(
    "--propose",
    is_flag=True,
    help="Write the labels into DATA as proposals, which notebook 08 shows.",
)
@click.option(
    "--mark",
    "marks",
    type=Parsed(
        "sequence:frame:x,y[:name]",
        parse=_read_mark,
        expected="SEQUENCE:FRAME:X,Y or SEQUENCE:FRAME:X,Y:NAME",
    ),
    multiple=True,
    help="A pixel with depth to find on all objects; may be repeated.",
)
@click.option(
    "--axes",
    type=Parsed(
        "tail,tip",
        parse=_read_axes,
        expected="SEQUENCE:front=FRAME:X,Y,FRAME:X,Y or the names of two marks",
    ),
    help="An arrow to the front: two marks by name, or SEQUENCE:front=FRAME:X,Y,FRAME:X,Y.",
)
@replace_option
@workers_option
@backbone_options
def align(
    data, category, sequences, pairs, out, propose, marks, axes, replace, backbone, workers
) -> None:
    """Align all objects of a category in one frame. No label is needed.

    DATA is a data folder, or a folder with a capture of each object (see `zsp-lite data import
    --help`).

    Every object gets a similarity from its world to the common frame, and the probability that its
    rotation is within 30 degrees of the one that most objects agree with. OUT gets them as
    alignment.json, as pose labels in class_labels/CATEGORY/, which `zsp-lite data labels OUT --root
    DATA` takes, and as pictures in report.html. With fewer than five objects, or where objects look
    alike from two sides, some may be turned round against the rest: look at the report. Pose labels
    and proposals that DATA has already, such as those of uCO3D, are compared with the result.

    A pixel of one object, --mark, is found on all others: OUT gets marks.json, marks.jpg,
    marks/SEQUENCE.ply with balls in each object's world, and a section of the report.

    An arrow between two places of one object, --axes, names the front: alignment.json gets
    world_to_axes, the rigid pose of each object with x to the front, y to the left and z up, by the
    floor or the cameras of that scan. The origin is amid the objects. Lengths are those of DATA; of
    scans those of OUT/data, in which each object has unit standard deviation, not metres.
    """
    from zsp_lite.cli.terminal import print_rows
    from zsp_lite.data.co3d import Co3D
    from zsp_lite.data.labels import read_label_folder
    from zsp_lite.errors import check_choice
    from zsp_lite.importers.convert import import_captures
    from zsp_lite.metrics import SAME_ANGLE, accuracy
    from zsp_lite.objects.align import (
        align_category,
        alignment_errors,
        remove_outputs,
        write_alignment,
        write_labels,
    )
    from zsp_lite.scans.marks import (
        category_axes,
        marked_points,
        place_marks,
        read_front,
        write_marks,
    )
    from zsp_lite.viz.category_sheet import COLUMNS, object_rows
    from zsp_lite.viz.report import write_category_report

    out = out or Path("outputs/align") / category
    if data.is_dir() and not Co3D(data).categories():
        for name, imported in import_captures(data, out / "data", category):
            for flag in imported.flags:
                print(f"{name}: {flag}")
        data = out / "data"
    dataset = Co3D(data)
    # Refuses wrong marks and axes before minutes of computing.
    marked_points(dataset, category, marks, sequences)
    if axes:
        named = {mark.name: mark for mark in marks}
        for end in axes:
            if isinstance(end, str):
                check_choice("--axes: name of a --mark of this command", end, named)
        tail, tip = (named.get(end, end) for end in axes)
        marked_points(dataset, category, (tail, tip), sequences)
        front = read_front(dataset, category, tail, tip)
    alignment = align_category(
        dataset, category, backbone, sequences, pairs, out=out, executor=workers
    )
    frame = category_axes(alignment, tail.sequence, front) if axes else None
    placed = place_marks(alignment, dataset, category, marks, backbone) if marks else []
    remove_outputs(out, category)  # those that are not written again would be of other objects
    written = [
        write_alignment(alignment, out, frame),
        write_labels(alignment, out, category, replace=True),
        write_category_report(out / "report.html", alignment, dataset, category, placed, frame),
        out / "objects.jpg",  # written with the report, as is marks.jpg
    ]
    if placed:
        written += [write_marks(placed, dataset, category, out), out / "marks.jpg", out / "marks"]
    title = f"{category}: {len(alignment.objects)} objects in one frame"
    print_rows(title, COLUMNS, object_rows(alignment))
    if axes:
        print(f"Axes: world_to_axes of each object in {written[0]}, in the lengths of {data}")
    for one in placed:
        places = [
            (name, f"{100 * place.confidence:.0f}" if place.found else "nothing here")
            for name, place in one.places.items()
            if name != one.mark.sequence
        ]
        print_rows(f"Mark {one.mark.name}", ("object", "right (%)"), places)
    for (first, second), angle in alignment.disagreements.items():
        print(f"{first} to {second}: the best pose of the pair alone is {angle:.0f}° away")
    for kind, what in (("class_labels", "pose labels"), ("label_proposals", "proposals")):
        labels = read_label_folder(dataset.root / kind / category)
        errors = alignment_errors(alignment, labels)
        if errors:
            right = accuracy(errors, SAME_ANGLE)
            print(
                f"By the {what}, {right:.1f}% of {len(errors)} ordered pairs are within "
                f"{SAME_ANGLE:.0f}° in the common frame."
            )
    if propose:
        written.append(write_labels(alignment, dataset.root, category, "label_proposals", replace))
    for path in written:
        print(f"Written: {path}")
