"""The drawings of the course: `python -m tools.drawings` writes them as SVG to notebooks/figures/
and docs/rooms.svg.

One picture of the whole method (`method.svg`), a strip of its stages for the top of each notebook
(`here_NN.svg`), and small drawings of single ideas. Two chairs made of boxes play the reference
(blue) and the target (orange). The colours are those of the figures (Okabe and Ito), and a white
ground makes the drawings legible on dark pages.
"""

import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cache, cached_property, partial
from itertools import product
from pathlib import Path
from xml.sax.saxutils import escape

import numpy as np
from matplotlib.colors import to_hex, to_rgb
from matplotlib.path import Path as Polygon
from numpy.typing import ArrayLike

from tools.rooms import ROOMS, flows
from zsp_lite.viz.plots import BLUE, GREEN, ORANGE, VERMILLION

FOLDER = Path(__file__).parents[1] / "notebooks" / "figures"
ROOMS_FILE = FOLDER.parents[1] / "docs" / "rooms.svg"
INK = "#1A1A1A"
GREY = "#595959"
PALE = "#F4F4F1"
LINE = "#B8B8B0"
SKY = "#56B4E9"
PINK = "#CC79A7"
WIDTH = 940  # of the two large drawings, in pixels
MARGIN = 14  # from the border of a large drawing to its content
PICTOGRAM = (204, 110)  # size of a stage's picture in `method.svg`
# The camera of every `Photo`: it looks down by this angle (degrees) at this height of a chair, and
# this length of the chair's world fills the picture.
TILT = 20
EYE_LEVEL = 0.92
FIELD = 2.45

# The parts of a chair are boxes with a centre and a size. The axes are x to the right of who sits
# on the chair, y forward, z up.
Chair = dict[str, tuple[tuple[float, float, float], tuple[float, float, float]]]


def _chair(width: float, depth: float, seat: float, back: float, leg: float) -> Chair:
    """Build a chair by its width, its depth, the heights of seat and back, and the leg's width."""
    x = (width - leg) / 2
    y = (depth - leg) / 2
    board = 0.14  # thickness of seat and back
    legs = {
        f"leg {side}{end}": ((i * x, j * y, seat / 2), (leg, leg, seat))
        for side, i in (("left", -1), ("right", 1))
        for end, j in (("", -1), (" front", 1))
    }
    return {
        **legs,
        "seat": ((0, 0, seat + board / 2), (width, depth, board)),
        "back": ((0, -(depth - board) / 2, seat + board + back / 2), (width, board, back)),
    }


REFERENCE = _chair(0.95, 0.95, 0.8, 1.0, 0.13)
TARGET = _chair(1.35, 1.05, 0.62, 0.8, 0.2)
# Places that both chairs have: a part and a corner of its box.
PLACES = {
    "top left": ("back", (-1, 1, 1)),
    "top right": ("back", (1, 1, 1)),
    "front left": ("seat", (-1, 1, 1)),
    "front right": ("seat", (1, 1, 1)),
    "foot left": ("leg left front", (-1, 1, -1)),
    "foot right": ("leg right front", (1, 1, -1)),
}


@dataclass(frozen=True)
class Photo:
    """A chair in a square picture."""

    chair: Chair
    azimuth: float  # direction from which it is seen, in degrees; 0 is its front
    x: float  # upper left corner of the picture in the drawing
    y: float
    size: float  # side of the picture

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the places (..., 2) of points (..., 3) in the drawing, and their distances (...)
        from the camera."""
        angle = np.radians(self.azimuth)
        tilt = np.radians(TILT)
        right = np.array([-np.cos(angle), np.sin(angle), 0])
        to_camera = np.array(
            [np.sin(angle) * np.cos(tilt), np.cos(angle) * np.cos(tilt), np.sin(tilt)]
        )
        up = np.cross(to_camera, right)
        centred = np.asarray(points, float) - [0, 0, EYE_LEVEL]
        scale = self.size / FIELD
        centre = np.add([self.x, self.y], self.size / 2)
        # Without perspective: the camera is far away.
        places = np.stack([centred @ right, -(centred @ up)], -1) * scale + centre
        return places, -(centred @ to_camera)

    @cached_property
    def faces(self) -> list[tuple[str, np.ndarray, np.ndarray, float]]:
        """Return the visible faces, far ones first: part, corners (4, 2), normal (3,), distance of
        the centre."""
        faces = []
        for part, axis, sign in product(self.chair, range(3), (-1, 1)):
            normal = sign * np.eye(3)[axis]
            _, (start, end) = self.project(np.array([np.zeros(3), normal]))
            if end - start >= -1e-9:  # The normal does not lead towards the camera.
                continue
            others = [other for other in range(3) if other != axis]
            corners = np.tile(normal, (4, 1))
            corners[:, others] = [(-1, -1), (1, -1), (1, 1), (-1, 1)]
            places, distances = self.project(self.in_box(part, corners))
            faces.append((part, places, normal, distances.mean()))
        return sorted(faces, key=lambda face: -face[3])

    def in_box(self, part: str, signs: ArrayLike) -> np.ndarray:
        """Return points (..., 3) of the chair's world by their places in a part, -1 to 1."""
        centre, size = self.chair[part]
        return np.array(centre) + np.array(signs) * np.array(size) / 2

    def place(self, name: str) -> np.ndarray:
        """Return where a place of `PLACES` is in the drawing, (2,)."""
        place, _ = self.project(self.in_box(*PLACES[name]))
        return place

    def parts_at(self, points: np.ndarray) -> np.ndarray:
        """Return the parts (N,) that the picture shows at points (N, 2) of the drawing; "" on the
        background."""
        parts = np.full(len(points), "", dtype=object)
        for part, corners, _, _ in self.faces:
            parts[Polygon(corners).contains_points(points)] = part
        return parts

    def dots(self, step: float) -> np.ndarray:
        """Return places (N, 2) about `step` pixels apart on what the picture shows of the chair,
        far ones first."""
        dots = []
        for part, (a, b, c, d), _, _ in self.faces:
            # The face is a parallelogram with corners a, b, c, d. A place is given by the share i
            # of the way from a to b, and the share j of the way from a to d.
            along = max(2, round(np.linalg.norm(b - a) / step))
            across = max(2, round(np.linalg.norm(d - a) / step))
            i, j = np.meshgrid((np.arange(along) + 0.5) / along, (np.arange(across) + 0.5) / across)
            i = i.reshape(-1, 1)
            j = j.reshape(-1, 1)
            places = a * (1 - i) * (1 - j) + b * i * (1 - j) + c * i * j + d * (1 - i) * j
            dots.append(places[self.parts_at(places) == part])
        return np.concatenate(dots)

    def draw(self, colour: str, frame: str = LINE, thick: float = 1) -> str:
        """Draw the picture in shades of a colour."""
        drawn = self.ground(frame, thick)
        for _, corners, normal, _ in self.faces:
            # Light from above: the brightness of faces across x, y and z.
            shade = (0.78, 0.9, 1.0)[int(np.abs(normal).argmax())]
            drawn += polygon(corners, mix(colour, INK, shade))
        return drawn

    def draw_depth(self) -> str:
        """Draw the depth map of the picture: near is dark."""
        far = self.faces[0][3]
        near = self.faces[-1][3]
        drawn = self.ground()
        for _, corners, _, distance in self.faces:
            grey = mix("#3A3A3A", "#C9C9C9", 1 - (distance - near) / (far - near))
            drawn += polygon(corners, grey, grey)
        return drawn

    def ground(self, frame: str = LINE, thick: float = 1) -> str:
        """Draw the picture's frame on a pale ground."""
        return rect(self.x, self.y, self.size, self.size, PALE, frame, thick, corner=3)


