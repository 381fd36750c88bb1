"""Paragraphs and sentences of Markdown pages, without code, tables and headings."""

import json
import re

FENCE = re.compile(r"^ *(```+|~~~+|:::+).*?^ *\1 *$", re.M | re.S)
DISPLAY = re.compile(r"\$\$.*?\$\$|<!--.*?-->", re.S)
CODE = re.compile(r"(`+)(?!`).+?(?<!`)\1(?!`)|\$[^$\n]+\$", re.S)
LINK = re.compile(r"!?\[((?:[^\[\]]|\[[^\[\]]*\])*)\](?:\([^()\s]*\)|\[[^\]]*\])")
LEFT_OUT = re.compile(
    r"\s*(#|\||!\[|\[[^\]]+\]:|---+\s*$|===+\s*$|<|\([\w-]+\)=\s*$|Measured on:)"
)
ITEM = re.compile(r"^\s*([-*+]|\d+[.)])\s+")
END = re.compile(r"(?<=[.!?])[\"')*_]*\s+(?=[\"'(*_\[]*(?:[A-Z0-9`]|jaxrod))")


def blank(found):
    return "\n" * found[0].count("\n")


def paragraphs(page):
    """First lines and texts of paragraphs and list items; code becomes `` `x` ``."""
    page = DISPLAY.sub(blank, FENCE.sub(blank, page))
    start, text = 0, ""
    for number, line in enumerate([*page.split("\n"), ""], 1):
        out = not line.strip() or LEFT_OUT.match(line)
        if (out or ITEM.match(line)) and text:
            yield start, plain(text)
            text = ""
        if not out:
            start = start if text else number
            text += (ITEM.sub("", line) if not text else line) + "\n"


def plain(text):
    """The text with `` `x` `` for every code span and formula, and links as text."""
    text = LINK.sub(r"\1", CODE.sub("`x`", text))
    return re.sub(r"\s+", " ", text).strip()


def sentences(paragraph):
    return END.split(paragraph)


def length(sentence):
    """Number of words."""
    return len([word for word in sentence.split() if re.search(r"\w", word)])


def markdown(path):
    """Markdown of a page or of the cells of a notebook."""
    if path.suffix != ".ipynb":
        return path.read_text()
    cells = json.loads(path.read_text())["cells"]
    return "\n\n".join(
        "".join(cell["source"]) for cell in cells if cell["cell_type"] == "markdown"
    )
