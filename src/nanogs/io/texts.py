"""Names and comments of files, whatever their encoding.

They are decoded as UTF-8 with `surrogateescape`, so that those in any encoding keep their bytes.
"""

from nanogs.errors import OutputError
from nanogs.formatting import utf8

_LONGEST = 120  # characters of a reason


def decode(text: bytes) -> str:
    """Bytes as text that `encode` turns back into the same bytes."""
    return text.decode("utf-8", "surrogateescape")


def encode(text: str) -> bytes:
    """The inverse of `decode`.

    Raises:
        OutputError: The text is neither decoded nor such as can be encoded.
    """
    try:
        return text.encode("utf-8", "surrogateescape")
    except UnicodeEncodeError:
        raise OutputError(f"The text {text[:40]!r} cannot be encoded; change it.") from None


def printable(text: str) -> str:
    """Decoded text that any terminal can be given: Latin-1 where it is not UTF-8."""
    try:
        return as_utf8(text)
    except OutputError:  # of no file
        return utf8(text).decode()


def as_utf8(text: str) -> str:
    """Decoded text without lone surrogates: Latin-1 where it is not UTF-8.

    Raises:
        OutputError: As for `encode`.
    """
    data = encode(text)
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError:
        return data.decode("latin-1")


def reason(error: Exception) -> str:
    """The words of a library on damage, for a sentence: some quote pages of what they found."""
    text = printable(str(error))
    return (text if len(text) <= _LONGEST else f"{text[:_LONGEST]}…") or type(error).__name__


def is_utf8(text: str) -> bool:
    """Whether a text that JSON holds is one, and has no lone surrogates."""
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True