def mix(first: str, second: str, share: float) -> str:
    """Return the colour with `share` of the first and the rest of the second."""
    return to_hex(share * np.array(to_rgb(first)) + (1 - share) * np.array(to_rgb(second)))


# Elements of SVG


def number(value: float) -> str:
    """Write a number with at most one decimal."""
    # Adding 0.0 turns -0.0 into 0.0, which is written without a sign.
    return f"{round(value, 1) + 0.0:.1f}".removesuffix(".0")


def attributes(**values: object) -> str:
    """Write attributes; "_" in a name stands for "-", and None leaves the attribute out."""
    written = ""
    for name, value in values.items():
        if isinstance(value, int | float):
            value = number(value)
        if value is not None:
            written += f' {name.replace("_", "-")}="{value}"'
    return written


def element(tag: str, content: str | None = None, **values: object) -> str:
    """Write an element with its attributes and content on a line."""
    end = "/>" if content is None else f">{content}</{tag}>"
    return f"<{tag}{attributes(**values)}{end}\n"


def rect(
    x: float,
    y: float,
    width: float,
    height: float,
    fill: str,
    stroke: str | None = None,
    thick: float = 1,
    corner: float = 0,
) -> str:
    """Draw a rectangle, with corners of a radius `corner`."""
    line = {} if stroke is None else {"stroke": stroke, "stroke_width": thick}
    return element(
        "rect", x=x, y=y, width=width, height=height, rx=corner or None, fill=fill, **line
    )


def polygon(corners: np.ndarray, fill: str, stroke: str | None = None) -> str:
    """Draw a polygon; its outline is by default a darker shade of its colour."""
    points = " ".join(f"{number(x)},{number(y)}" for x, y in corners)
    stroke = stroke or mix(fill, INK, 0.7)
    return element(
        "polygon",
        points=points,
        fill=fill,
        stroke=stroke,
        stroke_width=0.6,
        stroke_linejoin="round",
    )


def dot(
    place: np.ndarray, fill: str, radius: float = 4, stroke: str = "white", thick: float = 1.2
) -> str:
    """Draw a filled circle with an outline."""
    return element(
        "circle", cx=place[0], cy=place[1], r=radius, fill=fill, stroke=stroke, stroke_width=thick
    )


def ring(place: np.ndarray, stroke: str, radius: float, thick: float) -> str:
    """Draw a circle that is not filled."""
    return dot(place, "none", radius, stroke, thick)


def curve(
    path: str, stroke: str = INK, thick: float = 1.6, dash: str | None = None, head: bool = False
) -> str:
    """Draw a path; with a head it is an arrow."""
    marker = f"url(#{_HEADS[stroke]})" if head else None
    return element(
        "path",
        d=path,
        fill="none",
        stroke=stroke,
        stroke_width=thick,
        stroke_dasharray=dash,
        marker_end=marker,
        stroke_linecap="round",
    )


def pair(place: np.ndarray) -> str:
    """Write a place (2,) of a path."""
    return f"{number(place[0])} {number(place[1])}"


def straight(start: np.ndarray, end: np.ndarray, gap: float = 0) -> str:
    """Return the path from start to end, shorter by `gap` at both ends."""
    start = np.asarray(start, float)
    end = np.asarray(end, float)
    step = (end - start) / np.linalg.norm(end - start) * gap
    return f"M{pair(start + step)}L{pair(end - step)}"


def arc(start: np.ndarray, end: np.ndarray, bend: float, gap: float = 6) -> str:
    """Return a bent path from start to end; a positive bend lies to its left."""
    start = np.asarray(start, float)
    end = np.asarray(end, float)
    along = end - start
    control = (start + end) / 2 + bend * np.array([along[1], -along[0]])
    start = start + (control - start) / np.linalg.norm(control - start) * gap
    end = end + (control - end) / np.linalg.norm(control - end) * gap
    return f"M{pair(start)}Q{pair(control)} {pair(end)}"


# Names of the arrow heads by colour.
_HEADS = {
    INK: "ink",
    GREY: "grey",
    BLUE: "blue",
    ORANGE: "orange",
    GREEN: "green",
    VERMILLION: "red",
}
_TOKEN = re.compile(r"\*(.+?)\*|_\{(.+?)\}|\^\{(.+?)\}")
# How far plain, italic, subscript and superscript are below the line, in font sizes.
_SHIFTS = (0, 0, 0.28, -0.38)


def text(
    content: str,
    x: float,
    y: float,
    size: float = 13,
    fill: str = INK,
    anchor: str = "start",
    bold: bool = False,
) -> str:
    """Draw a line of text; `*x*` is italic, `_{a}` a subscript, `^{b}` a superscript."""
    spans = ""
    below = 0.0  # how far the present place is below the line
    # The parts are in turn plain, italic, subscript and superscript; most are None.
    for index, part in enumerate(_TOKEN.split(content)):
        if not part:
            continue
        kind = index % 4
        style = {"font_style": "italic"} if kind == 1 else {}
        shift = size * _SHIFTS[kind]
        if shift != below:
            style["dy"] = shift - below
        if shift:  # Subscripts and superscripts are smaller.
            style["font_size"] = 0.72 * size
        spans += f"<tspan{attributes(**style)}>{escape(part)}</tspan>" if style else escape(part)
        below = shift
    return element(
        "text",
        spans,
        x=x,
        y=y,
        font_size=size,
        fill=fill,
        text_anchor=None if anchor == "start" else anchor,
        font_weight="bold" if bold else None,
    )


def paragraph(
    lines: Iterable[str], x: float, y: float, step: float, size: float, anchor: str = "start"
) -> str:
    """Draw lines of text below each other, the first at y."""
    return "".join(text(line, x, y + step * i, size, anchor=anchor) for i, line in enumerate(lines))


def group(content: str, x: float = 0, y: float = 0, scale: float = 1) -> str:
    """Move elements to a place, and scale them."""
    transform = f"translate({number(x)} {number(y)})"
    if scale != 1:
        transform += f" scale({scale:g})"
    return f"<g{attributes(transform=transform)}>\n{content}</g>\n"


