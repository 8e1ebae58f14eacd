"""An extension of griffe, the program that reads docstrings for the reference pages of the site.

``mkdocs.yml`` names this file. Our dataclasses explain their fields in comments, and our types hold shapes as
strings; both are read from the source, so that nothing has to be imported.
"""

import re
from typing import Any, cast

import griffe

ROLE = re.compile(r":(?:class|func|meth|mod|data):`([^`]+)`")
# A piece of code, or else what Markdown would read as bold text (a power) or as a quotation (``>`` in front).
MISREAD = re.compile(r"(`+).+?\1|(?<=\w)\*\*(?=\w)|^>")
SHAPED = {"Float", "Int", "Bool", "UInt8", "Int64", "Shaped", "Num", "Real", "Complex"}


class Fields(griffe.Extension):
    """Show the fields of a dataclass as a table, with the comments beside them as their meaning."""

    def on_package(self, *, pkg: griffe.Module, **kwargs: Any) -> None:
        """Edit all objects of a package after it has been read."""
        edit(pkg)


def edit(parent: griffe.Module | griffe.Class) -> None:
    """Edit the docstrings and types of everything inside ``parent``."""
    for each in list(parent.members.values()):
        if each.is_alias:
            continue
        if each.docstring:
            each.docstring.value = as_markdown(each.docstring.value)
        if each.is_function:
            function = cast("griffe.Function", each)
            for annotation in [function.returns, *(value.annotation for value in function.parameters)]:
                quote_shapes(annotation)
        elif each.is_attribute:
            quote_shapes(cast("griffe.Attribute", each).annotation)
        elif each.is_class:
            edit(cast("griffe.Class", each))
            if "dataclass" in each.labels:
                tabulate_fields(cast("griffe.Class", each))
        elif each.is_module:
            edit(cast("griffe.Module", each))


def as_markdown(text: str) -> str:
    """Return a docstring or a comment with an escape wherever Markdown would misread it."""
    text = ROLE.sub(r"`\1`", text)
    return MISREAD.sub(lambda found: found[0] if found[1] else re.sub(".", r"\\\g<0>", found[0]), text)


def quote_shapes(annotation: Any) -> None:
    """Write the shapes of jaxtyping as strings again, because a one-letter shape was read as a name."""
    if not isinstance(annotation, griffe.Expr):
        return
    for each in annotation.iterate(flat=False):
        if each is not annotation:
            quote_shapes(each)
    if isinstance(annotation, griffe.ExprSubscript) and str(annotation.left) in SHAPED:
        array, shape = cast("griffe.ExprTuple", annotation.slice).elements
        text = str(shape).strip("\"'")
        annotation.slice = griffe.ExprTuple([array, f'"{text}"'], implicit=True)


def tabulate_fields(class_: griffe.Class) -> None:
    """Move the fields of a dataclass from its members into a table below its docstring.

    An ``__init__`` that griffe has made of the fields is left out.
    """
    init = class_.members.get("__init__")
    if init is None:
        return  # only a base is a dataclass
    init = cast("griffe.Function", init)
    if init.lineno == 0:
        class_.del_member("__init__")
    rows = []
    for parameter in init.parameters:
        field = class_.members.get(parameter.name)
        if field is None or not field.is_attribute:
            continue  # self, or a field of a base
        field = cast("griffe.Attribute", field)
        text = field.docstring.value if field.docstring else as_markdown(comment_of(field))
        about = {"description": text, "annotation": field.annotation}
        rows.append(griffe.DocstringParameter(parameter.name, value=parameter.default, **about))
        class_.del_member(parameter.name)
    if rows and class_.docstring:
        class_.docstring.parsed.append(section_of(rows))


def section_of(rows: list[griffe.DocstringParameter]) -> griffe.DocstringSection:
    """Return the table of the fields, with a column of defaults if a field has one."""
    if any(row.value is not None for row in rows):
        return griffe.DocstringSectionParameters(rows, title="Fields")
    attributes = [
        griffe.DocstringAttribute(row.name, description=row.description, annotation=row.annotation)
        for row in rows
    ]
    return griffe.DocstringSectionAttributes(attributes, title="Fields")


def comment_of(field: griffe.Attribute) -> str:
    """Return the comment that explains a field: at the end of its line, or else in the lines above."""
    lines = field.lines_collection[field.filepath]
    last = lines[(field.endlineno or field.lineno or 1) - 1]
    if "  # " in last:
        return last.split("  # ", 1)[1]
    above = []
    for line in reversed(lines[: (field.lineno or 1) - 1]):
        if not line.strip().startswith("# "):
            break
        above.append(line.strip().removeprefix("# "))
    return " ".join(reversed(above))
