"""For mkdocstrings: options in docstrings as lists in Markdown, where <DEFAULT> would be taken for a tag."""

import re
from typing import Any

import griffe

from petsc_fs.cli import manual


class Options(griffe.Extension):
    """Rewrites the sections "Options ...:"."""

    def on_instance(self, *, obj: griffe.Object, **_: Any) -> None:
        """After an object is made from its source."""
        if obj.docstring is not None:
            found = [re.sub(r"^(.*?): ", r"- `\1`: ", entry) for entry in manual.entries(obj.docstring.value)]
            text = "\n".join(["**Options**", "", *found, "", ""])
            obj.docstring.value = manual.SECTION.sub(lambda _: text, obj.docstring.value)