def svg(content: str, width: float, height: float, title: str, description: str) -> str:
    """Put a drawing on white ground, with a title and a description for those who cannot see it."""
    heads = "".join(
        element(
            "marker",
            element("path", d="M0 0L9 4.5L0 9Z", fill=colour).strip(),
            id=name,
            markerUnits="userSpaceOnUse",
            markerWidth=9,
            markerHeight=9,
            refX=7,
            refY=4.5,
            orient="auto",
        )
        for colour, name in _HEADS.items()
        if f"url(#{name})" in content
    )
    defs = f"<defs>\n{heads}</defs>\n" if heads else ""
    size = attributes(
        width=width, height=height, viewBox=f"0 0 {number(width)} {number(height)}"
    ).strip()
    # Half a pixel inside, so that the line of the border is sharp.
    frame = rect(0.5, 0.5, width - 1, height - 1, "white", "#D9D9D4", 1, corner=10)
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" {size} font-family="sans-serif" role="img" '
        'aria-labelledby="title desc">\n'
        f'<title id="title">{escape(title)}</title>\n'
        f'<desc id="desc">{escape(description)}</desc>\n'
        f"{defs}{frame}{content}</svg>\n"
    )


# The pictures of the stages, each in a field of PICTOGRAM; the small strip leaves out `words`


@cache
def draw_images() -> str:
    """Draw the picture of the reference, and three of the target, one over the other."""
    width, _ = PICTOGRAM
    drawn = Photo(REFERENCE, 35, 2, 18, 76).draw(BLUE)
    for i, azimuth in ((2, 100), (1, 60), (0, 25)):
        drawn += Photo(TARGET, azimuth, width - 76 - 12 * i, 30 - 12 * i, 76).draw(ORANGE)
    return drawn


def draw_grid(x: float, y: float, size: float, cells: int, thick: float = 0.8) -> str:
    """Draw white lines between the cells of a square grid."""
    path = ""
    for i in range(1, cells):
        step = size * i / cells
        path += f"M{pair((x + step, y))}v{number(size)}M{pair((x, y + step))}h{number(size)}"
    return curve(path, "white", thick)


@cache
def draw_features() -> str:
    """Draw the reference in patches, and their features: a colour for each part of the chair."""
    cells = 9
    photo = Photo(REFERENCE, 35, 4, 13, 84)
    grid = Photo(REFERENCE, 35, 116, 13, 84)
    side = grid.size / cells
    features = grid.ground()
    for row, column in np.ndindex(cells, cells):
        corner = np.array([grid.x + column * side, grid.y + row * side])
        # Of nine places in the cell, at 0.2, 0.5 and 0.8 of its side, three or more have to be on
        # the chair. The colour is that of the part that most of them show.
        places = corner + side * (np.indices((3, 3)).reshape(2, -1).T * 0.3 + 0.2)
        shown = [part for part in grid.parts_at(places) if part]
        if len(shown) > 2:
            part = max(set(shown), key=shown.count)
            colour = {"back": PINK, "seat": SKY}.get(part, GREEN)
            share = 0.7 + 0.1 * ((3 * row + 5 * column) % 4)  # irregular: no two features are equal
            features += rect(*corner, side, side, mix(colour, "white", share))
    drawn = photo.draw(BLUE) + draw_grid(photo.x, photo.y, photo.size, cells)
    drawn += curve("M92 55H111", INK, 1.8, head=True)
    return drawn + features + draw_grid(grid.x, grid.y, grid.size, cells)


@cache
def draw_cycle(words: bool = True) -> str:
    """Draw a cycle from the reference to the target and back."""
    first = Photo(REFERENCE, 35, 4, 13, 84)
    second = Photo(TARGET, 30, 116, 13, 84)
    u = first.place("front left")
    v = second.place("front left")
    drawn = first.draw(BLUE) + second.draw(ORANGE) + draw_walk(u, v, u + [9, 11])
    if words:
        drawn += text("*u*", u[0] - 1, u[1] - 8, 14)
        drawn += text("*v*", v[0] + 9, v[1] + 4, 14)
        drawn += text("*u*′", u[0] + 2, u[1] + 31, 14)
    return drawn


def draw_walk(
    u: np.ndarray, v: np.ndarray, end: np.ndarray, size: float = 5, bend: float = 0.42
) -> str:
    """Draw a cycle: from u to v (solid), from v to its end (dashed)."""
    drawn = curve(arc(u, v, bend, size + 3), INK, 2, head=True)
    drawn += curve(arc(v, end, 0.7 * bend, size + 4), INK, 2, "5 4", head=True)
    drawn += dot(u, BLUE, size)
    drawn += dot(v, ORANGE, size)
    return drawn + dot(end, "white", size, BLUE, 2.2)


@cache
def draw_best_view() -> str:
    """Draw three target views with bars of their scores; the best one is framed."""
    drawn = ""
    for i, (azimuth, score) in enumerate(((110, 0.35), (30, 0.95), (-50, 0.6))):
        x = 4 + 68 * i
        view = Photo(TARGET, azimuth, x, 6, 60)
        best = i == 1
        drawn += view.draw(ORANGE, INK, 3) if best else view.draw(ORANGE)
        drawn += rect(x, 106 - 32 * score, 60, 32 * score, GREY if best else LINE, corner=2)
    return drawn


@cache
def draw_depth() -> str:
    """Draw a depth map, and beside it a camera with rays from its centre through the image plane
    to points."""
    drawn = Photo(REFERENCE, 35, 4, 13, 84).draw_depth()
    eye = np.array([112, 58])
    plane = 136  # x of the image plane
    drawn += curve(f"M{plane} 26V90", GREY, 2)
    for place in (np.array([186, 14]), np.array([200, 52]), np.array([180, 98])):
        drawn += curve(straight(eye, place), LINE, 1.4)
        crossing = eye + (place - eye) * (plane - eye[0]) / (place[0] - eye[0])
        drawn += dot(crossing, BLUE, 3.2) + dot(place, BLUE, 5)
    return drawn + polygon(np.array([[100, 51], [100, 65], [114, 58]]), INK)


@cache
def draw_fit() -> str:
    """Draw matches between two sets of points, the last of them wrong and crossed out."""
    first = np.array([[20, 24], [66, 18], [18, 70], [62, 66], [40, 94]], float)
    angle = np.radians(18)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    second = (first - first.mean(0)) @ turn.T * 0.95 + [158, 56]
    second[4] = [196, 18]  # a wrong match
    drawn = ""
    for i, (a, b) in enumerate(zip(first, second)):
        if i == 4:
            x, y = a + (b - a) * 0.72
            drawn += curve(straight(a, b, 6), VERMILLION, 1.8, "4 4")
            drawn += curve(f"M{x - 5:.1f} {y - 5:.1f}l10 10m0 -10l-10 10", VERMILLION, 2.4)
        else:
            drawn += curve(straight(a, b, 6), GREEN, 1.8)
        drawn += dot(a, BLUE, 5) + dot(b, ORANGE, 5)
    return drawn


@cache
def draw_pose(words: bool = True) -> str:
    """Draw dots of the reference over the target, with arrows to its front and up."""
    photo = Photo(TARGET, 25, 52, 4, 102)
    # The reference, scaled as a whole to about the height of the target.
    moved = Photo(_chair(0.87, 0.87, 0.73, 0.91, 0.12), 25, 52, 4, 102)
    drawn = photo.draw(mix(ORANGE, "white", 0.7))
    for place in moved.dots(5.5):
        drawn += dot(place, BLUE, 1.8, "white", 0.4)
    origin, *ends = photo.project(np.array([[0, 0, 0.75], [0, 1.5, 0.75], [0, 0, 2.1]]))[0]
    for end in ends:
        drawn += curve(straight(origin, end), INK, 2.4, head=True)
    if words:
        drawn += text("front", 158, 96, 13) + text("up", 158, 18, 13)
    return drawn


