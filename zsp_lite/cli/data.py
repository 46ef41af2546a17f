"""The commands that look after data: `label` and `data check`, `data labels`, `data carry`, `data import`."""

import argparse
import math
from pathlib import Path

from zsp_lite.cli.main import _command, _count, _names, _positive
from zsp_lite.errors import InputError


def add_label(commands) -> None:
    parser = _command(
        commands, "label", _label, "label poses in Open3D's picking window: keypoints, overlay, accept or redo",
        ["label path/to/co3d chair", "label path/to/co3d chair --guess", "label path/to/co3d chair --list",
         "label path/to/co3d chair --contact-sheet outputs/chairs.png"],
    )  # fmt: skip
    parser.add_argument("root", type=Path, metavar="ROOT", help="a folder in CO3D's layout")
    parser.add_argument("category", metavar="CATEGORY")
    parser.add_argument("--reference", metavar="SEQ", help="default: the sequence with the best point cloud")
    parser.add_argument("--sequences", type=_names, metavar="A,B,...", help="default: the ten with the best clouds")
    parser.add_argument("--guess", action="store_true", help="let the method propose each alignment first")
    parser.add_argument(
        "--backbone", default="zsp-tiny", metavar="NAME", help="of the guess: as for `benchmark` (default: zsp-tiny)"
    )
    parser.add_argument("--list", action="store_true", help="print how far each sequence is, and open no window")
    parser.add_argument("--contact-sheet", type=Path, metavar="PNG", help="draw the candidates, and open no window")


def _label(arguments: argparse.Namespace) -> None:
    from zsp_lite.labelling import Labelling

    labelling = Labelling(arguments.root, arguments.category, arguments.sequences, arguments.reference)
    if arguments.contact_sheet:
        if arguments.contact_sheet.suffix.lower() != ".png":
            raise InputError(f"--contact-sheet is {arguments.contact_sheet}, expected the name of a .png file")
        import matplotlib

        matplotlib.use("Agg")
        from zsp_lite.labelling.candidates import contact_sheet

        chosen = {one.sequence_name: one for one in labelling.dataset.sequences(arguments.category)}
        figure = contact_sheet(labelling.dataset, arguments.category, [chosen[name] for name in labelling.sequences])
        arguments.contact_sheet.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(arguments.contact_sheet, dpi=110)
        print(f"Written: {arguments.contact_sheet}")
    if arguments.list or not arguments.contact_sheet:
        for row in labelling.progress():
            residual = "" if row.rms is None else f", residual {100 * row.rms:.1f} % of their spread"
            picks = (
                "label given, not clicked" if row.state == "accepted" and not row.picks else f"{row.picks} keypoints"
            )
            print(f"{row.sequence:24} {row.state:10} {picks}{residual}")
    if arguments.list or arguments.contact_sheet:
        return
    from zsp_lite.labelling.desktop import label_category

    guess = None
    if arguments.guess:
        from zsp_lite.backbones.load import load_backbone
        from zsp_lite.labelling.guess import guess_alignment

        backbone = load_backbone(arguments.backbone)

        def guess(sequence: str) -> None:
            found = guess_alignment(labelling.dataset, backbone, labelling.category, labelling.reference, sequence)
            print(f"{sequence}: guessed, {100 * found[1]:.0f} % sure")
            labelling.guess(sequence, found[0])

    label_category(labelling, _ask, print, guess)


def _ask(question: str) -> str:
    try:
        return input(question)
    except EOFError as error:
        raise InputError("no terminal to answer in, expected one") from error


def add_data(commands) -> None:
    parser = _command(
        commands, "data", lambda arguments: parser.error("expected one of check, labels, carry, import"),
        "check a CO3D folder, bring upstream's labels, carry labels to v2, import captures",
        ["data check path/to/co3d", "data labels path/to/clone --root path/to/co3d",
         "data carry path/to/v1 path/to/v2 chair",
         "data import nerfstudio path/to/scan --root mine --category cup --sequence cup_1 --box 120,200,300,280"],
    )  # fmt: skip
    parts = parser.add_subparsers(title="actions", metavar="ACTION", parser_class=type(parser))

    check = _command(
        parts, "check", _check, "what is there, missing or broken, how much can be evaluated, and the disk it takes; "
        "exit code 1 where something is wrong", ["data check path/to/co3d", "data check path/to/co3d --deep"],
    )  # fmt: skip
    check.add_argument("root", type=Path, metavar="ROOT")
    check.add_argument("--deep", action="store_true", help="decode every file as well: slow on large folders")
    check.add_argument("--show", type=_count, default=5, metavar="N", help="problems shown of a category (default: 5)")

    labels = _command(
        parts, "labels", _bring, "bring upstream's labels and evaluation pairs into a data folder",
        ["data labels path/to/clone --root path/to/co3d",
         "data labels https://HOST/archive.zip --sha256 DIGEST --root path/to/co3d"],
    )  # fmt: skip
    labels.add_argument("source", metavar="SOURCE", help="a local clone, an archive of it, or an archive's URL")
    labels.add_argument("--root", type=Path, required=True, metavar="DIR", help="the data folder")
    labels.add_argument("--sha256", metavar="DIGEST", help="of the archive; a URL needs it")
    _may_replace(labels)

    carry = _command(
        parts, "carry", _carry, "carry labels made on CO3D v1 to v2 by the camera centres of the same frames",
        ["data carry path/to/v1 path/to/v2 chair"],
    )  # fmt: skip
    carry.add_argument("source", type=Path, metavar="V1")
    carry.add_argument("target", type=Path, metavar="V2")
    carry.add_argument("category", metavar="CATEGORY")
    carry.add_argument(
        "--max-residual", type=_positive, default=0.05, metavar="SHARE",
        help="refuse where the centres differ by more than this share of their spread (default: 0.05)",
    )  # fmt: skip
    _may_replace(carry)

    bring = _command(
        parts, "import", _import, "import a capture as a sequence: tum, nerfstudio, open3d, or plain lists",
        ["data import tum path/to/scan --root mine --category cup --sequence cup_1 --box 120,200,300,280",
         "data import open3d path/to/scan --root mine --category cup --sequence cup_2 --masks path/to/masks"],
    )  # fmt: skip
    bring.add_argument("format", choices=("tum", "nerfstudio", "open3d", "lists"))
    bring.add_argument("source", type=Path, metavar="FOLDER")
    bring.add_argument("--root", type=Path, required=True, metavar="DIR", help="the data folder, new or old")
    bring.add_argument("--category", required=True, metavar="NAME")
    bring.add_argument("--sequence", required=True, metavar="NAME")
    bring.add_argument(
        "--box", type=_whole_numbers, metavar="T,L,H,W",
        help="the object in the first picture, pixels: top, left, height, width; GrabCut finds it in all",
    )  # fmt: skip
    bring.add_argument("--masks", type=Path, metavar="DIR", help="mask files with their pictures' names instead")
    bring.add_argument("--frames", type=_count, default=100, metavar="N", help="at most so many, evenly (default: 100)")
    bring.add_argument(
        "--intrinsics", type=_numbers, metavar="FX,FY,CX,CY", help="of a tum folder (default: that benchmark's default)"
    )
    bring.add_argument(
        "--depth-unit",
        type=_positive,
        metavar="M",
        help="of plain lists: world units per stored value (default: 0.001)",
    )


