"""Decoding and encoding names and comments of files, which may be in any encoding.

They are decoded as UTF-8 with `surrogateescape`, so that bytes that are not UTF-8 are preserved.
"""

from nanogs.errors import OutputError
from nanogs.formatting import utf8

_LONGEST = 120  # characters of a reason


def decode(text: bytes) -> str:
    """Decode bytes to a text that `encode` converts back to the same bytes."""
    return text.decode("utf-8", "surrogateescape")


def encode(text: str) -> bytes:
    """Encode a text; the inverse of `decode`.

    Raises:
        OutputError: The text has lone surrogates that `decode` does not make.
    """
    try:
        return text.encode("utf-8", "surrogateescape")
    except UnicodeEncodeError:
        raise OutputError(f"The text {text[:40]!r} cannot be encoded; change it.") from None


def printable(text: str) -> str:
    """Convert a decoded text to one that can be printed: Latin-1 if its bytes are not UTF-8."""
    try:
        return as_utf8(text)
    except OutputError:  # a text that `decode` did not make
        return utf8(text).decode()


def as_utf8(text: str) -> str:
    """Convert a decoded text to one without lone surrogates: Latin-1 if its bytes are not UTF-8.

    Raises:
        OutputError: As for `encode`.
    """
    data = encode(text)
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError:
        return data.decode("latin-1")


def is_line(text: str) -> bool:
    """Whether a comment is one line, so that it can be read back from the header of a `.ply`."""
    return "\n" not in text and not text.endswith("\r")


def one_line(text: str, what: str = "comment") -> str:
    """Return a text that is one line; `what` it is stands in the message.

    Raises:
        OutputError: It holds a line break.
    """
    if not is_line(text):
        raise OutputError(f"The {what} {text[:40]!r} holds a line break; split it in two.")
    return text


def reason(error: Exception) -> str:
    """Return a library's error message, cut to `_LONGEST` characters: some quote pages of input."""
    text = printable(str(error))
    return (text if len(text) <= _LONGEST else f"{text[:_LONGEST]}…") or type(error).__name__


def is_utf8(text: str) -> bool:
    """Whether a text, such as one from JSON, can be encoded as UTF-8: it has no lone surrogates."""
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True
