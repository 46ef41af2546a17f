"""Run every hostile input in a forked process with limits on memory and time, and count the
outcomes.

    python -m tests.hostile [GROUP ...]

The libraries are imported once, before the processes fork. A case fails if it ends with a traceback
or gives a wrong answer without an error, if it takes more than 20 s of processor time or two
minutes, or if it needs 1 GB more memory than an idle process. Linux only.
"""

import gc
import json
import multiprocessing
import os
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from pathlib import Path

os.environ |= {"OMP_NUM_THREADS": "1", "MPLBACKEND": "Agg", "HF_HUB_OFFLINE": "1", "COLUMNS": "120"}
sys.path.insert(0, str(Path(__file__).parents[1]))  # the helpers of the other tests

import cv2  # noqa: E402
import torch  # noqa: E402
import transformers  # noqa: E402, F401

from tests.hostile import cases  # noqa: E402, F401
from tests.hostile.harness import CASES, prepare  # noqa: E402
from zsp_lite.errors import InputError  # noqa: E402

# Limits of a case.
SECONDS = 20  # of processor time
WAIT = 120  # seconds
MEMORY = 1 << 30  # bytes above those of an idle process
LONGEST_MESSAGE = 1500  # characters of a refusal, which is one line
OUTCOME = "outcome.json"  # file of a case's folder


def attempt(case, folder: Path) -> None:
    """Run a case with limits, and write [outcome, message, bytes of memory used] to `OUTCOME`."""
    os.setsid()  # a group of its own, which can be killed with all that the case starts
    for stream in (1, 2):
        os.dup2(os.open(folder / f"stream{stream}", os.O_WRONLY | os.O_CREAT | os.O_TRUNC), stream)
    os.chdir(folder)
    resource.setrlimit(resource.RLIMIT_CPU, (SECONDS, SECONDS))
    size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    # No case fills the memory of the machine; address space is larger than the memory in use.
    resource.setrlimit(resource.RLIMIT_AS, (size + 3 * MEMORY,) * 2)
    try:
        kind, message = case.call(folder)
    except InputError as error:
        message = str(error)
        kind = "wrong" if "\n" in message or len(message) > LONGEST_MESSAGE else "refused"
    except BaseException as error:
        lines = traceback.format_exc().strip().splitlines()
        kind, message = "traceback", f"{type(error).__name__}: {error} | {' '.join(lines[-3:-1])}"
    # Linux counts in kilobytes.
    used = 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    (folder / OUTCOME).write_text(json.dumps([kind, message, used]))


def run_case(case, folder: Path, idle: int) -> tuple[str, str]:
    """Run a case in a forked process, where an idle one has `idle` bytes of memory.

    Returns the outcome and the message.
    """
    process = multiprocessing.get_context("fork").Process(target=attempt, args=(case, folder))
    process.start()
    process.join(WAIT)
    if process.is_alive():
        os.killpg(process.pid, signal.SIGKILL)
        process.join()
        return "hang", ""
    if not (folder / OUTCOME).exists():
        return "traceback", "the process died"
    kind, message, used = json.loads((folder / OUTCOME).read_text())
    return ("memory" if used - idle > MEMORY else kind), message


def main(groups: list[str]) -> int:
    """Run the cases of some groups, or all; returns 1 if one fails."""
    # Threads do not survive a fork.
    torch.set_num_threads(1)
    cv2.setNumThreads(0)
    start = time.monotonic()
    work = Path(tempfile.mkdtemp(prefix="hostile-"))
    chosen = [case for case in CASES if not groups or case.group in groups]
    counts = Counter()
    try:
        template = prepare(work / "template")
        gc.freeze()  # a collection in a child would copy every page
        idle = 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        for number, case in enumerate(chosen):
            folder = work / str(number)
            shutil.copytree(template, folder, symlinks=True)
            kind, message = run_case(case, folder, idle)
            shutil.rmtree(folder, ignore_errors=True)
            counts[case.group, kind] += 1
            if kind not in ("refused", "right"):
                print(f"{kind}: {case.group}: {case.name}: {' '.join(message.split())[:700]}")
    finally:
        shutil.rmtree(work, ignore_errors=True)
    for (group, kind), count in counts.items():
        print(f"{group:10} {kind:10} {count:4}")
    bad = sum(count for (_, kind), count in counts.items() if kind not in ("refused", "right"))
    print(
        f"{counts.total() - bad} of {counts.total()} as expected, {time.monotonic() - start:.0f} s"
    )
    return int(bad > 0)


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
