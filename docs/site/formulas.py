"""Sphinx extension of the course site: formulas as MathML, and the font that shows them.

MathML needs no script from the network, but a font with mathematical metrics: without one, brackets
do not grow and bars touch letters. The font is STIX Two Math of the package `ziamath`, cut down to
the characters of formulas. Where the package is not installed, the reader's own fonts are used.
"""

import base64
import io
import re
import unicodedata
from functools import cache
from html import unescape
from importlib.util import find_spec
from pathlib import Path

from docutils import nodes
from fontTools.subset import Options, Subsetter
from fontTools.ttLib import TTFont
from latex2mathml.converter import convert
from sphinx.application import Sphinx
from sphinx.writers.html5 import HTML5Translator

# First and last code of the characters of formulas.
CHARACTERS = [
    (0x20, 0xFF),  # Latin
    (0x300, 0x36F),  # accents
    (0x391, 0x3F6),  # Greek
    (0x2010, 0x2063),  # punctuation and invisible operators
    (0x2100, 0x22FF),  # letter-like symbols, arrows and operators
    (0x2308, 0x230B),  # ceilings and floors
    (0x27E6, 0x27EB),  # brackets
    (0x1D400, 0x1D503),  # bold, italic and script Latin
    (0x1D6A4, 0x1D7FF),  # bold and italic Greek, bold digits
]


@cache
def math_font() -> bytes:
    """Return the font of formulas in the format WOFF, or nothing where ziamath is not installed."""
    package = find_spec("ziamath")
    if package is None:
        return b""
    font = TTFont(Path(package.origin).parent / "fonts" / "STIXTwoMath-Regular.ttf")
    features = [
        "ssty",  # forms of subscripts and superscripts
        "dtls",  # letters without a dot, below accents
        "flac",  # flat accents, above capitals
        "kern",  # distances between letters
        "mark",  # places of accents
    ]
    # All names of the font are kept, since the licence is one of them.
    subsetter = Subsetter(Options(hinting=False, layout_features=features, name_IDs=["*"]))
    codes = [code for first, last in CHARACTERS for code in range(first, last + 1)]
    subsetter.populate(unicodes=codes)
    subsetter.subset(font)
    font.flavor = "woff"
    file = io.BytesIO()
    font.save(file)
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
    style = element[1].upper().replace("-", " ")
    # LATIN CAPITAL LETTER R becomes MATHEMATICAL BOLD CAPITAL R.
    name = re.sub("LATIN |GREEK |LETTER ", "", unicodedata.name(unescape(element[2])))
    try:
        return f"<mi>{unicodedata.lookup(f'MATHEMATICAL {style} {name}')}</mi>"
    except KeyError:  # Older characters, such as SCRIPT CAPITAL R, lack the first word.
        return f"<mi>{unicodedata.lookup(f'{style} {name}')}</mi>"


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
    if not error and app.builder.format == "html" and math_font():
        (app.outdir / "_static" / "math.woff").write_bytes(math_font())


def pass_font(
    app: Sphinx, pagename: str, templatename: str, context: dict, doctree: nodes.document | None
) -> None:
    """Pass the font to the templates, which may embed it (`html-page-context`)."""
    context["math_font"] = base64.b64encode(math_font()).decode()


def setup(app: Sphinx) -> dict[str, bool]:
    """Register how formulas are written, and connect the functions to Sphinx's events."""
    app.add_html_math_renderer("mathml", (visit_math, None), (visit_displayed_math, None))
    app.connect("html-page-context", pass_font)
    app.connect("build-finished", write_font)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
