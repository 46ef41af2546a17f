"""Answer the pairs of a challenge by one hand-in, in the process that `rank` starts for it."""

import csv
import importlib.util
import sys
from pathlib import Path

from zsp_lite.backbones.named import as_backbone
from zsp_lite.benchmark.methods import Method, make_extractors, resolve
from zsp_lite.benchmark.own import fails_alone, problem_of_own
from zsp_lite.benchmark.problem import FrameStore, PairProblem
from zsp_lite.benchmark.run import ask
from zsp_lite.data.co3d import Co3D, Pair
from zsp_lite.errors import InputError, describe_failure
from zsp_lite.io.files import read_bytes
from zsp_lite.io.threads import one_thread

_LARGEST_FILE = 1 << 28  # bytes of a file that a hand-in may write
_COLUMNS = ("pair", "target_frame", "rotation")


def answer(handin: Path, data: Path, questions: Path, out: Path, pair_seconds: int) -> None:
    """Write the poses of all pairs, each as soon as it is found.

    A pair that fails, also by taking longer than `pair_seconds`, has no line. The reason of the
    first one is printed at once, as the time of the hand-in may run out.
    """
    method, backbone = _load(handin)
    store = FrameStore(Co3D(data), make_extractors(backbone, {"hand-in": method}), threads=1)
    failed = 0
    with out.open("w", newline="", encoding="utf-8") as file, one_thread():
        lines = csv.writer(file)
        lines.writerow(_COLUMNS)
        for pair in read_questions(questions):
            try:
                with fails_alone(pair_seconds):
                    problem = PairProblem(pair, store, {method.features} - {"none"})
                    found = ask(method, problem_of_own(method.solve, problem))
                frame = pair.target_frames[found.view]
            except (InputError, IndexError) as error:
                failed += 1
                if failed == 1:
                    print(f"the first pair that failed: {error}", flush=True)
                continue
            rotation = " ".join(map(repr, found.rotation.ravel().tolist()))
            lines.writerow([pair.key, frame, rotation])
            file.flush()


def read_questions(path: Path) -> list[Pair]:
    """Read the pairs of the file that asks for them."""
    text = read_bytes(path, "pairs").decode()
    keys = dict.fromkeys(line["pair"] for line in csv.DictReader(text.splitlines()))
    return [Pair.from_key(key) for key in keys]


def _load(handin: Path) -> tuple[Method, object]:
    """Import a hand-in; return its row of the benchmark and its backbone, each the library's if it
    has none."""
    spec = importlib.util.spec_from_file_location("handin", handin)
    module = importlib.util.module_from_spec(spec)
    sys.modules["handin"] = module
    try:
        spec.loader.exec_module(module)
    except Exception as error:  # a module may raise anything
        raise InputError(f"{handin.name} cannot be imported: {describe_failure(error)}") from error
    backbone = getattr(module, "backbone", None)
    if hasattr(module, "method"):
        method = resolve({"hand-in": module.method})["hand-in"]
    elif backbone is None:
        raise InputError(f"{handin.name} defines neither `method` nor `backbone`, expected one")
    else:
        # The paper's method; its foreground is the mask where the backbone has no saliency.
        masked = getattr(backbone, "has_saliency", True) is False
        method = Method(settings={"foreground": "mask"} if masked else {})
    return method, as_backbone("zsp-tiny" if backbone is None else backbone)


def main(handin: str, data: str, questions: str, out: str, pair_seconds: str, memory: str) -> None:
    """Limit the memory of this process to a number of bytes where the system can, and answer."""
    if sys.platform == "linux":
        import resource  # Windows has none

        resource.setrlimit(resource.RLIMIT_DATA, (int(memory), int(memory)))
        resource.setrlimit(resource.RLIMIT_FSIZE, (_LARGEST_FILE, _LARGEST_FILE))
    try:
        answer(Path(handin), Path(data), Path(questions), Path(out), int(pair_seconds))
    except InputError as error:
        sys.exit(str(error))


if __name__ == "__main__":
    main(*sys.argv[1:])
