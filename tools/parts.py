"""Measure what each part of the verified solver is worth: the solver without it, on objects of training categories.

Run from the root of the repository; docs/rebuild.md makes the data:

    python -m tools.parts outputs/parts outputs/training_poses:36 outputs/training:36

The tool runs the benchmark on every folder, or continues it, keeps the errors of all pairs in `outputs/parts`, and
prints the differences to the whole solver on the same pairs. The terms `orientation` and `agreement` are left out of
all rows, because they were trained on these objects. Folders with categories of another side (`concepts.csv`) are
refused.
"""

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from tools.concepts import DATA_HELP, check_sides, folder_and_pairs
from zsp_lite.backbones.load import load_backbone
from zsp_lite.backbones.pretrained import DEFAULT
from zsp_lite.benchmark.methods import Method
from zsp_lite.benchmark.results import export_results, read_results
from zsp_lite.benchmark.run import evaluate
from zsp_lite.benchmark.summary import category_of, objects_of
from zsp_lite.benchmark.tables import PValue
from zsp_lite.errors import InputError
from zsp_lite.metrics import accuracy, object_weights, paired_test
from zsp_lite.verified import VerifiedSolver
from zsp_lite.verified.verification import ScoreWeights

WHOLE = "whole"
_SILHOUETTE = ("forward_silhouette", "reverse_silhouette")
_FREE_SPACE = ("forward_free_space", "reverse_free_space")
# Row: the terms that its score lacks, and the settings of the solver.
_PARTS: dict[str, tuple[tuple[str, ...], dict[str, bool]]] = {
    WHOLE: ((), {}),
    "soft ICP": ((), {"icp": False}),
    "refinement": ((), {"refinement": False}),
    "silhouettes": (_SILHOUETTE, {}),
    "free space": (_FREE_SPACE, {}),
    "view term": (("viewpoint",), {}),
    "soft ICP and refinement": ((), {"icp": False, "refinement": False}),
    "silhouettes and free space": ((*_SILHOUETTE, *_FREE_SPACE), {}),
    "silhouettes, free space and view term": ((*_SILHOUETTE, *_FREE_SPACE, "viewpoint"), {}),
}


def rows(names: Sequence[str] = tuple(_PARTS)) -> dict[str, Method]:
    """Return the benchmark's rows: the whole solver, and the solver without one part or several."""
    return {
        name: Method(
            settings={"solver": VerifiedSolver(ScoreWeights().without("orientation", "agreement", *terms), **settings)}
        )
        for name, (terms, settings) in _PARTS.items()
        if name in names or name == WHOLE
    }


def measure(data: Sequence[tuple[Path, int]], out: Path, backbone: str, methods: Mapping[str, Method]) -> list[Path]:
    """Run rows on folders of data, or continue, and export each run.

    Args:
        data: Folders, and how many pairs to take of each of their categories.
        out: Folder of the runs and their exports.
        backbone: Name of the backbone.
        methods: The rows.

    Returns:
        The exported files, OUT/NAME.json.gz for a folder NAME.

    Raises:
        InputError: A folder has a category that is not for training, or two folders have the same name.
    """
    folders = [folder for folder, _ in data]
    check_sides(folders, "training")
    if len({folder.name for folder in folders}) < len(folders):
        raise InputError(f"folders {', '.join(map(str, folders))}: expected different names")
    loaded, written = load_backbone(backbone), []
    for folder, pairs in data:
        run = out / folder.name
        evaluate(folder, loaded, methods, pairs=pairs, out=run)
        written.append(export_results(read_results(run), out / f"{folder.name}.json.gz"))
    return written


def read_errors(files: Sequence[Path]) -> dict[str, dict[str, float]]:
    """Return the rotation errors in degrees by row and pair of several exported runs."""
    errors: dict[str, dict[str, float]] = {}
    for results in map(read_results, files):
        for name in _PARTS:
            if name in results.rows:
                errors.setdefault(name, {}).update(results.errors(name))
    return errors


def differences(errors: Mapping[str, Mapping[str, float]]) -> dict[str, dict[str, float]]:
    """Compare every row with the whole solver on the same pairs.

    Returns:
        For each row Acc30 in percent, the change of Acc30 with its interval over objects, the pairs that only the row
        ("won") and only the whole solver ("lost") solve, and the p value of the sign test over these.
    """
    keys = list(errors[WHOLE])
    weights = object_weights([objects_of(key) for key in keys], [category_of(key) for key in keys])

    def column(name: str) -> Float[np.ndarray, " n"]:
        return np.array([errors[name][key] for key in keys])

    whole, table = column(WHOLE), {}
    for name in errors:
        found = column(name)
        test = paired_test(whole, found, weights=weights)
        low, high = test["accuracy_gain_ci"]
        table[name] = {
            "Acc30": accuracy(found, 30),
            "change": test["accuracy_gain"],
            "low": low,
            "high": high,
            "won": int(((found < 30) & (whole >= 30)).sum()),
            "lost": int(((found >= 30) & (whole < 30)).sum()),
            "p": test["sign_test_p"],
        }
    return table


def format_table(table: Mapping[str, Mapping[str, float]]) -> str:
    """Format the comparison as a Markdown table."""
    lines = ["| without | Acc30 (%) | change (points) | pairs won | lost | p |", "|---|---:|---:|---:|---:|---:|"]
    for name, row in table.items():
        change = f"{row['change']:+.1f} [{row['low']:+.1f}, {row['high']:+.1f}]".replace("-", "−")
        compared = f"{change} | {row['won']} | {row['lost']} | {PValue(row['p'])}"
        lines.append(f"| {name} | {row['Acc30']:.1f} | {'| | |' if name == WHOLE else compared} |")
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code."""
    parser = argparse.ArgumentParser(prog="python -m tools.parts", description=__doc__.split("\n")[0])
    parser.add_argument("out", type=Path, help="folder of the runs and their exports")
    parser.add_argument("data", type=folder_and_pairs, nargs="+", metavar="FOLDER:PAIRS", help=DATA_HELP)
    parser.add_argument(
        "--without",
        action="append",
        choices=list(_PARTS)[1:],
        metavar="PART",
        help="run the row without this part; may be repeated (default: all rows)",
    )
    parser.add_argument("--backbone", default=DEFAULT, metavar="NAME", help=f"default {DEFAULT}")
    given = parser.parse_args(arguments)
    try:
        errors = read_errors(measure(given.data, given.out, given.backbone, rows(given.without or tuple(_PARTS))))
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(f"{len(errors[WHOLE])} pairs\n{format_table(differences(errors))}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
