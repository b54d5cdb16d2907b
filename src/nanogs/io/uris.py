"""References from one file to another, as glTF and 3D Tiles write them: to plain files nearby."""

from pathlib import Path
from urllib.parse import unquote

from nanogs.io.json_fields import is_plain, refused


def local_path(folder: Path, uri: object, where: str) -> Path:
    """The file that a relative URI names, in a folder or below it.

    Args:
        folder: Of the file that holds the reference.
        uri: The reference; what follows a `?` or `#` says nothing to a file system.
        where: The file and the field, for the message.

    Raises:
        FormatError: It is no text, or leads elsewhere: to another folder or another machine.
    """
    plain = uri.partition("#")[0].partition("?")[0] if isinstance(uri, str) else ""
    parts = [part for part in unquote(plain).split("/") if part != "."]
    if not parts or not all(map(is_plain, parts)):
        raise refused(where, "must name a file in the same folder or below it")
    return folder.joinpath(*parts)