def _may_replace(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--replace", action="store_true", help="replace files that are there with other content")


def _check(arguments: argparse.Namespace) -> int:
    from rich.console import Console
    from rich.table import Table
    from tqdm import tqdm

    from zsp_lite.benchmark.plan import size
    from zsp_lite.data.check import check_folder

    checks = check_folder(arguments.root, arguments.deep, lambda names: tqdm(names, "checking", disable=None))
    table = Table(title=f"{arguments.root}: {len(checks)} categories, {size(sum(check.size for check in checks))}")
    for column in ("category", "layout", "sequences", "complete", "labelled", "usable", "pairs", "frames", "disk"):
        table.add_column(column, justify="left" if column in ("category", "layout") else "right", no_wrap=True)
    for check in checks:
        counts = (check.sequences, check.complete, check.labelled, check.usable, check.pairs, check.frames)
        table.add_row(check.category, check.layout, *(f"{count:,}" for count in counts), size(check.size))
    Console(width=max(Console().width, 100)).print(table)
    for check in checks:
        for problem in check.problems[: arguments.show]:
            print(f"{check.category}: {problem}")
        if (more := len(check.problems) - arguments.show) > 0:
            print(f"{check.category}: and {more} more")
    wrong = sum(len(check.problems) for check in checks)
    depth = "decoded" if arguments.deep else "there and not empty (--deep decodes them)"
    print(f"{wrong} problems." if wrong else f"No problems: every annotated file is {depth}.")
    return 1 if wrong else 0


def _bring(arguments: argparse.Namespace) -> None:
    from zsp_lite.data.label_import import import_labels

    counts = import_labels(arguments.source, arguments.root, arguments.sha256, arguments.replace)
    print(f"Written to {arguments.root}: {counts['class_labels']} labels, {counts['determ_eval']} files of pairs")


def _carry(arguments: argparse.Namespace) -> None:
    from zsp_lite.data.label_import import transfer_labels

    residuals = transfer_labels(
        arguments.source, arguments.target, arguments.category, arguments.max_residual, arguments.replace
    )
    for name, residual in residuals.items():
        print(f"{name:24} camera centres agree to {100 * residual:.2f} % of their spread")
    print(f"Written: {len(residuals)} labels of {arguments.category} in {arguments.target}")


def _import(arguments: argparse.Namespace) -> None:
    from zsp_lite.importers import READERS, import_capture

    given = {"intrinsics": arguments.intrinsics, "depth_unit": arguments.depth_unit}
    taken = {"tum": "intrinsics", "lists": "depth_unit"}.get(arguments.format)
    options = {name: value for name, value in given.items() if value is not None}
    if wrong := sorted(set(options) - {taken}):
        raise InputError(f"--{wrong[0].replace('_', '-')} does not go with the format {arguments.format}")
    done = import_capture(
        READERS[arguments.format](arguments.source, **options), arguments.root, arguments.category,
        arguments.sequence, arguments.box, arguments.masks, arguments.frames,
    )  # fmt: skip
    print(
        f"Written: {arguments.root / arguments.category / arguments.sequence}: {done.frames} frames, {done.points:,} "
        f"points, lengths times {done.scale:.4g}"
        + (f"; {done.empty} frames without the object left out" if done.empty else "")
    )


def _whole_numbers(text: str) -> tuple[int, ...]:
    values = _numbers(text)
    if any(value != int(value) for value in values):
        raise argparse.ArgumentTypeError(f"is {text!r}, expected whole numbers")
    return tuple(int(value) for value in values)


def _numbers(text: str) -> tuple[float, ...]:
    try:
        values = tuple(float(word) for word in text.split(","))
    except ValueError:
        values = ()
    if len(values) != 4 or not all(math.isfinite(value) for value in values):
        raise argparse.ArgumentTypeError(f"is {text!r}, expected four numbers separated by commas")
    return values
