"""The command `zsp-lite`: arguments in, library calls, what they found as text. Nothing is computed here.

What a subcommand needs is imported inside it, so that `--help` answers at once.
"""

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from zsp_lite.errors import InputError

if TYPE_CHECKING:
    from zsp_lite.backbones.load import BackboneConfig

SYNTHETIC_NOTE = (
    "synthetic: objects composed of primitives by zsp_lite.synthetic and rendered, with depth holes and "
    "soft masks as CO3D has them; no photograph."
)
USER_NOTE = "a folder in CO3D's layout, as given."


class Parser(argparse.ArgumentParser):
    """Answers wrong usage with one line on stderr and exit code 2."""

    def error(self, message: str):
        self.exit(2, f"zsp-lite: error: {message} (see: {self.prog} --help)\n")


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code: 0, 1 (a check failed), 2 (bad input), 130 (interrupted)."""
    arguments = build_parser().parse_args(argv)
    try:
        return arguments.run(arguments) or 0
    except InputError as error:
        message = str(error)
    except OSError as error:  # a folder that may not be written, a full disk
        message = f"{error.filename}: {error.strerror}" if error.filename else str(error)
    except KeyboardInterrupt:
        print("zsp-lite: interrupted", file=sys.stderr)
        return 130
    print(f"zsp-lite: error: {' '.join(message.split())}", file=sys.stderr)
    return 2


def build_parser() -> argparse.ArgumentParser:
    parser = Parser(
        prog="zsp-lite",
        description="Zero-shot category-level object pose estimation: demo, benchmark, data, backbone.",
        epilog="`zsp-lite COMMAND --help` explains a command. Bad input: one line on stderr, exit code 2.",
    )
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True, parser_class=Parser)
    from zsp_lite.cli import (
        benchmark,  # which take their helpers from here
        data,
    )

    for add in (
        _add_demo, benchmark.add_benchmark, benchmark.add_tables, benchmark.add_compare, _add_synth, _add_weights,
        _add_train, benchmark.add_train_baseline, data.add_label, data.add_data, _add_profile, _add_doctor,
    ):  # fmt: skip
        add(commands)
    return parser


def _command(commands, name: str, run: Callable, summary: str, examples: Sequence[str]) -> Parser:
    parser = commands.add_parser(
        name,
        help=summary,
        description=summary[0].upper() + summary[1:] + ".",
        epilog="examples:\n" + "\n".join(f"  zsp-lite {example}" for example in examples),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.set_defaults(run=run)
    return parser


def _count(text: str) -> int:
    if not text.isdecimal() or int(text) == 0:
        raise argparse.ArgumentTypeError(f"is {text!r}, expected a positive whole number")
    return int(text)


def _seed(text: str) -> int:
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"is {text!r}, expected a whole number, 0 or more")
    return int(text)


def _positive(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"is {text!r}, expected a positive number")
    return value


def _names(text: str) -> list[str]:
    names = [name.strip() for name in text.split(",") if name.strip()]
    if not names:
        raise argparse.ArgumentTypeError(f"is {text!r}, expected names separated by commas")
    return names


def _add_data(parser: Parser) -> None:
    parser.add_argument(
        "--data", type=Path, metavar="DIR",
        help="a folder in CO3D's layout (default: $ZSP_LITE_DATA, else data_samples)",
    )  # fmt: skip


def _add_backbone(parser: Parser) -> None:
    parser.add_argument(
        "--backbone", default="zsp-tiny", metavar="NAME",
        help="zsp-tiny (default), dino_vits8, dino_vits16, dino_vitb8, dino_vitb16, a checkpoint file, or hf:NAME: "
        "a vision transformer of the Hugging Face hub or a folder in its format",
    )  # fmt: skip
    parser.add_argument(
        "--layer", metavar="L",
        help="the block that describes patches: block0, block1, ..., last, or a number (default: the backbone's own; "
        "the paper's is block9)",
    )  # fmt: skip
    parser.add_argument(
        "--facet", default="key", metavar="F", help="what of it: key (default, the paper's), query, value, token"
    )
    parser.add_argument(
        "--image-size", type=_count, metavar="PX",
        help="object crops, of 224 px as in the paper, are resized to so many pixels, or the nearest multiple of the "
        "patch size: more of them make finer patches, no finer pictures (default: the checkpoint's, as a rule 224)",
    )  # fmt: skip


def _backbone(arguments: argparse.Namespace) -> "str | BackboneConfig":
    """What `load_backbone` takes for the options of `_add_backbone`: a name alone where nothing else was asked for."""
    from zsp_lite.backbones.load import BackboneConfig

    choice = BackboneConfig(arguments.backbone, arguments.layer, arguments.facet, arguments.image_size)
    return arguments.backbone if choice == BackboneConfig(arguments.backbone) else choice


def _add_demo(commands) -> None:
    parser = _command(
        commands, "demo", _demo, "one pair of each category, end to end: a table and a report of every stage",
        [
            "demo",
            "demo --data path/to/co3d --backbone dino_vits8 --out outputs/co3d",
            "demo --layer last --facet token --out outputs/tokens",
        ],
    )  # fmt: skip
    parser.add_argument("--data", type=Path, metavar="DIR", help="a folder in CO3D's layout (default: data_samples)")
    _add_backbone(parser)
    parser.add_argument("--out", type=Path, default=Path("outputs/demo"), metavar="DIR", help="default: outputs/demo")


def _demo(arguments: argparse.Namespace) -> None:
    import matplotlib

    matplotlib.use("Agg")  # draws files, needs no display
    from rich.console import Console
    from rich.table import Table

    from zsp_lite.backbones.load import load_backbone
    from zsp_lite.data.co3d import Co3D
    from zsp_lite.data.samples import sample_data
    from zsp_lite.demo import run_demo
    from zsp_lite.synthetic.export import SETTINGS_FILE
    from zsp_lite.viz.report import table_row, write_overview, write_report

    console = Console()
    folder = arguments.data or sample_data()
    note = SYNTHETIC_NOTE if (folder / SETTINGS_FILE).is_file() else USER_NOTE
    dataset, backbone = Co3D(folder), load_backbone(_backbone(arguments))
    arguments.out.mkdir(parents=True, exist_ok=True)
    name = getattr(backbone, "name", arguments.backbone)
    table = Table(title=f"One pair of each category in {folder}, backbone {name}")
    for column in ("category", "chosen view", "inliers", "rotation error", "time"):
        table.add_column(column, justify="left" if column == "category" else "right")
    results = []
    with console.status("estimating"):
        for result in run_demo(dataset, backbone):
            results.append(result)
            table.add_row(*table_row(result))
    console.print(table)
    with console.status("writing the report"):
        path = write_report(arguments.out / "report.html", results, str(folder), note, name)
        write_overview(arguments.out / "overview.jpg", results)
    console.print(f"Data: {note}", highlight=False)
    console.print(f"Every stage in pictures: {path}", soft_wrap=True)


def _add_synth(commands) -> None:
    parser = _command(
        commands, "synth", _synth, "make procedural objects as a CO3D folder, the same from the same seed",
        [
            "synth --preset samples --out data_samples",
            "synth --preset eval --out outputs/eval",
            "synth --preset paper --out outputs/paper",
            "synth --category chair --category teddybear --sequences 2 --seed 7 --out outputs/mine",
            "synth --category validation --sequences 8 --frames 16 --seed 5 --out outputs/validation",
        ],
    )  # fmt: skip
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument(
        "--preset", metavar="NAME",
        help="samples (what data_samples/ holds), eval, or paper: 20 categories of 10 sequences of 100 frames, about "
        "half an hour and 1.4 GB; a folder that is there is continued",
    )  # fmt: skip
    what.add_argument(
        "--category", action="append", metavar="NAME",
        help="a category, or training, validation or evaluation: all of that split; may be given more than once",
    )  # fmt: skip
    parser.add_argument("--sequences", type=_count, metavar="N", help="with --category: sequences of each (default: 4)")
    parser.add_argument("--frames", type=_count, metavar="N", help="with --category: frames per sequence (default: 24)")
    parser.add_argument("--seed", type=_seed, default=0, help="default: 0")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")


def _synth(arguments: argparse.Namespace) -> None:
    from tqdm import tqdm

    from zsp_lite.synthetic.export import export_categories, export_preset

    out, seed, sequences, frames = arguments.out, arguments.seed, arguments.sequences, arguments.frames
    if arguments.preset:
        if sequences or frames:
            raise InputError("a preset fixes its sequences and frames; --sequences and --frames go with --category")
        export_preset(arguments.preset, out, seed, progress=tqdm)
    else:
        export_categories(arguments.category, out, sequences or 4, frames or 24, seed, progress=tqdm)
    print(f"Written: {out}")


def _add_weights(commands) -> None:
    parser = _command(
        commands, "weights", _weights, "backbones: which are at hand, fetch one, check a file",
        ["weights list", "weights fetch dino_vits8", "weights verify path/to/checkpoint.pth"],
    )  # fmt: skip
    parser.add_argument("action", choices=("list", "fetch", "verify"))
    parser.add_argument("name", nargs="?", help="a backbone's name, or hf:NAME (verify: or a checkpoint file)")


def _weights(arguments: argparse.Namespace) -> None:
    if arguments.action == "list" and arguments.name:
        raise InputError(f"weights list takes no name, got {arguments.name}")
    from zsp_lite.backbones.load import available_backbones, download, verify

    backbones, name = available_backbones(), arguments.name
    if arguments.action == "list":
        for known, path in backbones.items():
            print(f"{known:12} {path or f'not at hand: zsp-lite weights fetch {known}'}")
        return
    if name is None:
        raise InputError(f"weights {arguments.action} needs a name, expected one of {', '.join(backbones)}")
    if arguments.action == "fetch":
        print(f"At hand: {download(name)}")
        return
    verify(name)
    print(f"{name}: complete, and loads")


def _add_train(commands) -> None:
    parser = _command(
        commands, "train", _train, "train the embedded backbone, or resume; hours on a CPU",
        ["train --out outputs/first", "train --out outputs/second --start-from outputs/first/checkpoint.pt",
         "train --out outputs/further --start-from zsp-tiny --seed 1 --objects 2400",
         "train --out outputs/try --shorten 0.02 --objects 60",
         "train --self-distillation --out outputs/dino --renders outputs/first/renders"],
    )  # fmt: skip
    parser.add_argument(
        "--out", type=Path, default=Path("outputs/train"), metavar="DIR",
        help="config, log, checkpoint, weights; a run found there is resumed (default: outputs/train)",
    )  # fmt: skip
    parser.add_argument("--renders", type=Path, metavar="DIR", help="training renders (default: OUT/renders)")
    parser.add_argument(
        "--start-from", metavar="WEIGHTS",
        help="go on, by the recipe's second part, from a run's checkpoint.pt, exported .safetensors, or zsp-tiny",
    )  # fmt: skip
    parser.add_argument(
        "--self-distillation", action="store_true",
        help="DINO instead, which sees pixels alone: what it learns in as many steps, for comparison",
    )  # fmt: skip
    parser.add_argument(
        "--objects", type=_count, metavar="N",
        help="training objects, 1.1 MB each on disk and in memory (default: 5600)",
    )  # fmt: skip
    parser.add_argument("--shorten", type=_positive, default=1.0, metavar="F", help="multiply every stage's steps by F")
    parser.add_argument("--seed", type=_seed, default=0, help="default: 0")


def _train(arguments: argparse.Namespace) -> None:
    from dataclasses import replace

    from tqdm import tqdm

    from zsp_lite.training.train import CONTINUATION, TrainingConfig, keep_freed_memory, train

    recipe = TrainingConfig() if arguments.start_from is None else CONTINUATION
    config = replace(recipe, seed=arguments.seed).shortened(arguments.shorten)
    if arguments.objects:
        config = replace(config, objects=arguments.objects)
    keep_freed_memory()

    def bar(shards, total):
        return tqdm(shards, "rendering", total, unit="shard", disable=None)

    if arguments.self_distillation:
        if arguments.start_from is not None:
            raise InputError("--start-from continues the other recipe; expected --self-distillation without it")
        from zsp_lite.training.distillation import LONG_RUN, distil

        steps = max(1, round(LONG_RUN.steps * arguments.shorten))
        run = replace(LONG_RUN, seed=arguments.seed, steps=steps)
        print(f"Written: {distil(run, config, arguments.out, arguments.renders, progress=bar)}")
        return
    start = dict(start_from=arguments.start_from)
    print(f"Written: {train(config, arguments.out, arguments.renders, progress=bar, **start)}")


def _add_profile(commands) -> None:
    parser = _command(
        commands, "profile", _profile, "time and memory of every stage, against the plain loops they replace",
        ["profile", "profile --repeats 2"],
    )  # fmt: skip
    parser.add_argument("--repeats", type=_count, default=5, metavar="N", help="runs behind each median (default: 5)")


def _profile(arguments: argparse.Namespace) -> None:
    from zsp_lite.benchmark.profile import profile

    for row in profile(arguments.repeats):
        print(row, flush=True)


def _add_doctor(commands) -> None:
    parser = _command(
        commands, "doctor", _doctor, "what is installed and at hand, and the command that mends what is not",
        ["doctor", "doctor --data path/to/co3d"],
    )  # fmt: skip
    parser.add_argument("--data", type=Path, metavar="DIR", help="a CO3D folder to look at besides the usual ones")


def _doctor(arguments: argparse.Namespace) -> int:
    from zsp_lite.cli.doctor import BAD, ok, run_checks

    checks = run_checks(arguments.data)
    width = max(len(check.name) for check in checks)
    for check in checks:
        print(f"{check.state:4}  {check.name:{width}}  {check.found}")
        if check.fix:
            print(f"{'':4}  {'':{width}}  -> {check.fix}")
    missing = [check.name for check in checks if check.state == BAD]
    print("All essentials are there." if not missing else f"Missing or broken: {', '.join(missing)}.")
    return 0 if ok(checks) else 1