STAGES: dict[str, tuple[str, Callable[[], str]]] = {
    "images": ("images", draw_images),
    "features": ("01 features", draw_features),
    "cycle": ("02 cycle", partial(draw_cycle, words=False)),
    "best view": ("03 best view", draw_best_view),
    "fit": ("04 depth, RANSAC", draw_fit),
    "pose": ("pose", partial(draw_pose, words=False)),
}


# The whole method


PANEL = (216, 208)  # width and height of the field of a stage
_GROUND = "#FBFBF9"  # colour of a field


def draw_panel(
    x: float, y: float, title: str, notebook: str, lines: Iterable[str], picture: str
) -> str:
    """Draw the field of a stage: title, notebook, picture and two lines of text."""
    width, height = PANEL
    drawn = rect(x, y, width, height, _GROUND, LINE, 1.2, corner=8)
    drawn += text(title, x + 12, y + 24, 15, bold=True)
    drawn += text(notebook, x + width - 12, y + 24, 13, GREY, "end")
    drawn += group(picture, x + (width - PICTOGRAM[0]) / 2, y + 40)
    return drawn + paragraph(lines, x + 12, y + 174, 19, 13)


def draw_given(x: float, y: float, width: float, height: float) -> str:
    """Draw the field of what is given: an image of the reference with depth, and target views."""
    drawn = rect(x, y, width, height, _GROUND, LINE, 1.2, corner=8)
    drawn += text("Reference", x + 12, y + 24, 15, BLUE, bold=True)
    drawn += Photo(REFERENCE, 35, x + 12, y + 38, 104).draw(BLUE)
    drawn += Photo(REFERENCE, 35, x + 122, y + 86, 56).draw_depth()
    drawn += text("depth", x + 150, y + 78, 13, GREY, "middle")
    drawn += paragraph(("one image of an object,", "with depth"), x + 12, y + 164, 19, 13)
    y += 200
    drawn += curve(f"M{x + 12} {y + 2}h{width - 24}", LINE, 1.2)
    drawn += text("Target", x + 12, y + 28, 15, mix(ORANGE, INK, 0.68), bold=True)
    for i, azimuth in enumerate((110, 30, -50, 170)):
        row, column = divmod(i, 2)
        drawn += Photo(TARGET, azimuth, x + 12 + 86 * column, y + 38 + 75 * row, 68).draw(ORANGE)
    words = ("several images of another", "object, with depth and", "known cameras")
    return drawn + paragraph(words, x + 12, y + 201, 18, 13)


def draw_method() -> str:
    """Draw the whole method: what is given at the left, and the stages in two rows beside it."""
    left = 190  # width of what is given
    gap = 24
    panel, row = PANEL
    column = [MARGIN + left + gap + i * (panel + gap) for i in range(3)]
    below = MARGIN + row + 30
    stages = (
        ("Features", "01", ("A network describes each", "patch by a vector Φ."), draw_features()),
        (
            "Cycle",
            "02",
            ("Matches come first whose way", "*u* → *v* → *u*′ ends near *u*."),
            draw_cycle(),
        ),
        (
            "Best view",
            "03",
            ("The view is chosen whose", "matches score highest."),
            draw_best_view(),
        ),
        (
            "Depth",
            "04",
            ("Depth turns the patches *u*, *v*", "into the 3D points *x*, *y*."),
            draw_depth(),
        ),
        (
            "Umeyama, RANSAC",
            "04",
            ("Of many fits, the one with", "which most matches agree."),
            draw_fit(),
        ),
        ("Pose", "05", ("*y* = *λRx* + *t* lays the", "reference on the target."), draw_pose()),
    )
    drawn = ""
    for i, stage in enumerate(stages):
        drawn += draw_panel(column[i % 3], MARGIN if i < 3 else below, *stage)

    # Arrows between the fields of a row, from what is given, and from the first row to the second.
    for y in (MARGIN + 95, below + 95):
        for x in column[1:]:
            drawn += curve(f"M{x - gap + 3} {y}h{gap - 8}", INK, 2.2, head=True)
    drawn += curve(f"M{column[0] - gap + 3} {MARGIN + 95}h{gap - 8}", INK, 2.2, head=True)
    middle = below - 15
    corner = 8
    start = column[2] + panel / 2
    end = column[0] + panel / 2
    drawn += curve(
        f"M{start} {MARGIN + row + 3}V{middle - corner}q0 {corner} -{corner} "
        f"{corner}H{end + corner}"
        f"q-{corner} 0 -{corner} {corner}V{below - 5}",
        INK,
        2.2,
        head=True,
    )

    drawn += draw_given(MARGIN, MARGIN, left, below + row - MARGIN)
    return svg(
        drawn,
        WIDTH,
        below + row + MARGIN,
        "The method",
        "From one image of a reference object and several images of a target object, both with "
        "depth, to the pose: features of patches, cycles of nearest neighbours, choice of the best "
        "view, depth of the matched patches, a fit by Umeyama's method in RANSAC, and the pose "
        "that lays the reference on the target. The numbers are those of the notebooks.",
    )


# Where a notebook stands

BOX = (136, 98)  # width and height of a stage in the strip
BOX_GAP = 19.2  # between two stages, which makes the strip as wide as `WIDTH`
PILL = 28  # height of the sign of a notebook below the stages
# Below the stages: number and name of a notebook, its left end and its width.
AROUND = {
    "10": ("own objects", MARGIN, 136),
    "09": ("training", 183.2, 108),
    "11": ("hypotheses, whole category", 314, 250),
    "08": ("labels", 594, 86),
    "05": ("errors", 690, 88),
    "07": ("benchmark", 788, 138),
}
# The notebooks that a line leads to, by the stage that it begins at.
BELOW_STAGE = {
    "images": ["10"],
    "features": ["09"],
    "best view": ["11"],
    "pose": ["08", "05", "07"],
}
WHOLE = tuple(STAGES)
HERE: dict[str, tuple[str, ...]] = {
    "00": WHOLE,
    "01": ("features",),
    "02": ("cycle",),
    "03": ("best view",),
    "04": ("fit",),
    "06": WHOLE,
    **{number: (number,) for number in AROUND},
}


