"""A library that is installed, made to look as if it were not."""

import sys


def pretend_missing(monkeypatch, library, *modules):
    """Unloads a library and the modules that use it, and lets no import find it."""
    for name in {*sys.modules}:
        if name.startswith((library, *modules)):
            monkeypatch.delitem(sys.modules, name)
    monkeypatch.setattr(sys, "meta_path", [_Missing(library), *sys.meta_path])


class _Missing:
    """Says of a library what Python says of one that is not there."""

    def __init__(self, library):
        self.library = library

    def find_spec(self, name, path=None, target=None):
        if name == self.library:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
