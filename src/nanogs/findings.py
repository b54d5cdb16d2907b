"""Notes about a model that can be merged from notes about its parts.

A streaming reader sees blocks of rows; its notes and those of writers about each block are merged
into one note about the model.
"""

import operator
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Self

from nanogs.formatting import counted


class Finding(str):
    """A sentence with a value in it that can be merged with the same sentence about another part.

    Attributes:
        template: The sentence, with a replacement field for the value; that of a number may hold
            the counted noun in singular and plural: "{:splat has|splats have} a negative scale."
        value: Value for this part of the model.
        merge: Function that combines the values of two parts.
    """

    __slots__ = ("merge", "template", "value")
    template: str
    value: Any
    merge: Callable[[Any, Any], Any]

    def __new__(
        cls,
        template: str,
        value: Any,  # noqa: ANN401 - whatever the template shows
        merge: Callable[[Any, Any], Any] = operator.add,
    ) -> Self:
        """Make a string of the formatted sentence, which is all that most callers use."""
        shown = _Count(value) if isinstance(value, int) else value
        text = super().__new__(cls, template.format(shown))
        text.template, text.value, text.merge = template, value, merge
        return text

    def __reduce__(self) -> tuple[type[str], tuple[str]]:
        """Pickle and copy as plain text: reports, which are copied, need no merging."""
        return str, (str(self),)


class _Count(int):
    """An integer that a format of the form `one|more` shows with the fitting noun."""

    __slots__ = ()

    def __format__(self, spec: str) -> str:
        one, bar, more = spec.partition("|")
        return counted(self, one, more) if bar else super().__format__(spec)


class Names(tuple[str, ...]):
    """Names in order of appearance, formatted with commas between them: `{:6}` is at most six."""

    __slots__ = ()

    def __format__(self, spec: str) -> str:
        return ", ".join(self[: int(spec)] if spec else self)

    def union(self, other: "Names") -> "Names":
        """Return the names of both, each once."""
        return Names(dict.fromkeys((*self, *other)))

    def intersection(self, other: "Names") -> "Names":
        """Return the names that are in both."""
        return Names(name for name in self if name in other)


def join_findings(parts: Iterable[Iterable[str]]) -> tuple[str, ...]:
    """Merge the sentences about parts into those about the whole, in order of first appearance.

    Args:
        parts: The sentences about each part; of equal plain texts one is kept. A finding without
            any names is left out.
    """
    found: dict[str, str] = {}
    for sentences in parts:
        for sentence in sentences:
            text = sentence
            if not isinstance(text, Finding):
                found[text] = text
                continue
            before = found.get(text.template)
            if isinstance(before, Finding):
                value = text.merge(before.value, text.value)
                text = Finding(text.template, value, text.merge)
            found[text.template] = text
    return tuple(text for text in found.values() if getattr(text, "value", None) != ())


_MERGES = {merge.__name__: merge for merge in (operator.add, min, Names.union, Names.intersection)}


def to_plain(sentence: str) -> str | dict[str, Any]:
    """Convert a sentence for JSON; a finding becomes a dictionary and can still be merged later."""
    if not isinstance(sentence, Finding) or sentence.merge.__name__ not in _MERGES:
        return str(sentence)
    return {
        "template": sentence.template,
        "value": sentence.value,
        "merge": sentence.merge.__name__,
    }


def of_plain(data: str | Mapping[str, Any]) -> str:
    """Restore a sentence from the result of `to_plain`."""
    if isinstance(data, str):
        return data
    value = data["value"]
    names = isinstance(value, Sequence)
    return Finding(data["template"], Names(value) if names else value, _MERGES[data["merge"]])


def became_infinite(name: str, count: int) -> Finding:
    """Make the note that `count` values of a column overflow float32."""
    quoted = repr(name).replace("{", "{{").replace("}", "}}")
    return Finding(
        f"{{:value|values}} of {quoted} became infinite when converted to float32.", count
    )


def negative_scales(count: int) -> list[str]:
    """Return a note if any splats have a negative scale, which has no logarithm; else none."""
    text = "{:splat has|splats have} a negative scale, which became NaN."
    return [Finding(text, count)] if count else []


def invalid_opacities(count: int) -> list[str]:
    """Return a note if any opacities are not from 0 to 1, which have no logit; else none."""
    text = "{:opacity is|opacities are} not from 0 to 1 and became NaN."
    return [Finding(text, count)] if count else []
