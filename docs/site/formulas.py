"""Sphinx extension of the course site: formulas as MathML, and the font that shows them.

MathML needs no script from the network, but a font with mathematical metrics: without one, brackets
do not grow and bars touch letters. The font is STIX Two Math of the package `ziamath`, cut down to
the characters of formulas.
"""

import io
import re
from functools import cache
from html import unescape
from pathlib import Path

import ziamath
from docutils import nodes
from fontTools.subset import Options, Subsetter, load_font, parse_unicodes, save_font
from latex2mathml.converter import convert
from sphinx.application import Sphinx
from sphinx.writers.html5 import HTML5Translator
from ziamath.styles import MathVariant, parse_variant, styledstr

# First and last code of the characters of formulas: Latin, accents, Greek, punctuation and
# invisible operators, letter-like symbols with arrows and operators, ceilings and floors, brackets,
# bold to script Latin, bold and italic Greek with bold digits.
CHARACTERS = (
    "20-FF, 300-36F, 391-3F6, 2010-2063, 2100-22FF, 2308-230B, 27E6-27EB, 1D400-1D503, 1D6A4-1D7FF"
)
FEATURES = [
    "ssty",  # forms of subscripts and superscripts
    "dtls",  # letters without a dot, below accents
    "flac",  # flat accents, above capitals
    "kern",  # distances between letters
    "mark",  # places of accents
]


@cache
def math_font() -> bytes:
    """Return the font of formulas in the format WOFF."""
    # All names of the font are kept, since the licence is one of them.
    options = Options(hinting=False, layout_features=FEATURES, name_IDs=["*"], flavor="woff")
    path = Path(ziamath.__file__).parent / "fonts" / "STIXTwoMath-Regular.ttf"
    font = load_font(str(path), options)
    subsetter = Subsetter(options)
    subsetter.populate(unicodes=parse_unicodes(CHARACTERS))
    subsetter.subset(font)
    file = io.BytesIO()
    save_font(font, file, options)
    return file.getvalue()


def mathml(latex: str, display: str = "inline") -> str:
    r"""Convert a formula, with four repairs of what latex2mathml makes.

    The names of `\operatorname` become text, with a space for `\,`. Bold and script letters become
    characters of their own, as browsers know no `mathvariant`. A minus after an equals sign is a
    sign, close to its term. The bars of a norm do not grow: as only the last of them has the
    exponent, they would become unequal.
    """
    latex = re.sub(
        r"\\operatorname\*?\{(.*?)\}",
        lambda match: rf"\text{{{match[1]}}}".replace(r"\,", " "),
        latex,
    )
    text = convert(latex, display=display)
    text = re.sub('<mi mathvariant="(bold|script|bold-italic)">(.*?)</mi>', _letter, text)
    text = re.sub("(<mo>&#x0003D;</mo>)<mo>(&#x02212;)", r'\1<mo form="prefix">\2', text)
    return text.replace("<mo>&#x02016;", '<mo stretchy="false">&#x02016;')


def _letter(element: re.Match[str]) -> str:
    """Replace an element <mi> with a style, such as bold, by one with the character of this
    style."""
    return f"<mi>{styledstr(unescape(element[2]), parse_variant(element[1], MathVariant()))}</mi>"


def visit_math(translator: HTML5Translator, node: nodes.math) -> None:
    """Write a formula within a line of text."""
    translator.body.append(mathml(node.astext()))
    raise nodes.SkipNode


def visit_displayed_math(translator: HTML5Translator, node: nodes.math_block) -> None:
    """Write a formula in a paragraph of its own."""
    translator.body.append(f'<div class="formula">{mathml(node.astext(), "block")}</div>')
    raise nodes.SkipNode


def write_font(app: Sphinx, error: Exception | None) -> None:
    """Write the font beside the pages (Sphinx's event `build-finished`)."""
    if not error and app.builder.format == "html":
        (app.outdir / "_static" / "math.woff").write_bytes(math_font())


def setup(app: Sphinx) -> None:
    """Register how formulas are written, and that their font is."""
    app.add_html_math_renderer("mathml", (visit_math, None), (visit_displayed_math, None))
    app.connect("build-finished", write_font)