def draw_here(notebook: str) -> str:
    """Draw the strip of stages with those of a notebook highlighted."""
    here = HERE[notebook]
    on_stage = here[0] in STAGES
    top = 34 if on_stage else MARGIN  # room for the sign above or below
    below = top + BOX[1] + 20
    foot = below + PILL

    # The stages, with arrows between them.
    spans = {name: (MARGIN + i * (BOX[0] + BOX_GAP), BOX[0]) for i, name in enumerate(STAGES)}
    drawn = ""
    for name in STAGES:
        drawn += draw_stage(name, spans[name][0], top, name in here)

    # Lines from the stages to the notebooks around them, by way of a height between the two.
    line = top + BOX[1] + 10
    for stage, names in BELOW_STAGE.items():
        x, width = spans[stage]
        start = x + width / 2
        ends = [AROUND[name][1] + AROUND[name][2] / 2 for name in names]
        path = f"M{number(start)} {line - 8}V{line}"
        path += f"M{number(min([start, *ends]))} {line}H{number(max([start, *ends]))}"
        for end in ends:
            path += f"M{number(end)} {line}V{below}"
        drawn += curve(path, LINE, 1.4)
    for name, (title, x, width) in AROUND.items():
        spans[name] = (x, width)
        centre = x + width / 2
        label = f"{name} {title}"
        if name in here:
            drawn += rect(x, below, width, PILL, BLUE, BLUE, 1.2, PILL / 2)
            drawn += text(label, centre, below + 18.5, 13, "white", "middle", bold=True)
        else:
            drawn += rect(x, below, width, PILL, "white", LINE, 1.2, PILL / 2)
            drawn += text(label, centre, below + 18.5, 13, GREY, "middle")

    # The sign: a bracket over the whole method, a triangle above a stage or below a notebook.
    start = min(spans[name][0] for name in here)
    end = max(sum(spans[name]) for name in here)
    middle = (start + end) / 2
    highlighted = ", ".join((STAGES | AROUND)[name][0] for name in here)
    if here == WHOLE:
        highlighted = "the whole method"
        drawn += curve(f"M{start} 27v-5H{end}v5", BLUE, 2)
        drawn += text(f"you are here: {highlighted}", middle, 16, 13, BLUE, "middle", bold=True)
    elif on_stage:
        drawn += text("you are here", middle, 16, 13, BLUE, "middle", bold=True)
        drawn += polygon(np.array([[middle - 6, 21], [middle + 6, 21], [middle, 30]]), BLUE)
    else:
        drawn += polygon(
            np.array([[middle - 6, foot + 12], [middle + 6, foot + 12], [middle, foot + 3]]), BLUE
        )
        drawn += text("you are here", middle, foot + 27, 13, BLUE, "middle", bold=True)
    return svg(
        drawn,
        WIDTH,
        foot + (MARGIN if on_stage else 36),
        f"Where notebook {notebook} stands",
        "The stages of the method in a row: images, features, cycle, best view, depth and "
        f"RANSAC, pose. Highlighted: {highlighted}.",
    )


def draw_stage(name: str, x: float, y: float, on: bool) -> str:
    """Draw a stage of the strip, highlighted if it is `on`, with an arrow from the one before."""
    title, draw = STAGES[name]
    width, height = BOX
    scale = 0.58
    picture = group(draw(), x + (width - scale * PICTOGRAM[0]) / 2, y + 8, scale)
    if on:
        drawn = rect(x, y, width, height, mix(SKY, "white", 0.22), BLUE, 3, 8) + picture
    else:
        drawn = rect(x, y, width, height, "white", LINE, 1.2, 8)
        drawn += f'<g opacity="0.55">\n{picture}</g>\n'
    drawn += text(title, x + width / 2, y + height - 10, 13, INK if on else GREY, "middle", bold=on)
    if name != "images":
        start = f"M{number(x - BOX_GAP + 2)} {y + height / 2:g}"
        drawn += curve(f"{start}h{BOX_GAP - 6:g}", GREY, 2, head=True)
    return drawn


# Single ideas

WIDTH_OF_IDEAS = 860


def draw_vector(x: float, y: float, colour: str, shades: tuple[float, ...]) -> str:
    """Draw a vector as a row of cells."""
    side = 15
    drawn = ""
    for i, share in enumerate(shades):
        drawn += rect(x + i * side, y, side, side, mix(colour, "white", share), "white")
    return drawn


# Shades of the cells of vectors: the three vectors of one patch, and the values of four patches.
_SHADES = (
    (0.9, 0.35, 0.7, 0.2),
    (0.3, 0.8, 0.45, 0.95),
    (0.6, 0.25, 0.9, 0.5),
    (0.2, 0.6, 0.3, 0.8),
)


def draw_query_key_value() -> str:
    """Draw how a patch gets its three vectors, and what it receives from all patches."""
    height = 330
    drawn = text("One patch, three vectors", 20, 32, 15, bold=True)
    drawn += Photo(REFERENCE, 35, 20, 96, 112).draw(BLUE) + draw_grid(20, 96, 112, 4)
    drawn += rect(76, 124, 28, 28, "none", INK, 2.6)
    drawn += text("patch *i*", 76, 230, 13, anchor="middle")
    drawn += curve("M106 138H152", INK, 2, head=True)
    drawn += draw_vector(158, 130, GREY, (0.7, 0.3, 0.85, 0.5))
    drawn += text("token_{i}", 188, 118, 13, anchor="middle")
    rows = (
        (56, BLUE, "query_{i}", "what the patch looks for"),
        (138, VERMILLION, "key_{i}", "what the patch offers"),
        (220, GREEN, "value_{i}", "what the patch hands on"),
    )
    for (y, colour, title, meaning), shades in zip(rows, _SHADES):
        drawn += curve(f"M222 138L294 {y}", INK, 1.8, head=True)
        drawn += draw_vector(302, y - 8, colour, shades)
        drawn += text(title, 372, y - 3, 13, bold=True)
        drawn += text(meaning, 372, y + 15, 13, GREY)

    # The right half: a row for each patch, and below the rows their sum.
    x = 570
    drawn += curve(f"M{x - 24} 20V{height - 20}", LINE, 1.2)
    drawn += text("What patch *i* receives", x, 32, 15, bold=True)
    drawn += text("keys", x + 30, 62, 13, VERMILLION, "middle")
    drawn += text("weights", x + 128, 62, 13, GREY, "middle")
    drawn += text("values", x + 232, 62, 13, mix(GREEN, INK, 0.8), "middle")
    for i, weight in enumerate((0.55, 0.25, 0.15, 0.05)):
        y = 76 + 30 * i
        drawn += draw_vector(x, y, VERMILLION, _SHADES[i - 1])
        drawn += rect(x + 84, y, 88 * weight / 0.55, 15, GREY)  # 88 pixels: the largest weight
        drawn += draw_vector(x + 202, y, mix(GREEN, "white", 0.35 + weight), _SHADES[i])
    drawn += curve(f"M{x + 232} 196V222", INK, 2, head=True)
    drawn += draw_vector(x + 202, 230, GREEN, (0.55, 0.4, 0.65, 0.4))
    drawn += text("weighted sum", x + 190, 242, 13, anchor="end")
    drawn += text("weight_{ij} = softmax_{j} ( query_{i} · key_{j} / √*D* )", x, 282, 14)
    drawn += text("output_{i} = Σ_{j} weight_{ij} value_{j}", x, 310, 14)
    return svg(
        drawn,
        WIDTH_OF_IDEAS,
        height,
        "Query, key and value",
        "Three matrices turn the token of a patch i into its query, its key and its value. "
        "The query is compared with the keys of all patches. The softmax of these products gives "
        "weights, and patch i receives the weighted sum of the values.",
    )


