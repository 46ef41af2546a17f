"""Labelling in Open3D's picking window and the terminal: `zsp-lite label ROOT CATEGORY`.

In the window, shift + left click picks a point, shift + right click removes the last pick, and Q closes the window.
"""

import os
import sys
from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from zsp_lite.errors import InputError
from zsp_lite.io.open3d import load_open3d
from zsp_lite.labelling.keypoints import MIN_KEYPOINTS, Alignment
from zsp_lite.labelling.session import ACCEPTED, SKIPPED, Labelling

Cloud = tuple[np.ndarray, np.ndarray]  # points and colours
Pick = Callable[[Cloud, str], list[int]]  # cloud and window title -> indices of the picked points, in order
Show = Callable[[np.ndarray, np.ndarray, str], None]  # two clouds and window title
Ask = Callable[[str], str]  # question -> answer
Guess = Callable[[str], None]  # name of a sequence

# Open3D's windows look along -z with +y up, cameras along +z with +y down.
_CAMERA_TO_WINDOW = np.diag([1.0, -1.0, -1.0])
_BLUE, _ORANGE = (0.0, 0.45, 0.70), (0.90, 0.62, 0.0)


def pick_in_window(cloud: Cloud, title: str) -> list[int]:
    """Open a picking window. Returns the indices of the picked points in order; InputError without a display."""
    _check_display()
    window = load_open3d().visualization.VisualizerWithEditing()
    window.create_window(window_name=title, width=1280, height=900)
    window.add_geometry(_geometry(cloud[0], cloud[1] / 255))
    window.run()
    window.destroy_window()
    return list(window.get_picked_points())


def show_in_window(reference: Float[np.ndarray, "n 3"], target: Float[np.ndarray, "m 3"], title: str) -> None:
    """Show the reference (blue) and the sequence (orange) in one window."""
    _check_display()
    o3d = load_open3d()
    clouds = [_geometry(points, np.tile(colour, (len(points), 1))) for points, colour in
              ((reference, _BLUE), (target, _ORANGE))]  # fmt: skip
    o3d.visualization.draw_geometries(clouds, window_name=title, width=1280, height=900)


def label_category(
    labelling: Labelling, ask: Ask, say: Callable[[str], None], guess: Guess | None = None,
    pick: Pick = pick_in_window, show: Show = show_in_window,
) -> None:  # fmt: skip
    """Label the sequences of a category: first the keypoints of the reference, then every open sequence.

    Each accepted label is stored at once, so the user can quit at any time.

    Args:
        labelling: The session.
        ask: Asks the user a question and returns the answer.
        say: Prints a message.
        guess: Proposes the picks of a sequence, for the user to accept or redo.
        pick: Opens the picking window.
        show: Shows two aligned clouds.
    """
    reference = labelling.reference
    while len(labelling.names) < MIN_KEYPOINTS:
        say(f"Reference {reference}: pick {MIN_KEYPOINTS} or more keypoints that every object of the category has.")
        indices = pick(_in_first_view(labelling, reference), f"{reference}: keypoints")
        if not indices and _choice(ask, "Nothing picked. Quit?", "yn") == "y":
            return
        labelling.clear(reference)
        for index in indices:
            name = ask(f"Name of keypoint {len(labelling.names) + 1} (return for none): ").strip()
            labelling.pick(reference, labelling.cloud(reference)[0][index], name or None)
    for row in labelling.progress()[1:]:
        if row.state in (ACCEPTED, SKIPPED):
            continue
        if not _label_sequence(labelling, row.sequence, ask, say, guess, pick, show):
            return


def _label_sequence(
    labelling: Labelling,
    sequence: str,
    ask: Ask,
    say: Callable[[str], None],
    guess: Guess | None,
    pick: Pick,
    show: Show,
) -> bool:
    """Label one sequence. Returns False if the user quits."""
    cloud = labelling.cloud(sequence)
    if guess is not None and not len(labelling.picks(sequence)):
        try:
            guess(sequence)
        except InputError as error:
            say(f"{sequence}: no guess: {error}")
    while True:
        if _alignment(labelling, sequence, say) is None:
            say(f"{sequence}: pick, in this order, {', '.join(labelling.names)}.")
            indices = pick(_in_first_view(labelling, sequence), f"{sequence}: {', '.join(labelling.names)}")
            if len(indices) != len(labelling.names):
                say(f"{len(indices)} picked, {len(labelling.names)} expected.")
                if (answer := _choice(ask, "Again, skip or quit?", "asq")) != "a":
                    if answer == "s":
                        labelling.skip(sequence)
                    return answer == "s"
                continue
            labelling.clear(sequence)
            for index in indices:
                labelling.pick(sequence, cloud[0][index])
        alignment = _alignment(labelling, sequence, say)
        if alignment is None:
            continue
        for name, residual in zip(labelling.names, alignment.residuals):
            say(f"  {name:20} {100 * residual:5.1f} % of the keypoints' spread")
        to_window = _CAMERA_TO_WINDOW @ labelling.first_view(sequence)
        aligned = alignment.sim3.apply(labelling.cloud(labelling.reference)[0])
        show(aligned @ to_window.T, cloud[0] @ to_window.T, f"{sequence}: is it right?")
        answer = _choice(ask, "Accept, redo, skip or quit?", "arsq")
        if answer == "a":
            doubt = labelling.doubt(sequence)
            if doubt and _choice(ask, f"{sequence}: {doubt}. Accept it nevertheless?", "yn") == "n":
                labelling.clear(sequence)
                continue
            say(f"Written: {labelling.accept(sequence, confirmed=True)}")
            return True
        if answer in ("s", "q"):
            if answer == "s":
                labelling.skip(sequence)
            return answer == "s"
        labelling.clear(sequence)


def _choice(ask: Ask, question: str, answers: str) -> str:
    """Ask until the answer is one of the letters `answers`."""
    while (answer := ask(f"{question} [{'/'.join(answers)}] ").strip().lower()) not in tuple(answers):
        pass
    return answer


def _in_first_view(labelling: Labelling, sequence: str) -> Cloud:
    """Rotate the cloud of a sequence so that the window shows it as seen from the first camera."""
    points, colours = labelling.cloud(sequence)
    return points @ (_CAMERA_TO_WINDOW @ labelling.first_view(sequence)).T, colours


def _alignment(labelling: Labelling, sequence: str, say: Callable[[str], None]) -> Alignment | None:
    """Return the alignment of a sequence; invalid picks, such as two at one place, are reported and removed."""
    try:
        return labelling.alignment(sequence)
    except InputError as error:
        say(str(error))
        labelling.clear(sequence)
        return None


def _check_display() -> None:
    """Raise InputError without a display, where Open3D would wait for its invisible window for ever."""
    if sys.platform.startswith("linux") and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise InputError(
            "no window can be opened: DISPLAY is not set, expected a desktop; notebooks/08_label_poses.ipynb needs none"
        )


def _geometry(points: np.ndarray, colours: np.ndarray):
    o3d = load_open3d()
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    cloud.colors = o3d.utility.Vector3dVector(colours)
    return cloud
