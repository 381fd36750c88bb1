"""Formulas in TeX, spelled out for docutils, and the MathML that it makes of them."""

import re

READ_DIFFERENTLY = (
    # It knows `\Bigl` and `\Bigr`, but not `\Big`.
    (r"\\([Bb]igg?)(?![a-zA-Z])", r"\\\1l"),
    # TeX takes one digit as an argument, docutils the whole number: `\frac12`, `x^12`.
    (r"(\\(?:[cdt]?frac|sqrt)|[\^_])\s*(\d)", r"\1{\2}"),
    (r"(\\[cdt]?frac(?:\{[^{}]*\}|\s*\\[a-zA-Z]+\s*|\s+[a-zA-Z]))\s*(\d)", r"\1{\2}"),
    # docutils sets the index of a letter with an accent below the letter.
    (
        r"(\\(?:(?:wide)?(?:hat|tilde)|d?dot|bar|vec|overline)"
        r"(?:\{[^{}]*\}|\s*\\[a-zA-Z]+|\s+[a-zA-Z]))(?=\s*_)",
        r"{\1{}}",
    ),
)
"""Formulas rewritten so that docutils reads them as TeX does."""


def spelled_out(formula: str) -> str:
    """A formula that docutils and TeX read alike."""
    for written, for_both in READ_DIFFERENTLY:
        formula = re.sub(written, for_both, formula)
    return formula


def tightened(mathml: str) -> str:
    """MathML in which the bars of `|x|` are no operators with space on both sides."""
    tight = r'<mo\1 lspace="0" rspace="0">\2</mo>'
    return re.sub(r"<mo([^>]*)>([|‖])</mo>", tight, mathml)
