"""Labelling in Open3D's picking window, with questions in the terminal: `zsp-lite label ROOT CATEGORY`.

In the window: shift + left click picks the point, shift + right click takes the last one back, Q closes it.
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

Cloud = tuple[np.ndarray, np.ndarray]
# Cloud and title to the indices picked on it, in order; two clouds and a title, to be looked at; question to answer.
Pick = Callable[[Cloud, str], list[int]]
Show = Callable[[np.ndarray, np.ndarray, str], None]
Ask = Callable[[str], str]
Guess = Callable[[str], None]

# Open3D's windows look along -z with y up, cameras along z with y down.
_WINDOW = np.diag([1.0, -1.0, -1.0])
_BLUE, _ORANGE = (0.0, 0.45, 0.70), (0.90, 0.62, 0.0)


def pick_in_window(cloud: Cloud, title: str) -> list[int]:
    """Indices of the points that were picked, in order. Raises InputError where no window can be opened."""
    _check_display()
    window = load_open3d().visualization.VisualizerWithEditing()
    window.create_window(window_name=title, width=1280, height=900)
    window.add_geometry(_geometry(cloud[0], cloud[1] / 255))
    window.run()
    window.destroy_window()
    return list(window.get_picked_points())


def show_in_window(reference: Float[np.ndarray, "n 3"], target: Float[np.ndarray, "m 3"], title: str) -> None:
    """Both clouds in one plain colour each, blue the reference, orange the sequence."""
    _check_display()
    o3d = load_open3d()
    clouds = [_geometry(points, np.tile(colour, (len(points), 1))) for points, colour in
              ((reference, _BLUE), (target, _ORANGE))]  # fmt: skip
    o3d.visualization.draw_geometries(clouds, window_name=title, width=1280, height=900)


def label_category(
    labelling: Labelling, ask: Ask, say: Callable[[str], None], guess: Guess | None = None,
    pick: Pick = pick_in_window, show: Show = show_in_window,
) -> None:  # fmt: skip
    """Go through a category: the reference's keypoints, then every open sequence; accept, redo, skip or quit.

    guess: fills in a sequence's picks, which are then looked at first. What was accepted stays on disk.
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
    """One sequence; False to stop altogether."""
    cloud = labelling.cloud(sequence)
    if guess is not None and not len(labelling.picks(sequence)):
        try:
            guess(sequence)
        except InputError as error:  # then by hand
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
        turn = _WINDOW @ labelling.first_view(sequence)
        both = (alignment.sim3.apply(labelling.cloud(labelling.reference)[0]), cloud[0])
        show(*(points @ turn.T for points in both), f"{sequence}: is it right?")
        answer = _choice(ask, "Accept, redo, skip or quit?", "arsq")
        if answer == "a":
            say(f"Written: {labelling.accept(sequence)}")
            return True
        if answer in ("s", "q"):
            if answer == "s":
                labelling.skip(sequence)
            return answer == "s"
        labelling.clear(sequence)


def _choice(ask: Ask, question: str, answers: str) -> str:
    """One of the letters `answers`; asked again until it is one."""
    while (answer := ask(f"{question} [{'/'.join(answers)}] ").strip().lower()) not in tuple(answers):
        pass
    return answer


def _in_first_view(labelling: Labelling, sequence: str) -> Cloud:
    """A sequence's cloud, turned so that a window shows it as the first camera saw it."""
    points, colours = labelling.cloud(sequence)
    return points @ (_WINDOW @ labelling.first_view(sequence)).T, colours


def _alignment(labelling: Labelling, sequence: str, say: Callable[[str], None]) -> Alignment | None:
    """The alignment by a sequence's picks; picks that give none, such as two at one place, are said and taken back."""
    try:
        return labelling.alignment(sequence)
    except InputError as error:
        say(str(error))
        labelling.clear(sequence)
        return None


def _check_display() -> None:
    """Without a display Open3D draws into memory, and its window would wait for ever."""
    if sys.platform.startswith("linux") and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise InputError(
            "no window can be opened: DISPLAY is not set, expected a desktop; notebooks/08_label_poses.ipynb needs none"
        )


def _geometry(points: np.ndarray, colours: np.ndarray):
    o3d = load_open3d()
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    cloud.colors = o3d.utility.Vector3dVector(colours)
    return cloud