def draw_cycles() -> str:
    """Draw a cycle that ends beside its start, and one that ends on another part."""
    height = 280
    size = 160

    def draw_pair(x: float, title: str) -> tuple[Photo, Photo, str]:
        """Draw both pictures below a title."""
        first = Photo(REFERENCE, 35, x, 50, size)
        second = Photo(TARGET, 30, x + 230, 50, size)
        drawn = text(title, x, 32, 15, bold=True)
        drawn += first.draw(BLUE) + draw_grid(x, 50, size, 12, thick=0.6)
        drawn += second.draw(ORANGE) + draw_grid(x + 230, 50, size, 12, thick=0.6)
        return first, second, drawn

    first, second, drawn = draw_pair(20, "A short cycle")
    u = first.place("front left")
    v = second.place("front left")
    end = u + [12, 16]
    drawn += curve(straight(u, end), GREEN, 3.5) + draw_walk(u, v, end, 6, 0.26)
    drawn += text("*v*", v[0] + 11, v[1] + 6, 16)
    drawn += text("*u*", u[0] + 2, u[1] - 11, 16)
    drawn += text("*u*′", end[0] - 4, end[1] + 24, 16)
    words = (
        "*v* is the nearest neighbour of *u*, *u*′ that of *v*.",
        "*u*′ is next to *u*: the match (*u*, *v*) ranks high.",
    )
    drawn += paragraph(words, 20, 236, 21, 14)
    drawn += curve(f"M430 20V{height - 20}", LINE, 1.2)

    first, second, pictures = draw_pair(450, "A long cycle")
    u = first.place("foot left")
    v = second.place("foot right")
    end = first.place("top right")
    drawn += pictures
    drawn += curve(straight(u, end), VERMILLION, 3.5) + draw_walk(u, v, end, 6, 0.26)
    drawn += text("*v*", v[0] + 11, v[1] + 6, 16)
    drawn += text("*u*", u[0] - 12, u[1] + 18, 16, anchor="end")
    drawn += text("*u*′", end[0] - 11, end[1] + 19, 16, anchor="end")
    words = (
        "The way back leads to another part.",
        "*d*(*u*, *u*′) is large: the match (*u*, *v*) ranks low.",
    )
    drawn += paragraph(words, 450, 236, 21, 14)
    return svg(
        drawn,
        WIDTH_OF_IDEAS,
        height,
        "The cycle",
        "Left: from a patch u of the reference an arrow leads to its nearest neighbour v in the "
        "target, a dashed arrow leads back to u', close to u, and the match ranks high. Right: "
        "the dashed arrow ends far from u, and the match ranks low.",
    )


def draw_axes(place: np.ndarray, turn: float, size: float = 30) -> str:
    """Draw the three axes of a frame."""
    drawn = ""
    for angle, colour in ((0, VERMILLION), (90, GREEN), (215, BLUE)):
        angle = np.radians(turn + angle)
        end = place + size * np.array([np.cos(angle), -np.sin(angle)])
        drawn += curve(straight(place, end), colour, 2.4, head=True)
    return drawn + dot(place, INK, 3)


def draw_camera(place: np.ndarray, colour: str, flip: int) -> str:
    """Draw a camera that looks to the right, or with `flip` -1 to the left."""
    x, y = place
    body = rect(x - 19, y - 13, 38, 26, colour, corner=4)
    lens = np.array([[x + 19 * flip, y], [x + 33 * flip, y - 11], [x + 33 * flip, y + 11]])
    return body + polygon(lens, colour)


def draw_frames() -> str:
    """Draw the chain of frames from the reference camera to that of the target view."""
    y = 118
    x = [80, 255, 430, 605, 780]
    names = (
        ("camera of the", "reference image *i*"),
        ("world of the", "reference, *a*"),
        ("frame of the", "category, 0"),
        ("world of the", "target, *b*"),
        ("camera of the", "target view *j*"),
    )
    steps = (
        ("(*T*^{cam}_{ai})^{−1}", "camera"),
        ("*T*_{0a}^{−1}", "label"),
        ("*T*_{0b}", "label"),
        ("*T*^{cam}_{bj}", "camera"),
    )
    drawn = text("From camera to camera, step by step", 20, 34, 15, bold=True)

    # The five frames, arrows between them, and their names.
    drawn += draw_camera(np.array([x[0], y]), BLUE, 1)
    drawn += draw_camera(np.array([x[4], y]), ORANGE, -1)
    for place, turn in ((x[1], 12), (x[2], 0), (x[3], -20)):
        drawn += draw_axes(np.array([place - 4, y + 10]), turn)
    for left, right, (step, kind) in zip(x[:-1], x[1:], steps):
        middle = (left + right) / 2
        drawn += curve(f"M{left + 48} {y}H{right - 48}", INK, 2.2, head=True)
        drawn += text(step, middle, y - 14, 15, anchor="middle")
        drawn += text(kind, middle, y + 22, 13, GREY, "middle")
    for place, lines in zip(x, names):
        drawn += paragraph(lines, place, y + 62, 18, 13, "middle")

    # The arrow from the first to the last, and its formula.
    foot = y + 98
    drawn += curve(
        f"M{x[0]} {foot}v12q0 10 10 10H{x[4] - 10}q10 0 10 -10V{foot + 4}", INK, 2.2, head=True
    )
    formula = "the pose: *T* = *T*^{cam}_{bj} *T*_{0b} *T*_{0a}^{−1} (*T*^{cam}_{ai})^{−1}"
    drawn += text(formula, WIDTH_OF_IDEAS / 2, foot + 48, 15, anchor="middle")
    return svg(
        drawn,
        WIDTH_OF_IDEAS,
        290,
        "The chain of frames",
        "Five frames in a row: the camera of the reference image, the world of the reference "
        "sequence, the frame of the category, the world of the target sequence, and the camera of "
        "the target view. Arrows between them are the known cameras and the labels; one arrow "
        "from the first to the last is the pose.",
    )


def _frame_of(chair: Chair) -> np.ndarray:
    """Return corners (10, 3) of a chair: feet, seat and top.

    Left and right alternate; those at the back come before those in front.
    """
    legs = [chair[f"leg {side}{end}"][0] for end in ("", " front") for side in ("left", "right")]
    feet = np.array(legs) * [1, 1, 0]
    _, _, seat_height = chair["seat"][0]
    (_, back_y, back_z), (_, _, back_height) = chair["back"]
    tops = feet[:2] * [1, 0, 0] + [0, back_y, back_z + back_height / 2]
    return np.vstack([feet, feet + [0, 0, seat_height], tops])


def best_matrix(x: np.ndarray, y: np.ndarray, proper: bool) -> np.ndarray:
    """Return the orthogonal matrix that lays centred points x (n, d) best on y.

    By Umeyama's method; a `proper` matrix is a rotation.
    """
    u, _, vt = np.linalg.svd(y.T @ x)
    signs = np.ones(len(u))
    if proper:
        signs[-1] = np.sign(np.linalg.det(u @ vt))
    return u * signs @ vt


