"""Sentences about a model that can be put together from those about its parts.

A reader that streams sees blocks of rows; what it or a writer says of each block becomes one
sentence about the model.
"""

import operator
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Self

from nanogs.formatting import counted


class Finding(str):
    """A sentence with a value in it, and how the values of two parts become one.

    Attributes:
        template: The sentence, with a replacement field for the value; that of a number may say
            what it counts: "{:splat has|splats have} a negative scale."
        value: Of the part that was looked at.
        merge: The value of two parts together.
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
        """The sentence as plain text, which is all that most callers look at."""
        shown = _Count(value) if isinstance(value, int) else value
        text = super().__new__(cls, template.format(shown))
        text.template, text.value, text.merge = template, value, merge
        return text

    def __reduce__(self) -> tuple[type[str], tuple[str]]:
        """A copy is plain text: reports are copied, and are about one whole."""
        return str, (str(self),)


class _Count(int):
    """A number that says what it counts, if its format is of the form `one|more`."""

    __slots__ = ()

    def __format__(self, spec: str) -> str:
        one, bar, more = spec.partition("|")
        return counted(self, one, more) if bar else super().__format__(spec)


class Names(tuple[str, ...]):
    """Names in the order met, shown with commas between."""

    __slots__ = ()

    def __format__(self, _spec: str) -> str:
        return ", ".join(self)

    def union(self, other: "Names") -> "Names":
        """The names of both, each once."""
        return Names(dict.fromkeys((*self, *other)))


def join_findings(parts: Iterable[Iterable[str]]) -> tuple[str, ...]:
    """The sentences about a whole from those about its parts, in the order they are first met.

    Args:
        parts: The sentences about each part; plain texts are kept once.
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
    return tuple(found.values())


_MERGES = {merge.__name__: merge for merge in (operator.add, min, Names.union)}


def to_plain(sentence: str) -> str | dict[str, Any]:
    """A sentence as JSON holds it; of a finding, what it takes to join it with others."""
    if not isinstance(sentence, Finding) or sentence.merge.__name__ not in _MERGES:
        return str(sentence)
    return {
        "template": sentence.template,
        "value": sentence.value,
        "merge": sentence.merge.__name__,
    }


def of_plain(data: str | Mapping[str, Any]) -> str:
    """A sentence from what `to_plain` made of it."""
    if isinstance(data, str):
        return data
    value = data["value"]
    names = isinstance(value, Sequence)
    return Finding(data["template"], Names(value) if names else value, _MERGES[data["merge"]])


def became_infinite(name: str, count: int) -> Finding:
    """The sentence on so many values of a column that are beyond single precision."""
    quoted = repr(name).replace("{", "{{").replace("}", "}}")
    return Finding(f"{{:value|values}} of {quoted} beyond float became infinite.", count)


def negative_scales(count: int) -> list[str]:
    """A sentence if so many splats of a file have a negative scale, which has no logarithm."""
    text = "{:splat has|splats have} a negative scale, which became NaN."
    return [Finding(text, count)] if count else []