def draw_mirror() -> str:
    """Draw the best orthogonal matrix and the best rotation for matches that confuse the left and
    the right."""
    height = 300
    panel = 280
    # Between the corners of `_frame_of`: legs, sides of the seat, sides of the back and its top.
    edges = [(0, 4), (1, 5), (2, 6), (3, 7), (4, 5), (5, 7), (7, 6), (6, 4), (4, 8), (5, 9), (8, 9)]
    x = _frame_of(REFERENCE)
    # Left corners have even and right ones odd indices: an index with its last bit flipped
    # exchanges them.
    y = x[np.arange(len(x)) ^ 1]
    centre = x.mean(0)

    # The matches of some corners, between two pictures.
    first = Photo(REFERENCE, 30, 14, 66, 126)
    second = Photo(REFERENCE, 30, 154, 66, 126)
    drawn = draw_title("The matches", 10, panel)
    drawn += first.draw(BLUE) + second.draw(ORANGE)
    drawn += draw_matches(first.project(x)[0], second.project(y)[0], [8, 9, 6, 7], GREY)
    words = ("They join the left of a chair", "with its right.")
    drawn += paragraph(words, 10 + panel / 2, 246, 20, 14, "middle")

    # Both fits, each over a picture. The index of a fit says whether the matrix is `proper`.
    fits = (
        (
            "The best matrix: det = −1",
            ("Every point is on its match, but left", "is right now. No motion does this."),
        ),
        (
            "The best rotation: det = +1",
            ("The fit is worse. It is a motion,", "and so it is the answer."),
        ),
    )
    for proper, (title, words) in enumerate(fits):
        left = 10 + panel * (proper + 1)
        photo = Photo(REFERENCE, 30, left + 52, 46, 176)
        moved = (x - centre) @ best_matrix(x - centre, y - centre, bool(proper)).T + centre
        places, _ = photo.project(moved)
        drawn += draw_title(title, left, panel) + photo.draw(ORANGE)
        for j, k in edges:
            drawn += curve(straight(places[j], places[k]), BLUE, 3)
        drawn += draw_matches(places, photo.project(y)[0], range(len(x)), VERMILLION)
        drawn += paragraph(words, left + panel / 2, 246, 20, 14, "middle")
        drawn += curve(f"M{left} 20V{height - 20}", LINE, 1.2)
    return svg(
        drawn,
        WIDTH_OF_IDEAS,
        height,
        "Mirror and rotation",
        "A chair whose matches confuse left and right. The best orthogonal matrix puts every "
        "point on its match, but it is a mirror, which no motion of the chair does. The best "
        "rotation leaves distances between the points, and is the answer.",
    )


def draw_title(title: str, left: float, width: float) -> str:
    """Draw the title of a panel."""
    return text(title, left + width / 2, 34, 15, anchor="middle", bold=True)


def draw_matches(points: np.ndarray, matches: np.ndarray, shown: Iterable[int], colour: str) -> str:
    """Draw the `shown` points (n, 2) and their matches (n, 2), with dashed lines between them."""
    drawn = ""
    for j in shown:
        if np.linalg.norm(matches[j] - points[j]) > 1:
            drawn += curve(straight(points[j], matches[j]), colour, 1.8, "3 3")
        drawn += dot(matches[j], ORANGE, 5) + dot(points[j], BLUE, 4)
    return drawn


def draw_three() -> str:
    """Draw three cases of the turns between three objects."""
    height = 356
    panel = 280
    size = 76
    third = _chair(1.1, 1, 0.7, 0.7, 0.1)
    chairs = ((REFERENCE, BLUE, (22, 66)), (TARGET, ORANGE, (182, 66)), (third, GREEN, (102, 190)))
    # Title, turns from a to b and from b to c, words. The third turn, from a to c, is 0.
    panels = (
        (
            "All right: it closes",
            (0, 0),
            ("0° + 0° = 0°: by way of *b* or", "directly, *c* stands the same."),
        ),
        ("One error: it does not", (0, 180), ("0° + 180° ≠ 0°: one of the three", "is wrong.")),
        (
            "Errors agree: it closes",
            (180, 180),
            ("180° + 180° = 0°: *b* is turned,", "only more objects can tell."),
        ),
    )
    drawn = ""
    for i, (title, (from_a, from_b), words) in enumerate(panels):
        x = 10 + panel * i
        drawn += draw_title(title, x, panel)
        if i:
            drawn += curve(f"M{x} 20V{height - 20}", LINE, 1.2)
        for chair, colour, (left, top) in chairs:
            # In the last panel the chair b stands the other way round.
            azimuth = 205 if i == 2 and chair is TARGET else 25
            drawn += Photo(chair, azimuth, x + left, top, size).draw(colour)
        centres = [np.add(corner, size / 2) + [x, 0] for _, _, corner in chairs]
        a, b, c = centres
        lines = ((a, b, from_a, (140, 90)), (b, c, from_b, (220, 182)), (a, c, 0, (54, 182)))
        for start, end, angle, (right, down) in lines:
            colour = VERMILLION if angle else INK
            drawn += curve(straight(start, end, 50), colour, 2.2, head=True)
            drawn += text(f"{angle}°", x + right, down, 14, colour, "middle", bold=True)
        drawn += text("*a*", x + 10, 106, 15)
        drawn += text("*b*", x + 262, 106, 15)
        drawn += text("*c*", x + 186, 232, 15)
        drawn += paragraph(words, x + panel / 2, 306, 20, 14, "middle")
    return svg(
        drawn,
        WIDTH_OF_IDEAS,
        height,
        "Cycles of three objects",
        "Three chairs a, b and c with arrows from a to b, b to c and a to c. If all turns are "
        "right, the way by b agrees with the direct one. If one is half a turn off, it does not. "
        "If both of b are off, it does again.",
    )


def draw_ransac() -> str:
    """Draw the inliers of a sample with wrong matches, of one without, and of the last fit."""
    panel = 280
    radius = 15  # threshold of inliers, in pixels
    random = np.random.default_rng(3)
    x = np.array(
        [
            [-70, -60],
            [-22, -66],
            [34, -58],
            [72, -30],
            [60, 22],
            [24, 62],
            [-28, 58],
            [-72, 20],
            [-20, 0],
            [18, -8],
        ],
        float,
    )
    # The matches are the points, turned by 12 degrees, with noise. Two are wrong and agree by
    # chance.
    y = x @ np.array([[0.96, -0.2], [0.2, 0.96]]).T + random.normal(0, 3.5, x.shape)
    y[[2, 6]] = [[74, 34], [-62, -22]]
    panels = (
        ("A sample with wrong matches", [2, 6, 8, 9], f" of {len(x)}: forgotten"),
        ("A sample of right matches", [0, 3, 5, 8], f" of {len(x)}: kept"),
        ("Fitted to all inliers", [], ": the result"),
    )
    drawn = ""
    inliers = np.array([], int)
    for i, (title, sample, words) in enumerate(panels):
        # The last fit has no sample: it uses the inliers of the fit before.
        fitted = sample or inliers
        centre = x[fitted].mean(0)
        goal = y[fitted].mean(0)
        matrix = best_matrix(x[fitted] - centre, y[fitted] - goal, proper=True)
        moved = (x - centre) @ matrix.T + goal
        inside = np.linalg.norm(moved - y, axis=1) < radius
        inliers = np.flatnonzero(inside)

        picture = ""
        for j, (point, match) in enumerate(zip(moved, y)):
            if inside[j]:
                picture += ring(match, GREEN, radius, 2.6)
            else:
                picture += ring(match, LINE, radius, 1.2)
                picture += curve(straight(point, match), VERMILLION, 2.4, "4 4")
            picture += dot(match, ORANGE, 5) + dot(point, BLUE, 5)
            if j in sample:
                picture += ring(point, INK, 8, 2)
        left = 10 + panel * i
        drawn += draw_title(title, left, panel)
        drawn += group(picture, left + panel / 2, 148)
        drawn += text(f"{len(inliers)} inliers{words}", left + panel / 2, 262, 14, anchor="middle")
        if i:
            drawn += curve(f"M{left} 20V270", LINE, 1.2)
    key = (
        (dot(np.array([20, 300]), BLUE, 5), "reference point, moved", 32),
        (dot(np.array([220, 300]), ORANGE, 5), "target point", 232),
        (ring(np.array([350, 300]), LINE, 9, 1.6), "threshold", 366),
        (ring(np.array([472, 300]), GREEN, 9, 2.6), "inlier", 488),
        (curve("M556 300h22", VERMILLION, 2.4, "4 4"), "outlier", 584),
        (ring(np.array([664, 300]), INK, 8, 2), "drawn in the sample", 678),
    )
    for mark, word, at in key:
        drawn += mark + text(word, at, 305, 13, GREY)
    return svg(
        drawn,
        WIDTH_OF_IDEAS,
        330,
        "RANSAC",
        "Three fits to the same matches, some of which are wrong. A sample with wrong matches has "
        "few inliers and is forgotten, a sample of right matches has many and is kept, and the "
        "last fit uses all of its inliers.",
    )


def draw_scan() -> str:
    """Draw the places of a phone around an object, from above and from the side."""
    radius = 82
    drawn = ""
    for x, title, turns in (
        (150, "once around: good", range(0, 360, 30)),
        (710, "an arc: one side", range(30, 151, 30)),
    ):
        middle = np.array([x, 166])
        drawn += ring(middle, LINE, radius, 1.4)
        drawn += rect(x - 20, 146, 40, 40, BLUE, corner=6)
        for turn in np.radians(turns):
            away = np.array([np.cos(turn), -np.sin(turn)])
            drawn += _phone(middle + radius * away, -away)
        drawn += text(title, x, 40, 15, anchor="middle", bold=True)
        drawn += text("from above", x, 60, 13, GREY, "middle")

    # From the side: the object stands on a table.
    x = 430
    table = 226
    turn = np.radians(30)
    object_at = np.array([x + 60, table - 20])
    camera_at = object_at + 150 * np.array([-np.cos(turn), -np.sin(turn)])
    drawn += curve(f"M{x - 120} {table}H{x + 120}", INK, 2)
    drawn += rect(x + 40, table - 40, 40, 40, BLUE, corner=6)
    drawn += curve(straight(camera_at, object_at, 24), GREY, 1.4, "5 4")
    drawn += _phone(camera_at, object_at - camera_at)
    drawn += text("looking down by 30°", x, 40, 15, anchor="middle", bold=True)
    drawn += text("from the side; ½ to 1 m away", x, 60, 13, GREY, "middle")
    return svg(
        drawn,
        WIDTH_OF_IDEAS,
        280,
        "How to scan an object",
        "A phone goes once around an object and looks down at it by 30 degrees; an arc shows "
        "one side only.",
    )


def _phone(place: np.ndarray, towards: np.ndarray) -> str:
    """Draw a phone that looks in a direction."""
    towards = towards / np.linalg.norm(towards)
    axes = np.stack([towards, (-towards[1], towards[0])])  # rows: forward, sideways
    view = place + np.array([(0, 0), (26, 12), (26, -12)]) @ axes
    body = place + np.array([(-4, -11), (4, -11), (4, 11), (-4, 11)]) @ axes
    return polygon(view, PALE, LINE) + polygon(body, ORANGE)


# The rooms of the library


def _types(names: Iterable[str]) -> list[str]:
    """Write the first two types among imported names in at most three lines of 11 letters, the
    width of a box."""
    lines = []
    types = [name for name in names if name[0].isupper() and not name.isupper()]
    for name in types[:2]:
        broken = [""]
        for word in re.findall("[A-Z][a-z0-9]*", name):
            if len(broken[-1] + word) > 11:
                broken.append("")
            broken[-1] += word
        if len(lines + broken) <= 3:
            lines += broken
    return lines


def draw_rooms() -> str:
    """Draw the rooms on a diagonal. What a room gives to another is at the right of the first and
    above the second."""
    # The step from a room to the next, and the size of a box, in pixels.
    across = 74
    down = 50
    wide = 68
    high = 40
    centre = {room: np.array([51 + across * i, 34 + down * i]) for i, room in enumerate(ROOMS)}

    # What is on top of the others comes last: lines, the names of types, and the rooms.
    wires = parcels = boxes = ""
    for (giver, taker), names in sorted(flows().items()):
        x = centre[taker][0]
        y = centre[giver][1]
        corner = np.array([x, y])
        path = straight(centre[giver], corner) + straight(corner, centre[taker])
        wires += curve(path, LINE, 1.2)
        wires += curve(f"M{x} {centre[taker][1] - high / 2 - 8:g}v7", GREY, 1.6, head=True)
        lines = _types(sorted(names, key=lambda name: (-names[name], name)))
        ground = rect(x - wide / 2, y - high / 2, wide, high, "white", LINE, 1, 3)
        parcels += ground if lines else dot(corner, GREY)
        top = y + 4 - 11 * (len(lines) - 1) / 2
        parcels += paragraph(lines, x, top, 11, 10, "middle")
    for room, (x, y) in centre.items():
        boxes += rect(x - wide / 2, y - high / 2, wide, high, mix(SKY, "white", 0.3), BLUE, 1.5, 5)
        boxes += text(room, x, y + 4, 12, anchor="middle", bold=True)
    words = [
        "A room gives what is at its right, and takes what is above it.",
        "Shown are the types that are imported most; a dot: functions or constants only.",
        "Nothing flows back: the half below the rooms is empty.",
        "",
    ]
    for room, modules in ROOMS.items():
        if room != modules:
            words.append(f"{room}: {modules.replace(' ', ', ')}")
    foot = down * len(ROOMS)
    top = foot - 18 * len(words)
    legend = text("The rooms of zsp_lite", 20, top - 8, 15, bold=True)
    legend += paragraph(words, 20, top + 18, 18, 13)
    return svg(
        wires + parcels + boxes + legend,
        102 + across * (len(ROOMS) - 1),
        foot + 18,
        "The rooms of the library",
        "The rooms on a diagonal, and the types that flow from each room to those after it, "
        "as the imports say.",
    )


DRAWINGS: dict[str, Callable[[], str]] = {
    "method": draw_method,
    "query_key_value": draw_query_key_value,
    "cycle": draw_cycles,
    "frames": draw_frames,
    "mirror": draw_mirror,
    "three": draw_three,
    "ransac": draw_ransac,
    "scan": draw_scan,
    **{f"here_{notebook}": partial(draw_here, notebook) for notebook in sorted(HERE)},
}


def main() -> None:
    """Write all drawings."""
    for name, draw in DRAWINGS.items():
        (FOLDER / f"{name}.svg").write_text(draw(), encoding="utf-8")
    ROOMS_FILE.write_text(draw_rooms(), encoding="utf-8")


if __name__ == "__main__":
    main()
